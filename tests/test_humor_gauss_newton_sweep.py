"""The sweep against the energy itself, frame by frame."""

import pytest
import torch

from motionlab.humor.gauss_newton import riccati_sweep
from tests.draws import draw

F64 = torch.float64
CLIPS, FRAMES, N, Z = 2, 5, 6, 3


@pytest.fixture(scope="module")
def case():
    """Slopes, and rows R_t and N_t of an energy whose frames alone say nothing about some directions."""
    return {
        "a": torch.eye(N, dtype=F64) + 0.3 * draw(0, CLIPS, FRAMES - 1, N, N),
        "b": draw(1, CLIPS, FRAMES - 1, N, Z),
        "frame": draw(2, CLIPS, FRAMES, 2, N),
        "pair": draw(3, CLIPS, FRAMES - 1, 4, N + Z),
    }


def swept(case, ridge):
    frame, pair = case["frame"], case["pair"]
    return riccati_sweep(frame.mT @ frame, case["a"], case["b"], pair.mT @ pair, ridge)


def energy(case, y, z, ridge):
    """1/2 sum of squares (B,), frame by frame along y_{t+1} = A y + B z; y (B, N), z (B, T - 1, Z)."""
    total = 0.5 * ridge * z.square().sum((1, 2))
    for t in range(FRAMES):
        total = total + 0.5 * (case["frame"][:, t] @ y[..., None]).square().sum((1, 2))
        if t < FRAMES - 1:
            both = torch.cat((y, z[:, t]), -1)[..., None]
            total = total + 0.5 * (case["pair"][:, t] @ both).square().sum((1, 2))
            y = (torch.cat((case["a"][:, t], case["b"][:, t]), -1) @ both)[..., 0]
    return total


def steered(case, found, y, nu):
    """z (B, T - 1, Z) that the gains make of nu on the way."""
    zs = []
    for t in range(FRAMES - 1):
        z = (found.gains[:, t] @ y[..., None] + found.whiteners[:, t] @ nu[:, t, :, None])[..., 0]
        y = (case["a"][:, t] @ y[..., None] + case["b"][:, t] @ z[..., None])[..., 0]
        zs.append(z)
    return torch.stack(zs, 1)


@pytest.mark.parametrize("ridge", [1e-6, 0.5])
def test_gains_and_shapers_whiten(case, ridge):
    """The energy is 1/2 |nu|^2 + 1/2 y P y, exactly; and with one wrong gain or shaper it is not."""
    found, y, nu = swept(case, ridge), draw(5, CLIPS, N), draw(6, CLIPS, FRAMES - 1, Z)

    def gap(each):
        claimed = 0.5 * nu.square().sum((1, 2)) + 0.5 * torch.einsum("bi,bij,bj->b", y, each.first, y)
        return (energy(case, y, steered(case, each, y, nu), ridge) / claimed - 1).abs().max()

    assert gap(found) < 1e-10
    wrong = found.gains.clone()
    wrong[:, 2] *= 1.1
    assert gap(found._replace(gains=wrong)) > 1e-3
    assert gap(found._replace(gains=-found.gains)) > 0.1
    assert gap(found._replace(whiteners=found.whiteners.mT)) > 1e-2
    assert gap(found._replace(first=1.1 * found.first)) > 1e-3


def test_latents_of_which_nothing_is_known_stay_where_they_are(case):
    """Only the ridge keeps them: no gain, and a finite shaper."""
    idle = case | {"b": torch.zeros_like(case["b"]), "pair": torch.zeros_like(case["pair"])}
    found = swept(idle, 1e-4)
    assert not found.gains.any()
    torch.testing.assert_close(found.whiteners, 100.0 * torch.eye(Z, dtype=F64).expand_as(found.whiteners))
