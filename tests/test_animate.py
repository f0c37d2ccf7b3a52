"""The animator's commands: what is kept stays to the bit, nothing hidden is read, no seam, feet stand, clear errors."""

import asyncio
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from rigs_made import made

from motionlab import __main__, baselines, io, rotation
from motionlab.animate import filling, restore, rewriting
from motionlab.animate.corrections import WINDOW, KeyMask, Rig, by_windows, overlapping
from motionlab.baselines import Noise
from motionlab.body import BodyModel
from motionlab.contact import with_contacts
from motionlab.diffusion.windows import on_standard
from motionlab.errors import DataError
from motionlab.io import bvh, gltf, smpl
from motionlab.metrics import acceleration
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT

SAVE = {".bvh": bvh.save, ".npz": smpl.save_motion, ".glb": gltf.save}
KEYS = "0,45,80-100,last"
MIXAMO = {name: own.removeprefix("mixamorig:") for name, own in made("Mixamo")[1].items()}


def walk(frames: int = 130, fps: float = 24.0) -> Motion:
    """Somebody who walks along +y at 1 m/s: hips, knees and shoulders swing, once in 1.1 seconds."""
    phase = 2 * torch.pi * torch.arange(frames) / fps / 1.1
    rot = torch.eye(3).repeat(frames, len(STANDARD), 1, 1)
    rot[:, 0] = UPRIGHT @ rotation.rotation_about("y", 0.05 * phase.sin())
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at = {part: STANDARD.index(f"{side}_{part}") for part in ("hip", "knee", "shoulder")}
        rot[:, at["hip"]] = rotation.rotation_about("x", -0.35 * sign * phase.sin())
        rot[:, at["knee"]] = rotation.rotation_about("x", 0.4 - 0.35 * sign * phase.cos())
        down = rotation.rotation_about("z", torch.full((frames,), -1.3 * sign))
        rot[:, at["shoulder"]] = rotation.rotation_about("x", 0.3 * sign * phase.sin()) @ down
    root = torch.zeros(frames, 3)
    root[:, 1], root[:, 2] = torch.arange(frames) / fps, float(STANDARD.standing_height()) - 0.03
    return Motion(STANDARD, root, rot, fps, name="walk")


def mixamo(motion: Motion) -> Motion:
    return replace(motion, skeleton=replace(motion.skeleton, names=tuple(MIXAMO[n] for n in STANDARD.names),
                                            contact_names=()))  # fmt: skip


def same(a: Motion, b: Motion, keep: KeyMask) -> bool:
    """Is what is kept of ``a`` in ``b`` to the bit?"""
    rot = (a.rot == b.rot).all(-1).all(-1) | ~keep.rot
    return bool(rot.all() and ((a.root == b.root).all(-1) | ~keep.rot[:, 0]).all())


def command(*words: object) -> int:
    return __main__.main([str(word) for word in words])


# ------------------------------------------------------------------------------------------------ what is kept
@pytest.mark.parametrize("suffix", [".bvh", ".npz", ".glb"])
def test_known_frames_stay_in_the_file_to_the_bit_and_the_rest_is_what_was_made(suffix, tmp_path, capsys):
    source, out = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    SAVE[suffix](source, walk())
    assert command("inbetween", source, "--keys", KEYS, "--method", "curves", "--out", out) == 0
    before, after = io.load(source), io.load(out)
    keep = filling.key_mask(before, filling.frames_named(KEYS, before.frames))
    assert keep.frames.sum() == 24 and "byte for byte" in capsys.readouterr().out
    assert same(before, after, keep) and after.fps == before.fps and after.skeleton.names == before.skeleton.names
    made = filling.inbetween(before, keep, method="curves").motion
    assert (after.positions - made.positions).abs().max() < 1e-4
    assert (after.positions - before.positions)[~keep.frames].norm(dim=-1).max() > 0.02  # it was filled in
    if suffix == ".bvh":
        old, new = (path.read_text().splitlines()[-before.frames :] for path in (source, out))
        assert [a == b for a, b in zip(old, new, strict=True)] == keep.frames.tolist()
    if suffix == ".npz":
        old, new = (np.load(path) for path in (source, out))
        assert set(old) == set(new) and (old["poses"][keep.frames] == new["poses"][keep.frames]).all()
    smoothed = baselines.smoothed(before, 5)  # a method that does not care what is kept
    assert not same(before, smoothed, keep)


