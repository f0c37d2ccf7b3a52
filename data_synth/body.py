"""Bodies with a known truth: a quick one of capsules, and one whose skinning weights have planted faults."""

from dataclasses import replace

import torch
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD
from motionlab.skinning import tree_distance

# Each line is one bone of flesh: the joint that carries it, from and to (a joint, or metres from the carrier), radii.
_LEFT = [
    ("left_hip", "left_hip", "left_knee", 0.088, 0.056),
    ("left_knee", "left_knee", "left_ankle", 0.056, 0.037),
    ("left_ankle", (0.0, 0.0, -0.005), (0.0, -0.045, -0.040), 0.034, 0.034),
    ("left_ankle", (0.0, -0.035, 0.0), (0.0, -0.050, 0.120), 0.034, 0.028),
    ("left_foot", (0.014, 0.016, -0.010), (0.020, 0.012, 0.050), 0.024, 0.018),
    ("left_foot", (-0.018, 0.016, -0.010), (-0.018, 0.012, 0.070), 0.024, 0.018),
    ("left_collar", "left_collar", "left_shoulder", 0.075, 0.062),
    ("left_shoulder", "left_shoulder", "left_elbow", 0.056, 0.042),
    ("left_elbow", "left_elbow", "left_wrist", 0.042, 0.028),
    ("left_wrist", "left_wrist", (0.165, 0.0, 0.0), 0.032, 0.026),
]
_MIDDLE = [
    ("pelvis", (0.085, -0.01, 0.0), (-0.085, -0.01, 0.0), 0.095, 0.095),
    ("spine1", (0.062, 0.0, 0.02), (-0.062, 0.0, 0.02), 0.100, 0.100),
    ("spine2", (0.068, 0.0, 0.015), (-0.068, 0.0, 0.015), 0.104, 0.104),
    ("spine3", (0.075, 0.10, 0.015), (-0.075, 0.10, 0.015), 0.118, 0.118),
    ("spine3", (0.080, 0.20, 0.015), (-0.080, 0.20, 0.015), 0.100, 0.100),
    ("neck", "neck", "head", 0.060, 0.058),
    ("head", (0.0, 0.035, 0.045), (0.0, 0.125, 0.015), 0.078, 0.094),
    ("head", (0.0, 0.045, 0.120), (0.0, 0.075, 0.110), 0.018, 0.012),
]
# Surface keypoints: the vertex nearest to a place given in metres from a joint.
_KEYPOINTS = {
    "nose": ("head", (0.0, 0.045, 0.140)),
    "left_eye": ("head", (0.032, 0.080, 0.115)),
    "left_ear": ("head", (0.095, 0.060, 0.020)),
    "left_big_toe": ("left_foot", (-0.018, 0.005, 0.100)),
    "left_small_toe": ("left_foot", (0.025, 0.005, 0.085)),
    "left_heel": ("left_ankle", (0.0, -0.045, -0.085)),
}
_BLEND = 0.016  # metres over which neighbouring flesh runs into each other
_SOFT = 0.03  # metres over which one joint's weight fades into the next one's


def capsule_body(spacing: float = 0.02) -> BodyModel:
    """A closed body of rounded capsules around ``STANDARD``, bound in the T-pose, made in about a second.

    Its weights are clean by construction: every vertex hangs on the joint whose flesh it is and on
    joints at most two bones away, no entry is below 0.02, none is long-range. The soles are flat.
    spacing: metres between samples of the implicit surface; 0.02 gives about 8,000 vertices.
    """
    import pyvista as pv  # takes a second or more to load

    rest = STANDARD.rest_positions()
    owners, starts, ends, radii = _flesh(rest)
    thick = radii.amax(1, keepdim=True) + _BLEND
    low = ((torch.minimum(starts, ends) - thick).amin(0) / spacing).floor().int()
    high = ((torch.maximum(starts, ends) + thick).amax(0) / spacing).ceil().int()
    corner = (spacing * low).tolist()
    grid = pv.ImageData(dimensions=(high - low + 1).tolist(), spacing=(spacing,) * 3, origin=corner)
    points = torch.tensor(grid.points).float()
    near = (_distance(some, starts, ends, radii) for some in points.split(8192))  # at once is slower: beyond the cache
    field = torch.cat([-_BLEND * torch.logsumexp(-some / _BLEND, dim=1) for some in near])
    floor = rest[:, 1].min() - STANDARD.sole
    field = torch.maximum(field, floor - points[:, 1])
    surface = grid.contour([0.0], scalars=field.numpy(), compute_normals=False, compute_scalars=False)
    surface = surface.triangulate().clean().compute_normals(auto_orient_normals=True)
    vertices = torch.tensor(surface.points).float()
    return BodyModel(
        template=vertices,
        joints=rest,
        bind_rot=torch.eye(3).repeat(len(STANDARD), 1, 1),
        weights=_clean_weights(_distance(vertices, starts, ends, radii), owners),
        faces=torch.tensor(surface.faces.reshape(-1, 4)[:, 1:]).long(),
        skeleton=replace(STANDARD, sole=float(rest[:, 1].min() - vertices[:, 1].min())),
        keypoint_vertices=_keypoints(vertices, rest),
    )


