"""``motionlab``, what every command says of itself, ``show`` and ``--film``, and wishes that cannot be met."""

import argparse
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from motionlab import io, viz
from motionlab.__main__ import main
from motionlab.commands.options import parser
from motionlab.examples import WALK
from motionlab.io import bvh, video
from motionlab.skeleton import STANDARD
from motionlab.viz import movie
from tests.test_animate import mixamo, walk


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with the walk that ships; films have a few pictures."""
    shutil.copy(WALK, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(viz, "draft", True)
    return tmp_path


@pytest.fixture
def filmed(monkeypatch):
    """What films were drawn of: the motions and how, one after the other."""
    calls = []
    draw = movie.film
    monkeypatch.setattr(movie, "film", lambda *a, **k: calls.append((a[0], k)) or draw(*a, **k))
    return calls


# ------------------------------------------------------------------------------------------------ the command
def subcommands() -> dict[str, argparse.ArgumentParser]:
    (action,) = (each for each in parser()._actions if each.dest == "command")
    return action.choices


def example(parser: argparse.ArgumentParser) -> list[str]:
    """The words of the one example in a command's help."""
    (line,) = [line for line in parser.format_help().splitlines() if line.startswith("  motionlab ")]
    return shlex.split(line)[1:]


@pytest.mark.parametrize("name", subcommands())
def test_every_command_says_what_it_does_and_its_example_is_one(name):
    command = subcommands()[name]
    words = example(command)
    assert words[0] == name and parser().parse_args(words).run
    with pytest.raises(SystemExit):  # control
        parser().parse_args([*words, "--no-such-option"])


# ------------------------------------------------------------------------------------------------------- show
def test_files_of_other_skeletons_stand_side_by_side_under_their_names(desk, filmed, capsys):
    bvh.save("other.bvh", mixamo(walk(60, 24.0)), unit="m")
    assert main(["show", "walk.bvh", "other.bvh", "--out", "film.mp4", "--follow"]) == 0
    ((motions, how),) = filmed
    assert list(motions) == ["walk.bvh", "other.bvh"] and how["body"] is not None and how["follow"]
    assert all(motion.skeleton.names == STANDARD.names for motion in motions.values())
    said = capsys.readouterr().out
    assert "other.bvh: joints recognised: 22 of 22" in said and "walk.bvh: unit cm detected" in said
    pictures = list(video.open_video("film.mp4").pictures([0, 59]))
    assert pictures[0].shape == (420, 960, 3) and not np.array_equal(pictures[0], pictures[-1])


def test_bones_are_the_files_own_and_a_cut_is_a_part(desk, filmed, capsys):
    bvh.save("other.bvh", mixamo(walk(60, 24.0)))
    assert main(["show", "other.bvh", "--out", "film.mp4", "--bones", "--cut", "1", "99"]) == 0
    ((motions, how),) = filmed
    assert how["body"] is None and "LeftUpLeg" in motions["other.bvh"].skeleton.names
    assert motions["other.bvh"].frames == 36 and "film.mp4: a film of 1.5 s" in capsys.readouterr().out


def test_a_long_motion_plays_faster_and_that_is_said(desk, capsys):
    bvh.save("long.bvh", walk(1800, 30.0))
    assert main(["show", "long.bvh", "--bones", "--out", "film.mp4"]) == 0
    assert "a film of 60.0 s, played 2.0 times as fast" in capsys.readouterr().out