@pytest.mark.parametrize(("method", "seed"), [("network", None), ("network", 0), ("curves", None)])
def test_kept_joints_stay_and_what_is_not_kept_is_never_read(method, seed):
    motion = mixamo(walk())
    keep = filling.key_mask(motion, {0, 40, 129}, ["arms", "Head"])
    generator = torch.Generator().manual_seed(0)
    other = rotation.random(motion.rot.shape[:2], generator)
    scrambled = replace(motion, rot=torch.where(keep.rot[..., None, None], motion.rot, other))
    scrambled = replace(scrambled, root=torch.where(keep.rot[:, :1], motion.root, motion.root + 3.0))
    made, again = (filling.inbetween(m, keep, method=method, seed=seed).motion for m in (motion, scrambled))
    assert same(motion, made, keep) and torch.equal(made.rot, again.rot) and torch.equal(made.root, again.root)
    assert keep.joints.sum() == 7 and not torch.equal(made.rot, motion.rot)


def test_hidden_legs_are_made_from_the_rest_alone_in_windows_that_overlap():
    motion = mixamo(walk(150))
    legs = sorted(filling.found_joints(motion, ["legs"]))
    rot = motion.rot.clone()
    rot[:, legs] = rotation.random((150, len(legs)), torch.Generator().manual_seed(1))
    made, again = (filling.completed(m, ["legs"], plant=False).motion for m in (motion, replace(motion, rot=rot)))
    others = [j for j in range(len(STANDARD)) if j not in legs]
    assert torch.equal(made.rot, again.rot) and torch.equal(made.rot[:, others], motion.rot[:, others])
    assert torch.equal(made.root, motion.root)
    starts = overlapping(0, 188, 188)
    assert starts[0] == 0 and starts[-1] == 188 - WINDOW and max(np.diff(starts)) <= 20
    size = acceleration(made.positions, made.fps)[:, legs].mean(-1)
    assert size.max() < 6 * size.median()  # no frame at which windows meet stands out


def test_a_seed_draws_one_motion_and_another_seed_another():
    motion = mixamo(walk(60))
    keep = filling.key_mask(motion, {0, 1, 58, 59})
    found = [filling.inbetween(motion, keep, seed=seed) for seed in (0, 0, 1, None)]
    assert ["drawn" in " ".join(made.notes) for made in found] == [True, True, True, False]
    drawn = [made.motion.rot for made in found]
    assert torch.equal(drawn[0], drawn[1])
    assert all((drawn[0] - other).abs().max() > 0.02 for other in drawn[2:])
    for draw in (partial(filling.completed, motion, ["legs"]), partial(restore.generated, 1.0)):
        first, again, other = (draw(seed=seed).motion.rot for seed in (0, 0, 1))
        assert torch.equal(first, again) and not torch.equal(first, other)


@pytest.mark.parametrize(("first", "last"), [(0, 200), (30, 200), (30, 150), (30, 99)])
def test_draws_go_on_from_each_other_and_are_never_averaged(first, last):
    """Every window filled in is numbered; each frame has the number of one of them, and knows the frames before it."""
    motion = with_contacts(walk(200, 30.0))
    known = torch.ones(200, 24, dtype=torch.bool)
    known[first:last] = False

    def filled(onward: bool) -> tuple[torch.Tensor, list[torch.Tensor]]:
        told = []

        def fill(windows: Motion, k: torch.Tensor) -> Motion:
            told.extend(k)
            number = torch.arange(len(told) - len(k), len(told))[:, None, None]
            return replace(windows, root=number.expand_as(windows.root).float())

        made = by_windows(fill, torch.zeros(22, dtype=torch.bool), onward=onward)(motion, known)
        return made.root[first:last, 0], told

    numbers, told = filled(onward=True)
    assert torch.equal(numbers, numbers.round()) and (numbers.diff() >= 0).all() and numbers.max() == len(told) - 1
    assert all(k[:10, 0].all() for k in told[1:])
    if last < 200:
        assert told[-1][-2:, 0].all()  # the last one sees where it has to arrive
    mixed, _ = filled(onward=False)
    assert not torch.equal(mixed, mixed.round())


# ---------------------------------------------------------------------------------------------- seams and feet
def seam(made: Motion, keep: KeyMask) -> float:
    """The largest change of velocity (m/s) at the frames beside a gap, over that inside what is known."""
    change = made.positions.diff(n=2, dim=0).norm(dim=-1).amax(-1) * made.fps
    beside = (keep.frames[:-1] ^ keep.frames[1:]).nonzero()[:, 0]
    at = torch.cat((beside - 1, beside)).clamp(0, len(change) - 1)
    inside = keep.frames[:-2] & keep.frames[1:-1] & keep.frames[2:]
    return float(change[at].max() / change[inside].max())


