"""Pictures: what a camera sees to the pixel, films that keep time, colours that differ, a silent start."""

import asyncio
import inspect
import subprocess
import sys
import threading
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.colors import to_rgb

from motionlab import rotation
from motionlab.body import vertex_normals
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion
from motionlab.observation import Observation2D, look_at, project
from motionlab.skeleton import STANDARD, Skeleton
from motionlab.viz import mannequin, palette
from motionlab.viz.interactive import explore, slider
from motionlab.viz.movie import film, stage, write_film
from motionlab.viz.scene import Scene
from studies.shared.overlay import overlay
from tests import figures

SMALL = (160, 120)


def standing(frames=8, fps=10.0, speed=0.5) -> Motion:
    """A T-pose that glides over the floor along +x and swings its left arm."""
    motion = figures.standing(frames, fps)
    swing = torch.linspace(0, 1.2, frames)
    motion.rot[:, STANDARD.index("left_shoulder")] = rotation.rotation_about("z", -swing)
    motion.root[:, 0] = speed * torch.arange(frames) / fps
    return replace(motion, name="glide")


def centroid(picture: np.ndarray, tint: str) -> np.ndarray:
    """Middle of the pixels of a saturated colour; a pixel's own middle lies half a pixel from its corner."""
    channel = "rgb".index(tint)
    p = picture.astype(int)
    rows, columns = np.nonzero(3 * p[..., channel] - p.sum(-1) > 150)
    if len(rows) == 0:
        return np.full(2, np.nan)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (2, 0.5)])
def test_a_rendered_marker_lies_where_its_point_projects(seed, scale):
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(8, generator=generator)
    eye = torch.tensor([3.5, 1.0, 1.2]) + draw[:3]
    camera = look_at(eye, torch.tensor([0.0, 0.0, 1.0]), focal=700, width=640, height=480)
    skewed = camera.intrinsics.clone()
    skewed[0, 0] *= 1.15  # two focal lengths, skew, and a principal point far from the middle
    skewed[0, 1] = 12.0
    skewed[:2, 2] += 160 * (draw[3:5] - 0.5)
    camera = replace(camera, intrinsics=skewed)
    points = 0.6 * (torch.rand(3, 3, generator=generator) - 0.5) + torch.tensor([0.0, 0.0, 1.0])
    expected, depth = project(camera, points)
    assert (depth > 0).all()
    with Scene((int(640 * scale), int(480 * scale)), camera=camera) as scene:
        for point, tint in zip(points, np.eye(3), strict=True):
            scene.points(point[None], tuple(tint), radius=0.02)
        picture = scene.image()
    for tint, pixel in zip("rgb", expected.numpy(), strict=True):
        found = centroid(picture, tint)
        assert np.abs(found - pixel * scale).max() < 0.6, (tint, found, pixel)


def test_an_occluder_hides_what_lies_behind_it():
    camera = look_at(torch.tensor([4.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 1.0]), focal=300, width=160, height=120)
    wall = [[1.0, -1, 0], [1.0, 1, 0], [1.0, 1, 2], [1.0, -1, 2]]
    red = (1.0, 0.0, 0.0)
    with Scene(camera=camera) as scene:
        free = scene.points([[0.0, 0.0, 1.0]], red, radius=0.1).image()
        hidden = scene.mesh(wall, [[0, 1, 2], [0, 2, 3]]).image()
    assert np.isfinite(centroid(free, "r")).all()
    assert np.isnan(centroid(hidden, "r")).all()


def test_the_mannequin_stands_on_the_floor_and_moves_rigidly_with_its_joints():
    figure = mannequin.build(STANDARD, palette.colour("ours"))
    motion = standing(1)
    positions, orientations = map(mannequin.array, motion.world)
    vertices = figure.pose(positions[0], orientations[0])
    assert abs(vertices[:, 2].min()) < 1e-6
    normals = mannequin.surface(vertices, figure.faces).active_normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    head = figure.joint == STANDARD.index("head")
    outward = vertices[head] - (vertices[head].max(0) + vertices[head].min(0)) / 2
    assert ((outward * normals[head]).sum(-1) > 0).all()  # faces wind so that their normals point outward
    left = vertices[figure.joint == STANDARD.index("left_elbow")]
    assert left[:, 0].max() < positions[0, STANDARD.index("pelvis"), 0]  # facing +y, its left is -x


def test_any_skeleton_gets_a_figure():
    chain = Skeleton(("Hips", "LeftLeg", "Head"), (-1, 0, 0), torch.tensor([[0.0, 0, 0], [0.1, -0.8, 0], [0, 0.7, 0]]))
    point = Skeleton(("only",), (-1,), torch.zeros(1, 3))
    offsets = STANDARD.offsets.clone()
    offsets[STANDARD.index("spine1")] = 0  # CMU's lower back starts in the pelvis
    for skeleton in (chain, point, replace(STANDARD, offsets=offsets)):
        figure = mannequin.build(skeleton, "#0072b2")
        assert np.isfinite(mannequin.surface(figure.vertices, figure.faces).active_normals).all()
        assert figure.faces.max() < len(figure.vertices)


