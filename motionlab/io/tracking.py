"""Who is who: joining the people detected in single frames into tracks through time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

#: A person may move by this share of their own size between two sightings.
REACH = 0.3
#: Keypoints that two sightings must share before they can be called the same person.
SHARED = 3


@dataclass
class Track:
    """One person: where they are in the frames' people lists, and their keypoints when last seen."""

    people: list[tuple[int, int]]  # (frame, index)
    last: np.ndarray  # (K, 3), every keypoint as last seen
    sizes: list[float] = field(default_factory=list)

    @property
    def size(self) -> float:
        """Median extent in the image, pixels."""
        return float(np.median(self.sizes))


def extent(people: np.ndarray) -> np.ndarray:
    """Diagonal (...) of the box around the seen keypoints of people (..., K, 3), pixels; 0 where none is seen."""
    seen = people[..., 2:] > 0
    top = np.where(seen, people[..., :2], -np.inf).max(-2)
    bottom = np.where(seen, people[..., :2], np.inf).min(-2)
    return np.where(seen.any((-1, -2)), np.linalg.norm(np.maximum(top - bottom, 0), axis=-1), 0.0)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance (A, B) between people (A, K, 3) and (B, K, 3): median over the keypoints that both have.

    A share of the larger extent of the two; infinite where they share fewer than ``SHARED`` keypoints.
    """
    both = (a[:, None, :, 2] > 0) & (b[None, :, :, 2] > 0)
    apart = np.linalg.norm(a[:, None, :, :2] - b[None, :, :, :2], axis=-1)
    shared = both.sum(-1)
    ordered = np.sort(np.where(both, apart, np.inf), axis=-1)
    median = np.take_along_axis(ordered, np.maximum(shared - 1, 0)[..., None] // 2, -1)[..., 0]
    size = np.maximum(extent(a)[:, None], extent(b)[None])
    return np.where((shared >= SHARED) & (size > 0), median / np.maximum(size, 1e-9), np.inf)


def track(frames: list[np.ndarray], *, gap: int) -> list[Track]:
    """Everybody's track through frames of people (P, K, 3), by optimal assignment from frame to frame.

    A sighting joins the track whose keypoints, as last seen, lie nearest, within ``REACH`` of its size; the
    assignment minimises the summed distance over all pairs (Hungarian method). A track that nobody joined for
    more than ``gap`` frames ends; a sighting that joins none begins one. Uses no randomness.
    """
    tracks: list[Track] = []
    for frame, people in enumerate(frames):
        alive = [t for t in tracks if frame - t.people[-1][0] <= gap]
        if not alive or not len(people):
            cost = np.full((len(alive), len(people)), np.inf)
        else:
            cost = distances(np.stack([t.last for t in alive]), people)
        blocked = cost > REACH
        joined = set()
        for row, column in zip(*linear_sum_assignment(np.where(blocked, 1e3, cost)), strict=True):
            if not blocked[row, column]:
                person, joined = people[column], joined | {column}
                alive[row].people.append((frame, int(column)))
                alive[row].last = np.where(person[:, 2:] > 0, person, alive[row].last)
                alive[row].sizes.append(float(extent(person)))
        for column, person in enumerate(people):
            if column not in joined and (person[:, 2] > 0).any():
                tracks.append(Track([(frame, column)], person.copy(), [float(extent(person))]))
    return tracks


def choose(tracks: list[Track], person: str | int) -> list[tuple[int, int]] | None:
    """The (frame, index) pairs of the longest track, the largest one, or person number n of the first frame.

    Ties go to the larger, then to the earlier. None where nobody fits.
    """
    if isinstance(person, int):
        start = min((t.people[0] for t in tracks), default=(0, 0))[0]
        return next((t.people for t in tracks if t.people[0] == (start, person)), None)
    keys = {"longest": lambda t: (len(t.people), t.size), "largest": lambda t: (t.size, len(t.people))}
    return max(tracks, key=keys[person]).people if tracks and person in keys else None
