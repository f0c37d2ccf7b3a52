"""The fast solver's parts: a closure in the loop as compiled loops against tensors, and the sweep against a dense
factorisation.

Ratios of processor time in one run, ways measured in turns; what is compared must give the same numbers before it is
timed.
"""

import time

import torch

from data_synth import clips
from motionlab.humor import compiled
from motionlab.humor.pretrained import load_priors
from motionlab.humor.shooting import coordinates
from motionlab.humor.stages import rolled_terms
from studies.shared.profiling import interleaved
from studies.shared.workload import workload

FRAMES, ROUNDS = 60, 3


def in_turns(*ways) -> list[torch.Tensor]:
    """Seconds of processor time of each way, (rounds,)."""
    found = interleaved({str(k): way for k, way in enumerate(ways)}, n=ROUNDS, clock=time.process_time)
    return [torch.as_tensor(seconds).float() for seconds in found.values()]


def said(what: str, slow: torch.Tensor, fast: torch.Tensor) -> None:
    low, middle, high = (slow / fast).quantile(torch.tensor([0.0, 0.5, 1.0])).tolist()
    times = f"{1e3 * slow.median():.0f} / {1e3 * fast.median():.0f} ms"
    print(f"{what}: {times}, ratio {middle:.2f} [{low:.2f}, {high:.2f}]")


def loops(motion) -> None:
    """A closure in the loop of one clip; what it costs beside a plain one, notebook 08 measures."""
    work = workload(motion, load_priors(), torch.Generator().manual_seed(0), 1, inferred=True)
    unknown = work.moving.detached()
    around = coordinates.linearised(work.problem, unknown)
    zero = {"nu": torch.zeros_like(unknown.z[:, 0]), "first": torch.zeros_like(around.first[:, 0])}

    def in_loops():
        moving = {n: x.clone().requires_grad_() for n, x in zero.items()}
        at, rolled = coordinates.unwhiten(work.problem, unknown, around, moving)
        energy = sum(rolled_terms(work.problem, at, rolled).values())
        return energy, torch.autograd.grad(energy.sum(), list(moving.values()))

    def tensors():
        few, compiled.FEW = compiled.FEW, 0
        try:
            return in_loops()
        finally:
            compiled.FEW = few

    if not torch.allclose(tensors()[0], in_loops()[0], rtol=1e-3):
        raise SystemExit(f"loops find {in_loops()[0]}, tensors {tensors()[0]}")
    said("closure in the loop, as tensors / as compiled loops", *in_turns(tensors, in_loops))


def sweeps() -> None:
    """The sweep against the dense matrix of the same quadratic, in double precision."""
    n, size, frames = 60, 12, 40
    draw = torch.Generator().manual_seed(0)
    a, b = (0.12 * torch.randn(1, frames - 1, n, m, generator=draw, dtype=torch.float64) for m in (n, size))
    rows = torch.randn(1, frames, 20, n, generator=draw, dtype=torch.float64)
    of_pair = torch.diag_embed(torch.cat((torch.zeros(n), torch.ones(size))).double()).expand(1, frames - 1, -1, -1)

    def dense():
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

    def ours():
        return coordinates.riccati_sweep(rows.mT @ rows, a, b, of_pair, ridge=0.0)

    if not torch.allclose(dense(), ours().first[0], rtol=1e-6, atol=1e-6):
        raise SystemExit("the sweep's cost of the first change is not the dense one")
    said(f"dense factorisation / sweep, {frames} frames of {n} + {size}", *in_turns(dense, ours))


if __name__ == "__main__":
    torch.set_num_threads(1)
    walk = clips.draw(1, torch.Generator().manual_seed(0), actions=("walk",))[0].motion.cut(0, FRAMES)
    loops(walk)
    sweeps()
