"""README.md and docs/: examples run as printed, commands are understood, links lead on, numbers are the records'."""

import json
import re
from pathlib import Path

import imageio.v2 as imageio
import pytest
import torch
from walked import table, write_json

from motionlab import bench, examples, io, retarget
from motionlab.baselines import curve_weights
from motionlab.bench import PersonWindows
from motionlab.commands import onnx_export
from motionlab.commands.options import parser
from motionlab.contact import with_contacts
from motionlab.diffusion import completer
from motionlab.diffusion.windows import on_standard
from motionlab.io import bvh, gltf
from motionlab.motion import resample, windows
from motionlab.skeleton import STANDARD
from suite import execute, findings, pages
from tests.test_architecture import notebooks

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
}
EXAMPLES = [
    code
    for page in ("README.md", "docs/library.md")
    for code in re.findall(r"```python\n(.*?)```", PAGES[page], re.DOTALL)
]
WALK = retarget.retarget(io.load(examples.WALK).cut(0, 66)).motion


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """A folder with the beginning of the walk, and the keypoints of its first eight frames in openpose_json/."""
    folder = tmp_path_factory.mktemp("desk")
    bvh.save(folder / "begun.bvh", io.load(examples.WALK).cut(0, 66))
    write_json(folder / "openpose_json", table(WALK.cut(0, 8)))
    return folder


