import math

import torch

from motionlab import rotation
from motionlab.skeleton import UPRIGHT
from studies.nb02_rotations import representations as rep


def turning(count=12, seconds=1.0, fps=30.0, seed=0, across=True):
    """Upright bodies (N, T, 3, 3) that turn about the vertical, through the branch cut or away from it."""
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(round(seconds * fps)) / fps - seconds / 2
    speed = 1.0 + 2.0 * torch.rand(count, 1, generator=g)
    centre = 0.0 if across else math.pi  # UPRIGHT faces +y, and its rotation angle is exactly pi
    lean = rotation.axis_angle_to_matrix(0.05 * torch.randn(count, 1, 3, generator=g))
    return rotation.rotation_about("z", centre + speed * t) @ UPRIGHT @ lean


def test_flips_are_found_where_the_vectors_disagree_and_the_rotations_agree():
    path = turning()
    carried, decoded = rep.carried_and_decoded(path)
    torch.testing.assert_close(rotation.axis_angle_to_matrix(carried), path, atol=1e-5, rtol=0)
    torch.testing.assert_close(rotation.axis_angle_to_matrix(decoded), path, atol=1e-5, rtol=0)
    flipped = rep.flipped(carried, decoded)
    assert flipped.any(-1).all()
    assert (rep.count_changes(flipped) >= 1).all()  # the frame before the cut agrees
    torch.testing.assert_close(rep.nearest_vector(decoded, carried), carried, atol=1e-4, rtol=0)
    away = rep.carried_and_decoded(turning(across=False))
    assert not rep.flipped(*away).any()