def test_key_poses_are_a_row_for_each_file_also_of_one_name(desk):
    Path("b").mkdir()
    shutil.copy("walk.bvh", "b")
    for out, *files in (("1.png", "walk.bvh"), ("2.png", "walk.bvh", "b/walk.bvh")):
        assert main(["show", *files, "--out", out]) == 0
    one, two = (np.asarray(Image.open(name)) for name in ("1.png", "2.png"))
    assert two.shape[0] == 2 * one.shape[0] and one.shape[1:] == two.shape[1:]
    first, second, title = two[: len(one)], two[len(one) :], 36
    assert np.array_equal(first[title:], second[title:]) and one[title:].std() > 5
    assert not np.array_equal(first[:title], second[:title])  # their folders tell them apart


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("walk.bvh", "--out", "film.avi"), "end it in .mp4 or .png"),
        (("walk.bvh", "--out", "nowhere/film.mp4"), "there is no such folder"),
        (("walk.bvh", "./walk.bvh", "--out", "film.mp4"), "name each file once"),
        (("walk.bvh",) * 7 + ("--out", "film.mp4"), "show 6 at most"),
        (("walk.bvh", "--cut", "3", "2", "--out", "film.mp4"), "it lasts 6.6 s"),
        (("walk.bvh", "--cut", "nan", "2", "--out", "film.mp4"), "it lasts 6.6 s"),
        ((".", "--out", "film.mp4"), "name the files in it"),
    ],
)
def test_what_cannot_be_shown_is_said_with_a_remedy(words, said, desk, capsys):
    assert main(["show", *words]) == 2
    assert said in capsys.readouterr().err and {path.name for path in desk.iterdir()} == {"walk.bvh"}


# ------------------------------------------------------------------------------------------------------ --film
def test_a_film_shows_what_was_given_beside_what_was_made(desk, filmed, capsys):
    assert main(shlex.split("inbetween walk.bvh --keys 0,last --method curves --out made.bvh --film both.mp4")) == 0
    ((motions, _),) = filmed
    assert list(motions) == ["given", "made"] and "both.mp4: a film of 6.5 s" in capsys.readouterr().out
    for label, name in (("given", "walk.bvh"), ("made", "made.bvh")):
        own = io.load(name)
        own = own.positions[:, own.skeleton.indices(STANDARD.names)]
        assert (motions[label].positions - motions[label].root[:, None] - own + own[:, :1]).abs().max() < 1e-3
    assert video.open_video("both.mp4").size == (960, 420)


def test_a_film_of_what_cannot_be_filmed_is_refused_before_anything_is_made(desk, capsys):
    Path("motions").mkdir()
    shutil.copy("walk.bvh", "motions")
    for words, said in (
        ("repair motions/ --out made/ --film film.mp4", "motionlab show IN OUT"),
        ("repair walk.bvh --out made.bvh --film film.png", "end it in .mp4"),
        ("generate --count 7 --out new/ --film film.mp4", "show 6 at most"),
    ):
        assert main(words.split()) == 2 and said in capsys.readouterr().err
    assert not any(Path(name).exists() for name in ("made", "made.bvh", "film.mp4", "film.png"))
    assert not list(desk.glob("new/*"))


# ------------------------------------------------------------------------------------------------------ wishes
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("generate --seconds 0.1 --out made", "ask for 0.5 to 600 s"),
        ("generate --seconds nan --start walk.bvh --out made", "ask for 0.5 to 600 s"),
        ("generate --seconds 1e9 --out made", "ask for 0.5 to 600 s"),
        ("plant . --jobs 0 --out made", "a whole number above 0"),
        ("plant . --jobs 2 --cluster tcp://127.0.0.1:1 --out made", "not allowed with"),
        ("generate --count 0 --out made", "a whole number above 0"),
        ("generate --seed -1 --out made", "a whole number from 0"),
        ("generate --seed 99999999999999999999 --out made", "a whole number from 0"),
        ("generate --out walk.bvh", "name another folder"),
        ("repair walk.bvh --noise nan --out made.bvh", "from 0 to 1000"),
        ("repair walk.bvh --noise 1,-1 --out made.bvh", "from 0 to 1000"),
        ("convert walk.bvh made.bvh --fps 0.01", "give 1 to 1000"),
    ],
)
def test_other_wishes_that_cannot_be_met(words, said, desk, capsys):
    try:
        status = main(words.split())
    except SystemExit as stop:
        status = stop.code
    assert status == 2 and said in capsys.readouterr().err
    assert not list(desk.glob("made/*")) and not Path("made.bvh").exists()
