"""Which joint of a skeleton is which of the standard 22: by what its name says, and by where it hangs.

Names differ in spelling (``mixamorig:LeftUpLeg``, ``thigh_l``, ``Bip01 L Thigh``, ``lThigh``) and in what they mean: a
``LeftLeg`` is a shin below a ``LeftUpLeg`` and a thigh above a ``LeftShin``. So every word may stand for several joints
of a limb, and of all ways to read a limb from the trunk outwards that which explains most of it is taken.
"""

import json
import re
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise, product

from motionlab.errors import DataError
from motionlab.skeleton import STANDARD, Skeleton

#: What the joints of each limb are called, from the trunk outwards; behind a bar, what is also said of a neighbour.
#: Lower case, without side, number, prefix, suffix and separators. Pelvis and spine need none: limbs hang on them.
WORDS: dict[str, dict[str, str]] = {
    "leg": {
        "hip": "thigh upleg upperleg legupper femur upperthigh thighbend 足 | hip leg",
        "knee": "knee shin calf lowleg lowerleg leglower tibia shank ひざ | leg",
        "ankle": "ankle footankle foot talus 足首",
        "foot": "ball football toebase toe toes bigtoe forefoot footindex foot つま先",
    },
    "arm": {
        "collar": "clavicle collar scapula 肩 | shoulder",
        "shoulder": "upperarm armupper uparm uarm humerus arm shldr shldrbend 腕 | shoulder",
        "elbow": "elbow forearm lowerarm armlower lowarm farm ulna radius forearmbend ひじ",
        "wrist": "wrist handwrist 手首 | hand",
    },
    "head": {"neck": "neck lowerneck necklower necktwist 首", "head": "head skull 頭 | face"},
}
_BOTH = ("left", "right")
#: What a skeleton has to have, or nobody can say how it stands.
NEEDED = ("pelvis", *(f"{side}_{part}" for side in _BOTH for part in ("hip", "knee", "ankle")))
#: Limb, and its standard joints from the trunk outwards.
_LIMBS = [(limb, [f"{side}{part}" for part in WORDS[limb]])
          for side, limb in (*product(("left_", "right_"), ("leg", "arm")), ("", "head"))]  # fmt: skip
_SIDES = {
    **dict.fromkeys("l lf lft left 左".split(), "left"), **dict.fromkeys("r rt rgt right 右".split(), "right"),
    **dict.fromkeys("c m x center centre".split(), ""),
}  # fmt: skip
_RANKS = {
    part: {word: rank for rank, group in enumerate(words.split("|")) for word in group.split()}
    for limb in WORDS.values() for part, words in limb.items()
}  # fmt: skip
_PARTS = {word: part for part, ranks in _RANKS.items() for word in ranks}
_ALIKE = {"leg": ("thigh", "shin", "ankle"), "arm": ("upperarm", "forearm", "wrist")}
_PART = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|[ぁ-ヶ一-龠ー]+")
_COUNTS = {"collar": 0.9, "foot": 0.9}  # a lone shoulder is a shoulder, a lone foot an ankle
_LISTED = 40  # names that are told of a file
_MOST = 8  # joints of one part to choose among, and words of a name to read: more are a jest