@pytest.mark.parametrize("method", ["network", "curves"])
@pytest.mark.parametrize("gap", [20, 100])
def test_no_seam_at_the_ends_of_a_gap_shorter_or_longer_than_a_window(method, gap):
    motion = walk(180, 30.0)
    keep = filling.key_mask(motion, set(range(180)) - set(range(40, 40 + gap)))
    made = filling.inbetween(motion, keep, method=method).motion
    assert seam(made, keep) < 4
    at = torch.where(keep.frames, torch.arange(180), 39)
    held = replace(motion, rot=motion.rot[at], root=motion.root[at])
    assert seam(held, keep) > 8  # a pose that waits, and jumps at the end


def test_feet_that_stand_are_planted_where_the_known_frames_have_them():
    motion = walk(60, 30.0)
    still = replace(motion, rot=motion.rot[:1].repeat(60, 1, 1, 1), root=motion.root[:1].repeat(60, 1))
    sway = torch.zeros(60)
    sway[20:40] = 0.04 * torch.hann_window(20)
    given = replace(still, root=still.root + torch.stack((sway, 0 * sway, 0 * sway), -1))
    keep = filling.key_mask(given, set(range(20)) | set(range(40, 60)))
    body = Rig.of(given, given, keep)
    feet = STANDARD.indices(["left_foot", "right_foot"])
    slid, stood = (body.to_own_rig(body.joints, plant=p).positions[:, feet] for p in (False, True))
    down = given.positions[0, feet, 2].argmin()
    assert (slid[:, down] - slid[0, down]).norm(dim=-1).max() > 0.03
    assert (stood[:, down] - stood[0, down]).norm(dim=-1).max() < 0.005


# ------------------------------------------------------------------------------------------------------ others
def test_noise_is_measured_and_taken_away_and_a_clean_motion_stays():
    motion = walk(120, 30.0)
    noise = Noise.of(3.0, 1.0)
    noisy = noise.on(motion, torch.Generator().manual_seed(0))
    found = restore._measured_noise(noisy)
    assert found.turn == pytest.approx(noise.turn, rel=0.15) and found.shift == pytest.approx(noise.shift, rel=0.3)
    assert torch.equal(restore.repaired(motion).motion.rot, motion.rot)
    before = (noisy.positions - motion.positions).norm(dim=-1).mean()
    for method in ("curves", "network"):
        made = restore.repaired(noisy, method=method).motion
        assert (made.positions - motion.positions).norm(dim=-1).mean() < 0.75 * before


def test_a_frame_that_jumps_is_filled_in_and_the_others_stay():
    motion = walk(90, 30.0)
    broken = replace(motion, root=motion.root + 2.0 * (torch.arange(90) == 50)[:, None])
    made = restore.repaired(broken)
    assert "jump" in " ".join(made.notes)
    assert (made.motion.root[50] - motion.root[50]).norm() < 0.05
    assert torch.equal(made.motion.rot[:40], motion.rot[:40]) and torch.equal(made.motion.root[60:], motion.root[60:])


def test_noise_that_is_given_is_believed_and_jumps_are_filled_in_first():
    motion = walk(90, 30.0)
    calm = restore.repaired(motion, Noise.of(0.3, 0.1), method="curves", plant=False)  # less than CLEAN
    assert not torch.equal(calm.motion.rot, motion.rot) and "as given" in calm.notes[0]
    assert torch.equal(restore.repaired(motion, Noise(0.0, 0.0)).motion.rot, motion.rot)
    jump = 2.0 * (torch.arange(90) == 50)[:, None]
    noisy = Noise.of(1.0, 0.5).on(motion, torch.Generator().manual_seed(0))
    made = restore.repaired(replace(noisy, root=noisy.root + jump), method="curves")
    off = (made.motion.root - motion.root).norm(dim=-1)
    assert off.max() < 0.05 and made.notes[1].startswith("frames that jump: ")


def test_a_motion_too_short_to_measure_noise_is_repaired_once_it_is_told():
    motion = walk(8, 30.0)
    with pytest.raises(DataError, match=r"12 frames are needed, it has 8 \(remedy: give --noise\)"):
        restore.repaired(motion)
    assert restore.repaired(motion, Noise.of(1.0, 0.5), method="curves").motion.frames == 8