def is_a_film_of_the_walk(names: dict) -> None:
    reader = imageio.get_reader("walk.mp4")
    assert torch.allclose(names["walk"].positions, WALK.positions, atol=1e-5) and reader.count_frames() == 66
    meta = reader.get_meta_data()
    assert (meta["fps"], meta["codec"], meta["pix_fmt"][:7]) == (30, "h264", "yuv420p")  # what browsers play
    first, middle = (reader.get_data(frame).astype(float) for frame in (0, WALK.frames // 2))
    assert first.std() > 5 and abs(first - middle).max() > 50  # somebody is there, and moves


def is_an_error_of_each_person(names: dict) -> None:
    assert names["error"].shape == (1,) and 0 < names["error"].item() < 30


def walk_as_a_person(folder: str, part: str) -> PersonWindows:
    """Stands in for recordings, which the project must not contain."""
    cut = windows(with_contacts(on_standard(resample(WALK, 30))), 60, 30)
    whose = torch.zeros(len(cut.root), dtype=torch.long)
    return PersonWindows(cut, whose, torch.zeros(len(whose), 1, len(STANDARD) + 2, dtype=torch.bool))


def is_twice_as_fine(names: dict) -> None:
    assert names["positions"].shape == (2 * WALK.frames - 1, 22, 3)
    assert torch.allclose(names["positions"][::2], WALK.positions, atol=1e-5)


def is_a_fit_without_doubts(names: dict) -> None:
    assert names["positions"].shape == (1, 8, 22, 3) and names["positions"].isfinite().all()
    assert not names["found"].diagnostics.doubtful.any()


def is_a_repair_of_the_gap_alone(names: dict) -> None:
    cut, filled = names["cut"], names["filled"]
    assert cut.root.shape == filled.root.shape == (WALK.frames // 60, 60, 3)
    apart = (filled.positions - cut.positions).norm(dim=-1)
    worst, mean = apart.amax((0, 2)), apart.mean((0, 2))  # joint of every frame
    assert torch.cat((worst[:15], worst[45:])).max() < 1e-4 < worst[15:45].min() and mean.max() < 0.15


def is_a_file_for_viewers(names: dict) -> None:
    assert names["jitter"].shape == names["skating"].shape == () and names["jitter"] > 0 < names["skating"] < 1
    back = gltf.load("walk.glb")
    assert back.fps == WALK.fps and back.skeleton.names == STANDARD.names
    assert torch.allclose(back.positions, WALK.positions, atol=1e-5)


def is_what_the_export_computes(names: dict) -> None:
    """Of the example, and of a walk what the network computes: known frames to the bit, the others to 1e-4."""
    frames = names["known"] > 0.5
    assert abs(names["curves"] - curve_weights(torch.from_numpy(frames)).numpy()).max() < 1e-6
    assert names["rotations"].shape == (1, 60, 22, 3, 3)
    still = abs(names["root"] - [0, 0, 0.95]).max((0, 2))
    assert still[:15].max() < 1e-6 > still[45:].max() and 1e-4 < still[15:45].max() < 1.0
    walk = windows(on_standard(resample(WALK, 30)), 60, 60)
    given = names["given"] | {"root": walk.root.numpy(), "rotations": walk.rot.numpy()}
    root, rot = names["session"].run(None, {name: x.astype("float32") for name, x in given.items()})
    known = torch.from_numpy(frames)[..., None].repeat(1, 1, len(STANDARD) + 2)
    known[..., -1] = False
    made = completer.load("completer").complete(walk, known)
    assert abs(root - made.root.numpy()).max() < 1e-4 and abs(rot - made.rot.numpy()).max() < 1e-4
    assert (root[frames] == given["root"][frames]).all() and (rot[frames] == given["rotations"][frames]).all()
    assert abs(rot - given["rotations"]).max() > 1e-2


PROMISES = (
    is_a_film_of_the_walk, is_an_error_of_each_person, is_twice_as_fine, is_a_fit_without_doubts,
    is_a_repair_of_the_gap_alone, is_what_the_export_computes, is_a_file_for_viewers,
)  # fmt: skip


@pytest.mark.parametrize(("number", "promise"), [*enumerate(PROMISES)], ids=lambda each: getattr(each, "__name__", ""))
def test_example_runs_as_printed_and_keeps_its_promise(number, promise, desk, monkeypatch):
    """Each stands alone: nothing of one is needed by another."""
    monkeypatch.chdir(desk)
    monkeypatch.setattr(bench, "people", walk_as_a_person)
    monkeypatch.setattr(examples, "WALK", desk / "begun.bvh")
    if promise is is_what_the_export_computes:
        onnx_export.export(completer.load("completer"), "inbetween.onnx")
    names: dict[str, object] = {}
    exec(compile(EXAMPLES[number], f"example {number + 1}", "exec"), names)
    promise(names)
    assert len(EXAMPLES) == len(PROMISES)


# ------------------------------------------------------------------------------------------------------ commands
def commands() -> list[tuple[str, str]]:
    """Where a command of the library is printed, in README, pages and text of notebooks, and what it says."""
    texts = dict(PAGES)
    for path in notebooks(ROOT):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts[path.stem] = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return [(name, words) for name, text in texts.items() for words in re.findall(COMMAND, text, re.MULTILINE)]


COMMAND = r"(?:python -m |`|^)motionlab ([a-z][^`\n#]+)"


def refused(words: str) -> bool:
    """Whether the command line does not understand a command, or cannot write what it is asked to."""
    try:
        options = parser().parse_args(words.split())
    except SystemExit:
        return True
    return words.startswith("fit ") and options.out is not None and bool(options.out.suffix)


def test_every_printed_command_is_understood(capsys):
    found = commands()
    assert len(found) > 15 and not [(name, words) for name, words in found if len(words.split()) > 1 and refused(words)]
    assert refused("fit FOLDER --out motion.npz") and refused("fit clip.mp4 --glb x.glb")  # as printed once


# ------------------------------------------------------------------------------------------------------ what is said
def broken_links(page: str, text: str) -> list[str]:
    """Links and pictures of a page that lead to no file of the checkout, or to no heading of the page itself."""
    headings = {
        re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)", text, re.MULTILINE)
    }
    targets = [t for t in re.findall(r"\]\(([^)\s]+)\)", text) if not t.startswith("https://")]
    here = (ROOT / page).parent
    return [t for t in targets if not (t[1:] in headings if t.startswith("#") else (here / t.split("#")[0]).exists())]


def test_links_lead_somewhere():
    texts = PAGES | {"CHANGELOG.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")}
    assert not [(page, link) for page, text in texts.items() for link in broken_links(page, text)]
    text = "# One two\n[a](#one-two) [b](#three) ![c](nowhere.png) [d](docs/library.md)"
    assert broken_links("README.md", text) == ["#three", "nowhere.png"]  # control


def test_what_is_said_of_the_results_is_what_the_records_say():
    claims = findings.load_claims(execute.NOTEBOOKS / "claims.toml")
    found = findings.load_results(execute.NOTEBOOKS / "results")
    assert pages.first_findings(claims, found) in PAGES["README.md"]
    assert pages.scoreboard(claims, found) in PAGES["docs/scoreboard.md"]
