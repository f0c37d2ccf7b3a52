"""Windows that the denoiser learns from, and the masks of what it is told."""

from dataclasses import replace

import pytest
import torch

from motionlab.diffusion import windows
from motionlab.diffusion.features import UNITS
from motionlab.errors import DataError, ShapeError
from motionlab.metrics import slide_in_contact_mm
from motionlab.motion import fix_root_horizontally, mirror
from motionlab.skeleton import STANDARD

PLACE, CONTACTS = UNITS - 2, UNITS - 1


# ------------------------------------------------------------------------------------------------- windows
def test_windows_begin_at_every_frame_and_lie_inside_one_motion(motions):
    data = windows.gather(motions, 20, mirrored=False)
    assert len(data.begins) == sum(m.frames - 19 for m in motions)
    assert torch.equal(data.clip[data.begins], data.clip[data.begins + 19])
    every = data.evenly(10**6)
    at = motions[0].frames - 19  # the first of the second motion
    assert torch.equal(every.root[at], motions[1].root[:20].float())
    assert torch.equal(every.rot[at - 1], motions[0].rot[-20:].float())
    assert torch.equal(every.contacts[7], motions[0].contacts[7:27].float())
    assert torch.equal(every.skeleton.offsets[at, 0], motions[1].skeleton.offsets)
    assert len(data.root) == sum(m.frames for m in motions)


def test_half_of_what_is_drawn_is_seen_in_the_mirror(motions):
    plain, both = (windows.gather(motions, 20, mirrored=mirrored) for mirrored in (False, True))
    a, b = (data.draw(200, torch.Generator().manual_seed(0)) for data in (plain, both))  # the same begins
    other = mirror(a)
    seen = torch.tensor([torch.equal(x, y) for x, y in zip(b.root, other.root, strict=True)])
    for x, same, turned in (
        (b.root, a.root, other.root), (b.rot, a.rot, other.rot), (b.contacts, a.contacts, other.contacts),
        (b.skeleton.offsets, a.skeleton.offsets, other.skeleton.offsets),
    ):  # fmt: skip
        assert torch.equal(x[seen], turned[seen]) and torch.equal(x[~seen], same[~seen])
    assert 70 < seen.sum() < 130


def test_joints_that_a_motion_lacks_are_not_seen_nor_are_their_mirror_images(motions):
    data = windows.gather([motions[0].cut(0, 19), *motions], 20, missing=[("head",), ("left_foot",), ()])
    unseen = [name for name, seen in zip(STANDARD.names, data.seen[0], strict=True) if not seen]
    assert unseen == ["left_foot", "right_foot"] and data.seen[1].all() and len(data.seen) == 2
    whole = windows.gather(motions, 20, missing=[(), ()])
    assert whole.seen is None and whole.digest == windows.gather(motions, 20).digest != data.digest
    with pytest.raises(ValueError, match="zip"):
        windows.gather(motions, 20, missing=[()])


def test_a_draw_follows_its_generator_and_the_digest_the_numbers(motions):
    data = windows.gather(motions, 20)
    one, same, other = (data.draw(9, torch.Generator().manual_seed(seed)).root for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)
    moved = replace(motions[0], root=motions[0].root + 1e-3)
    others = [
        windows.gather([moved, motions[1]], 20), windows.gather(motions, 21), windows.gather(motions[:1], 20),
        windows.gather(motions, 20, mirrored=False), windows.gather([fix_root_horizontally(m) for m in motions], 20),
    ]  # fmt: skip
    assert windows.gather(motions, 20).digest == data.digest
    assert len({data.digest, *(x.digest for x in others)}) == 6


@pytest.mark.parametrize(
    ("change", "complaint", "error"),
    [
        (lambda m: m.cut(0, 8), "20 frames", DataError),
        (lambda m: replace(m, root=m.root * torch.nan), "not finite", DataError),
        (lambda m: replace(m, rot=m.rot[None], root=m.root[None], contacts=m.contacts[None]), "22 joints", ShapeError),
    ],
)
def test_motions_that_cannot_be_learned_from(motions, change, complaint, error):
    with pytest.raises(error, match=complaint):
        windows.gather([change(motions[0])], 20)


def test_motions_that_do_not_go_together(motions):
    with pytest.raises(DataError, match=r"one has contacts .*with_contacts"):
        windows.gather([motions[0], replace(motions[1], contacts=None)], 20)
    with pytest.raises(DataError, match=r"another frame rate .*resample"):
        windows.gather([motions[0], motions[1].cut(step=2)], 20)


