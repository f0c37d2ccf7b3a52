"""Computes the chain of a roll-out in compiled loops: what ``rollout`` does in tensors, without a call per step.

A roll-out is a chain of small steps. In tensors each is some hundred calls, and for one clip nearly all the time is the
calls; here the whole chain is one call, and so is the way back. On the CPU, in one thread.

Source: numba compiles the loops where they first run and keeps them in ``__pycache__``.
"""

import contextlib
import math
import signal
import threading
from collections.abc import Iterator

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from motionlab import rotation
from motionlab.humor.priors import Cvae
from motionlab.humor.state import ADDED, CHANGES, STATE, VECTORS
from motionlab.parallel import WIDE

PLACED = STATE + 6  # numbers of a state and of its frame's place in the world
_TINY = 1e-18  # what a turn or a right axis on the floor is at least, so that none divides by 0
_loops = njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})  # NaN stays NaN


def fits(first: Tensor, z: Tensor) -> bool:
    """Says whether a roll-out is for loops: on the CPU, and of so few clips that torch would have one thread, too."""
    kinds = {first.dtype, z.dtype}
    return first.device.type == "cpu" and len(first) < WIDE and kinds in ({torch.float32}, {torch.float64})


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Hears Ctrl-C at the end of the block: within a compiled loop its KeyboardInterrupt would become a SystemError."""
    before, heard = signal.getsignal(signal.SIGINT), []
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield  # no Python code hears it here
        return
    signal.signal(signal.SIGINT, lambda *said: heard.append(said))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if heard:
        before(*heard[-1])


class Chain(torch.autograd.Function):
    """All steps, with first derivatives: from X_0 (B, 345), u (T, B, 48) and gains (T, B, 48, 345, or 0 for none) to X
    (T, B, 345), states in the frame before (T, B, 339), contact logits (T, B, 9) and z (T, B, 48); float32 or 64."""

    @staticmethod
    def forward(ctx, model: Cvae, first: Tensor, u: Tensor, gains: Tensor):
        """Walks the chain by a model's decoder, whose weights get no gradients."""
        linear = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.Linear)]
        norms = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.GroupNorm)]
        weights, zs = zip(*(layer.weight.tensor_split([-model.latent], 1) for layer in linear), strict=True)
        skip = linear[-1].weight[:, :0] if model.skip is None else model.skip.weight
        joint, ctx.groups, ctx.skip = torch.cat(zs), norms[0].num_groups, _array(skip)
        scale, shift = (_array(torch.cat(each)) for each in zip(*(norm.parameters() for norm in norms), strict=True))
        bias = _array(torch.cat([layer.bias for layer in linear]))
        ctx.fixed = _array(gains), tuple(_array(w) for w in weights), _array(joint), scale
        across = tuple(_array(w.mT) for w in weights), _array(joint.mT), bias
        norming = scale, shift, ctx.groups, norms[0].eps
        with unbroken():
            ctx.kept = _onward(_array(first), _array(u), ctx.fixed[0], *across, *norming, _array(skip.mT))
        past, after, raw, z = (torch.from_numpy(x) for x in ctx.kept[:4])
        return past.clone(), after.clone(), raw[..., CHANGES:].clone(), z.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, d_past: Tensor, d_after: Tensor, d_logits: Tensor, d_z: Tensor):
        """Gradients of X_0 and u."""
        past, after, raw, _, *kept = ctx.kept
        bend = rotation.left_jacobian(torch.from_numpy(raw[..., ADDED:CHANGES]).unflatten(-1, (22, 3)))
        given = tuple(_array(d) for d in (d_past, d_after, d_logits, d_z))
        with unbroken():
            d_x, d_u = _back(*given, past, after, *kept, _array(bend), *ctx.fixed, ctx.groups, ctx.skip)
        return None, torch.from_numpy(d_x), torch.from_numpy(d_u), None


def _array(x: Tensor) -> np.ndarray:
    return x.detach().contiguous().numpy()


