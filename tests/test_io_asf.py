"""ASF/AMC: against a scalar reading of the format with 4x4 matrices, and wrong files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from loaders import refused
from seeds import AMC, ASF

from motionlab import io
from motionlab.errors import DataError
from motionlab.io import asf
from tests.recorded import DATA, needs_data

SCALE = 0.0254 / 0.45


def write(folder: Path, skeleton: str | bytes = ASF, take: str | bytes = AMC) -> tuple[Path, Path]:
    for name, text in (("07.asf", skeleton), ("07_01.amc", take)):
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / "07.asf", folder / "07_01.amc"


def about(axis: int, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    m = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    m[i, i], m[j, j], m[i, j], m[j, i] = c, c, -s, s
    return m


def xyz(degrees) -> np.ndarray:
    return about(2, degrees[2]) @ about(1, degrees[1]) @ about(0, degrees[0])


def naive(path_asf: Path, path_amc: Path, frame: int) -> dict[str, np.ndarray]:
    """World position of the far end of every bone, y up, file units: literal, one bone and one matrix at a time."""
    bones, children, state, bone = {}, {}, "", {}
    for line in path_asf.read_text().splitlines():
        w = line.split()
        if not w:
            continue
        if w[0][0] == ":":
            state = w[0]
        elif state == ":bonedata":
            if w[0] == "begin":
                bone = {"dof": []}
            elif w[0] == "end":
                bones[bone["name"]] = bone
            elif w[0] in ("name", "dof", "direction", "length", "axis"):
                bone[w[0]] = w[1] if w[0] in ("name", "length") else w[1:]
        elif state == ":hierarchy" and w[0] not in ("begin", "end"):
            children[w[0]] = w[1:]
    text = path_amc.read_text().split(f"\n{frame + 1}\n")[1]
    values = {}
    for line in text.splitlines():
        w = line.split()
        if len(w) == 1:
            break
        values[w[0]] = [float(v) for v in w[1:]]
    ends = {}

    def walk(name: str, here: np.ndarray) -> None:
        b = bones[name]
        c = xyz([float(v) for v in b["axis"][:3]])
        angles = dict(zip(b["dof"], values.get(name, []), strict=True))
        m = xyz([angles.get(k, 0.0) for k in ("rx", "ry", "rz")])
        here = here @ c @ m @ np.linalg.inv(c)
        shift = np.eye(4)
        shift[:3, 3] = np.array([float(v) for v in b["direction"]]) * float(b["length"])
        here = here @ shift
        ends[name] = here[:3, 3]
        for child in children.get(name, []):
            walk(child, here)

    root = np.eye(4)
    root[:3, 3] = values["root"][:3]
    root = root @ xyz(values["root"][3:])
    for child in children["root"]:
        walk(child, root)
    return ends


def test_sections_may_stand_in_any_order(tmp_path):
    head, bones = ASF.split(":bonedata")
    bones, hierarchy = bones.split(":hierarchy")
    (tmp_path / "other").mkdir()
    plain, other = (asf.load(*write(at, text)) for at, text in (
        (tmp_path, ASF), (tmp_path / "other", f"{head}:hierarchy{hierarchy}\n:bonedata{bones}")))  # fmt: skip
    assert torch.equal(plain.positions, other.positions)


def compare(paths: tuple[Path, Path], frame: int) -> int:
    motion = asf.load(*paths)
    count = 0
    for bone, end in naive(*paths, frame).items():
        expected = SCALE * np.array([-end[0], end[2], end[1]])  # what faced z faces y, z up
        below = [j for j, p in enumerate(motion.skeleton.parents) if p == motion.skeleton.index(bone)]
        assert below, f"{bone} has a far end"
        for j in below:
            np.testing.assert_allclose(motion.positions[frame, j].numpy(), expected, atol=2e-6)
            count += 1
    return count


def test_agrees_with_a_scalar_reading(tmp_path):
    paths = write(tmp_path)
    assert compare(paths, 0) == compare(paths, 1) == 3


def test_what_the_files_do_not_say_is_noted(tmp_path):
    paths = write(tmp_path)
    motion = asf.load(*paths)
    assert motion.fps == 120 and motion.name == "07_01" and len(motion.notes) == 2
    assert "1/0.45 inch" in motion.notes[0] and "120" in motion.notes[1]
    told = asf.load(*paths, fps=60, unit=0.05)
    assert told.fps == 60 and told.notes == ()
    torch.testing.assert_close(told.positions * SCALE / 0.05, motion.positions)


def test_the_skeleton_is_found_beside_the_take(tmp_path):
    _, amc = write(tmp_path)
    torch.testing.assert_close(io.load(amc).positions, asf.load(tmp_path / "07.asf", amc).positions)
    (tmp_path / "07.asf").unlink()
    with pytest.raises(DataError, match=r"07\.asf.*no skeleton file.*--asf"):
        io.load(amc)


def test_of_several_skeletons_the_one_of_the_longest_name_is_taken(tmp_path):
    """As of HDM05: HDM_bd.asf of HDM_bd_walk_001.amc, though HDM.asf lies there too."""
    asf_path, amc = write(tmp_path)
    (tmp_path / "HDM.asf").write_text("nothing")
    asf_path.rename(tmp_path / "HDM_bd.ASF")
    amc = amc.rename(tmp_path / "hdm_bd_walk_001.amc")
    expected = asf.load(tmp_path / "HDM_bd.ASF", amc, fps=60, unit=0.01)
    found = io.load(amc, fps=60, unit="cm")
    torch.testing.assert_close(found.positions, expected.positions)
    named = io.load(amc, asf=tmp_path / "HDM_bd.ASF", fps=60, unit=0.01)
    assert found.notes == () and torch.equal(named.root, found.root)


def test_radians(tmp_path):
    motion = asf.load(*write(tmp_path))
    turned = []
    for w in map(str.split, AMC.replace(":DEGREES", ":RADIANS").splitlines()):
        start = {"root": 4, "lfemur": 1, "ltibia": 1}.get(w[0], len(w))
        turned.append(" ".join(w[:start] + [f"{np.radians(float(v)):.9f}" for v in w[start:]]))
    again = asf.load(*write(tmp_path, take="\n".join(turned)))
    torch.testing.assert_close(again.positions, motion.positions, atol=1e-5, rtol=0)


WRONG = {  # name: (asf, amc, words)
    "no hierarchy": (ASF[: ASF.index(":hierarchy")], AMC, "no section :hierarchy"),
    "truncated bones": (ASF.replace("  end\n:hierarchy", ":hierarchy"), AMC, "bone thorax has no end"),
    "no length": (ASF.replace("length 0.45", ""), AMC, "section :units"),
    "zero length unit": (ASF.replace("length 0.45", "length 0"), AMC, "section :units.*above zero"),
    "angle unit": (ASF.replace("angle deg", "angle grad"), AMC, "section :units.*angle"),
    "NaN direction": (ASF.replace("direction 0 1 0.1", "direction 0 nan 0.1"), AMC, "line 38"),
    "direction of two": (ASF.replace("direction 0 1 0.1", "direction 0 1"), AMC, "line 38.*expected 3 values"),
    "bad dof": (ASF.replace("dof rx\n", "dof rx l\n"), AMC, "degrees of freedom"),
    "duplicate bone": (ASF.replace("name thorax", "name ltibia"), AMC, "second bone named 'ltibia'"),
    "unknown bone": (ASF.replace("lfemur ltibia\n", "lfemur ltibia lfoot\n"), AMC, "'lfoot' is not in :bonedata"),
    "orphan": (ASF.replace("    lfemur ltibia\n", ""), AMC, "ltibia hang on nothing"),
    "two parents": (ASF.replace("root lfemur thorax", "root lfemur thorax ltibia"), AMC, "ltibia has two parents"),
    "cycle": (ASF.replace("root lfemur thorax", "root thorax\n    ltibia lfemur"), AMC, "ltibia hang on nothing"),
    "axis order": (ASF.replace("axis XYZ", "axis XYX"), AMC, "axis order"),
    "no frames": (ASF, AMC[: AMC.index("1\n")], "frame 1 without root"),
    "bone missing in frame": (ASF, AMC.replace("ltibia 22\n", ""), "line 9.*ltibia .* not in the one before"),
    "truncated frame": (ASF, AMC[: AMC.index("lfemur -25")], "frame 2 without lfemur"),
    "value missing": (ASF, AMC.replace("lfemur -28 5 -20", "lfemur -28 5"), "line 6.*expected 3 values, got 2"),
    "foreign bone": (ASF, AMC.replace("ltibia 22", "rtibia 22"), "line 7.*expected a bone"),
    "bone twice": (ASF, AMC.replace("ltibia 22\n", "ltibia 22\nltibia 22\n"), "line 8.*twice"),
    "frame skipped": (ASF, AMC.replace("\n2\n", "\n3\n"), "line 8.*frame 3 follows frame 1"),
    "NaN": (ASF, AMC.replace("ltibia 22", "ltibia nan"), "line 7.*value 1 is 'nan', not a usable number"),
    "values before a frame": (ASF, AMC.replace("1\nroot 10", "root 10"), "line 4.*frame number 1"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_name_file_place_and_remedy(tmp_path, name):
    skeleton, take, words = WRONG[name]
    with refused(match=words):
        asf.load(*write(tmp_path, skeleton, take))


@needs_data
@pytest.mark.parametrize("take", ["02_01", "02_05"])
def test_a_recording_agrees_with_a_scalar_reading(take):
    paths = DATA / "cmu_amc" / "02.asf", DATA / "cmu_amc" / f"{take}.amc"
    assert compare(paths, 150) == 34  # every joint but the root and the three that start there
