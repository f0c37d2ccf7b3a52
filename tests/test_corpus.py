"""The corpus: split, versions, room, determinism, and a cache that notices damage."""

from unittest.mock import Mock

import pytest
import torch

from data_synth import corpus
from data_synth.audit import audit
from data_synth.corpus import Recipe, build

SMALL = Recipe(sequences=5, seconds=15.0, heldout=(3,))


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MOTIONLAB_CACHE", str(tmp_path))


def small(**changes):
    return build(recipe=Recipe(**{**vars(SMALL), **changes}), progress=False)


def test_split_leaks_nothing():
    whole = small()
    parts = [whole.train, whole.heldout_sequences, whole.heldout_subject]
    assert sum(map(len, parts)) == len(whole.sequences) == 5 and all(parts)
    trained = {s.take.subject.name for s in whole.train}
    assert not trained & {s.take.subject.name for s in whole.heldout_subject}
    assert {s.take.subject.name for s in whole.heldout_sequences} <= trained
    for a in whole.train:
        for b in (*whole.heldout_sequences, *whole.heldout_subject):
            assert not torch.allclose(a.motion.rot, b.motion.rot, atol=1e-2)


def test_sequences_are_ground_truth():
    for sequence in small(seed=2).sequences:
        found = audit(sequence.motion)
        assert sequence.motion.frames == 450 and sequence.motion.root.dtype == torch.float32
        assert len(sequence.take.labels) == 450 and sequence.take.phase.shape == (450,)
        assert found.contact_speed < 1e-3 and found.contact_height < 1e-3 and found.penetration < 1e-3
        assert found.limit_excess == 0, found.at
        assert float(sequence.motion.root[:, :2].abs().max()) < SMALL.room


def test_version_a_is_b_without_travel():
    a, b = small(version="A"), small(version="B")
    for one, two in zip(a.sequences, b.sequences, strict=True):
        assert one.motion.contacts is None and two.motion.contacts is not None
        assert torch.equal(one.motion.rot, two.motion.rot)
        assert torch.equal(one.motion.root[:, 2], two.motion.root[:, 2])
        assert (one.motion.root[:, :2] == 0).all() and two.motion.root[:, :2].std(0).min() > 0


def test_seed_decides_and_the_cache_is_exact(monkeypatch):
    fresh = small()
    other = small(seed=1)
    assert not torch.equal(fresh.sequences[0].motion.rot, other.sequences[0].motion.rot)

    with monkeypatch.context() as patch:
        patch.setattr(corpus.perform, "perform", Mock(side_effect=RuntimeError("made anew")))
        again = small()
        with pytest.raises(RuntimeError, match="made anew"):
            small(seed=99)
    for one, two in zip(fresh.sequences, again.sequences, strict=True):
        assert torch.equal(one.motion.rot, two.motion.rot) and one.take.labels == two.take.labels
        torch.testing.assert_close(one.take.phase, two.take.phase, rtol=0, atol=0)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "garbage"])
def test_a_damaged_cache_is_made_anew(damage):
    fresh = small()
    path = corpus.cache_path(SMALL)
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[len(data) // 2] ^= 0xFF
    path.write_bytes({"truncated": data[: len(data) // 2], "flipped": data, "garbage": b"no tensors"}[damage])
    again = small()
    assert torch.equal(fresh.sequences[-1].motion.rot, again.sequences[-1].motion.rot)
