"""One judge of size, axes and root for every format: what is given is taken, what a file says is believed unless its
figure speaks against it, what it does not say is worked out from the figure; what was not given is said in notes."""

import re
from collections import Counter
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.io.reading import Location
from motionlab.motion import Motion
from motionlab.rigs import ancestors
from motionlab.skeleton import Skeleton

#: Metres per unit of length.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "ft": 0.3048}
_WORDS = {"in": "inch", "inche": "inch", "foot": "ft", "feet": "ft"}
#: Units that are tried for a figure, and its height in metres: a person's, else any figure's, else it is made so tall.
_TRIED, _PERSON, _FIGURE, ASSUMED = ("m", "cm", "mm", "inch", "ft", "dm"), (1.2, 2.2), (0.5, 2.5), 1.70
#: A person's longest chain of bones, foot to hand, over the height: the size of a figure in any pose; and thigh and
#: shin over the height. Where the two sizes differ by more than ``_PROP``, the chain holds more than a body.
CHAIN, _LEG, _PROP = 1.4, 0.47, 0.35
SAY_RATE, _SAY_UP = "say it with fps=, or --fps-in", "say it with up=, or --up"
#: The file's axes that become the world's x, y, z, by the one that points up. Who faces +z in a y-up file faces +y.
AXES = {"y": "-xzy", "z": "xyz", "x": "yzx", "-y": "xz-y", "-z": "x-y-z", "-x": "zy-x"}
#: How the letters of an up axis weigh: head above the feet (the share of frames), the lowest point near zero, what the
#: format or the zero pose says, and that hardly any file is upside down; below a lead of ``_SURE`` it is doubted.
_FLOOR, _RARE, _SURE = 0.5, 0.3, 0.3
_HEAD, _NECK = re.compile(r"head|[lr][fb]hd|頭|^face$"), re.compile(r"neck|nose|c7|clavicle|首")
_FEET = re.compile(r"foot|feet|ankle|toe|heel|足首|[lr](ank|hee)|malleol|calc(?!.*tub)")

#: What callers say: a unit's name or metres; a letter of ``AXES``, or the file axes that become x, y, z; a frame rate.
Unit, Axes, Fps = str | float | None, str | None, float | None
Figure = TypeVar("Figure")  # a Motion, or points.Positions
#: Shares of the longest chain: below SAME a joint sits at its OFFSET, above RIGID its bone changes length.
SAME, RIGID = 0.002, 0.02
_TRUNK = 0.8  # the figure hangs on a joint that so much of all hangs on


