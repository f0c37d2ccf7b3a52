"""Parts of the solvers against what they stand for, which must do as well before they are timed: ratios of one run.

L-BFGS for many clips at once, on roll-outs, against torch's own, clip by clip. A closure in the loop of one clip as
compiled loops, against tensors; what it costs beside a plain one, notebook 08 measures. The sweep, against a dense
factorisation of the same quadratic. Processor time of one thread, ways in turns.
"""

import time
from unittest import mock

import torch
from torch import Tensor

from data_synth import clips, scenes
from motionlab.humor import compiled, state
from motionlab.humor.pretrained import load_priors
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import rollout
from motionlab.humor.shooting import coordinates
from motionlab.humor.stages import rolled_terms
from motionlab.optimise import minimise_batch
from studies.shared.profiling import interleaved
from studies.shared.torch_search import minimise
from studies.shared.workload import workload

CLIPS, FRAMES, CLOSURES, ROUNDS = 8, 30, 25, 3


def said(what: str, slow, fast) -> None:
    """Prints how many times as long one way takes as another."""
    slow, fast = interleaved({0: slow, 1: fast}, n=ROUNDS, clock=time.process_time).values()
    low, middle, high = (slow / fast).quantile(torch.tensor([0.0, 0.5, 1.0]).double()).tolist()
    times = f"{1e3 * slow.median():.0f} / {1e3 * fast.median():.0f} ms"
    print(f"{what}: {times}, ratio {middle:.2f} [{low:.2f}, {high:.2f}]", flush=True)


def batches(kit: Priors, draw: torch.Generator) -> None:
    """The same closures for clips together and one after the other: joints of a roll-out to be found again."""
    first, joints = state.from_motion(scenes.held_out(CLIPS))[:, 0], state.SLICES["joints"]
    z = 0.5 * torch.randn(CLIPS, FRAMES, kit.motion.latent, generator=draw)
    truth = rollout(kit.motion, first, z).states[..., joints]

    def misfit(v, rows=slice(None)) -> Tensor:
        found = rollout(kit.motion, first[rows], v["z"])
        return 100 * (found.states[..., joints] - truth[rows]).square().sum((1, 2)) + found.prior.nll(found.z).sum(1)

    def together() -> Tensor:
        start = {"z": torch.zeros_like(z).requires_grad_()}
        return minimise_batch(misfit, start, max_closures=CLOSURES, steps=2).energy

    def one_by_one() -> Tensor:
        found = []
        for b in range(CLIPS):
            start = {"z": torch.zeros_like(z[[b]]).requires_grad_()}
            how = {"max_closures": CLOSURES, "steps": 1, "inner": 40}
            found.append(min(minimise(lambda v, b=b: misfit(v, [b]).sum(), start, **how)[1]))
        return torch.tensor(found)

    begun = misfit({"z": torch.zeros_like(z)})
    won, each = begun - together(), begun - one_by_one()
    if not (won > 0.5 * each).all():
        raise SystemExit(f"together they win {won}, alone {each}")
    print(f"L-BFGS, {CLIPS} clips: together {(won / each).median():.3f} of the decrease alone")
    said("L-BFGS, one by one / together", one_by_one, together)


def loops(kit: Priors, draw: torch.Generator) -> None:
    """A closure in the loop of one clip."""
    work = workload(clips.draw(1, draw, actions=("walk",))[0].motion.cut(0, 60), kit, draw, 1, inferred=True)
    unknown = work.moving.detached()
    around = coordinates.linearised(work.problem, unknown)
    zero = {"nu": torch.zeros_like(unknown.z[:, 0]), "first": torch.zeros_like(around.first[:, 0])}

    def in_loops() -> Tensor:
        moving = {n: x.clone().requires_grad_() for n, x in zero.items()}
        at, rolled = coordinates.unwhiten(work.problem, unknown, around, moving)
        energy = sum(rolled_terms(work.problem, at, rolled).values())
        torch.autograd.grad(energy.sum(), list(moving.values()))
        return energy

    def tensors() -> Tensor:
        with mock.patch.object(compiled, "FEW", 0):
            return in_loops()

    torch.testing.assert_close(in_loops(), tensors(), rtol=1e-3, atol=0)
    said("closure in the loop, as tensors / as compiled loops", tensors, in_loops)


def sweeps(draw: torch.Generator) -> None:
    """The sweep against the dense matrix of the same quadratic, in double precision."""
    n, size, frames = 60, 12, 40
    a, b = (0.12 * torch.randn(1, frames - 1, n, m, generator=draw, dtype=torch.float64) for m in (n, size))
    rows = torch.randn(1, frames, 20, n, generator=draw, dtype=torch.float64)
    of_pair = torch.diag_embed(torch.cat((torch.zeros(n), torch.ones(size))).double()).expand(1, frames - 1, -1, -1)

    def dense() -> Tensor:
        answer, parts = torch.eye(n, n + size * (frames - 1), dtype=torch.float64), []
        for t in range(frames):
            parts.append(rows[0, t] @ answer)
            if t < frames - 1:
                answer = a[0, t] @ answer
                answer[:, n + size * t : n + size * (t + 1)] += b[0, t]
        whole = torch.cat(parts)
        h = whole.mT @ whole
        h[n:, n:] += torch.eye(size * (frames - 1), dtype=torch.float64)
        factor = torch.linalg.cholesky(h[n:, n:])
        half = torch.linalg.solve_triangular(factor, h[n:, :n], upper=False)
        return h[:n, :n] - half.mT @ half

    def ours() -> Tensor:
        return coordinates.riccati_sweep(rows.mT @ rows, a, b, of_pair, ridge=0.0).first[0]

    torch.testing.assert_close(ours(), dense(), rtol=1e-6, atol=1e-6)
    said(f"dense factorisation / sweep, {frames} frames of {n} + {size}", dense, ours)


if __name__ == "__main__":
    torch.set_num_threads(1)
    kit, draw = load_priors(), torch.Generator().manual_seed(0)
    batches(kit, draw)
    loops(kit, draw)
    sweeps(draw)
