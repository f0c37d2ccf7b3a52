"""What notebook 03's tables and figures say, in sentences whose numbers come from the run."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from motionlab import skinning
from motionlab.body import BodyModel
from studies.nb03_skinning.partial_fit import FACE, PartialFit
from studies.nb03_skinning.pruning import at, held
from suite.findings import Finding


def _said(as_expected: object) -> str:
    return "**Reading.** As expected." if as_expected else "**Reading.** Not as expected."


def gradient(rows: Sequence[Mapping[str, float]]) -> str:
    """Reads the table of the first gradient: anny, planted, pruned."""
    none, some, after = (row["share, %"] for row in rows)
    return (
        f"{_said(some > 0 == none == after)} On the planted body {some:.3f} % of the gradient lies on the legs. "
        f"On anny it is {none:g} %, after pruning {after:g} %."
    )


def film(fits: Sequence[PartialFit]) -> str:
    """Reads the film: all weights, pruned."""
    before, after = (float(list(found.legs_mm.values())[-1]) for found in fits)
    return (
        f"{_said(before > 10 > after)} With all weights a leg joint moved by {before:.0f} mm, though nothing that is "
        f"seen depends on it. Pruned, it moved by {after:.0f} mm."
    )


def fall_off(body: BodyModel, distance: Tensor, rate: Tensor, hits: Tensor) -> str:
    """Reads how weights fall off, and what a fixed 15 cm would have cut."""
    small = (body.weights > 0) & (body.weights < skinning.SMALL)
    fixed = small & (distance > 0.15)
    near, few = int((fixed & (distance < 0.35)).sum()), hits.sum() < 0.05 * small.sum()
    return (
        f"{_said(few)} A weight falls to a tenth within {100 * rate.min():.0f} to {100 * rate.max():.0f} cm, by joint. "
        f"A fixed 15 cm would call {int(fixed.sum())} weights of anny long-range. {near} of them lie within 0.35 m and "
        f"fall off as their neighbours do. The measured reach leaves {int(hits.sum())}."
    )


def found(body: BodyModel, mask: Tensor, rows: Sequence[Mapping[str, object]]) -> str:
    """Reads what the audit finds in anny: a mask (V, J) of the first rig, a table row for every rig."""
    holders, names = body.weights.argmax(1), body.skeleton.names
    part = [names[holders[v]].split("_")[-1] + " to " + names[j].split("_")[-1] for v, j in mask.nonzero().tolist()]
    counts = ", ".join(f"{part.count(p)} from {p}" for p in sorted(set(part), key=lambda p: -part.count(p)))
    face = sum(int(mask[body.keypoint_vertices[name]].sum()) for name in FACE)
    out = ", ".join(f"{row['in reaches']:.1f}" for row in rows)
    return (
        f"**Reading.** A handful: {int(mask.sum())} of {int((body.weights > 0).sum())} weights of the rig that we use. "
        f"They go to the other side of the body: {counts}. On the keypoints of the face there are {face}. Rig by rig, "
        f"the farthest lie {out} reaches out. What lies little beyond 1 may still be fall-off. Nothing here says how "
        "these weights came about."
    )


def audit(finding: Finding, scores: Sequence[tuple[float, float]]) -> str:
    """Reads the audit's scores."""
    precision, recall = torch.tensor(scores).mean(0).tolist()
    return (
        f"{_said(finding.value >= 0.95 > finding.baseline_value)} F1 is {finding.value:.3f} over {finding.n} planted "
        f"bodies: precision {precision:.3f}, recall {recall:.3f}. Calling every small weight a fault gives F1 "
        f"{finding.baseline_value:.2f}."
    )


def who(influence: Mapping[str, Tensor], legs: list[int]) -> str:
    """Reads what joints do to the keypoints of the face (K, J), the first of which is the nose."""
    nose = 1000 * influence["planted"][0]
    clean = max(float(influence[name][:, legs].max()) for name in ("anny", "planted, then pruned"))
    left = 1000 * float(influence["planted, then pruned"][:, legs].max())
    pruned = f"Pruned, legs move the face by {left:.1f} mm per radian." if left else "Pruned, the legs move it by 0 mm."
    return (
        f"{_said(nose[legs].max() > clean == 0)} On the planted body a joint of the legs moves the nose by up to "
        f"{nose[legs].max():.1f} mm per radian. The joint that moves it most does so by {nose.max():.0f} mm. {pruned}"
    )