def test_poses_from_handles_have_them_where_they_were():
    motion = mixamo(walk(30, 30.0))
    made = restore.posed(motion, ["left_wrist", "Head"]).motion
    hands = motion.skeleton.indices(["LeftHand", "Head"])
    assert (made.positions - motion.positions)[:, hands].norm(dim=-1).max() < 1e-4
    assert (made.positions - motion.positions).norm(dim=-1).mean() > 0.005  # the others were not read


def test_new_motion_that_floats_is_let_down_to_the_floor(motions):
    """By the fifth of a metre that it was lifted; what stands or leaps stays."""
    walk = on_standard(motions[0])
    lifted = replace(walk, root=walk.root + torch.tensor([0.0, 0.0, 0.2]))
    standing = restore._on_floor(walk)
    torch.testing.assert_close(restore._on_floor(lifted).root, standing.root)
    assert (standing.root - walk.root).abs().max() < 0.03 and restore._on_floor(standing).root.equal(standing.root)


def test_what_follows_on_a_motion_begins_where_it_ends(tmp_path):
    source = tmp_path / "in.bvh"
    bvh.save(source, walk(60))
    assert command("generate", "--seconds", 1, "--start", source, "--out", tmp_path / "made") == 0
    before, after = io.load(source), io.load(tmp_path / "made" / "generated_0.bvh")
    assert after.frames == 84 and torch.equal(after.rot[:60], before.rot) and torch.equal(after.root[:60], before.root)
    assert (after.positions[60] - after.positions[59]).norm(dim=-1).max() * after.fps < 4  # m/s
    held = replace(after, root=torch.cat((after.root[:60], after.root[:24])))  # back to the start
    assert (held.positions[60] - held.positions[59]).norm(dim=-1).max() * after.fps > 4


def test_who_goes_on_from_a_glb_keeps_its_body(tmp_path, capsys):
    source = tmp_path / "in.glb"
    gltf.save(source, walk(30), BodyModel.from_anny())
    assert command("generate", "--seconds", 0.5, "--start", source, "--out", tmp_path / "made") == 0
    assert "the file's nodes and meshes stay" in capsys.readouterr().out
    assert "the body" in rewriting._left_behind(tmp_path / "made" / "generated_0.glb")
    assert io.load(tmp_path / "made" / "generated_0.glb").frames == 42


def test_beyond_keys_that_move_the_default_goes_on_and_beyond_a_lone_one_it_waits():
    motion = walk(60, 30.0)
    moving, lone = (filling.inbetween(motion, filling.key_mask(motion, frames)) for frames in (range(45), {44}))
    made = moving.motion.root[44:, 1].diff() * 30
    assert moving.notes[0].startswith("method: network") and made[0] > 0.4  # m/s, of 1: no dead stop
    assert lone.notes[0].startswith("method: curves") and (lone.motion.root.diff(dim=0).abs() < 1e-4).all()
    held = filling.inbetween(motion, filling.key_mask(motion, range(45)), method="curves").motion
    assert (held.root[45:].diff(dim=0).abs() < 1e-4).all()


# ------------------------------------------------------------------------------------------------------ errors
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("inbetween", "--keys", "0,500"), "give numbers from 0 to 19"),
        (("inbetween", "--keys", "0,x"), "write frames from 0"),
        (("inbetween", "--keys", "9-3"), "write frames from 0"),
        (("inbetween", "--keys", "0,last", "--joints", "tail"), "use legs, arms"),
        (("complete", "--hidden", "pelvis"), "name some below the root"),
        (("complete", "--known", "tail"), "use legs, arms"),
        (("complete", "--known", "head", "--seed", "1"), "leave it out"),
    ],
)
def test_bad_keys_and_joints_are_refused_with_a_remedy(words, said, tmp_path, capsys):
    source = tmp_path / "in.glb"
    gltf.save(source, walk(20))
    assert command(words[0], source, *words[1:], "--out", tmp_path / "out.glb") == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out.glb").exists()


def test_a_skeleton_of_unknown_joints_gets_curves_and_is_told_so():
    motion = walk(30)
    beast = replace(motion, skeleton=replace(STANDARD, names=tuple(f"b{j}" for j in range(22)), contact_names=()))
    keep = filling.key_mask(beast, {0, 29})
    found = filling.inbetween(beast, keep)
    assert same(beast, found.motion, keep) and "curves" in found.notes[0]
    with pytest.raises(DataError, match="--names"):
        filling.inbetween(beast, keep, method="network")


