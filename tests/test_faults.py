import pytest
import torch

from data_synth import clips, faults
from data_synth.audit import audit


@pytest.fixture(scope="module")
def walk():
    return clips.draw(1, torch.Generator().manual_seed(0), actions=("walk",))[0].motion


def test_the_audit_notices_every_fault_and_nothing_else(walk):
    clean, drift, low, knees = (
        audit(m) for m in (walk, faults.drifting(walk), faults.lowered(walk), faults.knees_reflected(walk))
    )
    assert clean.contact_speed < 1e-4
    assert drift.contact_speed == pytest.approx(0.01 / 30, rel=0.05)
    assert low.penetration == pytest.approx(0.01 + clean.penetration, abs=2e-3)
    assert knees.limit_excess > 20 > clean.limit_excess
    assert low.limit_excess == pytest.approx(clean.limit_excess, abs=1e-3)
