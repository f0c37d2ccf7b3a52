"""Does a region of 90 % hold 90 %? How far regions must be widened, and what draws are worth beside a ball of one size.

Every person counts the same, however many joints and frames were hidden: means are over a person's places, then over
people. Regions are widened by split-conformal prediction for numbers that come by person: were a new person like those
asked before, a place of theirs would be held with at least the probability of the level.

Source: Lee, Barber and Willett 2023 (distribution-free inference with hierarchical data); Gneiting and Raftery 2007
(energy score, logarithmic score).
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import product

import torch
from torch import Tensor

from motionlab.metrics import interval
from studies.nb09_posterior.hidden_people import Clip

LEVELS = (0.5, 0.8, 0.9)
FLOORS = (0.02, 0.05, 0.08, 0.12, 0.16)
NORMAL = dict(zip(LEVELS, (1.538, 2.154, 2.500), strict=True))  # deviations of a Gaussian in three dimensions
CM = 100.0
Asked = Mapping[str, Sequence[Clip]]  # clips of people, by who they are
Draw = Callable[[Clip], Tensor]  # from a clip to draws (K, M, 3)
Score = Callable[[Tensor, Clip], Tensor]  # from those and the clip to a number for each place, or one
Seeds = Callable[[str], torch.Generator]


def gaussian(clip: Clip, heat: float, floor: float) -> tuple[Tensor, Tensor]:
    """Means (M, 3) of a clip's draws, and factors (M, 3, 3) of their covariance with a floor, metres."""
    draws = clip.drawn[heat]
    off = draws - draws.mean(0)
    cov = torch.einsum("kma,kmb->mab", off, off) / (len(off) - 1) + floor**2 * torch.eye(3)
    return draws.mean(0), torch.linalg.cholesky(cov)


def deviations(clip: Clip, heat: float, floor: float) -> tuple[Tensor, Tensor]:
    """How many deviations (M,) the truth is off, and -log of the density there (M,), nats but for a constant."""
    mean, factor = gaussian(clip, heat, floor)
    white = torch.linalg.solve_triangular(factor, (clip.truth - mean)[..., None], upper=False)[..., 0]
    return white.norm(dim=-1), 0.5 * white.square().sum(-1) + factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def by_person(clips: Sequence[Clip], of: Callable[[Clip], Tensor]) -> Tensor:
    """The mean (P,) over each person's places of some number of them."""
    names = list(dict.fromkeys(c.person for c in clips))
    return torch.stack([torch.cat([of(c).flatten() for c in clips if c.person == n]).double().mean() for n in names])


def chosen(clips: Sequence[Clip]) -> tuple[float, float]:
    """The temperature and the floor under which the truth of these people is likeliest."""
    pairs = product(clips[0].drawn, FLOORS)
    return min(pairs, key=lambda pair: by_person(clips, lambda c: deviations(c, *pair)[1]).mean().item())


def radius(clips: Sequence[Clip], heat: float, floor: float, level: float) -> float:
    """How many deviations wide a region of a level must be, from these people; the widest asked for where they are too
    few to promise it."""
    names = list(dict.fromkeys(c.person for c in clips))
    off, weight = [], []
    for name in names:
        mine = torch.cat([deviations(c, heat, floor)[0] for c in clips if c.person == name])
        off.append(mine), weight.append(torch.full_like(mine, 1 / (len(mine) * (len(names) + 1))))
    off, order = torch.cat(off).sort()
    reached = torch.cat(weight)[order].cumsum(0) >= level - 1e-6
    return off[reached.int().argmax()].item() if reached.any() else off[-1].item()


def held(clips: Sequence[Clip], heat: float, floor: float, wide: float) -> Tensor:
    """Share (P,) of each person's hidden places inside regions so many deviations wide."""
    return by_person(clips, lambda c: (deviations(c, heat, floor)[0] <= wide).double())


def energy_score(draws: Tensor, truth: Tensor) -> Tensor:
    """Energy score (M,) of draws (K, M, 3), cm: their mean error less half of their mean distance from each other."""
    error, places = (draws - truth).norm(dim=-1).mean(0), draws.transpose(0, 1)
    apart = torch.cdist(places, places).sum((1, 2)) / max(len(draws) * (len(draws) - 1), 1)
    return CM * (error - apart / 2)


def ball(clip: Clip, size: float, count: int = 32) -> Tensor:
    """Draws (K, M, 3) from a ball around the fit that knows nothing of the clip: N(0, size^2) along each axis."""
    noise = torch.randn(count, *clip.fit.shape, generator=torch.Generator().manual_seed(0))
    return clip.fit + size * noise


def ball_size(clips: Sequence[Clip]) -> float:
    """The ball whose energy score is best on these people, metres."""
    sizes = torch.arange(0.01, 0.3, 0.01).tolist()
    return min(sizes, key=lambda s: by_person(clips, lambda c: energy_score(ball(c, s), c.truth)).mean().item())


def follows(clips: Sequence[Clip], heat: float, generator: torch.Generator) -> dict[str, tuple[float, float, float]]:
    """Rank correlation of spread with error, 95 % interval over people: of clips, and of a clip's joints and frames."""

    def spread(c: Clip) -> Tensor:
        return c.drawn[heat].var(0).sum(-1).sqrt()

    pairs = torch.tensor([[spread(c).mean(), c.error.mean()] for c in clips])
    names = list(dict.fromkeys(c.person for c in clips))
    rows = [torch.tensor([k for k, c in enumerate(clips) if c.person == name]) for name in names]
    picks = torch.randint(len(names), (1000, len(names)), generator=generator).tolist()
    again = torch.stack([ranked(*pairs[torch.cat([rows[p] for p in pick])].mT) for pick in picks])
    low, high = again.nanquantile(torch.tensor([0.025, 0.975])).tolist()
    within = by_person(clips, lambda c: ranked(spread(c), c.error))
    between = (ranked(*pairs.mT).item(), low, high)
    return {"between clips": between, "within a clip": interval(within, "mean", generator)}