def planted(body: BodyModel, generator: torch.Generator, share: float = 0.03) -> tuple[BodyModel, Tensor]:
    """The body with spurious long-range skinning weights like those that the thesis found in SMPL.

    Entries that were zero get a weight below 0.01, always on joints at least four steps along the
    tree from every joint that the vertex truly hangs on; rows are renormalised. The nose is planted as
    printed: 0.2 % shared by the right hip, left knee and right knee. share: of all non-zero weights.

    Returns:
        The body, and a mask (V, J), True where an entry was planted.
    Source: thesis 3.3.2.
    Raises:
        ShapeError: the share asks for more far entries than there are.
    """
    owned = body.weights > 0
    far = (tree_distance(body.skeleton) >= 4).to(body.weights)  # (J, J)
    possible = (owned.to(body.weights) @ (1 - far)) == 0  # (V, J): far from every true joint
    nose = body.keypoint_vertices["nose"]
    thesis = body.skeleton.indices(["right_hip", "left_knee", "right_knee"])
    mask = torch.zeros_like(owned)
    mask[nose, thesis] = True
    possible[nose] = False
    places = possible.nonzero()
    count = round(share / (1 - share) * int(owned.sum())) - len(thesis)
    if not 0 <= count <= len(places):
        raise ShapeError(f"share {share}: needs {count} planted entries, this body has room for 0 to {len(places)}")
    chosen = places[torch.randperm(len(places), generator=generator)[:count]]
    mask[chosen[:, 0], chosen[:, 1]] = True
    extra = 1e-2 * (0.02 + 0.93 * torch.rand(mask.shape, generator=generator, dtype=body.weights.dtype))
    extra[nose] = 0.002 / len(thesis)
    extra = torch.where(mask, extra, 0)
    weights = body.weights * (1 - extra.sum(1, keepdim=True)) + extra
    return replace(body, weights=weights), mask


def _flesh(rest: Tensor) -> tuple[list[int], Tensor, Tensor, Tensor]:
    def at(joint: int, end: str | tuple) -> Tensor:
        return rest[STANDARD.index(end)] if isinstance(end, str) else rest[joint] + torch.tensor(end)

    lines = [*_MIDDLE, *_LEFT, *map(_mirrored, _LEFT)]
    owners = [STANDARD.index(line[0]) for line in lines]
    starts, ends = (torch.stack([at(o, line[k]) for o, line in zip(owners, lines, strict=True)]) for k in (1, 2))
    return owners, starts, ends, torch.tensor([line[3:] for line in lines])


def _mirrored(line: tuple) -> tuple:
    ends = [e.replace("left_", "right_") if isinstance(e, str) else (-e[0], *e[1:]) for e in line[:3]]
    return (*ends, *line[3:])


def _distance(points: Tensor, starts: Tensor, ends: Tensor, radii: Tensor) -> Tensor:
    """Signed distance (N, S) from points to rounded cones, metres."""
    bones = ends - starts
    along = torch.einsum("nsc,sc->ns", points[:, None] - starts, bones) / bones.square().sum(-1)
    along = along.clamp(0, 1)
    nearest = starts + along[..., None] * bones
    return torch.linalg.vector_norm(points[:, None] - nearest, dim=-1) - torch.lerp(radii[:, 0], radii[:, 1], along)


def _clean_weights(distance: Tensor, owners: list[int]) -> Tensor:
    count = len(STANDARD)
    joint = torch.full((len(distance), count), torch.inf)
    joint.scatter_reduce_(1, torch.tensor(owners).expand_as(distance), distance, "amin")
    near = tree_distance(STANDARD) <= 2
    joint = joint.masked_fill(~near[joint.argmin(1)], torch.inf)
    weights = torch.softmax(-joint / _SOFT, dim=1).sub(0.05).clamp(min=0)
    weights = torch.where(weights < 0.02, 0, weights)
    return weights / weights.sum(1, keepdim=True)


def _keypoints(vertices: Tensor, rest: Tensor) -> dict[str, int]:
    found = {}
    for name, (joint, offset) in _KEYPOINTS.items():
        for side in ("left_", "right_") if "left_" in name else ("",):
            sign = torch.tensor([-1.0 if side == "right_" else 1.0, 1.0, 1.0])
            here = rest[STANDARD.index(joint.replace("left_", side))] + sign * torch.tensor(offset)
            found[name.replace("left_", side)] = int((vertices - here).norm(dim=1).argmin())
    return found
