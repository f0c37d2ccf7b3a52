"""Roll-outs, the official form against the lean one, K-step decoding, and L-BFGS for many clips at once.

Ratios of processor time in one run, ways measured in turns; every pair must give the same numbers before it is timed.
Both forms use the same networks with frozen weights, so that what is compared is the roll-out alone. The whole closure:
``bench_humor``.
"""

import sys
import time

import torch

from motionlab import heading, rotation
from motionlab.humor import state
from motionlab.humor.cvae import Cvae
from motionlab.humor.rollout import decode_ahead, rollout, sample_rollout
from motionlab.optimise import minimise_batch
from studies.official import rollout as official_rollout
from studies.shared.profiling import graph_nodes, interleaved
from studies.shared.torch_search import minimise

FRAMES, ROUNDS = 60, 5
EXACT = {"align": lambda root: heading.heading_frame(torch.zeros_like(root[..., 0]), root).turn}


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


def energy(form, net: Cvae, first: torch.Tensor, z: torch.Tensor, **more) -> torch.Tensor:
    """As the baseline's: squares of every output, and z under its prior."""
    found = form(net, first, z, **more)
    return found.states.square().sum() + found.contact_logits.square().sum() + found.prior.nll(found.z).sum()


def gradients(form, net: Cvae, first: torch.Tensor, z: torch.Tensor, **more) -> tuple[torch.Tensor, ...]:
    """Forward and backward: what one closure pays for."""
    first, z = first.clone().requires_grad_(), z.clone().requires_grad_()
    return torch.autograd.grad(energy(form, net, first, z, **more), (first, z))


def in_turns(ways, rounds: int = ROUNDS) -> torch.Tensor:
    """Seconds of processor time (ways, rounds): what neighbours on the machine take does not count."""
    found = interleaved({str(k): way for k, way in enumerate(ways)}, n=rounds, clock=time.process_time)
    return torch.stack(list(found.values())).float()


def roll_outs(width: int, batch: int, generator: torch.Generator) -> None:
    """One clip as an optimiser sees it, and batches."""
    net, (first, z) = model(width), inputs(batch, generator)
    # of z: that of x0 differs, where the official form moves its pelvis offset with it; and of a few steps, as random
    # networks are chaotic
    (_, ours), (_, theirs) = (
        gradients(form, net, first, z[:, :4], **more)
        for form, more in ((rollout, {}), (official_rollout.rollout, EXACT))
    )
    apart = (ours - theirs).norm() / theirs.norm()
    if not apart < 1e-2:
        raise SystemExit(f"width {width}, {batch} clips: gradients are {apart:.1e} apart")
    slow, fast = in_turns(
        [lambda form=form: gradients(form, net, first, z) for form in (official_rollout.rollout, rollout)]
    )
    ratio = (slow / fast).quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
    print(
        f"width {width:4d}, {batch:2d} clips x {FRAMES}: official {1e3 * slow.median():5.0f} ms, lean "
        f"{1e3 * fast.median():5.0f} ms, ratio {ratio[1]:.1f} [{ratio[0]:.1f}, {ratio[2]:.1f}]"
    )


def graphs() -> None:
    """Steps of autograd behind one closure."""
    net, (first, z) = model(64), inputs(1, torch.Generator().manual_seed(0))
    first, z = first.requires_grad_(), z.requires_grad_()
    slow, fast = (graph_nodes(energy(form, net, first, z)) for form in (official_rollout.rollout, rollout))
    print(f"autograd nodes of a closure: official {slow}, lean {fast}")


def others(width: int, generator: torch.Generator) -> None:
    """K steps from every frame at once, and sampling, against the roll-out forward and backward."""
    net, (first, z) = model(width), inputs(1, generator)
    states = rollout(net, first, z).states.detach()

    def ahead(steps):
        x, latent = states.clone().requires_grad_(), z.clone().requires_grad_()
        return torch.autograd.grad(decode_ahead(net, x, latent, steps).square().sum(), (x, latent))

    counts = (1, 2, 5, 10)
    ways = [lambda: gradients(rollout, net, first, z), *(lambda k=k: ahead(k) for k in counts)]
    whole, *each = in_turns([*ways, lambda: sample_rollout(net, first, FRAMES)])
    for k, seconds in zip(counts, each, strict=False):
        gain = (whole / seconds).median()
        print(f"width {width:4d}: {k:2d} steps from each of {FRAMES} frames: roll-out / it = {gain:.2f}")
    print(f"width {width:4d}: a sample takes {1e3 * each[-1].median():.0f} ms")


def fits(width: int, batch: int, generator: torch.Generator) -> None:
    """The same closures for B clips together and one after the other: joints of a roll-out to be found again."""
    net, (first, z) = model(width), inputs(batch, generator)
    first, z = first, z[:, :30]
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
    batched, single = in_turns([together, one_by_one], rounds=3)
    gain = ((begun - one) / (begun - each)).median()
    print(
        f"width {width:4d}, {batch:2d} clips x 30, {budget} closures of L-BFGS: one by one / together = "
        f"{(single / batched).median():.1f}; decrease together / alone = {gain:.3f}"
    )


def main(quick: bool = False) -> None:
    """The full-size networks and the compact ones; ``quick``: tiny ones, to see that it runs."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    graphs()
    widths, batches = ((64,), (1, 3)) if quick else ((1024, 512), (1, 4, 24))
    for width in widths:
        for batch in batches:
            roll_outs(width, batch, generator)
        others(width, generator)
    fits(widths[-1], 3 if quick else 8, generator)


if __name__ == "__main__":
    main("--quick" in sys.argv)
