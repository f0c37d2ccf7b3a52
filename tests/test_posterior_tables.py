from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from motionlab.posterior import tables
from motionlab.posterior.sampling import Posterior
from motionlab.posterior.trials import Draws, Placed


def chain(generator, spread, steps=400):
    x = torch.randn(steps, 10, 3, generator=generator, dtype=torch.float64) * torch.tensor(spread).double()
    return Posterior(x, x[..., 0], torch.ones(3).double(), 0.5, ("size", "distance", "camera"), ("", "", "m"), 0)


def placed(generator, truth):
    spread = (0.1, 0.05, 1.0)
    return Placed(chain(generator, spread), torch.zeros(3).double(), torch.diag(torch.tensor(spread)).double(), truth)


def test_depth_counts_the_truths_inside_and_names_the_width(generator):
    inside, outside = torch.tensor([0.0, 0.0, 0.0]).double(), torch.tensor([0.0, 0.2, 0.0]).double()
    (row,) = tables.depth_rows({"image": [placed(generator, inside), placed(generator, outside)]})
    assert row["truth in the central 90 %: distance"] == "1 of 2" and row["size"] == "2 of 2"
    assert row["s.d. of distance, %"] == pytest.approx(5, rel=0.05) and row["by Laplace"] == pytest.approx(5)
    half = tables.half_widths([placed(generator, inside)], torch.tensor([4.0]))
    assert half["Laplace"].item() == pytest.approx(100 * 1.645 * 0.05 * 4, rel=1e-6)
    assert half["emcee"].item() == pytest.approx(32.9, rel=0.05)


def test_ensembles_that_disagree_are_named_worst_and_single_ones_are_not_compared(generator):
    one, same, other = (chain(generator, (0.1, 0.05, 1.0)) for _ in range(3))
    other = replace(other, chain=other.chain + torch.tensor([0.0, 0.2, 0.0]))
    good, bad = tables.agreement_rows({"good": [(one, same), (one,)], "bad": [(one, same), (one, other)]})
    assert float(good["worst"]) < 1.01 and good["at most 1.01"] == "1 of 1 clips"
    assert float(bad["worst"]) > 2 and bad["at most 1.01"] == "1 of 2 clips"
    assert bad["R-hat of a chain's own walkers"].startswith("1.0")  # which knows nothing of the other
    (alone,) = tables.agreement_rows({"alone": [(one,)]})
    assert alone["worst"] == "-" and alone["at most 1.01"] == "0 of 0 clips"
    again = replace(placed(generator, torch.zeros(3).double()), again=(other,))
    assert float(tables.depth_rows({"image": [again]})[0]["worst R-hat of ensembles"]) > 2


def test_coverage_says_between_which_temperatures_and_on_how_many_clips(generator):
    clips, exact = [clip()] * 3, [torch.zeros(4).double()] * 3
    found = tables.judged(clips, [draws(generator), None, draws(generator)], exact)
    cold, warm = tables.coverage_rows(
        {"cold": found, "warm": found}, generator, {"warm": torch.tensor([50.0, 9.0, 70.0])}
    )
    assert cold["temperature"] == "1" and warm["temperature"] == "50 to 70"
    assert warm["n"] == 2 and warm["90 % holds"].startswith("100 % [34, 100]")


def clip(size=4):
    hidden = torch.ones(5, 6, dtype=torch.bool)
    return SimpleNamespace(
        point=SimpleNamespace(hidden=hidden, size=99),
        directions=SimpleNamespace(spread=torch.ones(size).double(), share=0.6),
        size=size, width=lambda: 0.02,
    )  # fmt: skip


def draws(generator, count=300):
    ways = 0.01 * torch.randn(count, 5, 6, 3, generator=generator)
    return Draws(None, None, ways, torch.randn(count, 4, generator=generator, dtype=torch.float64))


def test_refused_chains_are_left_out_and_said_so(generator):
    clips, exact = [clip()] * 3, [torch.zeros(4).double()] * 3
    found = tables.judged(clips, [draws(generator), None, draws(generator)], exact)
    assert found.clips == [0, 2] and found.ranks.shape == (2, 4)
    assert found.width == pytest.approx(100 * (4 / 30) ** 0.5, rel=0.1)
    assert tables.held(found, generator).endswith("n = 2")
    assert tables.judged(clips, [None] * 3, exact) is None and tables.held(None, generator) == "refused"


def test_balls_of_unit_normal_draws_hold_ninety_percent(generator):
    truth = 0.01 * torch.randn(5, 6, 3, generator=generator)
    share, radius = tables.ball([clip()], [draws(generator, 2000)], [truth])
    assert share.item() > 0.7 and radius.item() == pytest.approx(2.5, rel=0.05)
    (row,) = tables.ball_rows({"emcee": (share, radius)}, torch.tensor([1.0]))
    assert row["n"] == 1 and row["radius with error, correlation"] == "-"
    share, radius = torch.tensor([0.5, 0.9, 1.0]), torch.tensor([1.0, 2.0, 3.0])
    (row,) = tables.ball_rows({"emcee": (share, radius)}, torch.tensor([1.0, 2.0, 3.0]))
    assert row["radius with error, correlation"] == "1.00" and row["clips with 80 % or more"] == 2


def test_share_explained_is_one_for_an_error_inside_the_directions():
    c = torch.tensor([3.0, 4.0, 0, 0]).double()
    error = torch.tensor([100 * 5 / 30**0.5])
    rows = {
        r["of the hidden legs about the pelvis"]: r["median (quartiles)"]
        for r in tables.subspace_rows([clip()], [c], error)
    }
    assert rows["share of that error's square in them, %"].startswith("100 ")


def test_quartiles_leave_out_what_is_not_finite():
    assert tables.quartiles([1.0, 2.0, 3.0, float("nan")], 1) == "2.0 (1.5 to 2.5)"
    assert tables.quartiles([float("nan")]) == "none"
