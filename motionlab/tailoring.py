"""Puts the flesh of a body on the bones of another person: a template of that person's proportions.

A recording's spine, neck and collars stand elsewhere than a body's (CMU's neck lies below the shoulders). Posing the
body's own template with them crushes its chest. So the template is remade: limbs as long as the person's, and between
hips and shoulders the body's own trunk, scaled.
"""

from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel
from motionlab.skeleton import STANDARD, Skeleton

_SIDES = ("left", "right")
_LIMBS = (("collar", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")
_BOUND = 0.3  # widths of hips and chest and lengths of feet stay within this share of what the person's size says


@lru_cache(maxsize=8)
def tailored(body: BodyModel, skeleton: Skeleton) -> BodyModel:
    """Computes the body of a person from a body and the person's skeleton, for :func:`motionlab.body.lbs`.

    Around each joint the template is stretched: limbs along their bones, to the person's lengths; the trunk to the
    person's height of the shoulders above the hips and widths of both, leaning as they do; all else by the person's
    size. Hips and shoulders are where the person's are, the soles where the skeleton's are, and every joint of the
    result is the skeleton's, so that whatever poses it stays as it is.

    Args:
        body: on the 22 standard joints. skeleton: the same joints, offsets (J, 3) metres.

    Returns:
        the body with another template and other joints; ``body`` itself where the skeleton is its own within
        1 mm or has other joints.
    """
    own, theirs = body.skeleton.to(torch.float64), skeleton.to(torch.float64)
    theirs = replace(theirs, offsets=theirs.offsets.reshape(-1, 3))
    if own.names != STANDARD.names or theirs.names != own.names or (own.offsets - theirs.offsets).abs().max() < 1e-3:
        return body
    bind = body.bind_rot.double()
    stretch, flesh, lift = _stretches(own, theirs)
    stretch = bind @ stretch @ bind.mT
    centres = flesh.rest_positions(bind) + (bind @ lift[..., None])[..., 0]
    shift = centres - (stretch @ body.joints.double()[..., None])[..., 0]
    weights = body.weights.double()
    turned = (weights @ stretch.flatten(1)).unflatten(1, (3, 3)) @ body.template.double()[..., None]
    # the middle of the hips is where the person's is: the pelvis, which no flesh marks, is somewhere else in it
    template = turned[..., 0] + weights @ shift + _hips(theirs) - _hips(flesh)
    joints = theirs.rest_positions(bind)
    return replace(
        body, template=template.to(body.template), joints=joints.to(body.joints), skeleton=theirs.to(body.joints)
    )


def _pair(part: str) -> list[int]:
    """The left and the right joint."""
    return STANDARD.indices([f"{side}_{part}" for side in _SIDES])


def _hips(skeleton: Skeleton) -> Tensor:
    return skeleton.offsets[_pair("hip")].mean(0)


def _stretches(own: Skeleton, theirs: Skeleton) -> tuple[Tensor, Skeleton, Tensor]:
    """How the flesh around each joint is stretched (J, 3, 3) in the T-pose, the skeleton inside it, and by how much it
    is lifted (J, 3)."""
    before, after = own.rest_positions(), theirs.rest_positions()
    limbs = [joint for part in ("knee", "ankle", "elbow", "wrist") for joint in _pair(part)]
    # from between the hips to between the shoulders
    trunk, theirs_trunk = (rest[_pair("shoulder")].mean(0) - rest[_pair("hip")].mean(0) for rest in (before, after))
    reach, theirs_reach = (
        each.offsets[limbs].norm(dim=-1).sum() + 4 * high for each, high in ((own, trunk[1]), (theirs, theirs_trunk[1]))
    )
    size, high = theirs_reach / reach, theirs_trunk[1] / trunk[1]
    lean = (theirs_trunk[2] - size * trunk[2]) / trunk[1]

    def bounded(ratio: Tensor) -> Tensor:
        return ratio.clamp((1 - _BOUND) * size, (1 + _BOUND) * size)

    hips, shoulders = (
        bounded(after[_pair(part), 0].diff()[0] / before[_pair(part), 0].diff()[0]) for part in ("hip", "shoulder")
    )
    stretch = size * torch.eye(3).to(after).repeat(len(own), 1, 1)
    for share, name in zip(torch.linspace(0, 1, len(_TRUNK)), _TRUNK, strict=True):
        wide = torch.lerp(hips, shoulders, share.to(size))
        stretch[own.index(name)] = torch.diag(torch.stack((wide, high, size)))
        stretch[own.index(name), 2, 1] = lean
    offsets = theirs.offsets.clone()
    inner = [*own.indices(["spine1", "spine2", "spine3", "neck", "head"]), *_pair("collar")]
    offsets[inner] = (stretch[[own.parents[j] for j in inner]] @ own.offsets[inner][..., None])[..., 0]
    shift = stretch[0] @ _hips(own) - _hips(theirs)
    offsets[_pair("hip")] += shift
    collars = replace(theirs, offsets=offsets).rest_positions()[_pair("collar")]
    offsets[_pair("shoulder")] = after[_pair("shoulder")] + shift - collars
    flesh = replace(theirs, offsets=offsets)
    lift = torch.zeros_like(after)
    for side in _SIDES:
        for part, child in _LIMBS:
            joint, end = own.index(f"{side}_{part}"), own.index(f"{side}_{child}")
            stretch[joint] = _along(own.offsets[end], offsets[end], size)
        ankle, ball = own.indices([f"{side}_ankle", f"{side}_foot"])
        was, now = (x.offsets[ball] * torch.tensor([1.0, 0.0, 1.0]).to(after) for x in (own, flesh))
        long = bounded(now.norm() / was.norm())
        stretch[[ankle, ball]] = rotation.rotation_between(was, now) @ torch.diag(torch.stack((size, size, long)))
        lift[ankle, 1] = size * (own.sole - own.offsets[ball, 1]) - (theirs.sole - offsets[ball, 1])
    return stretch, flesh, lift


def _along(was: Tensor, now: Tensor, girth: Tensor) -> Tensor:
    """The map (3, 3) that takes one bone to another and what lies across it by ``girth``."""
    share = torch.outer(was, was) / was.square().sum()
    return rotation.rotation_between(was, now) @ (
        girth * (torch.eye(3).to(was) - share) + now.norm() / was.norm() * share
    )
