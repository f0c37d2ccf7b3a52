import pytest
import torch

from data_synth import clips
from motionlab import io, splits
from motionlab.skeleton import STANDARD
from studies.nb02_rotations import recordings


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two recordings of one known source, as BVH at 60 frames per second."""
    root = tmp_path_factory.mktemp("recordings")
    (root / "reactidle").mkdir()
    for i, take in enumerate(clips.draw(2, torch.Generator().manual_seed(0), actions=("idle",), fps=60.0)):
        io.bvh.save(root / "reactidle" / f"{i}.bvh", take.motion)
    return root


def test_recordings_come_on_the_standard_joints_at_one_rate(folder):
    motions = splits.load_source(folder, "reactidle")
    assert len(motions) == 2
    assert all(m.skeleton.names == STANDARD.names and m.fps == 30 for m in motions)
    assert len(splits.load_source(folder, "reactidle", each=1)) == 1
    assert splits.load_source(folder, "reactidle")[0] is motions[0]  # loaded once


def test_no_folder_or_no_such_source_is_an_empty_list(folder):
    assert splits.load_source(None, "cmu_amc") == []
    assert splits.load_source(folder, "cmu_amc") == []
    assert recordings.roots(None) == {}
    assert list(recordings.roots(folder)) == ["reactidle"]


def test_spread_takes_first_last_and_between():
    assert splits.subsample(list(range(10)), 4) == [0, 3, 6, 9]
    assert splits.subsample([1, 2], 4) == [1, 2]
    assert splits.subsample(list(range(10)), 1) == [0]
