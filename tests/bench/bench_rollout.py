"""L-BFGS for many clips at once against torch's own, clip by clip, on roll-outs.

Ratios of processor time in one run, both ways in turns; both must win as much before they are timed. The official form
against the lean one: notebook 06; K steps from every frame: notebook 07.
"""

import sys
import time

import torch

from motionlab import rotation
from motionlab.humor import state
from motionlab.humor.cvae import Cvae
from motionlab.humor.rollout import rollout
from motionlab.optimise import minimise_batch
from studies.shared.profiling import interleaved
from studies.shared.torch_search import minimise

FRAMES, ROUNDS = 30, 3


def model(width: int) -> Cvae:
    """Random weights; the last layer's are small, so that a motion stays near its start."""
    torch.manual_seed(0)
    made = Cvae(width)
    with torch.no_grad():
        made.decoder.net[-1].weight *= 0.1
        made.decoder.net[-1].bias *= 0.1
    return made.frozen()


def inputs(batch: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """First states whose pelvis is ``trans``, and latents."""
    first = torch.randn(batch, state.STATE, generator=generator)
    for name, count in (("root_orient", 1), ("pose_body", 21)):
        first[:, state.SLICES[name]] = rotation.random((batch, count), generator).flatten(1)
    first[:, state.SLICES["joints"]][:, :3] = first[:, state.SLICES["trans"]]
    return first, 0.5 * torch.randn(batch, FRAMES, 48, generator=generator)


def fits(width: int, batch: int, generator: torch.Generator) -> None:
    """The same closures for B clips together and one after the other: joints of a roll-out to be found again."""
    net, (first, z) = model(width), inputs(batch, generator)
    joints = state.SLICES["joints"]
    truth = rollout(net, first, z).states[..., joints]

    def misfit(v, rows=slice(None)):
        found = rollout(net, first[rows], v["z"])
        return 100 * (found.states[..., joints] - truth[rows]).square().sum((1, 2)) + found.prior.nll(found.z).sum(1)

    start, budget = torch.zeros_like(z).requires_grad_(), 25

    def together():
        return minimise_batch(misfit, {"z": start}, max_closures=budget, steps=2)

    def one_by_one():
        return [
            minimise(
                lambda v, b=b: misfit(v, slice(b, b + 1)).sum(),
                {"z": start[b : b + 1].detach().requires_grad_()},
                max_closures=budget,
                steps=1,
                inner=40,
            )
            for b in range(batch)
        ]

    one, each = together().energy, torch.tensor([fit.energy for fit in one_by_one()])
    begun = misfit({"z": start.detach()})
    if not ((begun - one) > 0.5 * (begun - each)).all():
        raise SystemExit(f"together they win {begun - one}, alone {begun - each}")
    ways = {"together": together, "one by one": one_by_one}
    batched, single = interleaved(ways, n=ROUNDS, clock=time.process_time).values()
    gain = ((begun - one) / (begun - each)).median()
    print(
        f"width {width:4d}, {batch:2d} clips x {FRAMES}, {budget} closures of L-BFGS: one by one / together = "
        f"{(single / batched).median():.1f}; decrease together / alone = {gain:.3f}"
    )


def main(quick: bool = False) -> None:
    """Networks of the size that ships; ``quick``: tiny ones, to see that it runs."""
    torch.set_num_threads(1)
    fits(64 if quick else 512, 3 if quick else 8, torch.Generator().manual_seed(0))


if __name__ == "__main__":
    main("--quick" in sys.argv)
