"""Who performs what, and that no performance is on both sides of the split, whatever source shows it."""

import copy
import tomllib
from collections import Counter
from pathlib import Path

import pytest
import torch

from data_synth import clips
from motionlab import io, splits
from motionlab.skeleton import STANDARD

#: Partners in one scene, and copies of one another, as the review of the data found them.
TOGETHER = [
    (18, 19), (20, 21), (22, 23), (33, 34), (60, 61), (63, 64), (70, 73), (74, 84), (83, 122), (85, 117), (91, 105),
    (93, 103), (106, 141),
]  # fmt: skip
IDS = [f"{subject:02}_{trial:02}" for subject in range(1, 145) for trial in (1, 17)]


@pytest.fixture(autouse=True)
def _without_data(monkeypatch):
    monkeypatch.delenv("MOTIONLAB_DATA", raising=False)


def files(performance):
    """Where each source keeps a performance."""
    subject = performance.split("_")[0]
    yield "cmu_library", f"cmu_library/{subject}/{performance}.bvh"
    yield "cmu_native", f"/data/cmu_native/{subject}/{performance}.amc"
    yield "cmu_amc", Path("cmu_amc") / f"{performance}.amc"


def crossing(ids):
    """Performances of which the sources disagree by whom they are, or in which part."""
    whose = {i: {splits.person_of(*file) for file in files(i)} for i in ids}
    return [i for i, found in whose.items() if len(found) > 1 or len({splits.part_of(p) for p in found}) > 1]


def apart(pairs):
    """Pairs of subjects that are not in one part."""
    return [pair for pair in pairs if len({splits.part_of(f"cmu_{subject:02}") for subject in pair}) > 1]


def changed(monkeypatch, change):
    table = copy.deepcopy(splits._table())
    change(table)
    monkeypatch.setattr(splits, "_table", lambda: table)


# --------------------------------------------------------------------------------------------------------- CMU
def test_no_performance_is_on_both_sides_of_the_split():
    assert crossing(IDS) == []
    assert splits.person_of("cmu_native", "05_02.amc") == splits.person_of("cmu_library", "05/05_20.bvh") == "cmu_05"
    assert Counter(splits.part_of(f"cmu_{s:02}") for s in range(1, 145)) == {"train": 113, "val": 14, "test": 17}


def test_partners_and_copies_stay_together(monkeypatch):
    assert apart(TOGETHER) == []
    changed(monkeypatch, lambda table: table["test"]["people"].remove("cmu_23"))
    assert apart(TOGETHER) == [(22, 23)]


# ------------------------------------------------------------------------------------------------------- others
def test_sources_whose_people_are_not_known_are_for_training():
    alone = tomllib.loads(splits._TABLE.read_text(encoding="utf-8"))["alone"]
    assert {"deepmimic", "isaacgym_amp_cmu"} <= set(alone)
    for source in alone:
        for file in (f"{source}/humanoid3d_walk.txt", f"{source}/someone/05_01.npz"):
            assert splits.person_of(source, file) == source and splits.part_of(source) == "train"
    assert set(splits.REAL) <= set(alone) | {"cmu_library", "cmu_native", "cmu_amc"}  # none by chance


@pytest.mark.parametrize(
    ("file", "person"),
    [
        ("/x/mine/ann/walk_01.bvh", "mine/ann"), ("mine/KIT/bob/7.npz", "mine/bob"), ("mine/ann_walk.bvh", "mine/ann"),
        ("ann7.bvh", "mine/ann"), ("mine/7.bvh", "mine/7"),
    ],
)  # fmt: skip
def test_elsewhere_a_person_is_a_folder_or_the_beginning_of_a_name(file, person):
    assert splits.person_of("mine", file) == person


def test_collections_that_nobody_knows_are_split_by_a_hash_that_stays():
    """sha256 of "mine/ann", as a number, leaves 5 when divided by 10: train; that of "mine/carla" 0: val."""
    known = {"ann": "train", "bob": "train", "carla": "val", "dora": "test", "emil": "test", "gus": "val"}
    assert {name: splits.part_of(f"mine/{name}") for name in known} == known
    shares = Counter(splits.part_of(f"mine/{i}") for i in range(1000))
    assert 80 < shares["val"] < 120 and 160 < shares["test"] < 240
    assert splits.part_of("cmu_extra/dora") == "val"  # not one of the sources whose ids are CMU's


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


def test_spread_takes_first_last_and_between():
    assert splits.subsample(list(range(10)), 4) == [0, 3, 6, 9]
    assert splits.subsample([1, 2], 4) == [1, 2]
    assert splits.subsample(list(range(10)), 1) == [0]