def ranked(x: Tensor, y: Tensor) -> Tensor:
    """Rank correlation of x and y (N,); equal numbers share their rank."""
    ranks = [(a[:, None] > a).float().sum(1) + 0.5 * (a[:, None] == a).float().sum(1) for a in (x, y)]
    return torch.stack(ranks).corrcoef()[0, 1]


def ways(size: float, heat: float, floor: float) -> dict[str, Draw]:
    """Returns who draws places (K, M, 3) of a clip, by name."""

    def regions(clip: Clip) -> Tensor:  # from the Gaussian of its draws, with a floor
        mean, factor = gaussian(clip, heat, floor)
        noise = torch.randn(32, *mean.shape, 1, generator=torch.Generator().manual_seed(0))
        return mean + (factor @ noise)[..., 0]

    return {
        "the fit alone": lambda c: c.fit[None],
        "a ball of one size": lambda c: ball(c, size),
        "draws at T = 1": lambda c: c.drawn[1.0],
        f"draws at T = {heat:g}": lambda c: c.drawn[heat],
        "regions of the tool": regions,
        "chapter 4's draws": lambda c: c.rival,
    }


def best_of(draws: Tensor, clip: Clip) -> Tensor:
    """The error of the nearest of 16 draws of a whole clip over that of the fit, a share (1,)."""
    return ((draws[:16] - clip.truth).norm(dim=-1).mean(-1).min() / clip.error.mean())[None]


def rows(asked, held_, kinds, generator: Seeds) -> list[dict]:
    """Makes a row per source and kind of region: what was held at each level, and how wide the regions are."""
    table = []
    for people, clips in asked.items():
        for kind, (heat, floor, radii) in kinds.items():
            row = {"regions": kind, "people": f"{people}, n = {len(held_[people][kind][0.5])}"}
            for level, shares in held_[people][kind].items():
                row[f"of {100 * level:.0f} % hold, %"] = said(100 * shares, generator(f"{people} {kind} {level}"))
            axes = lambda c, how=(heat, floor): gaussian(c, *how)[1].square().sum((-1, -2)).div(3).sqrt()  # noqa: E731
            row["half-width at 90 %, cm"] = f"{(CM * radii[0.9] * by_person(clips, axes)).mean():.1f}"
            table.append(row)
    return table


def score_rows(scores, nearest, generator: Seeds) -> list[dict]:
    """Makes a row per source and way of drawing: energy score, that less the ball's, the nearest of 16 draws."""
    table = []
    for people, by in scores.items():
        for way, x in by.items():
            best = said(100 * nearest[people][way], generator(f"{people} {way} best"))
            table.append({
                "people": f"{people}, n = {len(x)}", "draws": way, "energy score, cm": f"{x.mean():.2f}",
                "less the ball's, cm": said(x - by["a ball of one size"], generator(f"{people} {way} less"), "+.2f"),
                "nearest of 16, % of the fit's error": best * ("draws" in way),
            })  # fmt: skip
    return table


def compared(asked: Asked, ways_: Mapping[str, Draw], of: Score) -> dict[str, dict[str, Tensor]]:
    """Computes by source and way of drawing a number of the draws, by person (P,)."""
    return {
        people: {way: by_person(clips, lambda c, draw=draw: of(draw(c), c)) for way, draw in ways_.items()}
        for people, clips in asked.items()
    }


def promised(asked: Asked, kinds: Mapping[str, tuple]) -> dict[str, dict[str, dict[float, Tensor]]]:
    """Computes by source, kind of region and level the share (P,) of each person's places that were held. kinds: by
    name temperature, floor, and by level how many deviations."""
    return {
        people: {name: {x: held(clips, t, f, wide[x]) for x in LEVELS} for name, (t, f, wide) in kinds.items()}
        for people, clips in asked.items()
    }


def said(x: Tensor, generator: torch.Generator, form: str = ".0f") -> str:
    """Returns the mean of numbers (P,) and its 95 % interval as text."""
    return f"{{:{form}}} [{{:{form}}}, {{:{form}}}]".format(*interval(x, "mean", generator))


def spoken(found: Mapping[str, Tensor], generator: Seeds, unit: str) -> str:
    """Returns means with their 95 % intervals, by name, as one line."""
    return "; ".join(f"{name}: {said(x, generator(name))}{unit}" for name, x in found.items())


def who_rows(asked: Asked) -> list[dict]:
    """Makes a row per source: who was asked, and how far off the fits are."""
    return [
        {
            "people": f"{people}, n = {len({c.person for c in clips})}", "clips": len(clips),
            "of these doubted by the fit itself": sum(c.doubtful for c in clips),
            "error of hidden limbs, cm": CM * by_person(clips, lambda c: c.error).mean().item(),
            "of limbs that were seen": CM * torch.tensor([c.seen for c in clips]).nanmean().item(),
        }
        for people, clips in asked.items()
    ]  # fmt: skip


def follow_rows(asked: Asked, heat: float, generator: Seeds) -> list[dict]:
    """Makes a row per source: how well the spread of the draws follows the error."""
    return [
        {"people": people}
        | {what: "{:.2f} [{:.2f}, {:.2f}]".format(*x) for what, x in follows(clips, heat, generator(people)).items()}
        for people, clips in asked.items()
    ]


def listed(radii: Mapping[float, float]) -> str:
    """Returns radii by level as one line."""
    return ", ".join(f"{wide:.2f} at {100 * level:.0f} %" for level, wide in radii.items())