@_loops
def _onward(first, u, gains, weights, joint, bias, scale, shift, groups, eps, skip):
    """All steps; the arrays that the way back needs."""
    steps, batch, _ = u.shape
    hidden, kind = len(scale), u.dtype
    past, after = np.empty((steps, batch, PLACED), kind), np.empty((steps, batch, STATE), kind)
    raw, z = np.empty((steps, batch, len(bias) - hidden), kind), u.copy()
    turned, places = np.empty((steps, batch, 22, 3, 3), kind), np.empty((steps + 1, batch, 2, 3), kind)
    normed, outs = np.empty((steps, batch, hidden), kind), np.empty((steps, batch, hidden), kind)
    spread = np.empty((steps, batch, groups * (len(weights) - 1)), kind)
    share, x = np.empty((batch, len(bias)), kind), first.copy()
    for b in range(batch):
        places[0, b] = first[b, STATE:].copy().reshape(2, 3)
    for t in range(steps):
        past[t] = x
        for b in range(batch):
            _add_matvec(gains[t, b], x[b], z[t, b])
            share[b] = bias
        _add_product(z[t], 0, joint, share, 0)
        h, at, begin = x, 0, 0
        for k in range(len(weights)):
            end = begin + weights[k].shape[1]
            _add_product(h, at, weights[k], share, begin)
            for b in range(batch if end <= hidden else 0):
                _normalise(
                    share[b, begin:end], scale[begin:end], shift[begin:end], eps,
                    normed[t, b, begin:end], spread[t, b, k * groups : (k + 1) * groups], outs[t, b, begin:end],
                )  # fmt: skip
            h, at, begin = outs[t], begin, end
        _add_product(x, 0, skip, share, hidden)
        for b in range(batch):
            raw[t, b] = share[b, hidden:]
            _step(x[b], raw[t, b], after[t, b], turned[t, b], places[t, b], places[t + 1, b])
    return past, after, raw, z, turned, places, normed, spread, outs


@_loops
def _add_product(a, at, w, out, begin):
    """out (B, begin : begin + N) += a (B, at : at + K) @ w (K, N), four rows of w at a time."""
    inner, count = w.shape
    whole = inner - inner % 4
    for k in range(0, whole, 4):
        w0, w1, w2, w3 = w[k], w[k + 1], w[k + 2], w[k + 3]
        for b in range(len(a)):
            i, row = at + k, out[b, begin : begin + count]
            a0, a1, a2, a3 = a[b, i], a[b, i + 1], a[b, i + 2], a[b, i + 3]
            for n in range(count):
                row[n] += (a0 * w0[n] + a1 * w1[n]) + (a2 * w2[n] + a3 * w3[n])
    for k in range(whole, inner):
        for b in range(len(a)):
            for n in range(count):
                out[b, begin + n] += a[b, at + k] * w[k, n]


@_loops
def _add_matvec(w, a, out):
    """out (N,) += w (N, K) @ a (K,)."""
    for n in range(len(w)):
        row, total = w[n], 0 * a[0]
        for k in range(len(row)):
            total += row[k] * a[k]
        out[n] += total


@_loops
def _normalise(h, scale, shift, eps, normed, spread, out):
    """GroupNorm, gain, shift and ReLU of one row (n,); 1 / std of each group is kept."""
    size = len(h) // len(spread)
    for g in range(len(spread)):
        mean, square = 0 * h[0], 0 * h[0]
        for n in range(g * size, (g + 1) * size):
            mean += h[n] / size
        for n in range(g * size, (g + 1) * size):
            square += (h[n] - mean) * (h[n] - mean)
        spread[g] = 1 / math.sqrt(square / size + eps)
        for n in range(g * size, (g + 1) * size):
            normed[n] = (h[n] - mean) * spread[g]
            out[n] = max(normed[n] * scale[n] + shift[n], 0 * h[0])