def find_joints(skeleton: Skeleton, path: object = None) -> dict[str, int]:
    """Finds which joint of a skeleton is which standard joint: standard name -> index.

    What ``skeleton.roles`` says holds; the rest is found.

    Args:
        path: the file, for what is said of it.

    Raises:
        DataError: no pelvis, hips, knees and ankles, or the roles name what is not there; says what was found, what
            is missing, and gives a map to fill in.
    """
    given = skeleton.roles
    strange = [n for n in given if n not in STANDARD.names] + [n for n in given.values() if n not in skeleton.names]
    if strange:
        remedy = f"map names out of {', '.join(STANDARD.names)} to joints of the file: {', '.join(skeleton.names)}"
        raise DataError(f"no joint {', '.join(map(repr, strange))}", path=path, place="names", remedy=remedy)
    fixed = {standard: skeleton.index(own) for standard, own in given.items()}
    found = dict(_found(skeleton.names, skeleton.parents, tuple(fixed.items())))
    if "neck" not in found and "head" not in fixed and _turns_at_the_neck(skeleton, found):
        found = {"neck" if name == "head" else name: j for name, j in found.items()}
    if missing := [name for name in NEEDED if name not in found]:
        told = ", ".join(f"{name} = {skeleton.names[j]}" for name, j in found.items()) or "nothing"
        called, more = ", ".join(skeleton.names[:_LISTED]), len(skeleton) - _LISTED
        called += f" and {more} more" if more > 0 else ""
        blank = json.dumps({name: skeleton.names[found[name]] if name in found else "" for name in STANDARD.names})
        remedy = "say what is what by names=, on the command line --names FILE.json, and leave out what the file lacks"
        message = f"its joints are called {called}: found {told}; missing {', '.join(missing)}"
        raise DataError(message, path=path, place="joint names", remedy=f"{remedy}: {blank}")
    return found


def dropped_joints(skeleton: Skeleton, joints: dict[str, int]) -> list[int]:
    """Finds joints with others below them that stand where a standard joint is missing: what they do is lost."""
    above, lost, found = ancestors(skeleton.parents), set(), {*joints.values()}
    for limb, chain in _LIMBS:
        known = [(place, joints[name]) for place, name in enumerate(chain) if name in joints]
        known = [(-1, joints["pelvis"] if limb == "leg" else joints.get("spine3", joints["pelvis"])), *known]
        for (i, a), (k, b) in pairwise(known):
            lost |= {j for j in above[b] if a in above[j] and k > i + 1}
        end, last = known[-1]
        lost |= {j for j, path in enumerate(above) if -1 < end < len(chain) - 1 and last in path}
        if end < 0 and limb != "leg":  # no arm or head has a name: what the trunk carries may be it
            trunk = {joints["pelvis"], *(joints[name] for name in joints if name.startswith("spine"))}
            lost |= {j for j, path in enumerate(above) if next((k for k in path[::-1] if k in found), -1) in trunk}
    return sorted(lost & set(skeleton.parents) - found)


def guessed_joints(skeleton: Skeleton, joints: dict[str, int]) -> dict[str, int]:
    """Returns those of the joints found that no name and no user calls so: their place says it."""
    words = [word for _, word in _read(skeleton.names)]
    parts = {name: _RANKS.get(name.rpartition("_")[2], dict.fromkeys(words)) for name in joints}
    return {n: j for n, j in joints.items() if n not in skeleton.roles and words[j] not in parts[n]}


def _turns_at_the_neck(skeleton: Skeleton, found: dict[str, int]) -> bool:
    """Whether a head without a neck hangs where the arms do, at their height: its joint is the neck's."""
    joints = [found[name] for name in ("head", "left_shoulder", "right_shoulder") if name in found]
    if len(joints) < 3 or len({skeleton.parents[j] for j in joints}) > 1:
        return False
    head, left, right = skeleton.offsets[joints].double()
    return bool((head - (left + right) / 2).norm() < 0.3 * (left - right).norm())


@lru_cache(maxsize=64)
def _found(names: tuple[str, ...], parents: tuple[int, ...], fixed: tuple[tuple[str, int], ...]) -> dict[str, int]:
    above = ancestors(parents)
    said = _told_apart(_read(names), above)
    found = dict(fixed)
    below = Counter(j for path in above for j in path)
    rank = {j: k for k, j in enumerate(sorted(range(len(names)), key=lambda j: (-below[j], names[j])))}
    for _, chain in _LIMBS:
        words = [word if own == chain[0].rpartition("_")[0] else "" for own, word in said]
        found |= _limb(chain, words, above, found, rank)
    found = _trunk(above, found) | found
    top = found.get("spine3", found.get("pelvis"))
    if "neck" not in found and "spine3" in found:  # a spine that goes on above the arms
        column = [j for j, (_, word) in enumerate(said) if word == said[top][1] and top in above[j]]
        if all(a in above[b] for a, b in pairwise(column)):
            found |= dict(zip(("neck", "head"), column[:1] + column[1:][-1:], strict=False))
    for limb, chain in _LIMBS:
        found |= _between(chain, None if limb == "leg" else top, parents, above, found)
    return {name: found[name] for name in STANDARD.names if name in found}


