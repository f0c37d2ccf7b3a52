"""What notebook 09 shows of many clips' posteriors, as rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.posterior import Posterior
from studies.nb09_posterior import agreement, calibration, trials
from studies.nb09_posterior.legs import Open
from studies.nb09_posterior.trials import CM, Draws, Placed

_NORMAL_90 = 1.645  # standard deviations to either side that hold 90 % of a Gaussian


def quartiles(values: Tensor | Sequence[float], digits: int = 2) -> str:
    """ "median (quartile to quartile)"; values that are not finite are left out."""
    values = torch.as_tensor(values).double().flatten()
    values = values[values.isfinite()]
    if not len(values):
        return "none"
    low, middle, high = values.quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


# ------------------------------------------------------------------------------------------------- distance
def depth_rows(place: Mapping[str, Sequence[Placed]]) -> list[dict[str, object]]:
    """A row per state of knowledge: how wide the posteriors of the clips are, and how many hold their truth."""
    rows = []
    for name, each in place.items():
        draws = [p.chain.draws() for p in each]
        ranks = torch.stack([calibration.ranks(d, p.truth) for d, p in zip(draws, each, strict=True)])
        inside = ((ranks > 0.05) & (ranks < 0.95)).double().sum(0).long().tolist()
        spread = 100 * torch.stack([d.std(0) for d in draws]).mean(0)
        gauss = 100 * torch.stack([p.factor.norm(dim=1) for p in each]).mean(0)
        ridge = torch.stack([d.mT.corrcoef()[0, 1] for d in draws]).median()
        rows.append(
            {
                "known": name,
                "s.d. of distance, %": spread[1].item(),
                "by Laplace": gauss[1].item(),
                "correlation with size": f"{ridge:.4f}",
                "s.d. of size, %": spread[0].item(),
                "truth in the central 90 %: distance": f"{inside[1]} of {len(each)}",
                "size": f"{inside[0]} of {len(each)}",
                "longest autocorrelation time": max(p.chain.times.max().item() for p in each),
                "worst R-hat of ensembles": agreed([(p.chain, *p.again) for p in each]),
            }
        )
    return rows


def agreed(clips: Sequence[Sequence[Posterior]]) -> str:
    """The largest R-hat of any clip and number between the clip's independent ensembles."""
    several = [agreement.worst(each) for each in clips if len(each) > 1]
    return f"{max(several):.4f}" if several else "-"


def agreement_rows(found: Mapping[str, Sequence[Sequence[Posterior]]]) -> list[dict[str, object]]:
    """A row per posterior, from the ensembles of each clip, one or several: what a chain knows of itself (its
    autocorrelation time, R-hat of its own walkers) beside what only another can tell."""
    rows = []
    for name, clips in found.items():
        several = [agreement.worst(each) for each in clips if len(each) > 1]
        rows.append(
            {
                "posterior": name,
                "longest autocorrelation time, steps": quartiles([each[0].times.max() for each in clips], 1),
                "R-hat of a chain's own walkers": quartiles([agreement.of_walkers(each[0]) for each in clips], 3),
                "R-hat of independent ensembles": quartiles(several, 3),
                "worst": agreed(clips),
                f"at most {agreement.AGREED}": f"{sum(r <= agreement.AGREED for r in several)} of {len(several)} clips",
            }
        )
    return rows


def half_widths(each: Sequence[Placed], away: Tensor) -> dict[str, Tensor]:
    """Half of the 90 % of the distance in cm (C,), from emcee and from Laplace; away (C,): metres."""
    emcee = torch.stack([p.chain.draws()[:, 1].std() for p in each])
    gauss = torch.stack([p.factor[1].norm() for p in each])
    return {"emcee": CM * _NORMAL_90 * emcee * away, "Laplace": CM * _NORMAL_90 * gauss * away}


# ------------------------------------------------------------------------------------------------- legs
def subspace_rows(clips: Sequence[Open], exact: Sequence[Tensor], error: Tensor) -> list[dict[str, str]]:
    """What the directions hold of what the energy leaves open, and of what the fits get wrong; error (C,): cm."""
    explained = []
    for clip, c, e in zip(clips, exact, error.tolist(), strict=True):
        square = (c * clip.directions.spread).square().sum()
        explained.append(float(square / ((e / CM) ** 2 * clip.point.hidden.sum())))
    found = {
        "unknowns of a clip in the basis": quartiles([c.point.size for c in clips], 0),
        "s.d. of a joint in the four directions, by the energy, cm": quartiles([CM * c.width() for c in clips]),
        "share of the energy's own variance in them, %": quartiles([100 * c.directions.share for c in clips], 0),
        "error of the fit, root mean square, cm": quartiles(error),
        "share of that error's square in them, %": quartiles([100 * x for x in explained], 0),
    }
    return [{"of the hidden legs about the pelvis": k, "median (quartiles)": v} for k, v in found.items()]


