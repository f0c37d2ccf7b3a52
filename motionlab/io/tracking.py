"""People through time: who of one frame is who of the next, by where their keypoints lie."""

from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np

_REACH = 0.3  # share of their own size by which a person may move between two sightings
_SHARED = 3  # keypoints that two sightings must share before their distance says anything
_TWIN = 0.08  # share of their size by which two sightings in one frame may be apart and show one person
_BODY = 33  # points that are compared: those of face and hands come after the body's in every layout, and follow it
_MOST = 100  # people who are looked at in one frame, the largest first; twice as many may be missed at a time


@dataclass(eq=False)
class _Track:
    """One person: the keys of the pieces of which they are made, the (frame, index) pairs where they are, and their
    keypoints when last seen."""

    keys: list[Hashable]
    people: list[tuple[int, int]]
    last: np.ndarray  # (K, 3), every keypoint as last seen
    latest: np.ndarray  # (K, 3), the last sighting
    step: np.ndarray = field(default_factory=lambda: np.zeros(3))  # x, y, 0: pixels from frame to frame

    def add(self, frame: int, index: int, person: np.ndarray) -> None:
        """Adds a sighting (K, 3) of a later frame."""
        both = (self.latest[:, 2] > 0) & (person[:, 2] > 0)
        if both.any() and self.people:
            moved = np.median(person[both, :2] - self.latest[both, :2], axis=0) / (frame - self.people[-1][0])
            self.step[:2] = moved if len(self.people) == 1 else (self.step[:2] + moved) / 2
        self.people.append((frame, index))
        self.last, self.latest = np.where(person[:, 2:] > 0, person, self.last), person


def join(frames: list[np.ndarray], *, gap: int) -> list[list[tuple[int, int]]]:
    """Finds everybody's (frame, index) pairs through frames of people (P, K, 3): sightings that go on with each other,
    see :func:`continued`. At most ``_MOST`` people of a frame are looked at."""
    sightings = {}
    for frame, people in enumerate(frames):
        seen = np.flatnonzero((people[..., 2] > 0).any(-1))
        for k in sorted(sorted(seen, key=lambda k: -_extent(people[k]))[:_MOST]):
            sightings[frame, k] = [(frame, k)]
    return [*continued(sightings, frames, gap=gap).values()]


def continued(
    tracks: dict[Hashable, list[tuple[int, int]]], frames: list[np.ndarray], *, gap: int
) -> dict[Hashable, list[Hashable]]:
    """Finds which tracks, (frame, index) pairs by id, are one person: the first id of each person -> all of their ids.

    One that begins within ``gap`` frames of another's end goes on with it, if it begins where that ended, or where that
    would be at its pace: if the keypoints, as last seen, lie within ``_REACH`` of its size. At most twice ``_MOST``
    people are waited for. The assignment is the best over all pairs (Hungarian method). Uses no randomness.
    """
    starts: dict[int, list] = {}
    for key, people in tracks.items():
        starts.setdefault(people[0][0], []).append(key)
    everybody: list[_Track] = []
    alive: list[_Track] = []
    for frame in sorted(starts):
        recent = (track for track in alive if frame - track.people[-1][0] <= gap)
        alive = sorted(recent, key=lambda track: track.people[-1][0])[-2 * _MOST :]
        people = {key: frames[frame][tracks[key][0][1]][:_BODY] for key in starts[frame]}
        found = _assigned([track for track in alive if track.people[-1][0] < frame], people, frame)
        for key, person in people.items():
            if key not in found:
                found[key] = _Track([], [], person, person)
                everybody.append(found[key])
                alive.append(found[key])
            found[key].keys.append(key)
            for at, index in tracks[key]:
                found[key].add(at, index, frames[at][index][:_BODY])
    return {track.keys[0]: track.keys for track in everybody}


def twins(tracks: dict[int, list[tuple[int, int]]], frames: list[np.ndarray]) -> dict[int, list[int]]:
    """Finds which tracks, (frame, index) pairs by id, show one person twice: the id of the longest -> the others'.

    Where both are seen they lie on each other, within ``_TWIN`` of their size in four of five frames. The ``_MOST``
    longest are compared.
    """
    longest = sorted(tracks, key=lambda name: -len(tracks[name]))[:_MOST]
    found: dict[int, list[int]] = {}
    for name in longest:
        twin = next((other for other in found if _is_twin(tracks[name], tracks[other], frames)), name)
        found.setdefault(twin, []).extend([name] * (twin != name))
    return {name: others for name, others in found.items() if others}


def _is_twin(one: list[tuple[int, int]], other: list[tuple[int, int]], frames: list[np.ndarray]) -> bool:
    both = dict(one).keys() & dict(other).keys()
    pair = (np.stack([frames[n][index][:_BODY] for n, index in people if n in both]) for people in (one, other))
    return bool(both) and (_between(*pair) <= _TWIN).mean() >= 0.8


def _assigned(tracks: list[_Track], people: dict[Hashable, np.ndarray], frame: int) -> dict[Hashable, _Track]:
    """The tracks that go on with people (K, 3), by key, with the lowest sum of distances, none above ``_REACH``.

    A pair that is not made costs ``_REACH``: one good pair is better than two of which each is nearly too far.
    """
    from scipy.optimize import linear_sum_assignment  # half a second, and only videos of several people need it

    if not tracks or not people:
        return {}
    keys, cost = list(people), _distances(tracks, np.stack(list(people.values())), frame)
    blocked = cost > _REACH
    pairs = zip(*linear_sum_assignment(np.where(blocked, _REACH, cost)), strict=True)
    return {keys[column]: tracks[row] for row, column in pairs if not blocked[row, column]}


def _distances(tracks: list[_Track], people: np.ndarray, frame: int) -> np.ndarray:
    """Distance (A, B) of tracks to people (B, K, 3), see ``_between``: where last seen, or would be by now."""
    still = np.stack([track.last for track in tracks])[:, None]
    moved = np.stack([track.step * (frame - track.people[-1][0]) for track in tracks])[:, None, None]
    return np.minimum(_between(still, people[None]), _between(still + moved, people[None]))


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance (...) of sightings (..., K, 3): median over the keypoints that both have.

    A share of the larger extent of the two; infinite where they share fewer than ``_SHARED`` keypoints.
    """
    both = (a[..., 2] > 0) & (b[..., 2] > 0)
    apart = np.linalg.norm(a[..., :2] - b[..., :2], axis=-1)
    shared, ordered = both.sum(-1), np.sort(np.where(both, apart, np.inf), axis=-1)
    median = np.take_along_axis(ordered, np.maximum(shared - 1, 0)[..., None] // 2, -1)[..., 0]
    size = np.maximum(_extent(a), _extent(b))
    return np.where((shared >= _SHARED) & (size > 0), median / np.maximum(size, 1e-9), np.inf)


def _extent(people: np.ndarray) -> np.ndarray:
    """Diagonal (...) of the box around the seen keypoints of people (..., K, 3), pixels; 0 where none is seen."""
    seen, xy = people[..., 2:] > 0, people[..., :2]
    sides = np.where(seen, xy, -np.inf).max(-2) - np.where(seen, xy, np.inf).min(-2)
    return np.linalg.norm(np.maximum(sides, 0), axis=-1)
