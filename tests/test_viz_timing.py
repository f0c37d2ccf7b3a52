import torch

from motionlab.scaling import power_law
from motionlab.viz import timing


def test_phases_are_stacked_to_their_sum():
    minutes = {"faithful": {"a": {"body": 1.0, "backward": 2.0}, "b": {"chain": 4.0}}}
    (ax,) = timing.phases(minutes).axes
    assert ax.get_title() == "faithful: 7.0 min"
    widths = {bars.get_label(): [bar.get_width() for bar in bars] for bars in ax.containers}
    assert widths == {"chain": [0.0, 4.0], "body": [1.0, 0.0], "backward": [2.0, 0.0]}
    assert [text.get_text().strip() for text in ax.texts] == ["3.0", "4.0"]
    bottom, top = ax.get_ylim()
    assert bottom > top  # the first phase above


def test_shares_and_claims_stand_where_they_are():
    found = {"faithful": {"x": torch.tensor([60.0, 70.0, 80.0])}}
    (ax,) = timing.shares({"x": 90.0}, found).axes
    lines = [list(map(float, line.get_xdata())) for line in ax.lines]
    assert [90.0, 90.0] in lines and [70.0] in lines


def test_growth_shows_every_point_and_the_exponent():
    x = (15, 30, 60)
    y = torch.tensor([[15.0, 15.3], [30.0, 30.5], [60.0, 61.0]])
    law = power_law(torch.tensor(x).repeat_interleave(2), y.flatten(), draws=320)
    panels = {"frames": {"lean": (x, y, law)}, "clips": {"lean": (x, y, law)}}
    axes = timing.growth(panels, ("ms", "ms")).axes
    assert [ax.get_xlabel() for ax in axes] == ["frames", "clips"]
    dots = [line for line in axes[0].lines if line.get_marker() == "o"]
    assert sum(len(line.get_xdata()) for line in dots) == 6
    assert "1.00" in axes[0].get_legend().get_texts()[0].get_text()


def test_memory_is_carried_to_the_limit():
    gib = timing.GIB
    (ax,) = timing.memory({"faithful": ([1, 2, 4], [gib, 2 * gib, 4 * gib])}, 11.0, claimed=4).axes
    assert "11 clips" in [text.get_text() for text in ax.texts]
    assert "1024 MiB a clip" in ax.get_legend().get_texts()[0].get_text()


def test_ladder_says_both_factors():
    seconds = {"first": torch.tensor([0.4, 0.4]), "second": torch.tensor([0.2, 0.2]), "third": torch.tensor([0.1, 0.1])}
    (ax,) = timing.ladder(seconds).axes
    texts = [text.get_text() for text in ax.texts]
    assert texts[0] == "400 ms" and "x 2.00" in texts[2] and "in all x 4.0" in texts[2]