def errors(clips: Sequence[Open], truths: Sequence[Tensor]) -> Tensor:
    """Root mean square error of the hidden legs about the pelvis at each clip's centre, cm (C,)."""
    found = []
    for clip, truth in zip(clips, truths, strict=True):
        away = truth - clip.roll(torch.zeros(1, clip.size))[0][0]
        found.append(CM * away[clip.point.hidden].square().sum(-1).mean().sqrt())
    return torch.stack(found)


class Judged(NamedTuple):
    """One kind of posterior over all clips whose chains were long enough: their indices, u (C,), ranks (C, k), and the
    mean s.d. of a hidden joint in cm."""

    clips: list[int]
    levels: Tensor
    ranks: Tensor
    width: float


def judged(clips: Sequence[Open], found: Sequence[Draws | None], exact: Sequence[Tensor]) -> Judged | None:
    """The truth among the draws, clip by clip; None where no chain is left."""
    kept = [i for i, draws in enumerate(found) if draws is not None]
    if not kept:
        return None
    widths = []
    for i in kept:
        moved = found[i].coordinates.var(0) * clips[i].directions.spread.square()
        widths.append(CM * (moved.sum() / clips[i].point.hidden.sum()).sqrt())
    return Judged(
        kept,
        torch.tensor([calibration.level_of(found[i].coordinates, exact[i]) for i in kept]),
        torch.stack([calibration.ranks(found[i].coordinates, exact[i]) for i in kept]),
        float(torch.stack(widths).mean()),
    )


def held(judged: Judged | None, generator: torch.Generator, level: float = 0.9) -> str:
    """Coverage at one level with Wilson's interval."""
    if judged is None:
        return "refused"
    (row,) = calibration.coverage(judged.levels, generator, (level,))
    return f"{100 * row['share']:.0f} % [{100 * row['low']:.0f}, {100 * row['high']:.0f}], n = {row['n']}"


def coverage_rows(
    posteriors: Mapping[str, Judged], generator: torch.Generator, temperatures: Mapping[str, Tensor]
) -> list[dict[str, object]]:
    """A row per posterior: its clips' temperatures (C,), 1 unless given, coverage at each level, and how wide it is."""
    rows = []
    for name, found in posteriors.items():
        said = {
            f"{100 * r['level']:g} % holds": f"{100 * r['share']:.0f} % [{100 * r['low']:.0f}, {100 * r['high']:.0f}]"
            for r in calibration.coverage(found.levels, generator)
        }
        heat = temperatures.get(name, torch.ones(max(found.clips) + 1))[found.clips]
        warm = {"temperature": " to ".join(dict.fromkeys(f"{t:.0f}" for t in (heat.min(), heat.max())))}
        rows.append({"posterior": name} | warm | {"n": len(found.clips)} | said | {"s.d. of a joint, cm": found.width})
    return rows


def ball_rows(balls: Mapping[str, tuple[Tensor, Tensor]], error: Tensor) -> list[dict[str, object]]:
    """A row per kind of ball, from its shares (C,) and radii (C,): how many true places it holds, and how large it is.

    The last column says whether clips with a larger error (C,) get a larger ball.
    """
    rows = []
    for name, (share, radius) in balls.items():
        follows = "-"
        if len(radius) == len(error) > 2 and radius.std() > 1e-6:
            follows = f"{torch.stack((radius.double(), error.double())).corrcoef()[0, 1]:.2f}"
        rows.append(
            {
                "ball": name,
                "n": len(share),
                "true places inside, %": 100 * share.double().mean().item(),
                "clips from .. to, %": f"{100 * share.min():.0f} to {100 * share.max():.0f}",
                "clips with 80 % or more": int((share >= 0.8).sum()),
                "radius, cm": radius.double().mean().item(),
                "radius with error, correlation": follows,
            }
        )
    return rows


def ball(
    clips: Sequence[Open],
    found: Sequence[Draws | None],
    truths: Sequence[Tensor],
    *,
    rest: torch.Generator | None = None,
    temperatures: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Shares and radii (C,) of the clips that have draws; with the scatter of the other directions where ``rest``."""
    kept = [i for i, draws in enumerate(found) if draws is not None]
    draws = [found[i] for i in kept]
    if rest is not None:
        heat = torch.ones(len(found)) if temperatures is None else temperatures
        draws = [trials.spread_out(found[i], clips[i], rest, float(heat[i])) for i in kept]
    return trials.joint_shares([clips[i] for i in kept], draws, [truths[i] for i in kept])
