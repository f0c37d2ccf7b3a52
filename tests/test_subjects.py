"""Who performs what, and that no performance is on both sides of the split, whatever source shows it."""

import copy
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from motionlab import splits

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


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda table: table["patterns"].pop("cmu_native"), IDS),
        (lambda table: table["files"].update({"cmu_amc/07_01": "somebody"}), ["07_01"]),
    ],
)
def test_control_sources_that_disagree_are_found(monkeypatch, change, found):
    changed(monkeypatch, change)
    assert crossing(IDS) == found


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
