import pytest
import torch

from data_synth import clips


def test_takes_cover_actions_and_people_and_repeat_by_seed():
    draw = lambda seed: clips.draw(6, torch.Generator().manual_seed(seed), actions=("walk", "idle"))  # noqa: E731
    takes, again, other = draw(0), draw(0), draw(1)
    assert len({(t.subject.name, t.labels[len(t.labels) // 2]) for t in takes}) >= 4
    assert all(torch.equal(a.motion.root, b.motion.root) for a, b in zip(takes, again, strict=True))
    assert not all(
        a.motion.root.shape == b.motion.root.shape and torch.equal(a.motion.root, b.motion.root)
        for a, b in zip(takes, other, strict=True)
    )


def test_a_longer_draw_begins_with_the_shorter_one():
    few, many = (clips.draw(n, torch.Generator().manual_seed(3), actions=("idle",)) for n in (1, 2))
    assert torch.equal(few[0].motion.rot, many[0].motion.rot)


def test_unknown_actions_are_named():
    with pytest.raises(KeyError, match="levitate"):
        clips.draw(1, torch.Generator(), actions=("levitate",))
