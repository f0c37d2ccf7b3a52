"""The corpus of real motion: what is in it, and of which kind its motion is."""

import re
from collections.abc import Sequence
from pathlib import Path

from motionlab import corpus
from motionlab.corpus import Corpus, Take
from motionlab.motion import Motion, velocity

#: Sources of a corpus that may be trained on.
SOURCES = ("cmu_library", "cmu_native", "cmu_amc", "deepmimic", "isaacgym_amp_cmu")
#: Words of a description or a file's name -> kind of motion; the first that fits.
KINDS = {
    "floor": r"roll|crawl|get(ting)? ?up|lay|lie|lying|fall|floor|yoga|push.?up|sit.?up|swim|stroke",
    "dance": r"danc|salsa|lindy|charleston|waltz|arabesque|pirouette|glissade|ballet|jete|plie",
    "acrobatics": r"flip|cartwheel|hand ?stand|somersault|back ?hand|tumbl",
    "fight": r"punch|box|kick|karate|bassai|empi|heian|gedan|attack|defen|sword|martial|fight|block|strike|shuto",
    "sit": r"\bsit|chair|stool|sofa|motorcycle",
    "climb": r"climb|stair|ladder|playground|steps?\b.*up|uneven|slope",
    "jump": r"jump|hop|leap|skip",
    "run": r"\brun|jog|sprint|dash",
    "sport": r"soccer|golf|putt|swing|tee\b|ball|frisbee|pitch|bunt|dribble|shot|turn cleaned|tight",
    "animal": r"human subject|monkey|chicken|bear|cat |dinosaur|mummy|gorilla|penguin|mickey",
    "walk": r"walk|stride|step|march|navigate|path|limp|creep|pace|stroll|hobble",
    "everyday": r"wash|drink|eat|reach|pick|lift|carry|wave|clean|hammer|saw|screw|story|rhyme|signal|vacation|laugh|"
    r"talk|point|direct|look|open|write|chop|fish|conversation|stretch|bow|idle|wait|vignettes|broom|drop",
}


def load(folder: Path | None, every: int = 1) -> Corpus | None:
    """Assembles the clean recordings of people in a folder, each ``every``-th; None where there is nothing."""
    sources = [source for source in SOURCES if folder and (folder / source).is_dir()]
    return corpus.assemble(folder, sources, every=every, progress=False) if sources else None


def size(found: Corpus | None) -> str:
    """Returns how much there is, in words."""
    if found is None:
        return "nothing, since MOTIONLAB_DATA is not set"
    return f"{_minutes(found.takes):.0f} minutes of {len({take.person for take in found.takes})} people"


def kind_of(take: Take) -> str:
    """Returns the kind of motion that a take's description speaks of: one of ``KINDS``, or "other"."""
    said = take.said.lower().replace("_", " ")
    return next((kind for kind, words in KINDS.items() if re.search(words, said)), "other")


def takes_by_kind(found: Corpus) -> dict[str, list[Take]]:
    """Returns the takes of each kind of motion, the kind with most minutes first."""
    by_kind: dict[str, list[Take]] = {}
    for take in found.takes:
        by_kind.setdefault(kind_of(take), []).append(take)
    return dict(sorted(by_kind.items(), key=lambda pair: -_minutes(pair[1])))


def busiest(motion: Motion) -> Motion:
    """Cuts out the three seconds in which the joints move most; a shorter motion stays whole."""
    length = round(3.0 * motion.fps)
    if motion.frames <= length:
        return motion
    moves = velocity(motion.positions, motion.fps, dim=0).norm(dim=-1).mean(-1)
    start = int(moves.unfold(0, length, 1).mean(-1).argmax())
    return motion.cut(start, start + length)


def _minutes(takes: Sequence[Take]) -> float:
    return sum(t.motion.seconds for t in takes) / 60
