"""Every golden array of the official code against the value computed here."""

from functools import cache
from pathlib import Path

import pytest

from motionlab.humor.priors import Cvae
from studies.nb04_prior import parity
from studies.official import rotation as official_rotation

FOLDER = Path(__file__).parent / "golden"


@pytest.fixture(scope="module", autouse=True)
def drawn_once():
    """Weights of full size take a second to draw."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parity, "seeded", cache(parity.seeded))
        yield


@pytest.fixture(scope="module")
def rows(drawn_once):
    return parity.parity_rows(FOLDER)


def missed(rows):
    return {row.arrays for row in rows if not row.holds}


def of(rows, form):
    return [row for row in rows if row.form == form]


def test_the_official_form_is_met_to_rounding(rows):
    official = of(rows, "official")
    assert len(official) >= 44 and max(row.error for row in official) < 1e-12
    assert {row.tolerance for row in official} == {parity.EXACT}


def test_the_lean_form_misses_what_is_explained_and_nothing_else(rows):
    lean = of(rows, "lean")
    assert missed(lean) == set(parity.WHY)
    assert all(bool(row.why) != row.holds for row in lean)
    chains = ("roll", "infer_", "grad_", "alt_roll", "alt_infer", "alt_grad")
    assert all(row.tolerance == (parity.YAW if row.arrays.startswith(chains) else parity.EXACT) for row in lean)


def test_control_other_weights_are_noticed():
    golden, model = parity.Golden(FOLDER), parity.seeded(alternative=True)
    wrong = list(parity._networks(golden, model, ""))
    assert sum(not row.holds for row in wrong) > 0.8 * len(wrong)


def test_control_a_changed_epsilon_is_noticed(monkeypatch):
    monkeypatch.setattr(official_rotation, "GUARD", 1e-8)
    golden = parity.Golden(FOLDER)
    rows = of(parity._frames(golden), "official")
    assert missed(rows) >= {"w2a_from_root_mat", "canon_w2a_rot", "canon_local_*"}


def test_control_what_is_wrong_on_purpose_is_noticed():
    golden, model = parity.Golden(FOLDER), parity.seeded()
    assert min(parity.broken(golden, model).values()) > 1e-2
    assert parity.misfits(model, golden) == []
    assert len(parity.misfits(Cvae(512), golden)) == 50
