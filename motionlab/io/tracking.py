"""People through time: who of one frame is who of the next, by where their keypoints lie and their boxes overlap."""

from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np

_REACH = 0.3  # share of their own size by which a person may move between two sightings
_SHARED = 3  # keypoints that two sightings must share before their distance says anything
_OVERLAP = 0.4  # share of their union that boxes of one person may share
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
    step: np.ndarray = field(default_factory=lambda: np.zeros(2))  # pixels by which they move from frame to frame

    def add(self, frame: int, index: int, person: np.ndarray) -> None:
        """Adds a sighting (K, 3) of a later frame."""
        both = (self.latest[:, 2] > 0) & (person[:, 2] > 0)
        if both.any() and self.people:
            moved = np.median(person[both, :2] - self.latest[both, :2], axis=0) / (frame - self.people[-1][0])
            self.step = moved if len(self.people) == 1 else (self.step + moved) / 2
        self.people.append((frame, index))
        self.last, self.latest = np.where(person[:, 2:] > 0, person, self.last), person

    def box(self, frame: int) -> np.ndarray:
        """Returns the box (4,) of the last sighting, moved on to a frame at the pace so far."""
        return _boxes(self.latest[None])[0] + np.tile(self.step * (frame - self.people[-1][0]), 2)


def join(frames: list[np.ndarray], *, gap: int) -> list[list[tuple[int, int]]]:
    """Finds everybody's (frame, index) pairs through frames of people (P, K, 3): sightings that go on with each other,
    see :func:`continued`.

    One that is left over there joins the track whose box, moved on at its pace, overlaps its own by ``_OVERLAP``: so
    does who moved too fast, or shows other keypoints than before. At most ``_MOST`` people of a frame are looked at.
    """
    sightings = {}
    for frame, people in enumerate(frames):
        seen = [k for k, person in enumerate(people) if (person[:, 2] > 0).any()]
        for k in sorted(sorted(seen, key=lambda k: -_extent(people[k]))[:_MOST]):
            sightings[frame, k] = [(frame, k)]
    return [*continued(sightings, frames, gap=gap, by_box=True).values()]


def continued(
    tracks: dict[Hashable, list[tuple[int, int]]], frames: list[np.ndarray], *, gap: int, by_box: bool = False
) -> dict[Hashable, list[Hashable]]:
    """Finds which tracks, (frame, index) pairs by id, are one person: the first id of each person -> all of their ids.

    One that begins within ``gap`` frames of another's end goes on with it, if it begins where that ended: if the
    keypoints, as last seen, lie within ``_REACH`` of its size; ``by_box``: or else the boxes do. Each assignment is the
    best over all pairs (Hungarian method). Uses no randomness.
    """
    starts: dict[int, list] = {}
    for key, people in tracks.items():
        starts.setdefault(people[0][0], []).append(key)
    everybody: list[_Track] = []
    alive: list[_Track] = []
    for frame in sorted(starts):
        alive = [track for track in alive if frame - track.people[-1][0] <= gap]
        if by_box and len(alive) > 2 * _MOST:
            alive = sorted(alive, key=lambda track: track.people[-1][0])[-2 * _MOST :]
        free = {key: frames[frame][tracks[key][0][1]][:_BODY] for key in starts[frame]}
        found: dict[Hashable, _Track] = {}
        for costs, most in ((_distances, _REACH), (_apart, 1 - _OVERLAP))[: 1 + by_box]:
            waiting = [track for track in alive if track.people[-1][0] < frame and track not in found.values()]
            people = {key: person for key, person in free.items() if key not in found}
            found |= {key: track for track, key in _assigned(waiting, people, frame, costs, most)}
        for key, person in free.items():
            track = found.get(key) or _Track([], [], person, person)
            if key not in found:
                everybody.append(track)
                alive.append(track)
            track.keys.append(key)
            for at, index in tracks[key]:
                track.add(at, index, frames[at][index][:_BODY])
    return {track.keys[0]: track.keys for track in everybody}


def twins(tracks: dict[int, list[tuple[int, int]]], frames: list[np.ndarray]) -> dict[int, list[int]]:
    """Finds which tracks, (frame, index) pairs by id, show one person twice: the id of the longest -> the others'.

    Where both are seen they lie on each other, within ``_TWIN`` of their size in four of five frames. The ``_MOST``
    longest are compared.
    """
    longest = sorted(tracks, key=lambda name: -len(tracks[name]))[:_MOST]
    places = {name: dict(tracks[name]) for name in longest}
    found: dict[int, list[int]] = {}
    for name in longest:
        for other in found:
            both = sorted(places[name].keys() & places[other].keys())
            if both:
                a, b = (np.stack([frames[n][places[one][n]][:_BODY] for n in both]) for one in (name, other))
                if (_between(a, b) <= _TWIN).mean() >= 0.8:
                    found[other].append(name)
                    break
        else:
            found[name] = []
    return {name: others for name, others in found.items() if others}


def _assigned(tracks: list[_Track], people: dict[int, np.ndarray], frame: int, costs, most: float) -> list:
    """Pairs (track, key of the person) with the lowest sum of costs, none of them above ``most``.

    A pair that is not made costs ``most``: one good pair is better than two of which each is nearly too far.
    """
    from scipy.optimize import linear_sum_assignment  # half a second, and only videos of several people need it

    if not tracks or not people:
        return []
    keys, cost = list(people), costs(tracks, np.stack(list(people.values())), frame)
    blocked = cost > most
    pairs = zip(*linear_sum_assignment(np.where(blocked, most, cost)), strict=True)
    return [(tracks[row], keys[column]) for row, column in pairs if not blocked[row, column]]


def _distances(tracks: list[_Track], b: np.ndarray, frame: int) -> np.ndarray:
    """Distance (A, B) of tracks to people (B, K, 3), see ``_between``."""
    return _between(np.stack([track.last for track in tracks])[:, None], b[None])


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


def _apart(tracks: list[_Track], b: np.ndarray, frame: int) -> np.ndarray:
    """1 - intersection over union (A, B) of the boxes of tracks, moved on to the frame, and of people (B, K, 3)."""
    a, b = np.stack([track.box(frame) for track in tracks])[:, None], _boxes(b)[None]
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    shared = np.maximum(sides, 0).prod(-1)
    return 1 - shared / np.maximum(sum((box[..., 2:] - box[..., :2]).prod(-1) for box in (a, b)) - shared, 1e-9)


def _boxes(people: np.ndarray) -> np.ndarray:
    """Left, top, right, bottom (..., 4) of the seen keypoints of people (..., K, 3); infinite where none is seen."""
    seen = people[..., 2:] > 0
    top = np.where(seen, people[..., :2], np.inf).min(-2)
    return np.concatenate([top, np.where(seen, people[..., :2], -np.inf).max(-2)], -1)


def _extent(people: np.ndarray) -> np.ndarray:
    """Diagonal (...) of the box around the seen keypoints of people (..., K, 3), pixels; 0 where none is seen."""
    box = _boxes(people)
    return np.linalg.norm(np.maximum(box[..., 2:] - box[..., :2], 0), axis=-1)