def test_on_the_standard_body_feet_stand_where_they_stood(motions):
    joints = STANDARD.indices(["left_foot", "right_foot"])
    feet = [STANDARD.contact_names.index(f"{side}_foot") for side in ("left", "right")]

    def slide(motion):
        return float(slide_in_contact_mm(motion.positions[:, joints], motions[1].contacts[:, feet]))

    moved = windows.on_standard(motions[1])
    assert moved.skeleton is STANDARD and torch.equal(moved.contacts, motions[1].contacts)
    bare = replace(motions[1], skeleton=STANDARD)  # the same angles on another body: what it is better than
    assert slide(moved) < 0.05 < 0.15 < slide(bare)
    same = windows.on_standard(moved)
    assert torch.allclose(same.positions, moved.positions, atol=1e-3)


# --------------------------------------------------------------------------------------------------- masks
def drawn(kind, generator, count=60, frames=20):
    return windows.draw_units(frames, count, generator, {kind: 1.0})


def test_onward_is_all_behind_a_beginning(generator):
    m = drawn("onward", generator)[..., 0]
    assert m[:, 0].all() and not m[:, -1].any() and (m.int().diff(dim=1) <= 0).all() and len(m.sum(1).unique()) > 3


def test_gaps_are_one_run_of_frames_with_something_known(generator):
    m = drawn("gap", generator)
    rows = m.all(-1)
    assert torch.equal(rows, m.any(-1))  # whole frames
    unknown = (~rows).int()
    assert (unknown.sum(1) > 0).all() and (rows.sum(1) > 0).all()
    edges = torch.nn.functional.pad(unknown, (1, 1)).diff(dim=1)
    assert ((edges == 1).sum(1) == 1).all()
    assert unknown.sum(1).min() < 6 and unknown.sum(1).max() > 14


def test_frames_and_entries_change_from_frame_to_frame_and_joints_do_not(generator):
    frames, entries, joints = (drawn(kind, generator) for kind in ("frames", "entries", "joints"))
    assert torch.equal(frames.all(-1), frames.any(-1))
    assert torch.equal(joints, joints[:, :1].expand_as(joints))
    assert (entries != entries[:, :1]).any(-1).any(-1).float().mean() > 0.8
    assert not entries[..., CONTACTS].any() and not joints[..., CONTACTS].any() and frames[..., CONTACTS].any()
    for m in (frames, entries, joints):
        share = m.float().mean((1, 2))
        assert share.min() < 0.25 and share.max() > 0.7


def test_legs_are_asked_with_and_without_the_roots_place(generator):
    m = drawn("legs", generator)
    legs = [j for j, name in enumerate(STANDARD.names) if name.endswith(("hip", "knee", "ankle", "foot"))]
    others = [j for j in range(len(STANDARD)) if j not in legs]
    assert len(legs) == 8 and not m[..., legs].any() and m[..., others].all() and not m[..., CONTACTS].any()
    assert 10 < m[..., PLACE].all(-1).sum() < 50


@pytest.mark.parametrize("kinds", [{}, {"arms": 1.0}, {"gap": 0.0}])
def test_unknown_kinds_are_refused(generator, kinds):
    with pytest.raises(ValueError, match="expected odds above 0"):
        windows.draw_units(20, 3, generator, kinds)


def test_what_lies_between_has_known_frames_on_either_side(generator):
    known = windows.draw_units(20, 200, generator, {"between": 1.0})
    assert known[:, :5].all() and known[:, -5:].all()
    hidden = 20 - known[..., 0].sum(1)
    assert hidden.min() >= 1 and hidden.max() <= 9 and len(hidden.unique()) > 5
    assert (known[..., 0].float().diff(dim=1) < 0).sum(1).eq(1).all()  # one run


def test_lone_keys_are_evenly_apart_and_begin_anywhere(generator):
    known = windows.draw_units(60, 400, generator, {"keys": 1.0})
    apart, first = set(), set()
    for each in known[..., 0]:
        keys = each.nonzero()[:, 0]
        first.add(int(keys[0]))
        apart |= set(keys.diff().tolist()) if keys.diff().unique().numel() < 2 else {0}
    assert torch.equal(known, known[..., :1].expand_as(known)) and min(apart) == 4 and 40 < max(apart) <= 45
    assert min(first) == 0 and max(first) > 30
    assert not windows.draw_units(3, 50, generator, {"keys": 1.0}).any(1).logical_not().any()  # at least one
