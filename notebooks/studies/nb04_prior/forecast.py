"""How well two seconds of a person's future can be told from one state: the prior's mean beside ridge regression.

    PYTHONPATH=notebooks python -m studies.nb04_prior.forecast FOLDER [--prior real]

Ridge regression maps a state, which is all that the prior sees, straight to the joints two seconds later. It learns
from the people who train, its width is chosen on the people who choose, and both are measured on the people of the
report, each person counting alike.
"""

import argparse
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from motionlab import corpus, splits
from motionlab.humor import pretrained, quality
from motionlab.humor.state import heading, localise, unpack
from motionlab.metrics.intervals import interval, paired
from motionlab.training import model_card
from motionlab.training.examples import live_examples

DRAWS, BATCH = 16_000, 400  # windows to learn from; drawn at once
AHEAD, WIDTHS = 60, (1e1, 1e2, 1e3, 1e4)  # frames; ridges


def task(states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Features (N, 340) of first states, joints (N, 66) then and ``AHEAD`` frames later, all in the first frame."""
    frame = heading(states[:, 0])
    now, later = localise(states[:, 0], frame), localise(states[:, AHEAD], frame)
    joints = [unpack(x)["joints"].flatten(1).double() for x in (now, later)]
    return torch.cat((now, torch.ones(len(now), 1)), 1).double(), *joints


def ridges(takes: Sequence[corpus.Take], generator: torch.Generator) -> dict[float, Callable[[Tensor], Tensor]]:
    """Ridge regressions of each width, that say joints from windows of states."""
    data = live_examples([t.motion for t in takes], AHEAD + 2, [t.missing for t in takes])
    drawn = [task(data.draw(BATCH, generator)[0]) for _ in range(DRAWS // BATCH)]
    x, now, later = (torch.cat(each) for each in zip(*drawn, strict=True))
    scale = x.std(0).clamp_min(1e-3)
    scale[-1] = 1.0
    x = x / scale
    both, moved = x.T @ x, x.T @ (later - now)
    found = {}
    for width in WIDTHS:
        weights = torch.linalg.solve(both + width * torch.eye(len(both), dtype=both.dtype), moved) / scale[:, None]
        found[width] = lambda states, weights=weights: (at := task(states))[0] @ weights + at[1]
    return found


def left(said: Tensor, states: Tensor) -> float:
    """Mean distance of joints (N, 66) from the true ones, cm."""
    return float(100 * (said - task(states)[2]).unflatten(-1, (-1, 3)).norm(dim=-1).mean())


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("--prior", default="real")
    options = parser.parse_args()
    takes, generator = corpus.assemble(options.folder, splits.real_sources(options.folder)), torch.Generator()
    fitted = ridges(takes.part("train"), generator.manual_seed(0))
    model = pretrained.load_motion_prior(f"humor_{options.prior}")
    choose, report = (model_card.person_states(takes.part(part)) for part in ("choose", "report"))
    width = min(WIDTHS, key=lambda w: sum(left(fitted[w](x), x) for x, _ in choose.values()))
    print(f"width {width:g}")
    for part, people in (("choose", choose), ("report", report)):
        rows = {"hold": [], "ridge": [], "prior's mean": []}
        for x, _ in people.values():
            rows["hold"].append(left(task(x)[1], x))
            rows["ridge"].append(left(fitted[width](x), x))
            rows["prior's mean"].append(float(quality.rollout_errors(model, x)["prior mean"][:, AHEAD - 1].mean()))
        errors = {name: torch.tensor(each) for name, each in rows.items()}
        for name, each in errors.items():
            mean, low, high = interval(each, "mean", generator)
            print(f"{part}: {name} {mean:.1f} [{low:.1f}, {high:.1f}] cm, {len(each)} people")
        print(part, "prior's mean minus ridge", paired(errors["prior's mean"], errors["ridge"], generator))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