@_loops
def _step(x, raw, after, turned, place, onward):
    """One step of one clip. x (345,) becomes the next; turned (22, 3, 3): exp(v)^T; place, onward (2, 3)."""
    after[:ADDED] = x[:ADDED] + raw[:ADDED]
    for j in range(22):
        _exp(raw[ADDED + 3 * j : ADDED + 3 * j + 3], turned[j])
        at = ADDED + 9 * j
        for r in range(0, 9, 3):
            for c in range(3):
                after[at + r + c] = (
                    x[at + r] * turned[j, 0, c] + x[at + r + 1] * turned[j, 1, c] + x[at + r + 2] * turned[j, 2, c]
                )
    cos, sin = _heading(after)
    for v in range(50):
        moved = 1 if v == 0 or 3 <= v < 25 else 0  # those that are positions
        right, ahead = after[3 * v] - moved * after[0], after[3 * v + 1] - moved * after[1]
        x[3 * v], x[3 * v + 1], x[3 * v + 2] = right * cos + ahead * sin, ahead * cos - right * sin, after[3 * v + 2]
    x[VECTORS:STATE] = after[VECTORS:]
    for r in range(2):
        p, q = place[r, 0], place[r, 1]
        onward[r, 0], onward[r, 1] = p * cos + q * sin, q * cos - p * sin
        onward[r, 2] = p * after[0] + q * after[1] + place[r, 2]
        x[STATE + 3 * r : STATE + 3 * r + 3] = onward[r]


@_loops
def _heading(after):
    """Cosine and sine of the right axis on the floor; 1 and 0 where there is none."""
    x, y = _TINY - after[ADDED], -after[ADDED + 1]
    size = math.sqrt(x * x + y * y)
    return x / size, y / size


@_loops
def _exp(v, out):
    """exp(v)^T by the quaternion (cos t/2, v sin(t/2) / t), t = |v|."""
    t = max(math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), _TINY)
    w, s = math.cos(0.5 * t), math.sin(0.5 * t) / t
    x, y, z = s * v[0], s * v[1], s * v[2]
    out[0, 0], out[0, 1], out[0, 2] = w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z


@_loops
def _back(
    d_past, d_after, d_logits, d_z, past, after, turned, places, normed, spread, outs, bend,
    gains, weights, joint, scale, groups, skip,
):  # fmt: skip
    """Gradients of X_0 (B, 345) and u (T, B, 48)."""
    steps, batch, _ = d_z.shape
    hidden, d_x, d_u = len(scale), np.zeros_like(past[0]), d_z.copy()
    d, share = np.empty_like(d_after[0]), np.empty((batch, len(joint)), joint.dtype)
    for t in range(steps - 1, -1, -1):
        d[:] = d_after[t]
        for b in range(batch):
            if t < steps - 1:  # the last state's own frame is nobody's input
                _back_frame(d_x[b], past[t + 1, b], after[t, b], places[t, b], d[b])
            _back_turns(d[b], after[t, b], bend[t, b], share[b, hidden:])
            share[b, hidden + CHANGES :] = d_logits[t, b]
        end, d_h = hidden, np.zeros((batch, weights[len(weights) - 1].shape[1]), joint.dtype)
        _add_product(share, hidden, weights[len(weights) - 1], d_h, 0)
        for k in range(len(weights) - 2, -1, -1):
            begin = end - len(weights[k])
            for b in range(batch):
                _back_norm(
                    d_h[b], scale[begin:end], normed[t, b, begin:end], spread[t, b, k * groups : (k + 1) * groups],
                    outs[t, b, begin:end], share[b, begin:end],
                )  # fmt: skip
            d_h = np.zeros((batch, weights[k].shape[1]), joint.dtype)
            _add_product(share, begin, weights[k], d_h, 0)
            end = begin
        _add_product(share, hidden, skip, d_h, 0)
        _add_product(share, 0, joint, d_u[t], 0)
        for b in range(batch):
            _back_state(d[b], turned[t, b], d_h[b], d_x[b])
            d_x[b] += d_past[t, b]
        for b in range(batch):
            _add_product(d_u[t, b : b + 1], 0, gains[t, b], d_x[b : b + 1], 0)
    return d_x, d_u


