"""How far this package's HuMoR is from the official code: every golden array against the value computed here.

The networks are not the trained ones but two seeded sets of weights at full size, which the golden arrays were made
with: they need no file, and in the second every layer matters.

Source: golden arrays of the official code (Rempe et al. 2021), float64; see ``tests/golden/README.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.frames import heading_frame
from motionlab.humor import energies, faithful, faithful_rotation, floor, rollout, state
from motionlab.humor.cvae import Cvae, Gaussian, kl
from motionlab.humor.init_gmm import InitGmm
from motionlab.humor.state import SHAPES, SLICES
from motionlab.metrics import contact, pose
from motionlab.motion import velocity

EXACT = 1e-10  # the same formula in float64
YAW = 5e-5  # eight steps with the exact heading against the official acos, which is wrong by up to 1.3e-3 rad
LOOSE = {  # lean form, where an epsilon of the official code weighs more
    "canon_w2a_rot": 1e-4,  # that acos itself
    "cam2prior_R": 1e-8, "decode_out": 1e-8,  # its rotation vectors are 1e-8 longer
    "alt_roll_prior_mean": 5e-4, "alt_roll_prior_var": 5e-4,  # weights that amplify their input
    "alt_grad_z": 1e-2,  # and the derivative of acos
}  # fmt: skip
F64 = torch.float64


class Row(NamedTuple):
    """arrays: names of golden arrays. form: "official", its formula to the letter, or "lean", what fits run on.

    error: largest difference, divided by the array's largest entry where that exceeds 1.
    """

    arrays: str
    form: str
    error: float
    tolerance: float

    @property
    def holds(self) -> bool:
        """Within its tolerance."""
        return self.error <= self.tolerance


class Golden:
    """Golden arrays by name, float64, from the files of a folder."""

    def __init__(self, folder: Path | str) -> None:
        files = {path.name: np.load(path) for path in sorted(Path(folder).glob("humor_*.npz"))}
        self._names = {name: file.files for name, file in files.items()}
        self._arrays = {name: file[name] for file in files.values() for name in file.files}

    def __getitem__(self, name: str) -> Tensor:
        return torch.as_tensor(self._arrays[name], dtype=F64)

    def names(self, file: str) -> list[str]:
        """The arrays of one file."""
        return self._names[file]

    def states(self, prefix: str) -> Tensor:
        """The parts ``prefix``trans, ``prefix``trans_vel and so on as packed states (..., 339)."""
        return torch.cat([self[prefix + name] for name in SHAPES], -1)

    @property
    def weight_sums(self) -> dict[str, float]:
        """Sum of every tensor of the first set of weights."""
        return dict(zip(self._arrays["weight_check_keys"].tolist(), self["weight_check_sum"].tolist(), strict=True))


def seeded(alternative: bool = False) -> Cvae:
    """The full-size networks, float64, frozen, with one of the two sets of weights of the golden arrays."""
    model = Cvae()
    draw = np.random.RandomState(int(alternative))
    tensors = model.state_dict()
    for name in sorted(tensors):
        raw = draw.standard_normal(tuple(tensors[name].shape))
        last = 0.1 if name.startswith("decoder.net.9.") else 1.0
        if not alternative:
            value = raw * 0.02
        elif raw.ndim == 2:
            value = raw / np.sqrt(raw.shape[1]) * last
        else:
            value = 1 + 0.1 * raw if name.endswith("weight") else raw * 0.05 * (0.2 if last < 1 else 1.0)
        tensors[name] = torch.as_tensor(value.astype(np.float32))
    model.load_state_dict(tensors)
    return model.double().frozen()


def seeded_mixture() -> InitGmm:
    """The three-component mixture over first states of the golden arrays."""
    draw = np.random.RandomState(7)
    means, a = draw.standard_normal((3, 138)) * 0.3, draw.standard_normal((3, 138, 138)) * 0.05
    covariances = a @ a.swapaxes(1, 2) + 0.1 * np.eye(138)
    return InitGmm(torch.tensor([0.2, 0.3, 0.5], dtype=F64), torch.as_tensor(means), torch.as_tensor(covariances))


def difference(found: Tensor, golden: Tensor) -> float:
    """Largest difference over the largest golden entry, or over 1."""
    return ((found.reshape(golden.shape) - golden).abs().max() / golden.abs().max().clamp(min=1)).item()


def parity_rows(folder: Path | str) -> list[Row]:
    """Every comparison; ``folder`` holds the golden files (``tests/golden``). About two seconds on one core."""
    golden = Golden(folder)
    rows = [Row(*row) for row in _geometry(golden)]
    for alternative in (False, True):
        model = seeded(alternative)
        rows += [Row(*row) for row in _networks(golden, model, "alt_" if alternative else "")]
    return rows + [Row(*row) for row in _energies(golden)]


def gradients(
    golden: Golden, model: Cvae, prefix: str, roll: Callable[[Tensor, Tensor], rollout.Rollout]
) -> dict[str, Tensor]:
    """Gradients of the golden scalar in z and in every part of x0, under the names of the golden arrays."""
    first, z = golden["x_past"][:, 0].requires_grad_(), golden["roll_z"].requires_grad_()
    found = roll(first, z)
    joints, trans, root = (found.states[..., SLICES[n]] for n in ("joints", "trans", "root_orient"))
    loss = joints.square().sum() + trans.square().sum()
    if not prefix:
        surprise = 0.5 * (found.prior.log_var + (z - found.prior.mean).square() * (-found.prior.log_var).exp())
        loss = loss + root[..., 1].sum() + 0.1 * surprise.sum()
    by_first, by_z = torch.autograd.grad(loss, (first, z))
    return {"grad_loss": loss.detach(), "grad_z": by_z} | {f"grad_x0_{n}": by_first[:, None, SLICES[n]] for n in SHAPES}


def _geometry(golden: Golden) -> Iterator[tuple]:
    aa, matrix = golden["rot_aa_in"], golden["rot_mat_from_aa"]
    yield "rot_mat_from_aa", "official", difference(faithful_rotation.axis_angle_to_matrix(aa), matrix), EXACT
    found = faithful_rotation.matrix_to_axis_angle(matrix)
    yield "rot_aa_from_mat", "official", difference(found, golden["rot_aa_from_mat"]), EXACT
    yield (
        "w2a_from_root_mat",
        "official",
        difference(faithful_rotation.alignment(matrix), golden["w2a_from_root_mat"]),
        EXACT,
    )
    root = golden["world_root_orient"].unflatten(-1, (3, 3))[:, 0]
    yield "canon_w2a_rot", "official", difference(faithful_rotation.alignment(root), golden["canon_w2a_rot"]), EXACT
    lean = heading_frame(golden["world_trans"][:, 0], root).turn
    yield "canon_w2a_rot", "lean", difference(lean, golden["canon_w2a_rot"]), LOOSE["canon_w2a_rot"]
    yield "vel_lin", "lean", difference(velocity(golden["world_trans"], 30.0, dim=1), golden["vel_lin"]), EXACT
    spin = state.angular_velocity(golden["world_root_orient"].unflatten(-1, (3, 3)), 30.0)
    yield "vel_ang", "lean", difference(spin, golden["vel_ang"]), EXACT
    normal, offset = floor.normal_and_offset(golden["floor3"])
    yield "floor4", "lean", difference(torch.cat((normal, offset[:, None]), -1), golden["floor4"]), EXACT
    forms = ("official", faithful_rotation.axis_angle_to_matrix, EXACT), ("lean", rotation.exp, LOOSE["cam2prior_R"])
    for form, to_matrix, limit in forms:
        frame = floor.world_frame(golden["floor3"], golden["cam_trans"], to_matrix(golden["cam_root_aa"]))
        yield "cam2prior_R", form, difference(frame.turn, golden["cam2prior_R"]), limit
    above = floor.height(golden["floor3"], golden["cam_joints"][:, 0])
    yield "cam2prior_root_height", "lean", difference(above, golden["cam2prior_root_height"]), EXACT


def _networks(golden: Golden, model: Cvae, pre: str) -> Iterator[tuple]:
    past, now, z = golden["x_past"][:, 0], golden["x_t"][:, 0], golden["z"]
    if not pre:
        sums = [abs(float(model.state_dict()[k].sum()) - s) for k, s in golden.weight_sums.items()]
        yield "weight_check_sum", "lean", max(sums), EXACT
    posterior, prior, raw = model.posterior(past, now), model.prior(past), model.decode(past, z)
    for name, value in (
        ("encoder_raw", torch.cat(posterior, -1)),
        ("prior_raw", torch.cat(prior, -1)),
        ("decoder_raw", raw),
    ):
        yield pre + name, "lean", difference(value, golden[pre + name]), EXACT
    if not pre:
        yield (
            "kl_posterior_prior",
            "lean",
            difference(kl(posterior, prior).sum(-1), golden["kl_posterior_prior"]),
            EXACT,
        )
        decoded = torch.cat(state.apply(past, raw), -1)
        yield "decode_out", "lean", difference(decoded, golden["decode_out"]), LOOSE["decode_out"]
    yield from _rollouts(golden, model, pre)
    worlds = golden.states("world_")
    c = state.pelvis_offset(worlds[:, 0])
    for form, infer, limit in (
        ("official", faithful.infer(model, worlds), EXACT),
        ("lean", rollout.infer(model, worlds, offset=c), YAW),
    ):
        for name, found in zip(("post", "prior"), infer, strict=True):
            yield f"{pre}infer_{name}_mean", form, difference(found.mean, golden[f"{pre}infer_{name}_mean"]), limit


def _rollouts(golden: Golden, model: Cvae, pre: str) -> Iterator[tuple]:
    local, worlds, z = golden["x_past"][:, 0], golden.states("world_"), golden["roll_z"]
    c, c_world = state.pelvis_offset(local), state.pelvis_offset(worlds[:, 0])
    official = {
        "roll_": faithful.rollout(model, local, z, canonical=True),
        "rollworld_": faithful.rollout(model, worlds[:, 0], z),
    }
    lean = {
        "roll_": rollout.rollout(model, local, z, offset=c),
        "rollworld_": rollout.rollout(model, worlds[:, 0], z, offset=c_world),
    }
    if not pre:
        official["rollmean_"] = faithful.rollout(model, local, None, steps=z.shape[1], canonical=True)
        lean["rollmean_"] = rollout.sample(model, local, z.shape[1], offset=c)
    for form, runs, limit in (("official", official, EXACT), ("lean", lean, YAW)):
        for name, found in runs.items():
            yield f"{pre}{name}*", form, difference(found.states, golden.states(pre + name)), limit
            yield f"{pre}{name}contacts", form, difference(found.contact_logits, golden[f"{pre}{name}contacts"]), limit
        prior = runs["roll_"].prior
        for name, value in ((f"{pre}roll_prior_mean", prior.mean), (f"{pre}roll_prior_var", prior.log_var.exp())):
            loose = LOOSE.get(name, limit) if form == "lean" else limit
            yield name, form, difference(value, golden[name]), loose
    if not pre:
        found = faithful.rollout(model, worlds[:, 0], golden["infer_post_mean"]).states
        for name in ("joints", "trans"):
            yield f"recon_{name}", "official", difference(found[..., SLICES[name]], golden[f"recon_{name}"]), EXACT
    slopes = gradients(golden, model, pre, lambda first, z: faithful.rollout(model, first, z, canonical=True))
    for name in slopes if not pre else ("grad_loss", "grad_z", "grad_x0_joints"):
        yield pre + name, "official", difference(slopes[name], golden[pre + name]), EXACT
    slopes = gradients(golden, model, pre, lambda first, z: rollout.rollout(model, first, z, offset=c))
    for name in ("grad_loss", "grad_z"):  # what x0 does to the heading differs by construction
        yield pre + name, "lean", difference(slopes[name], golden[pre + name]), LOOSE.get(pre + name, YAW)


def _energies(golden: Golden) -> Iterator[tuple]:
    joints, other = golden["world_joints"].unflatten(-1, (22, 3)), golden["loss_joints_b"]
    touching, seen = golden["loss_contact_conf"], golden["reproj_obs"]
    initial = torch.tensor(floor.INITIAL, dtype=F64).expand(len(joints), 3)
    confidence = energies.body_25_confidence(seen[..., 2])
    prior = Gaussian(golden["roll_prior_mean"], golden["roll_prior_var"].log())
    values = {
        "loss_joints2d": energies.joints2d(golden["reproj_uv"], seen[..., :2], confidence),
        "loss_joints3d": energies.joints3d(joints, other),
        "loss_smooth": energies.joints3d_smooth(joints),
        "loss_motion_prior_nll": energies.motion_prior(golden["roll_z"], prior),
        "loss_joint_consistency": energies.joint_consistency(joints, other),
        "loss_bone_length": energies.bone_length(joints),
        "loss_contact_vel": energies.contact_vel(joints, touching),
        "loss_contact_height": energies.contact_height(joints, touching),
        "loss_floor_reg": energies.floor_reg(golden["floor3"], initial),
    }
    for name, value in values.items():
        yield name, "lean", difference(value.sum(), golden[name]), EXACT
    mixture = seeded_mixture().log_prob(golden["gmm_x"])
    yield "gmm_logprob", "lean", difference(mixture, golden["gmm_logprob"]), EXACT
    yield "gmof_sigma100", "lean", difference(energies.gmof(golden["gmof_in"]), golden["gmof_sigma100"]), EXACT
    accelerations = pose.acceleration(joints[0], 30.0)
    yield "metric_accel_mag", "lean", difference(accelerations, golden["metric_accel_mag"]), EXACT
    toes, depths = golden["metric_pen_joints"][:, [10, 11]], golden["metric_pen_thresholds"].tolist()
    counts = contact.floor_penetration(toes, depths=depths).frequency * golden["metric_pen_total"]
    yield "metric_pen_counts", "lean", difference(counts, golden["metric_pen_counts"]), EXACT
