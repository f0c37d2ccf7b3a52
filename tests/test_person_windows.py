"""Windows of people against a loop that retargets every recording and cuts every window."""

import pytest
import torch

from data_synth import clips
from motionlab import bench
from motionlab.contact import with_contacts
from motionlab.corpus import Take
from motionlab.diffusion.windows import on_standard
from motionlab.errors import DataError

# whose recording it is, its frames, what it lacks; the third is too short for a window
RECORDINGS = [
    ("b", 40, ()),
    ("a", 25, ("neck",)),
    ("a", 10, ()),
    ("b", 60, ("left_foot",)),
    ("a", 33, ()),
    ("c", 20, ()),
]
FRAMES = 20


@pytest.fixture(scope="module")
def takes():
    whole = with_contacts(clips.draw(1, torch.Generator().manual_seed(3), actions=("walk",))[0].motion)
    return [
        Take(whole.cut(k, k + frames), str(k), "made", who, "", 30.0, lacks)
        for k, (who, frames, lacks) in enumerate(RECORDINGS)
    ]


def naive(takes, each):
    """Windows (person, motion, what is lacked) in the order of people as they come."""
    found = []
    for number, person in enumerate(["b", "a", "c"]):
        places = [(t, at) for t in takes if t.person == person for at in range(t.motion.frames - FRAMES + 1)]
        for k in torch.linspace(0, len(places) - 1, min(each, len(places))).round().long():
            take, at = places[k]
            found.append((number, on_standard(take.motion).cut(at, at + FRAMES), take.missing))
    return found


@pytest.mark.parametrize(("each", "needed"), [(3, 5), (1, 3)])
def test_they_are_those_of_all_recordings_retargeted(takes, each, needed, monkeypatch):
    """Though no recording is retargeted that no window is of."""
    moved = []
    monkeypatch.setattr(bench, "on_standard", lambda motion: moved.append(motion.name) or on_standard(motion))
    found, expected = bench.person_windows(takes, FRAMES, each), naive(takes, each)
    assert found.whose.tolist() == [who for who, _, _ in expected]
    for name in ("root", "rot", "contacts"):
        assert torch.equal(getattr(found.motion, name), torch.stack([getattr(m, name) for _, m, _ in expected]))
    names = found.motion.skeleton.names
    lacks = [{n for n, lacked in zip(names, row[0], strict=False) if lacked} for row in found.lacks]
    assert lacks == [set(lacked) for _, _, lacked in expected]
    assert len(moved) == needed


def test_nobody_long_enough_is_said(takes):
    with pytest.raises(DataError, match="nobody has 1000 frames"):
        bench.person_windows(takes, 1000, 3)