def axes_to_matrix(axes: str) -> Tensor:
    """Computes the rotation (3, 3) float64, world from file, from the file axes that become world x, y, z.

    Raises:
        ShapeError: not three different axes, or a left-handed choice, which would mirror the body.
    """
    words = re.fullmatch(r"([+-]?[xyz])([+-]?[xyz])([+-]?[xyz])", axes)
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    for row, word in enumerate(words.groups() if words else ()):
        matrix[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    if not torch.linalg.det(matrix) > 0:
        raise ShapeError(f'axes: expected a right-handed choice such as "xyz" or "x-zy", got {axes!r}')
    return matrix


def metres(unit: str | float) -> float:
    """Returns the metres of one of ``UNITS``, or of a number of metres; ValueError for anything else."""
    length = UNITS.get(unit, unit)
    if not isinstance(length, int | float) or not 0 < length < float("inf"):
        raise ValueError(f"unit: expected metres per unit or one of {', '.join(UNITS)}, got {unit!r}")
    return float(length)


def unit_named(word: object) -> float | None:
    """Returns the metres of a unit as files and people write it ("mm", "Meters", "in"); None for another word."""
    word = str(word).strip().strip(".").lower().removesuffix("s")
    word = re.sub("^([cmd]?)(?:enti|illi|eci)?met(?:er|re)$", r"\1m", word)
    return UNITS.get(_WORDS.get(word, word))


def to_world(
    at: Location, figure: Figure, *, unit: Unit = None, up: Axes = None, axes: Axes = None,
    says_unit: float | None = None, says_up: str | None = None, trust: float = 1.0, table: dict[str, str] = AXES,
) -> Figure:  # fmt: skip
    """Turns a motion or positions of a file's own unit and axes into metres, z up, float32; notes what was guessed.

    Args:
        unit, up, axes: what the caller gives, which is taken as it is: metres per unit, or one of ``UNITS``; the file's
            axis that points up, of ``AXES``; or before it the file's axes that become the world's x, y and z, "x-zy".
        says_unit, says_up: what the file or its format says: metres, and a letter of ``AXES``. Of a motion without,
            the zero pose is asked. trust: how much the letter weighs against a head above the feet in all frames (1).
        table: the axes by the one that points up, as ``AXES``.

    Raises:
        DataError: neither the file nor its figure tells the unit, or what is up; or what is given is none of these.
    """
    skeleton = getattr(figure, "skeleton", None)
    names = [name.lower().rpartition(":")[2] for name in (skeleton or figure).names]
    head, feet = _found(_HEAD, names) or _found(_NECK, names), _found(_FEET, names)
    if skeleton is not None:  # the ankles alone: who has no foot above
        feet = [j for j in feet if skeleton.parents[j] not in feet]
    step, notes = max(figure.frames // 20, 1), [*figure.notes]
    if skeleton is None:  # some 20 frames (S, J, 3), NaN where not measured
        points = torch.where(figure.valid[::step, :, None], figure.positions[::step].double(), torch.nan)
    else:
        points = figure.cut(step=step).to(torch.float64).positions
    if not 5 <= figure.fps <= 1000:
        notes.append(f"{figure.fps:.4g} frames per second is no usual rate: give the right one with fps=, or --fps-in")
    if axes is None and up is None:
        zero = None if says_up else _rest_up(skeleton, head, feet)
        up, said, sure = _up(points, head, feet, says_up or zero, trust, skeleton is None)
        if up is None or (skeleton is None and says_up is None and not sure):
            remedy = f"{_SAY_UP}: one of {', '.join(AXES)}"
            raise at.error("neither the file nor its points say what is up", place="axes", remedy=remedy)
        said = f"the zero pose stands along it, {said}" if zero and up == zero else said
        guessed = skeleton is None and (says_up is None or trust < 1)  # who lies looks like who stands
        doubt = f"; if they do not stand, {_SAY_UP}" if guessed else ""
        doubt = doubt if sure else f", too close to be sure: {_SAY_UP}"
        notes += [f"up axis {up} detected: {said}{doubt}"] if up != says_up or doubt else []
    if unit is None:
        size = _size(points, head, feet, skeleton)
        if skeleton is not None and not size > 0:
            raise at.error("every joint is at one point: there is no figure")
        unit, said = _unit(size, says_unit, skeleton is not None)
        if unit is None:
            remedy = f"say it with unit=, or --unit: one of {', '.join(UNITS)}"
            raise at.error("neither the file nor its points say the unit", remedy=remedy)
        notes += [said] if said else []
    return _turned(replace(figure, notes=tuple(notes)), metres(unit), axes or table.get(up, up))


def _turned(figure: Figure, scale: float, axes: str) -> Figure:
    world = axes_to_matrix(axes)
    if not isinstance(figure, Motion):
        return replace(figure, positions=(scale * figure.positions @ world.T).float())
    skeleton, root, rot = figure.skeleton, figure.root, figure.rot.clone()
    rot[:, 0] = world.to(rot) @ rot[:, 0]
    root = scale * root @ world.to(root).T
    if skeleton.offsets.dtype != torch.float32 or scale != 1:
        skeleton = replace(skeleton, offsets=skeleton.offsets * scale).to(torch.float32)
    return replace(figure, skeleton=skeleton, root=root.float(), rot=rot.float())


def _found(words: re.Pattern, names: list[str]) -> list[int]:
    return [i for i, name in enumerate(names) if words.search(name)]


def _legs(skeleton: Skeleton, feet: list[int]) -> list[list[int]]:
    """From each ankle up to the hip, where a leg of its own ends: thigh, shin and what lies between."""
    above = ancestors(skeleton.parents)
    ways = [[joint, *above[joint][::-1]] for joint in feet]
    shared = set(ways[0]).intersection(*ways[1:]) if len(ways) > 1 else set()
    return [[joint for joint in way if joint not in shared] for way in ways] if shared else []


def _rest_up(skeleton: Skeleton | None, head: list[int], feet: list[int]) -> str | None:
    """What is up in the zero pose, if that is a standing figure: its legs down and its head above them."""
    if skeleton is None or not head or not feet:
        return None
    rest = skeleton.rest_positions().double()
    ways = [rest[head].mean(0) - rest[feet].mean(0)]
    ways += [rest[leg[-1]] - rest[leg[0]] for leg in _legs(skeleton, feet) if len(leg) > 1]
    return next((axis for axis in AXES if all(_along(axis, way) > 0.8 * way.norm() for way in ways)), None)


def _along(axis: str, way: Tensor) -> Tensor:
    return way[..., "xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)


def _up(
    points: Tensor, head: list[int], feet: list[int], says: str | None, trust: float, markers: bool
) -> tuple[str | None, str, bool]:
    """The up axis of points (S, J, 3), on what grounds, and whether that is sure; None where they do not tell."""
    low, high = points.nan_to_num(nan=torch.inf).amin(1), points.nan_to_num(nan=-torch.inf).amax(1)
    seen = (low <= high).all(-1)
    ways = points[:, head].nanmean(1) - points[:, feet].nanmean(1)
    ways = ways[ways.isfinite().all(-1)]
    if not len(ways) or not ways.norm(dim=-1).max() > 0:
        if not seen.any() or says:
            return says, "as files of its kind are", True
        _, y, z = (high - low)[seen].mean(0).tolist()
        far = f"the figure extends {y:.3g} units along y, {z:.3g} along z"
        return ("z" if z > 1.2 * y else "y"), far, max(y, z) > 1.2 * min(y, z)
    length = ways.norm(dim=-1).quantile(0.9)
    shares = {axis: float((_along(axis, ways) > 0.6 * length).double().mean()) for axis in AXES}
    score, floors = {}, set()
    for axis, share in shares.items():
        floor = torch.minimum(_along(axis, low[seen]), _along(axis, high[seen])).quantile(0.1)
        floors |= {axis} if abs(floor) < 0.08 * length else set()
        score[axis] = share + _FLOOR * (axis in floors) - _RARE * (axis not in ("y", "z", says))
        score[axis] += trust * (axis == says)
    first, second = sorted(score, key=lambda axis: (-score[axis], axis != says))[:2]
    sure = score[first] - score[second] > _SURE and shares[first] > 0
    sure &= not markers or first in floors or not floors & {"y", "z"}
    return first, f"the head is above the feet along it in {shares[first]:.0%} of the frames", sure


def _size(points: Tensor, head: list[int], feet: list[int], skeleton: Skeleton | None) -> float:
    """About how tall a figure is, in its unit: by its bones, which no pose changes, or from markers of feet to head."""
    if skeleton is None:
        ways = (points[:, head].nanmean(1) - points[:, feet].nanmean(1)).norm(dim=-1)
        ways = ways[ways.isfinite()]
        return 1.1 * float(ways.quantile(0.9)) if len(ways) else 0.0
    size = longest_chain(skeleton) / CHAIN
    bones = [skeleton.offsets[leg[:-1]].norm(dim=-1) for leg in _legs(skeleton, feet) if len(leg) > 1]
    legs = [float(bone[bone > 0.35 * bone.max()].sum()) / _LEG for bone in bones]
    by_legs = sum(legs) / len(legs) if legs else 0.0
    return by_legs if by_legs > 0 and not 1 - _PROP < size / by_legs < 1 + _PROP else size


def _unit(size: float, says: float | None, is_figure: bool) -> tuple[str | float | None, str]:
    """The unit of a figure so tall, and what is to be said of it; None where it is not known."""

    def fits(tried: tuple[str, ...], heights: tuple[float, float]) -> list[str]:
        return [name for name in tried if heights[0] <= size * UNITS[name] <= heights[1]]

    found = fits(_TRIED[: 6 if is_figure else 4], _PERSON) or fits(_TRIED[:3], _FIGURE)
    if says is not None and (not found or _FIGURE[0] / 2 < size * says < 2 * _FIGURE[1]):
        return says, ""
    tall = f"the figure is about {size:.3g} units tall"
    if found:
        wrong = "" if says is None else f", not {says:g} m as the file says; say it with unit=, or --unit"
        return found[0], f"unit {found[0]} detected{wrong}: {tall}"
    made = f"no unit fits, so it is made {ASSUMED:.2f} m tall: {tall}; give it with unit=, or --unit"
    return (ASSUMED / size, made) if is_figure else (None, "")


def longest_chain(skeleton: Skeleton) -> float:
    """Computes the length of the longest chain of bones between any two joints."""
    down, longest = [0.0] * len(skeleton), 0.0
    for j in range(len(skeleton) - 1, 0, -1):
        parent, reach = skeleton.parents[j], down[j] + float(skeleton.offsets[j].norm())
        longest = max(longest, down[parent] + reach)
        down[parent] = max(down[parent], reach)
    return longest


def rerooted(
    at: Location, skeleton: Skeleton, place: np.ndarray, rot: Tensor, translations: str, lines: list[str]
) -> tuple[list[int], Skeleton, Tensor, Tensor]:
    """Computes which joints are kept, their skeleton, root positions (T, 3) and rotations (T, K, 3, 3) of a tree that
    stands at ``place`` (T, J, 3) and is turned by ``rot`` (T, J, 3, 3), each joint against its parent; float64.

    The root is the deepest joint of the trunk at the top that moves; the joints above it are composed into it, and what
    else hangs on them (handles of inverse kinematics) is left out. Both are noted.

    translations: a joint below that moves is kept at its mean place and noted; "strict" refuses if it moves more than
    ``RIGID``, "mean" never. lines: where each joint stands in the file, for messages.
    """
    names, parents, offset = skeleton.names, skeleton.parents, skeleton.offsets.double().numpy()
    reach = longest_chain(skeleton) or 1e-12
    strays = np.abs(place - offset).max((0, 2)) > SAME * reach
    paths = ancestors(parents)
    size = Counter(joint for path in paths for joint in path)
    share = [(size[j] + 1) / (size[0] + 1 - len(paths[j])) for j in range(1, len(parents))]  # of all not above a joint
    top = [0, *(j for j, much in enumerate(share, start=1) if strays[j] and much >= _TRUNK)][-1]
    above = paths[top]
    root, first = torch.from_numpy(place[:, top]), rot[:, top]
    for joint in reversed(above):
        root = torch.from_numpy(place[:, joint]) + (rot[:, joint] @ root[..., None])[..., 0]
        first = rot[:, joint] @ first
    if above:
        said = ", ".join(names[j] for j in above)
        at.notes.append(f"root is {names[top]}, whose position changes; it takes on the motion of {said} above")
    kept = [j for j, path in enumerate(paths) if top in (j, *path)]
    if beside := [name for j, name in enumerate(names) if j not in (*kept, *above)]:
        at.notes.append(f"joints beside the root are left out: {', '.join(beside)}")
    mean = place.mean(0)
    for j in kept[1:]:
        moves = np.abs(place[:, j] - mean[j]).max()
        if moves > SAME * reach:
            what = f"{names[j]} moves {moves / reach:.1%} of the figure against its parent"
            if translations != "mean" and moves > RIGID * reach:
                remedy = 'translations="mean", or --translations mean, keeps its mean place'
                raise at.error(f"{what}: bones of changing length", place=lines[j], remedy=remedy)
            at.notes.append(f"{what}: its mean place is kept")
        elif strays[j]:
            off = np.abs(mean[j] - offset[j]).max() / reach
            at.notes.append(f"{names[j]} is always {off:.1%} of the figure off its OFFSET: believed as it moves")
    rot = rot[:, kept].clone()
    rot[:, 0] = first
    offsets = torch.from_numpy(np.where(strays[:, None], mean, offset)[kept])
    offsets[0] = 0
    tree = (-1, *(kept.index(parents[j]) for j in kept[1:]))
    return kept, Skeleton(tuple(names[j] for j in kept), tree, offsets), root, rot
