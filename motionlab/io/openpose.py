"""OpenPose: folders with one JSON file of detected people per frame; tracking tells the people apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motionlab.io import detection_json, detections, tracking
from motionlab.io.keypoints import Footage, Person, cleaned
from motionlab.io.reading import read_json, reading
from motionlab.observation import Observation2D


def load(
    folder: str | Path, *, fps: float, layout: str | None = None, person: str | int = "longest", gap: float = 0.5
) -> Observation2D:
    """Reads one person's keypoints through time, in pixels, from a folder of OpenPose JSON files.

    Frames are ordered by the number at the end of the file's name, as a number; one that is missing becomes a
    frame in which nobody was seen. Files that are named otherwise before the number than most are left out.
    Everybody is tracked, then one track is chosen; where no frame shows more than one person, that is the one.
    Where the person or a keypoint is absent, confidence is 0 and the coordinates are 0, whatever the file says.

    Args:
        fps: frames per second. OpenPose does not store it.
        layout: one of ``layouts.LAYOUTS``; None decides by the number of keypoints, and for 25 by which points lie
            around the nose.
        person: ``"longest"`` (seen in most frames), ``"largest"`` (tallest in the image), or the place of the
            person in the people list of the first frame that shows anybody.
        gap: seconds for which a person may vanish and still be the same one.

    Raises:
        DataError: no numbered JSON, two files of one number, people that are no keypoint lists, nobody at all,
            or nobody at the place asked for.
    """
    with reading(folder, "point at a folder with one OpenPose JSON file per frame of one camera") as at:
        found = detections.from_folder(at, lambda one: detection_json.openpose(one, read_json(one)), ".json")
        found, frames = found.in_order(at, fps)
        frames, names, _ = cleaned(at, found, frames, layout, 0.0)
        if max(len(people) for people in frames) == 1 and person in ("longest", "largest", 0):
            pairs = [(frame, 0) for frame, people in enumerate(frames) if len(people)]
        else:
            pairs = _choose(tracking.join(frames, gap=max(1, round(gap * found.fps))), person)
        if pairs is None:
            raise at.error(f"nobody fits person={person!r}", remedy='pass "longest", "largest" or a smaller number')
        track = Person(0, np.array([n for n, _ in pairs]), np.stack([frames[n][k] for n, k in pairs]))
        first = min(found.frames)
        return Footage(at.path, found.detector, names, found.fps, None, first, len(frames), (), (track,)).person()


def _choose(tracks: list[tracking.Track], person: str | int) -> list[tuple[int, int]] | None:
    """The (frame, index) pairs of the longest track, the largest one, or person number n of the first frame.

    Ties go to the larger, then to the earlier. None where nobody fits.
    """
    if isinstance(person, int):
        start = min((t.people[0] for t in tracks), default=(0, 0))[0]
        return next((t.people for t in tracks if t.people[0] == (start, person)), None)
    keys = {"longest": lambda t: (len(t.people), t.size), "largest": lambda t: (t.size, len(t.people))}
    return max(tracks, key=keys[person]).people if tracks and person in keys else None
