"""Who of one frame is who of the next, of people whose paths are known."""

import numpy as np
import pytest

from motionlab.io import tracking

POSE = np.random.default_rng(1).uniform((-30, -100), (30, 100), (17, 2))


def person(x: float, y: float = 300.0, shown: slice = slice(None)) -> np.ndarray:
    """A person (17, 3) in pixels; points that are not shown have confidence 0."""
    points = np.concatenate([POSE + np.array([x, y]), np.zeros((17, 1))], 1)
    points[shown, 2] = 0.9
    points[points[:, 2] == 0] = 0
    return points.astype(np.float32)


def listed(*paths: list[np.ndarray | None], seed: int = 0) -> tuple[list[np.ndarray], list[dict[int, int]]]:
    """Frames of people in an order drawn anew, None where one is away; and who is at which place of each frame."""
    draw, frames, truth = np.random.default_rng(seed), [], []
    for here in zip(*paths, strict=True):
        order = draw.permutation([k for k, one in enumerate(here) if one is not None])
        frames.append(np.stack([here[k] for k in order]) if len(order) else np.zeros((0, 17, 3), np.float32))
        truth.append({place: int(k) for place, k in enumerate(order)})
    return frames, truth


def followed(tracks: list[list[tuple[int, int]]], truth: list[dict[int, int]]) -> list[list[int]]:
    """The true people that each track shows, in its order, each run once."""
    shown = [[truth[frame][index] for frame, index in track] for track in tracks]
    return sorted([one for one, before in zip(row, [None, *row], strict=False) if one != before] for row in shown)


def test_people_who_cross_stay_who_they_are():
    frames, truth = listed([person(100 + 10 * n) for n in range(40)], [person(500 - 10 * n, 320) for n in range(40)])
    tracks = tracking.join(frames, gap=5)
    assert followed(tracks, truth) == [[0], [1]] and [len(track) for track in tracks] == [40, 40]
    assert len({people[0] for people in truth}) == 2  # control: the file's order would not do
    # hidden behind the other for eight frames of 20 px: farther than the reach of the place last seen
    hidden = [person(100 + 20 * n) if not 12 <= n < 20 else None for n in range(40)]
    frames, truth = listed(hidden, [person(420, 310)] * 40)
    assert followed(tracking.join(frames, gap=15), truth) == [[0], [1]]


@pytest.mark.parametrize("away", [8, 30])
def test_who_leaves_and_returns_within_the_gap_is_the_same(away):
    frames, truth = listed([person(200) if not 10 <= n < 10 + away else None for n in range(60)], [person(700)] * 60)
    tracks = tracking.join(frames, gap=15)
    assert len(tracks) == (2 if away <= 15 else 3) and all(len(row) == 1 for row in followed(tracks, truth))


def test_fast_people_and_other_points_are_joined_by_their_boxes(monkeypatch):
    """One gathers speed, to half of the own size a frame; of the other, half of the points are seen, then the rest."""
    turns = [person(500, 900, slice(0, 8) if n == 0 else slice(8, 17)) for n in range(12)]
    frames, truth = listed([person(100 + 5 * n * n) for n in range(12)], turns)
    tracks = tracking.join(frames, gap=3)
    assert followed(tracks, truth) == [[0], [1]] and [len(track) for track in tracks] == [12, 12]
    monkeypatch.setattr(tracking, "_OVERLAP", 2.0)  # control: no box overlaps by so much
    assert len(tracking.join(frames, gap=3)) > 6


def test_control_without_distances_people_who_pass_are_taken_for_each_other(monkeypatch):
    paths = [[person(300 + 4 * n) for n in range(20)], [person(340 - 4 * n, 302) for n in range(20)]]
    frames, truth = listed(*paths, seed=2)
    assert followed(tracking.join(frames, gap=5), truth) == [[0], [1]]
    monkeypatch.setattr(tracking, "_distances", lambda tracks, people, frame: np.zeros((len(tracks), len(people))))
    assert max(len(row) for row in followed(tracking.join(frames, gap=5), truth)) > 5


def test_of_a_crowd_a_bounded_number_is_compared(monkeypatch):
    """Three hundred strangers in every frame, remembered for ever: time goes with the number of frames."""
    sizes, compare, draw = [], tracking._distances, np.random.default_rng(0)
    monkeypatch.setattr(tracking, "_distances", lambda a, b, n: sizes.append((len(a), len(b))) or compare(a, b, n))
    points = draw.uniform(0, 100_000, (6, 300, 1, 2)) + draw.uniform(0, 20, (6, 300, 17, 2))
    assert len(tracking.join([*np.concatenate([points, np.ones((6, 300, 17, 1))], -1)], gap=100)) == 600
    assert max(sizes) == (200, 100)


@pytest.mark.parametrize("seed", range(5))
def test_false_detections_do_not_take_the_place_of_a_person(seed, monkeypatch):
    """In every frame one, somewhere: a good pair is better than two bad ones."""
    draw = np.random.default_rng(seed)
    ghosts = [person(*draw.uniform(100, 500, 2)) + np.float32([*draw.normal(0, 20, 2), 0]) for _ in range(61)]
    frames, truth = listed([person(300 + n) for n in range(61)], ghosts)
    longest = max(tracking.join(frames, gap=15), key=lambda track: len(track))
    assert [truth[frame][index] for frame, index in longest] == [0] * 61


def tracks_of(frames: list[list[tuple[int, np.ndarray]]]) -> tuple[dict, list[np.ndarray]]:
    """Tracks by id, and the people, of frames of (id, person)."""
    named: dict[int, list[tuple[int, int]]] = {}
    for n, here in enumerate(frames):
        for k, (name, _) in enumerate(here):
            named.setdefault(name, []).append((n, k))
    return named, [np.stack([one for _, one in here]) if here else np.zeros((0, 17, 3)) for here in frames]


def test_an_id_that_begins_where_another_ends_goes_on_with_it():
    walks = [[(0 if n < 20 else 7 if n < 30 else 12, person(200 + 3 * n)), (3, person(700))] for n in range(40)]
    assert tracking.continued(*tracks_of(walks), gap=15) == {0: [0, 7, 12], 3: [3]}
    away = [row if not 20 <= n < 26 else row[1:] for n, row in enumerate(walks)]
    assert tracking.continued(*tracks_of(away), gap=15)[0] == [0, 7, 12]
    assert tracking.continued(*tracks_of(away), gap=4) == {0: [0], 3: [3], 7: [7, 12]}  # control: too long ago
    fresh = [[(n, person(200 + 3 * n))] for n in range(9)]  # a new id in every frame
    assert tracking.continued(*tracks_of(fresh), gap=15) == {0: [*range(9)]}
    other = [[(0 if n < 20 else 7, person(200 if n < 20 else 600))] for n in range(40)]
    assert tracking.continued(*tracks_of(other), gap=15) == {0: [0], 7: [7]}  # control: elsewhere


def test_who_is_there_twice_is_found_and_who_is_near_is_not():
    pairs = [[(0, person(200 + n)), (1, person(201 + n, 301)), (2, person(240 + n))] for n in range(20)]
    assert tracking.twins(*tracks_of(pairs)) == {0: [1]}
    met = [[(0, person(200)), (1, person(200 + 20 * abs(n - 10)))] for n in range(20)]
    assert tracking.twins(*tracks_of(met)) == {}  # control: they only meet
