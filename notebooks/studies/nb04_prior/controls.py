"""Wrong on purpose: variants of the networks and the roll-out that a comparison with the official code must catch."""

import copy
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab.humor import state
from motionlab.humor.priors import Cvae, official_weights
from studies.nb04_prior import parity as golden_parity
from studies.nb04_prior.parity import Golden, Row, difference


def without_repeated_z(model: Cvae) -> Cvae:
    """A copy whose decoder sees z in its first layer only."""
    model = copy.deepcopy(model)
    with torch.no_grad():
        for layer in list(model.decoder.net)[1:]:
            if isinstance(layer, nn.Linear):
                layer.weight[:, layer.in_features - model.latent :] = 0
    return model


def rollout_in_one_frame(model: Cvae, first: Tensor, z: Tensor) -> Tensor:
    """States (B, T, 339) of a roll-out that takes the canonical frame once: first (B, 339) in it, z (B, T, 48)."""
    x, found = first, []
    for now in z.unbind(1):
        x, _ = state.apply(x, model.decode(x, now))
        found.append(x)
    return torch.stack(found, 1)


def errors(golden: Golden, model: Cvae) -> dict[str, float]:
    """Their differences from the golden arrays of the first set of weights, to whom ``model`` belongs."""
    past, z = golden.packed("x_past"), golden["roll_z"]
    broken = without_repeated_z(model).decode(past, golden["z"])[..., state.OFFICIAL_DELTA_ORDER.argsort()]
    return {
        "decoder_raw": difference(broken, golden["decoder_raw"]),
        "roll_*": difference(rollout_in_one_frame(model, past, z), golden.states("roll_")),
    }


def misfits(model: Cvae, golden: Golden) -> list[str]:
    """Names of tensors that a model lacks, adds, or whose sum differs from that of the official tensor."""
    ours, theirs = official_weights(model), golden.weight_sums
    other = [n for n in ours.keys() & theirs.keys() if abs(float(ours[n].sum()) - theirs[n]) > 1e-6]
    return sorted(other) + sorted(ours.keys() ^ theirs.keys())


def parity(folder: Path | str) -> tuple[list[Row], dict[str, tuple[list[float], float]]]:
    """Compares with every golden array; returns the rows, and for each test of H01 its errors and the error of what is
    broken on purpose: half the width, a decoder without its repeated z, one heading for all, the other form."""
    rows, golden, seeded = golden_parity.parity_rows(folder), Golden(folder), golden_parity.seeded()
    wrong = errors(golden, seeded)
    tests = {"tensors": ([float(len(misfits(seeded, golden)))], float(len(misfits(Cvae(512), golden))))}
    for name, form, arrays, broken in golden_parity.TESTS:
        other = wrong[broken] if broken else max(golden_parity.chosen(rows, "lean", arrays))
        tests[name] = golden_parity.chosen(rows, form, arrays), other
    return rows, tests