def test_roles_are_told_apart_even_without_red_green_vision():
    deuteranope = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])  # Machado 2009
    for a, b in combinations(palette.ROLE.values(), 2):
        both = np.array([to_rgb(a), to_rgb(b)]) ** 2.2
        assert np.linalg.norm(both[0] - both[1]) > 0.04
        seen = np.clip(both @ deuteranope.T, 0, 1) ** (1 / 2.2)
        assert np.linalg.norm(seen[0] - seen[1]) > 0.08, (a, b)


def test_normals_agree_with_trimesh():
    ball = trimesh.creation.icosphere(2)
    vertices = ball.vertices * [1.0, 2.0, 0.5]
    ours = vertex_normals(torch.from_numpy(vertices), torch.tensor(ball.faces)).numpy()
    a, b, c = (vertices[ball.faces[:, i]] for i in range(3))
    theirs = trimesh.geometry.mean_vertex_normals(len(vertices), ball.faces, np.cross(b - a, c - a))
    np.testing.assert_allclose(ours, theirs, atol=1e-8)


def test_a_scene_moves_in_place_and_in_sync():
    slow, fast = standing(8, 10.0), standing(15, 20.0)  # the same glide at two rates
    with Scene((320, 120), panels=("a", "b")) as scene:
        scene.floor().skeleton(slow, "ours", panel=0).skeleton(fast, "ours", panel=1)
        first = scene.image(0.0)
        actors = set(scene.plotter.actors)
        later = scene.image(0.6)
        assert set(scene.plotter.actors) == actors
        assert np.abs(first.astype(int) - later).max() > 50
        picture = later[20:].astype(int)
        assert np.abs(picture[:, :160] - picture[:, 160:]).mean() < 0.5  # both panels show the same moment
        assert np.array_equal(scene.image(0.7), scene.image(9.0))  # past its end a motion holds still


def test_a_slider_moves_the_picture():
    box = slider(standing(), "picture", size=SMALL)
    view, controls = box.children
    play, hand, clock, left, right = controls.children
    before = view.value
    hand.value = hand.max
    assert view.value != before and clock.value == "0.70 s"
    hand.value = 0
    assert view.value == before and clock.value == "0.00 s"
    left.click()
    assert view.value != before
    right.click()
    assert view.value == before
    assert play.max == hand.max and play.interval * play.max == pytest.approx(700, rel=0.05)  # as fast as life
    with pytest.raises(ValueError, match="picture, trame"):
        slider(standing(), "hologram")


def test_a_figure_takes_another_motion_and_the_eye_follows_it():
    slow, fast = standing(), standing(speed=3.0)
    turned = replace(standing(), rot=fast.rot.flip(0))
    scene = Scene(SMALL, follow=True).floor().skeleton(slow)
    before = scene.image(0.5)
    same = Scene(SMALL, follow=True).floor().skeleton(turned).image(0.5)
    assert not np.array_equal(before, same)
    np.testing.assert_array_equal(scene.exchange(turned).image(), same)
    np.testing.assert_array_equal(scene.exchange(slow).image(), before)
    scene.exchange(fast)
    np.testing.assert_array_equal(scene.image(0.7), Scene(SMALL, follow=True).floor().skeleton(fast).image(0.7))


def test_a_hand_that_turned_one_eye_turns_all_and_the_turn_travels_on():
    slow, fast = standing(speed=0.0), standing(speed=3.0)
    scene = Scene((320, 120), panels=("a", "b"), follow=True).floor().skeleton(slow).skeleton(fast, panel=1).at(0.0)
    eyes = [renderer.camera for renderer in scene.plotter.renderers]
    usual, start = np.subtract(eyes[0].position, eyes[0].focal_point), np.array(eyes[1].focal_point)
    offset = rotation.rotation_about("z", torch.tensor(1.0)).numpy() @ usual + [0.0, 0.0, 1.0]
    eyes[1].position, eyes[1].up = start + offset, (0.6, 0.0, 0.8)
    for now in (0.3, 0.7, 0.0):
        plain = Scene((320, 120), panels=("a", "b"), follow=True).skeleton(slow).skeleton(fast, panel=1).at(now)
        scene.at(now)
        for eye, other in zip(eyes, plain.plotter.renderers, strict=True):
            np.testing.assert_allclose(eye.focal_point, other.camera.focal_point, atol=1e-6)
            np.testing.assert_allclose(np.subtract(eye.position, eye.focal_point), offset, atol=1e-6)
            assert eye.up == (0.0, 0.0, 1.0)
    assert np.linalg.norm(np.subtract(eyes[1].focal_point, start)) < 1e-6