def _read(names: Sequence[str]) -> list[tuple[str, str]]:
    """Side and word of every name, less the prefix and suffix with which most names make sense; of a name that says its
    limb first (arm_L0_hand) the joint."""
    tokens, sides = [], []
    for name in names:
        own = re.split(r"[:|/](?=.*[A-Za-z])", name)[-1]
        words = [part.lower() for part in _PART.findall(own)[-2 * _MOST :]]
        sides.append(max((_SIDES[word] for word in words if word in _SIDES), key=len, default=None))
        tokens.append(tuple(word for word in words if word not in _SIDES))

    def words_with(prefix: tuple[str, ...], suffix: tuple[str, ...]) -> list[tuple[str, str]]:
        found = []
        for side, own in zip(sides, tokens, strict=True):
            own = own[len(prefix) :] if prefix and own[: len(prefix)] == prefix else own
            own = own[: -len(suffix)] if suffix and own[-len(suffix) :] == suffix else own
            told = own[-1:] if own and {own[0], own[-1]} <= _PARTS.keys() and "".join(own) not in _PARTS else own
            found.append(_sided(side, "".join(told)))
        return found

    prefixes = Counter(own[:k] for own in tokens for k in range(1, len(own)))
    suffixes = Counter(own[-k:] for own in tokens for k in range(1, len(own)))
    shared = ([words for words, names in counted.items() if names >= 6] for counted in (prefixes, suffixes))
    ways = product(*([(), *sorted(words, key=lambda w: (len(w), w))] for words in shared))

    def sense(said: list[tuple[str, str]]) -> int:
        return len({(side, _PARTS[word]) for side, word in said if word in _PARTS})

    return max((words_with(*way) for way in ways), key=sense)