# ------------------------------------------------------------------------------------------------------ widget
def test_the_editor_fills_in_what_is_chosen_and_exports_it(tmp_path):
    source, out = tmp_path / "in.bvh", tmp_path / "out.bvh"
    bvh.save(source, mixamo(walk(30)))
    box = filling.editor(source, backend="picture")
    player, frames, keep, method, file, export, message = (
        box.hands[name] for name in ("player", "frames", "keep", "method", "file", "export", "message")
    )
    player.hand.value = 15  # each frame is a step of the slider
    assert player.clock.value == "frame 15 of 29, 0.62 s" and keep.description == "keep this frame"
    first = player.view.value
    method.value = "curves"
    assert player.view.value != first and "curves, as asked" in message.value
    keep.click()
    assert frames.value == "0,15,last" and keep.description == "let this frame go"
    assert player.clock.value == "frame 15 of 29, 0.62 s, kept" and "27 of 30 frames made" in message.value
    box.hands["next"].click()
    assert player.hand.value == 29
    box.hands["previous"].click()
    assert player.hand.value == 15
    box.hands["joints"].value = ("arms",)
    file.value = str(out)
    export.click()
    before, after = io.load(source), io.load(out)
    keys = filling.key_mask(before, {0, 15, 29}, ["arms"])
    assert same(before, after, keys) and not torch.equal(before.rot, after.rot)
    assert f"{out} is written" in message.value


def test_the_editor_draws_a_body_or_a_figure_where_joints_are_not_known(tmp_path):
    known, strange = tmp_path / "known.bvh", tmp_path / "strange.bvh"
    bvh.save(known, mixamo(walk(8)))
    beast = replace(STANDARD, names=tuple(f"b{j}" for j in range(22)), contact_names=())
    bvh.save(strange, replace(walk(8), skeleton=beast))

    def skins(path, **how) -> int:
        plotter = filling.editor(path, "picture", **how).hands["player"].scene.plotter
        meshes = [actor.mapper.dataset for actor in plotter.renderers[0].actors.values() if hasattr(actor, "mapper")]
        return sum(mesh.n_cells > 10_000 for mesh in meshes)

    assert skins(known) > 0 == skins(known, body=None) == skins(strange)


def test_the_editor_exports_what_was_typed_last_though_it_is_not_drawn_yet(tmp_path):
    source, out = tmp_path / "in.bvh", tmp_path / "out.bvh"
    bvh.save(source, mixamo(walk(30)))

    def person(hands) -> None:
        hands["frames"].value = "0,7,last"
        hands["player"].hand.value = 20
        hands["keep"].click()
        hands["file"].value = str(out)
        hands["export"].click()

    async def session() -> str:
        hands = filling.editor(source, backend="picture").hands
        other = threading.Thread(target=person, args=[hands])  # as ipykernel answers widgets
        other.start()
        other.join()  # the loop stands still, as under a slow draw
        assert not out.exists()
        for _ in range(3000):
            if out.exists():
                break
            await asyncio.sleep(0.01)
        return hands["frames"].value

    assert asyncio.run(session()) == "0,7,20,last"
    before, after = io.load(source), io.load(out)
    assert same(before, after, filling.key_mask(before, {0, 7, 20, 29})) and not torch.equal(before.rot, after.rot)


def test_the_editor_says_what_is_wrong_and_exports_nothing_until_it_is_right(tmp_path, monkeypatch):
    source = tmp_path / "in.bvh"
    bvh.save(source, mixamo(walk(30)))
    hands = filling.editor(source, backend="picture").hands
    frames, keep, file, export, message = (hands[name] for name in ("frames", "keep", "file", "export", "message"))
    wrong = {"0,900": "give numbers from 0 to 29", "a<b": "&#x27;a&lt;b&#x27; is no frame", "": "no frame is kept"}
    for text, said in (wrong | {"0-9999999999": "is no frame", "5-2": "is no frame"}).items():
        frames.value = text
        assert said in message.value and "--keys" not in message.value and export.disabled, text
    frames.value = "3-5,20"
    hands["player"].hand.value = 4
    keep.click()  # a frame out of a range
    assert frames.value == "3,5,20" and not export.disabled
    before = source.read_bytes()
    said = {source: "this is the file that was opened", tmp_path / "no/x.bvh": "cannot be written", "x.fbx": "x.fbx"}
    for name, words in (said | {tmp_path / f"{'x' * 300}.bvh": "too long"}).items():
        file.value = str(name)
        export.click()
        assert words in message.value, name
    assert source.read_bytes() == before and list(tmp_path.iterdir()) == [source]
    monkeypatch.setattr(filling, "inbetween", lambda *a, **k: 1 / 0)
    frames.value = "0,10"
    assert "ZeroDivisionError" in message.value and export.disabled
