"""The first demo, a fit of somebody who sits down behind a desk, and its picture in the README.

PYTHONPATH=notebooks python -m studies.nb00_start.first_demo    # writes docs/pictures/sitting.jpg
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from data_synth import scenes
from motionlab.body import BodyModel
from motionlab.commands.doctor import ROOT
from motionlab.humor import pretrained, testops
from motionlab.motion import Motion
from motionlab.viz import movie, scene
from studies.shared.overlay import overlay

ROLES = {"truth": "truth", "smooth poses only": "stage2", "with the motion prior": "stage3"}
_WOOD = "#b9a88f"
_PANEL = (375, 480)  # pixels


def fits(filmed: scenes.Scene) -> dict[str, Motion]:
    """Fits the one clip of a scene by the default search: the truth beside what stages 2 and 3 make of it."""
    found = testops.fit(
        filmed.observation, pretrained.load_priors(), solver="shooting", cameras=filmed.cameras, floor="camera"
    )
    motions = (filmed.truth, found.stages[2], found.stages[3])
    return {name: motion.clip(0) for name, motion in zip(ROLES, motions, strict=True)}


def picture(filmed: scenes.Scene, motions: Mapping[str, Motion], frame: int) -> np.ndarray:
    """Draws one frame (H, W, 3): what the camera saw and the detector found, then each motion from one side."""
    anny = BodyModel.from_anny()
    around = {name: motion.cut(frame - 1, frame + 1) for name, motion in motions.items()}  # the eye comes near
    with movie.stage(around, ROLES, anny, (_PANEL[0] * len(around), _PANEL[1]), follow=True)[0] as stage:
        bodies = stage.image(1 / motions["truth"].fps)
    return np.concatenate((_seen(filmed, motions["truth"], frame, anny), bodies), 1)


def _seen(filmed: scenes.Scene, truth: Motion, frame: int, anny: BodyModel) -> np.ndarray:
    """The camera's image about what is detected of the person, and the detections."""
    observation, camera = filmed.observation, filmed.cameras[0]
    points, confidence = observation.keypoints[0, frame], observation.confidence[0, frame]
    found = points[confidence > 0]
    corner = torch.stack((found[:, 0].mean() - _PANEL[0] / 2, found[:, 1].min() - _PANEL[1] / 6)).round()
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2, 2] -= corner.to(intrinsics)
    near = replace(camera, intrinsics=intrinsics, width=_PANEL[0], height=_PANEL[1])
    with scene.Scene(panels=("what the camera saw",), camera=near) as view:
        view.floor().body(anny, truth, "truth")
        for vertices, faces in movie.meshes(filmed.occluders[0]):
            view.mesh(vertices[0].numpy(), faces.numpy(), _WOOD)
        image = view.image(frame / truth.fps)
    shown = replace(observation, keypoints=(points - corner)[None], confidence=confidence[None], camera=None)
    return overlay(shown, image, 0, width=3.0)


def main(path: Path = ROOT / "docs/pictures/sitting.jpg") -> None:
    """Writes the README's picture."""
    filmed = scenes.film("sitting, legs hidden", 1, seed=0, frames=60)
    path.write_bytes(movie.jpeg(picture(filmed, fits(filmed), 59)))


if __name__ == "__main__":
    main()