def _told_apart(said: list[tuple[str, str]], above: list[tuple[int, ...]]) -> list[tuple[str, str]]:
    """The same, but of limbs whose joints all have its name (leg_0, leg_1, ..., leg_end; or leg, leg.001, foot): there
    the first, the one in the middle and the tip are ``_ALIKE``, and those between are nothing."""
    for side, (limb, words) in product(_BOTH, _ALIKE.items()):
        upper, lower, tip = (_RANKS[_PARTS[word]].keys() for word in words)
        mine = {j: word for j, (own, word) in enumerate(said) if own == side}
        chain = sorted((j for j, word in mine.items() if word in (limb, f"{limb}end")), key=lambda j: len(above[j]))
        if chain and mine[chain[-1]] == limb:
            chain += [j for j, word in mine.items() if word in tip and chain[-1] in above[j]][:1]
        known = (upper | lower) & {*mine.values()} - {limb, "shoulder"}
        if len(chain) > 2 and not known and all(a in above[b] for a, b in pairwise(chain)):
            places = dict(zip((chain[0], chain[(len(chain) - 1) // 2], chain[-1]), words, strict=True))
            said = [(own, places.get(j, "" if j in chain else word)) for j, (own, word) in enumerate(said)]
    return said


def _sided(side: str | None, word: str) -> tuple[str, str]:
    """Splits a side off a word that is written in one, as lfemur, leftupleg, UPPERARML."""
    if side or word in _PARTS:
        return side or "", word
    ways = ((_SIDES[mark], rest) for mark in _SIDES for rest in (word.removeprefix(mark), word.removesuffix(mark)))
    return next(((side, rest) for side, rest in ways if rest in _PARTS), ("", word))  # the word itself is no part


def ancestors(parents: Sequence[int]) -> list[tuple[int, ...]]:
    """Returns the joints above every joint, the root first."""
    above: list[tuple[int, ...]] = []
    for parent in parents:
        above.append((*above[parent], parent) if parent >= 0 else ())
    return above


def _limb(
    chain: list[str], said: list[str], above: list[tuple[int, ...]], fixed: dict[str, int], rank: dict[int, int]
) -> dict[str, int]:
    """The reading of a limb that names most of its joints, each below the one above; of equals the first by rank."""
    choices = []
    for name in chain:
        ranks = _RANKS[name.rpartition("_")[2]]
        own = [(ranks[word], len(above[j]), rank[j], j) for j, word in enumerate(said) if word in ranks]
        # of joints with one name below each other (upperarm01, upperarm02) the upper is the joint
        own = [c for c in own if not any(said[c[-1]] == said[j] and j in above[c[-1]] for *_, j in own)]
        own = sorted(own)[:_MOST]
        choices.append([(0, 0, 0, fixed[name])] if name in fixed else [None, *own])
    best: tuple = ((0.0, 0, 0, 0), {})
    for way in product(*choices):
        taken = [(name, choice) for name, choice in zip(chain, way, strict=True) if choice]
        joints = [choice[-1] for _, choice in taken]
        if all(a in above[b] for a, b in pairwise(joints)):
            count = sum(_COUNTS.get(name.rpartition("_")[2], 1.0) for name, _ in taken)
            score = (count, *(-sum(choice[i] for _, choice in taken) for i in range(3)))
            best = max(best, (score, {name: choice[-1] for name, choice in taken}), key=lambda x: x[0])
    return best[1]


def _trunk(above: list[tuple[int, ...]], found: dict[str, int]) -> dict[str, int]:
    """The pelvis, where legs and trunk meet, and the spine from there to what carries neck and shoulders."""
    tips = ("neck", "head", *(f"{side}_{part}" for side in ("left", "right") for part in ("collar", "shoulder")))
    paths = [above[found[tip]] for tip in tips if tip in found]
    legs = [above[found[name]] for name in ("left_hip", "right_hip") if name in found]
    meeting = [j for j in legs[0] if all(j in path for path in legs)] if len(legs) == 2 else []
    meeting = [j for j in meeting if all(j in path for path in paths)] or meeting
    pelvis = found.get("pelvis", meeting[-1] if meeting else None)
    if pelvis is None:
        return {}
    shared = [j for j in min(paths, key=len, default=()) if pelvis in above[j] and all(j in path for path in paths)]
    middle = {"spine2": shared[len(shared) // 2]} if len(shared) > 2 else {}
    ends = {"spine1": shared[0]} if len(shared) > 1 else {}
    return {"pelvis": pelvis} | ({**ends, **middle, "spine3": shared[-1]} if shared else {})


def _between(
    chain: list[str], start: int | None, parents: Sequence[int], above: list[tuple[int, ...]], found: dict[str, int]
) -> dict[str, int]:
    """What no name says but the place does: as many joints as are missing between two that are known, or, at the
    end of a limb, an only child below an only child."""
    more: dict[str, int] = {}
    known = [(-1, start)] if start is not None else []
    known += [(place, found[name]) for place, name in enumerate(chain) if name in found]
    for (i, a), (k, b) in pairwise(known):
        way = above[b][above[b].index(a) + 1 :] if a in above[b] else ()
        more |= dict(zip(chain[i + 1 : k], way, strict=True)) if len(way) == k - i - 1 else {}
    end, last = known[-1] if known else (-1, -1)
    for name in chain[end + 1 :] if end >= 0 else []:
        children = [j for j, parent in enumerate(parents) if parent == last]
        if len(children) != 1:
            break
        more[name] = last = children[0]
    return more
