"""Every golden array of the official code against the value computed here."""

from pathlib import Path

import pytest
import torch

from motionlab.humor import faithful_rotation, parity
from motionlab.motion import velocity

FOLDER = Path(__file__).parent / "golden"


@pytest.fixture(scope="module")
def rows():
    return parity.parity_rows(FOLDER)


def test_every_golden_array_is_met(rows):
    missed = [f"{r.arrays} ({r.form}): {r.error:.1e} > {r.tolerance:.0e}" for r in rows if not r.holds]
    assert not missed, "\n".join(missed)


def test_the_official_form_is_met_to_rounding(rows):
    official = [row for row in rows if row.form == "official"]
    assert len(official) > 30 and max(row.error for row in official) < 1e-12


def test_no_roll_out_array_is_left_out(rows):
    inputs = {"world_", "x_past", "x_t", "z", "roll_z", "weight_check", "rollmean_z"}
    of_encoder = {"posterior_mean", "posterior_var", "prior_mean", "prior_var"}  # halves of encoder_raw, prior_raw
    variances = {"infer_post_var", "infer_prior_var"}  # of nets whose raw output is compared
    named = {row.arrays for row in rows}
    stems = tuple(name[:-1] for name in named if name.endswith("*"))
    left = [
        name
        for name in parity.Golden(FOLDER).names("humor_rollouts.npz")
        if name not in named | of_encoder | variances and not name.startswith((*inputs, *stems))
    ]
    assert not left


def test_control_other_weights_are_noticed():
    golden, model = parity.Golden(FOLDER), parity.seeded(alternative=True)
    wrong = [parity.Row(*row) for row in parity._networks(golden, model, "")]
    assert sum(not row.holds for row in wrong) > 0.8 * len(wrong)


def test_control_a_changed_epsilon_is_noticed(monkeypatch):
    monkeypatch.setattr(faithful_rotation, "GUARD", 1e-8)
    rows = [parity.Row(*row) for row in parity._geometry(parity.Golden(FOLDER))]
    assert {row.arrays for row in rows if not row.holds} >= {"w2a_from_root_mat", "canon_w2a_rot"}


def test_difference_is_relative_to_large_arrays_and_absolute_for_small_ones():
    assert parity.difference(torch.tensor([101.0]), torch.tensor([100.0])) == pytest.approx(0.01)
    assert parity.difference(torch.tensor([0.02]), torch.tensor([0.01])) == pytest.approx(0.01)
    assert parity.difference(velocity(torch.zeros(1, 4, 3), 30.0, dim=1), torch.ones(1, 4, 3)) == 1
    assert not parity.Row("a", "lean", float("nan"), 1.0).holds