@pytest.mark.parametrize("away", [1e-3, 1e3])
def test_no_hand_loses_the_body(away):
    scene = Scene(SMALL).floor().skeleton(standing())
    scene.at(0.0)
    eye = scene.plotter.camera
    for _ in range(3):
        eye.position = np.add(eye.focal_point, away * np.subtract(eye.position, eye.focal_point))
        eye.focal_point = np.add(eye.focal_point, [50.0, 0.0, 0.0])
        scene.heed()
    picture = scene.turn(degrees=180.0).image()
    blue = (picture[..., 2].astype(int) - picture[..., 0]) > 40
    assert blue.sum() > 20
    eye.position = np.add(eye.focal_point, [1.0, 0.0, -5.0])  # from below the floor
    scene.heed()
    assert eye.position[2] > 0


def flying(speed: float) -> Motion:
    """Somebody who leaves the floor ever faster."""
    motion = standing(30, 30.0, speed=0.3)
    t = torch.linspace(0, 1, 30)
    return replace(motion, root=motion.root + speed * torch.stack((t, t, t**2), -1))


@pytest.mark.parametrize("follow", [True, False])
def test_who_flies_off_does_not_shrink_the_others(follow):
    calm = standing(30, 30.0, speed=0.3)

    def height(rival: Motion) -> float:
        """Of the truth in its own panel, as a share of the picture."""
        with Scene((960, 420), panels=("truth", "rival", "ours"), follow=follow) as scene:
            for panel, motion in enumerate((calm, rival, calm)):
                scene.skeleton(motion, (1.0, 0.0, 0.0), shadow=0, panel=panel)
            picture = scene.image(0.5)[:, :320].astype(int)
            rows = np.nonzero((2 * picture[..., 0] - picture[..., 1:].sum(-1) > 80).any(1))[0]
        return np.ptp(rows) / 420

    assert height(flying(40.0)) > 0.7 * height(calm) > 0.4


@pytest.mark.parametrize("follow", [True, False])
def test_the_eye_stays_with_who_flies_only_if_it_follows(follow):
    scene = Scene((640, 240), panels=("truth", "rival"), follow=follow)
    picture = scene.skeleton(standing(30, 30.0)).skeleton(flying(8.0), panel=1).image(0.9).astype(int)
    seen = (picture[..., 2] - picture[..., 0] > 60).reshape(240, 2, 320).sum((0, 2))  # blue pixels of each panel
    assert seen[0] > 100 and (seen[1] > 100) == follow


def test_a_ghost_stands_in_the_other_panels_only():
    truth = standing(4)
    off = replace(truth, root=truth.root + torch.tensor([0.4, 0.0, 0.0]))
    pictures = []
    for ghost in (None, truth):
        scene, _ = stage({"truth": truth, "ours": off, "same": replace(truth)}, size=(480, 160), ghost=ghost)
        with scene:
            pictures.append(scene.image().astype(int))
    changed = np.abs(pictures[0] - pictures[1]).max(-1) > 15
    own, beside, same = (changed[:, k : k + 160].sum() for k in (0, 160, 320))
    assert own == 0 and beside > 50 and same < 0.2 * beside


async def until(condition):
    """The loop runs until the condition holds; half a minute without it, and what is asserted next fails."""
    for _ in range(3000):
        if condition():
            break
        await asyncio.sleep(0.01)


def test_a_slider_draws_on_its_own_thread_and_skips_what_is_overtaken():
    async def drag() -> tuple:
        view, controls = slider(standing(), "picture", size=SMALL).children
        _, hand, clock, *_ = controls.children
        before, drawn = view.value, []
        view.observe(lambda _: drawn.append((threading.get_ident(), clock.value)), names="value")
        other = threading.Thread(target=lambda: [setattr(hand, "value", k) for k in range(1, hand.max + 1)])
        other.start()
        other.join()  # the loop stands still, as under a slow draw
        assert view.value == before and clock.value == "0.00 s"
        await until(lambda: clock.value != "0.00 s")
        return drawn, clock.value

    drawn, shown = asyncio.run(drag())
    assert [thread for thread, _ in drawn] == [threading.get_ident()] and shown == "0.70 s"


