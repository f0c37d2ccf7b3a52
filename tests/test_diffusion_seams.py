"""The seam between given and made frames: its measures, the ends of a cure, and the table."""

from dataclasses import replace

import pytest
import torch
from tiny_diffusion import FRAMES, smooth, tiny

from motionlab import baselines
from motionlab.diffusion import repair, seams
from motionlab.errors import ShapeError

KNOWN = seams.gap(FRAMES, 8)


def from_seed(name, seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def truth():
    return smooth(6, seed=3)


@pytest.fixture(scope="module")
def lines(truth):
    models = {"free": tiny(), "told": tiny(told=True)}
    return seams.table(
        models, truth, KNOWN, from_seed, cures=("overwrite (thesis)", "guided", "told", "small, told"), steps=3
    )


def test_a_gap_lies_in_the_middle():
    assert (~KNOWN).nonzero()[:, 0].tolist() == list(range(6, 14))
    with pytest.raises(ValueError, match="1 to 16"):
        seams.gap(FRAMES, 17)


@pytest.mark.parametrize("frame", ["stuck", "world"])
def test_ends_are_exact_or_left(truth, frame):
    made = seams.ended(tiny(frame=frame), truth, KNOWN, from_seed(""), seams.CURES["overwrite (thesis)"][1])
    scale = seams.natural(truth)
    off = {end: seams.measure(motion, truth, KNOWN, scale)["known off"].max() for end, motion in made.items()}
    assert off["pasted"] < 1e-6 and off["faded"] < 1e-6 < 1e-4 < off["left"]
    inside = made["left"].positions[:, ~KNOWN] - made["pasted"].positions[:, ~KNOWN]
    assert inside.abs().max() < 1e-5  # pasting touches nothing else; fading does
    assert (made["faded"].positions[:, ~KNOWN] - made["left"].positions[:, ~KNOWN]).abs().max() > 1e-4


def test_pasting_is_the_last_overwriting_of_the_thesis(truth):
    model, way = tiny(), seams.CURES["overwrite (thesis)"][1]
    mask = model.layout.mask(FRAMES, only=KNOWN.nonzero()[:, 0].tolist())
    last = repair.repair(model, truth, mask, from_seed(""), repair.Way(sampler="ddpm", steps=way.steps, last=True))
    pasted = seams.ended(model, truth, KNOWN, from_seed(""), way)["pasted"]
    assert (last.positions - pasted.positions).abs().max() < 2e-5


def test_imputation_can_leave_the_last_word_to_the_network(truth):
    way = seams.CURES["x0 imputed (MDM)"][1]
    left = seams.ended(tiny(), truth, KNOWN, from_seed(""), way)["left"]
    assert (left.positions - truth.positions)[:, KNOWN].abs().max() > 1e-4


def test_soft_masks_are_exact_by_themselves(truth):
    made = seams.ended(tiny(), truth, KNOWN, from_seed(""), seams.CURES["blended (thesis)"][1])
    assert set(made) == {"pasted"}
    assert (made["pasted"].positions - truth.positions)[:, KNOWN].abs().max() < 1e-6


def test_the_truth_measures_as_the_truth(truth):
    found = seams.measure(truth, truth, KNOWN, seams.natural(truth))
    assert found["known off"].max() == 0 and found["gap error"].max() == 0
    assert found["acceleration"].mean() == pytest.approx(1.0, abs=1e-5)
    assert found["jump / natural"].mean() < 1.2 and set(found) == set(seams.UNITS)


def test_a_shifted_gap_jumps(truth):
    """A body that stands, in the gap 10 cm aside: 0.1 m x 30 / s at each seam, 100 mm of error."""
    still = replace(truth, root=truth.root[:, :1].expand_as(truth.root), rot=truth.rot[:, :1].expand_as(truth.rot))
    shift = torch.where(KNOWN[:, None], 0.0, torch.tensor([0.1, 0.0, 0.0]))
    found = seams.measure(replace(still, root=still.root + shift), still, KNOWN, torch.linspace(0, 4, 101))
    assert found["gap error"] == pytest.approx(torch.full((6,), 100.0), abs=1e-3)
    assert found["jump"] == pytest.approx(torch.full((6,), 3.0), abs=1e-4)
    assert found["jump / natural"] == pytest.approx(torch.full((6,), 3 / 3.8), abs=1e-4)
    assert found["percentile"] == pytest.approx(torch.full((6,), 100 * 76 / 101), abs=1.0)


def test_a_jump_that_moved_into_the_gap_is_found(truth):
    """A step in the middle of the gap: nothing at the seams, all of it in the worst change."""
    still = replace(truth, root=truth.root[:, :1].expand_as(truth.root), rot=truth.rot[:, :1].expand_as(truth.rot))
    shift = torch.zeros(FRAMES, 3)
    shift[10, 0] = 0.1
    found = seams.measure(replace(still, root=still.root + shift), still, KNOWN, torch.linspace(0, 4, 101))
    assert found["jump"].abs().max() < 1e-4
    assert found["worst / natural"] == pytest.approx(torch.full((6,), 6 / 3.8), abs=1e-3)


def test_the_table_has_all_cures_whose_models_are_there(lines, truth):
    rows, made = lines
    names = [(line.cure, line.end) for line in rows]
    assert ("slerp", "pasted") in names and ("truth", "left") in names
    assert len(names) == 2 + 3 * 3 and set(names) == set(made)  # the small model is not there
    assert {"way", "end", "s a window"} < set(rows[1].row())
    cure, end = seams.best(rows)
    assert end in seams.EXACT and cure in seams.CURES
    what = "worst / natural"
    worst = {(x.cure, x.end): x.found[what].mean() for x in rows if x.cure in seams.CURES and x.end in seams.EXACT}
    assert seams.pick(rows, cure, end)[what].mean() == min(worst.values())
    with pytest.raises(ShapeError):
        seams.table({}, truth.cut(2), KNOWN, from_seed)


def test_fading_lowers_the_jump(lines):
    rows, _ = lines
    pasted, faded = (seams.pick(rows, "overwrite (thesis)", end)["jump"] for end in seams.EXACT)
    assert (faded < pasted).all()


def test_linearity_of_a_line_and_of_real_motion(truth):
    line = baselines.interpolate(truth, KNOWN.expand(truth.root.shape[:-1]))
    assert seams.linearity(line, truth, KNOWN).abs().max() < 1e-6
    assert seams.linearity(truth, truth, KNOWN).mean() == pytest.approx(1.0, abs=1e-5)