@_loops
def _back_frame(d_x, x, after, place, d):
    """Through the next state's own frame: to d (339,), of the next state in the old; d_x's place becomes the old's."""
    cos, sin = _heading(after)
    angle, right, ahead = 0 * cos, 0 * cos, 0 * cos
    for v in range(50):
        p, q = d_x[3 * v], d_x[3 * v + 1]
        angle += p * x[3 * v + 1] - q * x[3 * v]
        back_right, back_ahead = p * cos - q * sin, p * sin + q * cos
        if v == 0 or 3 <= v < 25:
            right, ahead = right + back_right, ahead + back_ahead
        d[3 * v] += back_right
        d[3 * v + 1] += back_ahead
        d[3 * v + 2] += d_x[3 * v + 2]
    d[VECTORS:] += d_x[VECTORS:STATE]
    for r in range(2):
        at = STATE + 3 * r
        p, q, s = d_x[at], d_x[at + 1], d_x[at + 2]
        # onward = place way, way = [[cos, -sin, x], [sin, cos, y], [0, 0, 1]]
        angle += place[r, 0] * (-p * sin - q * cos) + place[r, 1] * (p * cos - q * sin)
        right, ahead = right - place[r, 0] * s, ahead - place[r, 1] * s
        d_x[at], d_x[at + 1] = p * cos - q * sin + s * after[0], p * sin + q * cos + s * after[1]
    d[0], d[1] = d[0] - right, d[1] - ahead
    size = after[ADDED] * after[ADDED] + after[ADDED + 1] * after[ADDED + 1]
    if size > 0:
        d[ADDED] -= angle * after[ADDED + 1] / size
        d[ADDED + 1] += angle * after[ADDED] / size


@_loops
def _back_turns(d, after, bend, share):
    """Of the raw output (207,): what is added as it is, of each rotation vector dL/dv = w J."""
    share[:ADDED] = d[:ADDED]
    for j in range(22):
        at, wx, wy, wz = ADDED + 9 * j, 0 * d[0], 0 * d[0], 0 * d[0]
        for r in range(at, at + 9, 3):
            wx += after[r + 1] * d[r + 2] - after[r + 2] * d[r + 1]
            wy += after[r + 2] * d[r] - after[r] * d[r + 2]
            wz += after[r] * d[r + 1] - after[r + 1] * d[r]
        for c in range(3):
            share[ADDED + 3 * j + c] = wx * bend[j, 0, c] + wy * bend[j, 1, c] + wz * bend[j, 2, c]


@_loops
def _back_norm(d_out, scale, normed, spread, out, d_in):
    """Through ReLU, gain and GroupNorm of one row (n,)."""
    size = len(d_out) // len(spread)
    for g in range(len(spread)):
        along, mean = 0 * scale[0], 0 * scale[0]
        for n in range(g * size, (g + 1) * size):
            d_in[n] = d_out[n] * scale[n] if out[n] > 0 else 0
            mean += d_in[n]
            along += d_in[n] * normed[n]
        for n in range(g * size, (g + 1) * size):
            d_in[n] = spread[g] * (d_in[n] - mean / size - normed[n] * along / size)


@_loops
def _back_state(d, turned, d_h, d_x):
    """Of the state that the step began with (339,): through the decoder, d_h, and past it."""
    d_x[:ADDED] = d_h[:ADDED] + d[:ADDED]
    for j in range(22):
        at = ADDED + 9 * j
        for r in range(at, at + 9, 3):
            for c in range(3):
                e = turned[j, c]
                d_x[r + c] = d_h[r + c] + d[r] * e[0] + d[r + 1] * e[1] + d[r + 2] * e[2]