def test_a_fresh_process_is_silent_loads_what_it_draws_with_late_and_sends_pictures_offline():
    """Colours and captures need no graphics library, and a first picture writes nothing to stderr."""
    code = """
import sys, warnings, motionlab.viz.palette, data_synth.capture, data_synth.body, data_synth.corpus
print([m for m in sys.modules if m.startswith(("vtk", "pyvista"))])
from motionlab.viz.scene import Scene
s = Scene((64, 48), panels=("a",)).floor(); s.points([[0, 0, 1]], "ours"); print(s.image().shape); s.close()
print("and now trame", file=sys.stderr, flush=True); warnings.simplefilter("default")
import asyncio, torch
from unittest import mock
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from motionlab.viz.interactive import explore, slider
rot = torch.eye(3).expand(4, 22, 3, 3).clone(); rot[:, 0] = UPRIGHT
async def main():
    view, controls = slider(Motion(STANDARD, torch.zeros(4, 3), rot, 10.0), "trame", size=(64, 48)).children
    with mock.patch.object(next(iter(view.viewer._html_views)), "update") as push:
        controls.children[1].value = 3
        await until(lambda: push.call_count)
    print(push.call_count, "<iframe" in view.value, "trame_vtklocal" in sys.modules)
asyncio.run(main())
"""
    code = f"{inspect.getsource(until)}{code}"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    before, _, after = done.stderr.partition("and now trame\n")
    assert done.stdout.splitlines() == ["[]", "(48, 64, 3)", "1 True False"] and before == ""
    assert "Error" not in after, after


def test_an_overlay_meets_the_rendered_body_at_any_scale():
    camera = look_at(torch.tensor([4.0, 1.0, 1.2]), torch.tensor([0.0, 0.0, 1.0]), focal=640, width=640, height=480)
    point = torch.tensor([[0.1, 0.2, 1.3]])
    pixel, _ = project(camera, point)
    names = ("nose",)
    observation = Observation2D(pixel[None], torch.ones(1, 1), names, 30.0, camera)
    blank = np.zeros((240, 320, 3), np.uint8)
    rows, columns = np.nonzero(overlay(observation, blank, 0, 4.0).sum(-1))
    assert np.abs(np.array([columns.mean() + 0.5, rows.mean() + 0.5]) - pixel[0].numpy() / 2).max() < 1.0


def test_bad_input_says_what_is_wrong(tmp_path):
    motion = standing()
    batch = Motion(STANDARD, motion.root[None], motion.rot[None], 10.0)
    broken = replace(motion, root=motion.root.clone().index_fill_(0, torch.tensor([2]), float("nan")))
    with Scene(SMALL) as scene:
        with pytest.raises(KeyError, match="no role 'mine'; roles are truth"):
            scene.skeleton(motion, "mine")
        with pytest.raises(ShapeError, match="batch"):
            scene.skeleton(batch)
        with pytest.raises(ShapeError, match="without frames"):
            scene.trail(motion.cut(0, 0), "left_wrist")
        with pytest.raises(DataError, match="frame 2"):
            scene.skeleton(broken)
        with pytest.raises(IndexError, match="frame 99"):
            scene.skeleton(motion, frame=99)
        with pytest.raises(IndexError, match="panel 1"):
            scene.skeleton(motion, panel=1)
        with pytest.raises(KeyError, match="no joint"):
            scene.trail(motion, "tail")
    with pytest.raises(ShapeError, match="no motions"):
        film({}, tmp_path / "x.mp4")
    with pytest.raises(ValueError, match=r"ends in \.mp4"):
        write_film([np.zeros((4, 4, 3), np.uint8)], tmp_path / "x.webm", 10, 1.0)
    with pytest.raises(ShapeError, match="no pictures"):
        write_film([], tmp_path / "x.mp4", 10, 1.0)
    camera = look_at(torch.tensor([3.0, 0.0, 1.0]), torch.zeros(3), focal=100, width=160, height=120)
    with pytest.raises(ShapeError, match="size"):
        Scene((100, 100), camera=camera)


def test_knobs_redraw_a_picture_or_a_film_and_say_units_and_errors(tmp_path):
    def draw(seconds=0.5):
        if seconds == 0.2:
            raise ValueError("too short")
        return film(standing().cut(0, int(10 * seconds)), tmp_path / "a.mp4", size=SMALL)

    picture, message, knob = explore(draw, units={"seconds": "s"}, seconds=(0.2, 0.8, 0.1)).children
    before, knob.value = picture.value, 0.8
    assert "<video" in before and picture.value != before and not message.value
    assert knob.description == "seconds (s)"
    before, knob.value = picture.value, 0.2
    assert picture.value == before and message.value == "ValueError: too short"
    picture, message, knob = explore(lambda rows=2: np.zeros((rows, 8, 3), np.uint8), rows=(0, 8, 1)).children
    before, knob.value = picture.value, 4
    assert "<img" in before and picture.value != before and not message.value


def test_a_film_has_a_bar_where_somebody_watches(tmp_path, capsys):
    how = {"size": SMALL, "fps": 10.0}
    film(standing(), tmp_path / "walk.mp4", **how)
    assert capsys.readouterr().err == ""
    film(standing(), tmp_path / "walk.mp4", progress=True, **how)
    assert "film walk.mp4" in capsys.readouterr().err
