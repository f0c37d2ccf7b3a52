"""Samplers that need few steps: those of diffusers, and a flow that knows the data's spectrum.

With the spectrum S (T, D) of the data (``diffusion.gaussian_guess``) a sampler of few steps (:func:`flow`) is exact
where motion is Gaussian. Let y = x / sqrt(a) and
sigma^2 = (1 - a) / a. With z = y / sqrt(S + sigma^2), of unit variance at every sigma, and the angle
theta = atan(sigma / sqrt(S)), the flow dy / dsigma = (y - x_0 estimate) / sigma has the form

    dz / dtheta = -n,    x_0 estimate = sqrt(S) (cos(theta) z + sin(theta) n).

n is what the network says: what it adds to the Wiener filter. Where it adds nothing, z stays as it is, and one step
from noise to signal is exact. DDIM holds the x_0 estimate over a step instead, which lets the variance of all that is
finer than the step's change of sigma shrink: quick changes vanish first.

Source: exponential integrators (DPM-Solver, Lu et al. 2022), whose linear part is the schedule alone (S = 1 gives the
v-prediction of Salimans and Ho 2022).
Differs: the linear part is the data's Wiener filter.
"""

from __future__ import annotations

import warnings
from inspect import signature

import torch
from torch import Tensor

from motionlab.baselines import cosine_transform
from motionlab.diffusion.sampling import DenoiseFunction, NoiseSchedule
from motionlab.errors import ShapeError, check_shape

_LARGEST = 1.0  # ratio of steps up to which the second order of ``flow`` looks back


@torch.no_grad()
def through(
    scheduler, denoise: DenoiseFunction, x: Tensor, count: int | list[int], generator: torch.Generator | None = None
) -> Tensor:
    """Samples (B, ...) by ``count`` steps of any scheduler of diffusers that takes x_0 estimates (``scheduler``).

    count: how many, or the steps themselves, falling, where the scheduler lets them be chosen.
    """
    with warnings.catch_warnings():  # numpy 2 and the way some schedulers read tensors
        warnings.simplefilter("ignore", DeprecationWarning)
        scheduler.set_timesteps(**({"num_inference_steps": count} if isinstance(count, int) else {"timesteps": count}))
    takes = {"generator": generator} if "generator" in signature(scheduler.step).parameters else {}
    for t in scheduler.timesteps:
        x0 = denoise(scheduler.scale_model_input(x, t), t.to(x.device).expand(len(x)))
        x = scheduler.step(x0, t, x, **takes).prev_sample
    return x


def scheduler(name: str, schedule: NoiseSchedule, **options):
    """A scheduler of diffusers on our betas, x_0 estimates, nothing clipped, spaced to reach the last step.

    name: of its class, as "DPMSolverMultistepScheduler".
    """
    import diffusers

    betas = schedule.beta.float().numpy()
    how = {"trained_betas": betas, "prediction_type": "sample", "timestep_spacing": "trailing"} | options
    made = getattr(diffusers, name)
    known = signature(made.__init__).parameters
    return made(**{k: v for k, v in (how | {"clip_sample": False}).items() if k in known})


def _angles(schedule: NoiseSchedule, spectrum: Tensor) -> Tensor:
    """theta (steps, T, D) of the power S (T, D) at every noising step: pi / 2 is noise, 0 is signal."""
    sigma = ((1 - schedule.alpha_bar) / schedule.alpha_bar).sqrt()
    return torch.atan2(sigma[:, None, None], spectrum.double().sqrt())


def spaced(schedule: NoiseSchedule, spectrum: Tensor, count: int) -> NoiseSchedule:
    """The same process in fewer steps, each of which turns the numbers of a motion by the same angle on average.

    The average is weighted by sqrt(S), what a turn moves. Raises: ValueError: count is not 1 to the schedule's length.
    """
    if not 1 <= count <= len(schedule):
        raise ValueError(f"count: expected 1 to {len(schedule)} steps, got {count}")
    weight = spectrum.double().sqrt()
    turn = torch.stack([(theta * weight).sum() / weight.sum() for theta in _angles(schedule, spectrum)])
    wanted = turn[-1] * torch.arange(1, count + 1, dtype=torch.float64) / count
    at = torch.searchsorted(turn, wanted).clamp(max=len(schedule) - 1)
    for k in range(count):  # no step twice, at either end
        at[k] = max(int(at[k]), k, int(at[k - 1]) + 1 if k else 0)
        at[k] = min(int(at[k]), len(schedule) - count + k)
    return NoiseSchedule(schedule.alpha_bar[at], schedule.stamps[at])


@torch.no_grad()
def flow(
    denoise: DenoiseFunction,
    schedule: NoiseSchedule,
    spectrum: Tensor,
    x: Tensor,
    *,
    order: int = 2,
) -> Tensor:
    """Samples (B, T, D) from noise x (B, T, D), one evaluation of the network a step; draws nothing.

    order: 1 holds n over a step, 2 follows its last change (Adams-Bashforth).

    Raises:
        ShapeError: x is not of the spectrum's size. ValueError: another order.
    """
    sizes = check_shape(x, "B T D", "x")
    if spectrum.shape != (sizes["T"], sizes["D"]):
        raise ShapeError(f"spectrum: expected {tuple(x.shape[1:])}, got {tuple(spectrum.shape)}")
    if order not in (1, 2):
        raise ValueError(f"order: expected 1 or 2, got {order}")
    c, s = cosine_transform(sizes["T"]).to(x), spectrum.to(x)
    theta = _angles(schedule, spectrum).to(x)
    theta = torch.cat((torch.zeros_like(theta[:1]), theta))  # theta[t] lies before step t
    said = turned = None
    for t in range(len(schedule) - 1, -1, -1):
        a, before = schedule.alpha_bar[t].to(x), schedule.before[t].to(x)
        z = c @ x / (a * s + 1 - a).sqrt()
        x0 = denoise(x, schedule.stamps[t].to(x.device).expand(len(x)))
        here = theta[t + 1]
        n, turn = (c @ x0 / s.sqrt() - here.cos() * z) / here.sin(), here - theta[t]
        change = 0.0
        if order == 2 and said is not None:
            change = (turn / turned).clamp(max=_LARGEST) / 2 * (n - said)
        said, turned = n, turn.clamp(min=1e-9)
        x = c.T @ ((before * s + 1 - before).sqrt() * (z + turn * (n + change)))
    return x
