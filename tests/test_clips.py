import pytest
import torch

from data_synth import clips


def test_takes_cover_actions_and_people_repeat_by_seed_and_a_longer_draw_begins_with_the_shorter_one():
    draw = lambda count, seed: clips.draw(count, torch.Generator().manual_seed(seed), actions=("walk", "idle"))  # noqa: E731
    takes, again, other = draw(6, 0), draw(3, 0), draw(1, 1)
    assert len({(t.subject.name, t.labels[len(t.labels) // 2]) for t in takes}) >= 4
    assert all(torch.equal(a.motion.root, b.motion.root) for a, b in zip(takes, again, strict=False))
    assert not torch.equal(takes[0].motion.rot[:60], other[0].motion.rot[:60])
    with pytest.raises(KeyError, match="levitate"):
        clips.draw(1, torch.Generator(), actions=("levitate",))
