"""The corpus: what the thesis had, made of synthetic performances with known truth.

21 sequences of 128 seconds, four subjects, 30 frames a second, 45 minutes, in a room of nine by nine metres;
three sequences of the training subjects and one whole subject held out.
Source: thesis section 4.1.2, "Data" (claim D05).
"""

import hashlib
import json
import math
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from tqdm.auto import tqdm

from data_synth import perform
from data_synth.actions import WRITERS, locomotion
from data_synth.perform import Take
from data_synth.score import Score
from data_synth.subjects import SUBJECTS, Subject
from motionlab import checkpoint
from motionlab.files import source_hash
from motionlab.motion import Motion, fix_root_horizontally

#: How often each action is chosen, relative to the others.
MIX = {
    "walk": 5.5, "run": 1.5, "turn": 0.8, "idle": 1.4, "reach": 1.7, "wave": 1.1, "punch": 1.1, "kick": 1.2,
    "sit": 1.0, "crouch": 1.1, "jump": 1.3, "dance": 1.7, "floor": 0.5,
}  # fmt: skip
MANNERS = (None,) * 7 + locomotion.MANNERS
_SOURCES = ("anatomy", "corpus", "curves", "legs", "perform", "score", "subjects")
_ARRAYS = ("root", "rot", "contacts", "phase")  # of a sequence, as it is kept


