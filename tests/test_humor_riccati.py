"""The sweep against one dense matrix of everything."""

import pytest
import torch

from motionlab.humor.riccati import affine_sweep, sweep

F64 = torch.float64
CLIPS, FRAMES, N, Z = 2, 5, 6, 3
MANY = (FRAMES - 1) * Z


def draw(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


@pytest.fixture(scope="module")
def case():
    """Slopes, and rows R_t and N_t of an energy whose frames alone say nothing about some directions."""
    return {
        "a": torch.eye(N, dtype=F64) + 0.3 * draw(0, CLIPS, FRAMES - 1, N, N),
        "b": draw(1, CLIPS, FRAMES - 1, N, Z),
        "frame": draw(2, CLIPS, FRAMES, 2, N),
        "pair": draw(3, CLIPS, FRAMES - 1, 4, N + Z),
    }


def swept(case, ridge=1e-6):
    frame, pair = case["frame"], case["pair"]
    return sweep(frame.mT @ frame, case["a"], case["b"], pair.mT @ pair, ridge)


def energy(case, y, z, ridge=0.0):
    """1/2 sum of squares (B,), frame by frame along y_{t+1} = A y + B z; y (B, N), z (B, T - 1, Z)."""
    total = 0.5 * ridge * z.square().sum((1, 2))
    for t in range(FRAMES):
        total = total + 0.5 * (case["frame"][:, t] @ y[..., None]).square().sum((1, 2))
        if t < FRAMES - 1:
            both = torch.cat((y, z[:, t]), -1)[..., None]
            total = total + 0.5 * (case["pair"][:, t] @ both).square().sum((1, 2))
            y = (torch.cat((case["a"][:, t], case["b"][:, t]), -1) @ both)[..., 0]
    return total


def dense(case, ridge):
    """The Hessian (B, N + (T - 1) Z, the same) of that energy."""
    unit = torch.eye(N + MANY, dtype=F64)
    single = [energy(case, *split(row.expand(CLIPS, -1)), ridge) for row in unit]
    rows = []
    for i, row in enumerate(unit):
        both = [energy(case, *split((row + other).expand(CLIPS, -1)), ridge) for other in unit]
        rows.append(torch.stack([e - single[i] - single[j] for j, e in enumerate(both)], -1))
    return torch.stack(rows, 1)


def split(v):
    return v[:, :N], v[:, N:].unflatten(1, (FRAMES - 1, Z))


def steered(case, found, y, nu):
    """z (B, T - 1, Z) that the gains make of nu on the way."""
    zs = []
    for t in range(FRAMES - 1):
        z = (found.gains[:, t] @ y[..., None] + found.shapers[:, t] @ nu[:, t, :, None])[..., 0]
        y = (case["a"][:, t] @ y[..., None] + case["b"][:, t] @ z[..., None])[..., 0]
        zs.append(z)
    return torch.stack(zs, 1)


@pytest.mark.parametrize("ridge", [1e-6, 0.5])
def test_what_the_first_change_costs_is_a_schur_complement(case, ridge):
    h = dense(case, ridge)
    yy, yz, zz = h[:, :N, :N], h[:, :N, N:], h[:, N:, N:]
    schur = yy - yz @ torch.linalg.solve(zz, yz.mT)
    found = swept(case, ridge)
    torch.testing.assert_close(found.first, schur, atol=1e-9, rtol=1e-9)
    assert (yy - schur).norm() > 0.1 * yy.norm()  # control: what the z can still mend is much


def test_gains_are_the_dense_solutions_first_step(case):
    h, y = dense(case, 1e-6), draw(4, CLIPS, N)
    best = -torch.linalg.solve(h[:, N:, N:], h[:, N:, :N] @ y[..., None])[..., 0]
    ours = steered(case, swept(case), y, torch.zeros(CLIPS, FRAMES - 1, Z, dtype=F64))
    torch.testing.assert_close(ours.flatten(1), best, atol=1e-9, rtol=1e-9)


def test_gains_and_shapers_whiten(case):
    """The energy is 1/2 |nu|^2 + 1/2 y P y, exactly; and with one wrong gain or shaper it is not."""
    found, y, nu = swept(case), draw(5, CLIPS, N), draw(6, CLIPS, FRAMES - 1, Z)

    def gap(each):
        claimed = 0.5 * nu.square().sum((1, 2)) + 0.5 * torch.einsum("bi,bij,bj->b", y, each.first, y)
        return (energy(case, y, steered(case, each, y, nu), 1e-6) / claimed - 1).abs().max()

    assert gap(found) < 1e-10
    wrong = found.gains.clone()
    wrong[:, 2] *= 1.1
    assert gap(found._replace(gains=wrong)) > 1e-3
    assert gap(found._replace(gains=-found.gains)) > 0.1
    assert gap(found._replace(shapers=found.shapers.mT)) > 1e-2
    assert gap(found._replace(first=1.1 * found.first)) > 1e-3


def test_the_hessian_in_nu_is_the_identity(case):
    found, h = swept(case), dense(case, 1e-6)
    nothing = torch.zeros(CLIPS, N, dtype=F64)
    unit = torch.eye(MANY, dtype=F64).unflatten(1, (FRAMES - 1, Z))
    way = torch.stack([steered(case, found, nothing, nu.expand(CLIPS, -1, -1)).flatten(1) for nu in unit], -1)
    identity = torch.eye(MANY, dtype=F64).expand(CLIPS, -1, -1)
    torch.testing.assert_close(way.mT @ h[:, N:, N:] @ way, identity, atol=1e-9, rtol=0)


def test_clips_do_not_see_each_other(case):
    both = swept(case)
    for k in range(CLIPS):
        alone = swept({name: value[k : k + 1] for name, value in case.items()})
        for ours, theirs in zip(alone, both, strict=True):
            torch.testing.assert_close(ours[0], theirs[k], atol=1e-12, rtol=1e-10)


def test_latents_of_which_nothing_is_known_stay_where_they_are(case):
    """Only the ridge keeps them: no gain, and a finite shaper."""
    idle = case | {"b": torch.zeros_like(case["b"]), "pair": torch.zeros_like(case["pair"])}
    found = swept(idle, 1e-4)
    assert not found.gains.any()
    torch.testing.assert_close(found.shapers, 100.0 * torch.eye(Z, dtype=F64).expand_as(found.shapers))


def test_single_precision_is_near(case):
    found, single = swept(case), swept({name: value.float() for name, value in case.items()})
    for ours, theirs in zip(single, found, strict=True):
        assert ours.dtype == torch.float32 and (ours - theirs).norm() < 1e-4 * theirs.norm()


# ------------------------------------------------------------------------------------------------------- with gradients
@pytest.fixture(scope="module")
def sloped(case):
    """What the affine sweep takes: the same energy with gradients, and something that holds the controls."""
    held = draw(7, CLIPS, FRAMES - 1, Z, Z)
    return {
        "of_frame": case["frame"].mT @ case["frame"],
        "a": case["a"],
        "b": case["b"],
        "rows": case["pair"],
        "of_control": held.mT @ held + torch.eye(Z, dtype=F64),
        "slope": draw(8, CLIPS, FRAMES, N),
        "control_slope": draw(9, CLIPS, FRAMES - 1, Z),
    }


def sloped_energy(case, sloped, y, z):
    """Of a first change (N,) and controls ((T - 1) Z,) of the first clip."""
    z = z.unflatten(0, (FRAMES - 1, Z))
    one = {name: value[:1] for name, value in case.items()}
    total = energy(one, y[None], z[None])[0] + 0.5 * torch.einsum("ti,tij,tj->", z, sloped["of_control"][0], z)
    for t in range(FRAMES):
        total = total + sloped["slope"][0, t] @ y
        if t < FRAMES - 1:
            total = total + sloped["control_slope"][0, t] @ z[t]
            y = case["a"][0, t] @ y + case["b"][0, t] @ z[t]
    return total


def least(quadratic, at):
    """Where a quadratic function is least, by one dense solve."""
    h, g = (getattr(torch.autograd.functional, what)(quadratic, at) for what in ("hessian", "jacobian"))
    return at - torch.linalg.solve(h, g)


def dense_least(case, sloped, y):
    """The best controls after a first change (N,), and what they cost, by one dense solve."""
    nothing = torch.zeros(MANY, dtype=F64)
    best = least(lambda z: sloped_energy(case, sloped, y, z), nothing)
    return best, sloped_energy(case, sloped, y, best)


def test_what_is_walked_is_the_dense_solution(case, sloped):
    found, y = affine_sweep(**sloped), draw(10, CLIPS, N)
    changes, controls = found.walked(sloped["a"], sloped["b"], y)
    best, _ = dense_least(case, sloped, y[0])
    torch.testing.assert_close(controls[0].flatten(), best, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(changes[:, 0], y)
    last = sloped["a"][:, -1] @ changes[:, -2, :, None] + sloped["b"][:, -1] @ controls[:, -1, :, None]
    torch.testing.assert_close(changes[:, -1], last[..., 0])
    wrong, _ = dense_least(case, sloped | {"slope": 0 * sloped["slope"]}, y[0])  # control: gradients matter
    assert (wrong - best).norm() > 0.1 * best.norm()


def test_cost_and_slope_of_the_first_change_are_those_of_the_least(case, sloped):
    found, nothing = affine_sweep(**sloped), torch.zeros(N, dtype=F64)
    base = dense_least(case, sloped, nothing)[1]
    for number in range(3):
        y = draw(11 + number, N)
        claimed = 0.5 * y @ found.first[0] @ y + found.slope[0] @ y
        torch.testing.assert_close(dense_least(case, sloped, y)[1] - base, claimed, atol=1e-8, rtol=1e-9)


def test_without_gradients_the_gains_are_those_of_the_plain_sweep(case, sloped):
    eye = torch.eye(Z, dtype=F64).expand(CLIPS, FRAMES - 1, Z, Z)
    still = {name: 0 * sloped[name] for name in ("slope", "control_slope")}
    found, plain = affine_sweep(**sloped | still | {"of_control": 0.3 * eye}), swept(case, 0.3)
    torch.testing.assert_close(found.gains, plain.gains, atol=1e-10, rtol=1e-9)
    torch.testing.assert_close(found.first, plain.first, atol=1e-10, rtol=1e-9)
    assert not found.offsets.any() and not found.slope.any()


@pytest.mark.parametrize("rho", [0.1, 1e6])
def test_controls_that_are_gaps_make_the_dynamics_soft(case, sloped, rho):
    """A dense least over all changes and z, gaps y' - A y - B z paid for; at a great rho none is left."""
    eye = torch.eye(N, dtype=F64).expand(CLIPS, FRAMES - 1, N, N)
    white, held = draw(20, N).square() + 0.1, sloped["of_control"]
    both = torch.zeros(CLIPS, FRAMES - 1, Z + N, Z + N, dtype=F64)
    both[..., :Z, :Z], both[..., Z:, Z:] = held, rho * torch.diag(white)
    rows = torch.nn.functional.pad(case["pair"], (0, N))
    aside = torch.nn.functional.pad(sloped["control_slope"], (0, N))
    b = torch.cat((case["b"], eye), -1)
    found = affine_sweep(sloped["of_frame"], case["a"], b, rows, both, sloped["slope"], aside)
    start = draw(21, CLIPS, N)
    changes, controls = found.walked(case["a"], b, start)

    def whole(v):
        y, z = v[: (FRAMES - 1) * N].unflatten(0, (-1, N)), v[(FRAMES - 1) * N :].unflatten(0, (-1, Z))
        y = torch.cat((start[:1], y))
        gaps = y[1:] - (case["a"][0] @ y[:-1, :, None] + case["b"][0] @ z[..., None])[..., 0]
        pairs = (case["pair"][0] @ torch.cat((y[:-1], z), -1)[..., None]).square().sum()
        frames = (case["frame"][0] @ y[..., None]).square().sum()
        held_z = torch.einsum("ti,tij,tj->", z, held[0], z)
        linear = (sloped["slope"][0] * y).sum() + (sloped["control_slope"][0] * z).sum()
        return 0.5 * (frames + pairs + held_z + rho * (white * gaps.square()).sum()) + linear

    best = least(whole, torch.zeros((FRAMES - 1) * (N + Z), dtype=F64))
    ours = torch.cat((changes[0, 1:].flatten(), controls[0, :, :Z].flatten()))
    torch.testing.assert_close(ours, best, atol=1e-7, rtol=1e-6)
    left = controls[..., Z:].norm() / changes.norm()
    assert left < 1e-4 if rho > 1 else left > 0.1
