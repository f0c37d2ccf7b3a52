"""The evaluation in one call: what it says of real, spoilt, copied and trivial motion; dances and their gaps."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion import embedding
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.model import DenoiserRecipe, Trained
from motionlab.diffusion.repair import Way
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD
from studies.nb15_evaluation import copies, measures, trivial
from studies.shared import inbetweening, lafan_benchmark

FRAMES = 12


@pytest.fixture(scope="module")
def library():
    made = [perform_sequence(Corpus(seconds=8.0, seed=3), index).motion for index in (0, 1)]
    return [on_standard(m) for m in made]


@pytest.fixture(scope="module")
def data(library):
    return gather(library, FRAMES)


@pytest.fixture(scope="module")
def features(data):
    recipe = embedding.FeatureRecipe(frames=FRAMES, size=6, width=8, steps=40, batch=8, lr=5e-3)
    return embedding.train_features(data, recipe)[0]


@pytest.fixture(scope="module")
def real(data):
    return measures.grouped(data, 64)


@pytest.fixture(scope="module")
def model(data, real):
    """A denoiser that says nothing, with a real model's numbers."""

    class Silent(torch.nn.Module):
        told = False

        def __init__(self):
            super().__init__()
            self.nothing = torch.nn.Parameter(torch.zeros(()))

        def forward(self, x, stamps, known=None, mask=None):
            return 0 * x if known is None else known

    recipe = DenoiserRecipe(frames=FRAMES, noising=20)
    layout = Layout()
    normaliser = Normaliser.measure(layout.encode(real[0]), layout)
    return Trained(Silent(), recipe.schedule, layout, normaliser, recipe)


# -------------------------------------------------------------------------------------------------------- scores
def test_a_set_against_itself_is_perfect(features, real, generator):
    row = measures.score(real[0], real[0], features, generator)
    assert set(measures.MEASURES) < set(row)
    assert row["frechet"] < 1e-6 and row["precision"] == row["recall"] == row["coverage"] == 1
    assert row["skate ratio"] == row["acceleration ratio"] == 1 and row["n"] == row["m"] == 64
    assert abs(row["diversity ratio"] - 1) < 1e-9


def test_faults_are_seen_and_a_mirror_is_none(features, data, generator):
    one, two = (replace(data.draw(128, generator), skeleton=STANDARD) for _ in range(2))
    judged = measures.judged(two, features)
    plain = measures.score(one, judged, features, generator)
    rows = {name: measures.score(m, judged, features, generator) for name, m in measures.spoilt(one, generator).items()}
    assert rows["mirrored"]["frechet"] < 3 * plain["frechet"]
    for fault in ("slid 20 cm/s", "trembling 2 degrees", "frozen", "legs of another"):
        assert rows[fault]["frechet"] > 1.5 * plain["frechet"], fault
    assert rows["trembling 2 degrees"]["acceleration ratio"] > 3 and rows["frozen"]["acceleration ratio"] == 0
    assert rows["legs of another"]["skate ratio"] > plain["skate ratio"]
    assert rows["frozen"]["recall"] < plain["recall"]


# -------------------------------------------------------------------------------------------------------- copies
def test_copies_are_found_and_brought_back(library, data, generator):
    taken = trivial.copying(data)(6, generator)
    moved = replace(taken, root=taken.root + torch.tensor([2.0, 1.0, 0.0]))
    fresh = measures.spoilt(taken, generator)["legs of another"]
    found = copies.neighbours({"copies": moved, "new": fresh}, library)
    assert found["copies"].distance.max() < 1e-4 < found["new"].distance.min()
    assert copies.memorisation(found["copies"].distance, found["new"].distance).copies == 1
    for at in range(6):
        back = copies.recalled(found["copies"], at, library, FRAMES)
        torch.testing.assert_close(back.rot, taken.rot[at], atol=1e-5, rtol=0)


# ------------------------------------------------------------------------------------------------------- in-betweens
@pytest.fixture(scope="module")
def long(library):
    return replace(gather(library, 24).evenly(60), skeleton=STANDARD)


def test_a_perfect_filling_scores_nothing_and_a_model_never_sees_the_gap(long, model):
    stats = inbetweening.statistics(long)
    truth = inbetweening.canonical(long)
    perfect = {"truth": lambda seen, gap: truth.cut(0, 16)}
    found = inbetweening.judge(long, perfect, 5, stats)["truth"]
    assert found.errors.max() < 1e-5 and found.l2p.max() < 1e-4 and found.npss < 1e-6
    short = long.cut(0, 12)
    fill = inbetweening.by_diffusion(model, torch.Generator().manual_seed(0), Way(put="imputed", steps=4, finish=1))
    filled = fill(lafan_benchmark.hidden(short, 1), 1)
    known = [*range(10), 11]
    torch.testing.assert_close(filled.rot[:, known], short.rot[:, known], atol=1e-4, rtol=0)
    torch.testing.assert_close(filled.root[:, known], short.root[:, known], atol=1e-4, rtol=0)
    other = replace(short, rot=short.rot.clone())
    other.rot[:, 10] = other.rot[:, 0]
    again = inbetweening.by_diffusion(model, torch.Generator().manual_seed(0), Way(put="imputed", steps=4, finish=1))
    torch.testing.assert_close(again(lafan_benchmark.hidden(other, 1), 1).rot, filled.rot)
    with pytest.raises(ShapeError, match="do not fit"):
        fill(lafan_benchmark.hidden(long, 5), 5)