def leak(findings: Mapping[str, Finding]) -> str:
    """Reads the share of the face's gradient that reaches the legs, body by body."""
    clean, planted, *_ = findings.values()
    each = "; ".join(f"{n}: {f.value:.3f} %, pruned {f.baseline_value:g} %" for n, f in findings.items())
    told = _said(planted.low > clean.value == planted.baseline_value == 0)
    return f"{told} {each} (n = {clean.n} poses, one a clip)."


def legs(groups: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> str:
    """Reads how far the legs of several clips went: planted with Adam, with L-BFGS, anny."""
    adam, lbfgs, clean = (sum(before) / len(before) for before, _ in groups.values())
    after = max(max(pair[1]) for pair in groups.values())
    return (
        f"{_said(adam > lbfgs > clean and after < 1)} On average Adam moves the legs by {adam:.0f} mm and L-BFGS by "
        f"{lbfgs:.1f} mm. On anny Adam moves them by {clean:g} mm. After pruning, the farthest is {after:g} mm."
    )


def budget(curves: Mapping[str, Tensor]) -> str:
    """Reads how far the legs went (clips, budgets) by optimiser, Adam's three steps before L-BFGS."""
    *adam, lbfgs = (mm.mean(0).tolist() for mm in curves.values())
    grows = all(some == sorted(some) for some in adam) and adam == sorted(adam, key=lambda some: some[-1])
    first, last = (", ".join(f"{some[at]:.0f}" for some in adam) for at in (0, -1))
    return (
        f"{_said(grows)} At the least budget Adam's three steps give {first} mm on average; at the largest, {last} mm. "
        "So the number depends on the budget, but no step length spares the legs. L-BFGS moves them by "
        f"{max(lbfgs):.1f} mm at most."
    )


def trade(rows: Sequence[Mapping[str, float]]) -> str:
    """Reads what 1e-3 and 1e-2 leave and move."""
    low, high = at(rows, 1e-3), at(rows, 1e-2)
    return (
        f"{_said(low['leakage'] == 0 and low['max_mm'] < high['max_mm'])} 1e-3 ends the leak to the face and moves the "
        f"planted skin by {low['max_mm']:.1f} mm at worst, 1e-2 by {high['max_mm']:.1f} mm. Most of that is repair: "
        f"1e-2 moves anny without faults by {high['clean_max_mm']:.1f} mm at worst. And 1e-3 leaves "
        f"{100 * low['left']:.0f} % of the planted weights. It suffices for the thesis's nose, where three joints "
        "share 0.002, and for no larger weight."
    )


def cost(source: str, finding: Finding, worst_mm: float) -> str:
    """Reads what pruning anny costs on many clips."""
    return (
        f"{_said(finding.high < 2)} {source.capitalize()}, {finding.n} clips: 95 % of the vertices move by less than "
        f"{finding.value:.2f} mm, the worst by {worst_mm:.1f} mm. Below 5e-2, 95 % move by less than "
        f"{finding.baseline_value:.2f} mm."
    )


def smpl(name: str, body: BodyModel, rows: Sequence[Mapping[str, object]]) -> str:
    """Reads the row of an SMPL file, or of its stand-in."""
    row, nose = rows[-1], body.keypoint_vertices["nose"]
    first = "**Reading.**" if name.startswith("your") else _said(2.5 < row["% of all entries"] < 3.5)
    return (
        f"{first} {name}: {row['% of all entries']:.1f} % of all entries are small, {row['% of the non-zero']:.0f} % "
        f"of the non-zero ones. Vertex {nose}: {held(body, nose)}. Pruned below 1e-3, {row['leak, pruned 1e-3']:.2g} % "
        f"of the face's gradient still reaches the legs; below 1e-2, {row['leak, pruned 1e-2']:.2g} %. A stand-in "
        "tests the counting alone. It can neither confirm nor refute the thesis's 3 % of SMPL."
    )