@dataclass(frozen=True)
class Recipe:
    """What a corpus is made of. version "A": root fixed horizontally, no contacts; "B": free root and contacts.

    sequences: how many; heldout: indices of those kept from training though their subject is not.
    heldout_subject: name of the subject of whom nothing is trained on. room: half its side, metres.
    """

    seed: int = 0
    version: str = "B"
    sequences: int = 21
    seconds: float = 128.0
    fps: float = 30.0
    room: float = 4.5
    heldout: tuple[int, ...] = (4, 9, 14)
    heldout_subject: str = "dee"

    def subject(self, index: int) -> Subject:
        """Who performs a sequence: the held-out subject the last four of 21 (a fifth), the others in turn."""
        others = [s for s in SUBJECTS if s.name != self.heldout_subject]
        last = next(s for s in SUBJECTS if s.name == self.heldout_subject)
        return last if index >= self.sequences - max(1, self.sequences // 5) else others[index % len(others)]


@dataclass(frozen=True, eq=False)
class Sequence:
    """One performance in the corpus, and which part of the split it belongs to."""

    name: str
    take: Take
    split: str

    @property
    def motion(self):
        """The motion of the take."""
        return self.take.motion


class Corpus(NamedTuple):
    """All sequences; what a model may learn from; unseen sequences of known subjects; all of the unknown subject."""

    sequences: tuple[Sequence, ...]
    train: tuple[Sequence, ...]
    heldout_sequences: tuple[Sequence, ...]
    heldout_subject: tuple[Sequence, ...]


def build(version: str = "B", *, recipe: Recipe | None = None, progress: bool = True) -> Corpus:
    """The corpus of a recipe, from the cache if it is there and whole, else made (and cached).

    The cache lies in $MOTIONLAB_CACHE or ~/.cache/motionlab, one file per recipe and state of the code. A
    damaged file is made anew.
    """
    recipe = recipe or Recipe(version=version)
    path = cache_path(recipe)
    takes = _kept(path, recipe)
    if takes is None:
        indices = tqdm(range(recipe.sequences), desc="synthetic corpus", unit="sequence", disable=not progress)
        takes = [perform_sequence(recipe, k) for k in indices]
        _keep(path, takes)
    if recipe.version == "A":
        takes = [replace(take, motion=fix_root_horizontally(take.motion)) for take in takes]
    whole, parts = [], {"train": [], "held-out sequence": [], "held-out subject": []}
    for k, take in enumerate(takes):
        split = "held-out subject" if take.subject.name == recipe.heldout_subject else "train"
        split = "held-out sequence" if split == "train" and k in recipe.heldout else split
        whole.append(Sequence(f"{k:02d}_{take.subject.name}", take, split))
        parts[split].append(whole[-1])
    return Corpus(tuple(whole), *map(tuple, parts.values()))


def perform_sequence(recipe: Recipe, index: int) -> Take:
    """One sequence: actions in random order without a seam, kept inside the room; cut to the asked length."""
    generator = torch.Generator().manual_seed(1_000_003 * recipe.seed + index)
    part = Score(recipe.subject(index), generator)
    names, weights = list(MIX), torch.tensor(list(MIX.values()))
    previous = ""
    while part.now < recipe.seconds + 0.1:
        name = names[int(torch.multinomial(weights, 1, generator=generator))]
        if name == previous and name != "walk":
            continue
        previous = name
        if name in ("walk", "run"):
            _roam(part, recipe.room, name)
        else:
            WRITERS[name](part)
    take = perform.perform(part, recipe.fps)
    frames = round(recipe.seconds * recipe.fps)
    return replace(take, motion=take.motion.cut(0, frames), labels=take.labels[:frames], phase=take.phase[:frames])


def _roam(part: Score, room: float, name: str) -> None:
    """Walk or run along the first arc drawn that stays in the room; if none of many does, turn on the spot first."""
    manner = part.choose(MANNERS) if name == "walk" else None
    if manner in ("backwards", "sideways"):
        if _arc_stays(part, 0.0, 0.0, room - 2.2):
            return WRITERS["walk"](part, seconds=part.uniform(2.5, 3.5), speed=1.2, manner=manner)
        manner = None
    for attempt in range(150):
        name = "walk" if attempt == 100 else name
        if attempt == 50:
            x, y, heading = (part.value[key] for key in ("x", "y", "heading"))
            away = math.atan2(x, -y) + part.uniform(-0.8, 0.8) - heading
            WRITERS["turn"](part, angle=(away + math.pi) % (2 * math.pi) - math.pi)
        speed = part.uniform(2.0, 2.9) if name == "run" else part.uniform(0.9, 1.7)
        seconds = part.uniform(3.8, 7.5) if name == "run" else part.uniform(3.0, 9.0)
        way, tightest = speed * (seconds - 1.1), 1.7 if name == "run" else 1.2
        turn = part.choose((-1, 1)) * way / (tightest * math.exp(part.uniform(0, 1.5)))
        if abs(turn) < 6 and _arc_stays(part, way, turn, 0.85 * room):
            break
    return WRITERS[name](part, seconds=seconds, speed=speed, turn=turn, **({"manner": manner} if manner else {}))


def _arc_stays(part: Score, way: float, turn: float, half: float) -> bool:
    """Whether an arc of ``way`` metres that turns by ``turn`` radians from here stays within half the side."""
    x, y, heading = (part.value[key] for key in ("x", "y", "heading"))
    half = max(half, abs(x) + 0.05, abs(y) + 0.05)
    for k in range(12):
        ahead = heading + turn * (k + 0.5) / 12
        x, y = x - way / 12 * math.sin(ahead), y + way / 12 * math.cos(ahead)
        if max(abs(x), abs(y)) > half:
            return False
    return True


def cache_path(recipe: Recipe) -> Path:
    """Where the sequences of a recipe are cached; both versions share them. Changes with the code that makes them."""
    folder, here = os.environ.get("MOTIONLAB_CACHE") or Path.home() / ".cache" / "motionlab", Path(__file__).parent
    files = [*(here / f"{name}.py" for name in _SOURCES), *sorted((here / "actions").glob("*.py"))]
    code = [source_hash(path.read_text(encoding="utf-8")) for path in files]
    what = asdict(recipe) | {"version": "", "heldout": (), "code": code}
    digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]
    return Path(folder) / f"corpus-{digest}.safetensors"


def _keep(path: Path, takes: list[Take]) -> None:
    tensors = {}
    for k, take in enumerate(takes):
        tensors |= {f"{k}.{name}": getattr(take if name == "phase" else take.motion, name) for name in _ARRAYS}
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.keep(path, tensors, [take.labels for take in takes])


def _kept(path: Path, recipe: Recipe) -> list[Take] | None:
    if (found := checkpoint.kept(path)) is None:
        return None
    takes = []
    for k, labels in enumerate(found[1]):
        who, (root, rot, contacts, phase) = recipe.subject(k), (found[0][f"{k}.{name}"] for name in _ARRAYS)
        motion = Motion(who.skeleton, root, rot, recipe.fps, contacts, f"{k:02d}_{who.name}")
        takes.append(Take(motion, tuple(labels), phase, who))
    return takes
