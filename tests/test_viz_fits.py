"""The figures of notebook 05 draw what they are given."""

from dataclasses import replace

import numpy as np
import torch

from data_synth import scenes
from motionlab.viz import fits

ROLES = {"truth": "truth", "stage 2": "stage2", "stage 3": "stage3"}


def noise(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)))


def test_pairs_draws_a_line_per_clip_and_a_mean_per_stage():
    ax, empty = fits.pairs({"a": (noise(5), noise(5)), "b": (noise(3), noise(3))}, ylabel="x").axes[:2]
    assert len(ax.get_lines()) == 5 + 2 and len(empty.get_lines()) == 3 + 2
    bars = [line for line in ax.get_lines() if line.get_linewidth() == 3]
    assert np.isclose(bars[0].get_ydata()[0], noise(5).mean())


def test_over_time_shades_what_is_hidden():
    hidden = torch.arange(60) > 20
    series = {"truth": noise(60), "stage 2": noise(4, 60)}
    fig = fits.over_time({"a": series}, ylabel="x", fps=30.0, roles=ROLES, hidden={"a": hidden})
    assert len(fig.axes[0].get_lines()) == 2 and len(fig.axes[0].collections) == 2
    assert len(fits.over_time({"a": series}, ylabel="x", fps=30.0, roles=ROLES).axes[0].collections) == 1


def test_gaps_and_spectra():
    found = {("lean", "middle"): {1: noise(3), 10: noise(3)}, ("faithful", "middle"): {1: noise(3)}}
    roles = {"lean": "ours", "faithful": "baseline"}
    fig = fits.gaps(found, modes=("lean", "faithful"), places=("middle",), roles=roles)
    assert len(fig.axes[0].collections) == 3
    fig = fits.spectra({"dance": {"stage 2": noise(4, 3) + 0.1}}, (0, 2, 5, 15), roles=ROLES)
    assert [tick.get_text() for tick in fig.axes[0].get_xticklabels()] == ["0-2", "2-5", "5-15"]


def test_grid_lays_pictures_row_by_row():
    tiles = [np.full((2, 3, 3), k, np.uint8) for k in range(4)]
    assert fits.grid(tiles, 2)[:, :, 0].tolist()[2][0] == 2 and fits.grid(tiles, 2).shape == (4, 6, 3)


def test_on_paper_draws_every_layer_in_a_panel_of_its_own():
    pixels, sure = 200 * noise(2, 25, 2), torch.ones(2, 25)
    layers = {"a": ("observation", pixels, sure), "b": ("stage3", pixels, 0 * sure)}
    drawn = fits.on_paper(layers, 1, height=300)
    half = drawn.shape[1] // 2
    assert drawn.shape[0] == 300 and half >= 200
    marked = (drawn[40:] != 246).any(-1)
    assert marked[:, :half].sum() > 500 and not marked[:, half:].any()


def test_film_and_camera_picture(tmp_path):
    scene = scenes.film("sitting, legs hidden", 1, frames=12)
    truth, things = scene.truth.clip(0), fits.meshes(scene.occluders[0])
    lifted = replace(truth, root=truth.root + torch.tensor([0.4, 0.0, 0.1]))
    motions = {"truth": truth, "stage 2": fits.placed(lifted, truth)}
    assert torch.allclose(motions["stage 2"].root[0, :2], truth.root[0, :2])
    assert torch.allclose(motions["stage 2"].root[:, 2], lifted.root[:, 2])
    film = fits.side_by_side(motions, tmp_path / "a.gif", roles=ROLES, things=things, fps=6.0, speed=0.5)
    assert film.frames >= 3 and film.path.stat().st_size > 1000
    seen, camera = scene.clip(0), scene.cameras[0]
    layers = {"detected": ("observation", seen.keypoints, seen.confidence)}
    bare = {"detected": ("observation", seen.keypoints, torch.zeros_like(seen.confidence))}
    drawn = fits.through_the_camera(truth, camera, layers, 5, things=things, width=240)
    empty = fits.through_the_camera(truth, camera, bare, 5, things=things, width=240)
    assert drawn.shape == empty.shape and (drawn != empty).any(-1).sum() > 100
    desk = fits.through_the_camera(truth, camera, bare, 5, width=240)
    assert (desk != empty).any(-1).mean() > 0.02  # the desk is in the picture
