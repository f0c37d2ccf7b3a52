"""What is said of a fitted clip: lines for a terminal, and one page of HTML that needs no network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab.humor import body_shape
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.humor.evidence import FEET_SEEN, feet_seen
from motionlab.humor.start import above_floor
from motionlab.humor.testops import MISFIT_WIDTH, SURPRISED
from motionlab.metrics import pose
from motionlab.observation import BODY_25
from motionlab.scene_fit import SceneFit
from motionlab.skeleton import FEET
from motionlab.viz.palette import ROLE

#: The colours of the people, in the film and here, one after the other.
PEOPLE = ("ours", "baseline", "6d", "axis-angle", "quaternion", "synthetic", "stage2", "stage3")
_LISTED = 40  # people in the table of who was seen
_STYLE = """
body { font: 15px/1.5 sans-serif; color: #30343b; background: #f6f7f9; max-width: 62rem; margin: 2rem auto;
  padding: 0 1rem; overflow-wrap: anywhere }
h1 { font-size: 1.6rem }
table { border-collapse: collapse; margin: .6rem 0; display: block; overflow-x: auto }
td, th { padding: .15rem .7rem; border-bottom: 1px solid #c3c9d3; text-align: left; overflow-wrap: normal }
td:last-child { overflow-wrap: anywhere }
td.n { text-align: right; font-variant-numeric: tabular-nums }
video, svg { max-width: 100%; height: auto; background: #fff }
.doubt { color: #d55e00; font-weight: bold }
"""
_WIDE, _HIGH = 860, 190

Record = Mapping[str, object]


def person_row(k: int, each: int, fitted: SceneFit, away: Tensor, weight: Tensor) -> dict[str, object]:
    """Returns the record's row of the k-th fitted person, whose id is ``each``.

    away, weight: (T, 25), as ``fit.pixel_distances`` gives them.
    """
    motion, shown, seen = fitted.motions[k], fitted.shown[k], weight > 0
    rms, surprise = float(away[seen].square().mean().sqrt()), float(fitted.surprise[k])
    contacts = motion.contacts[shown].mean(0).tolist()
    used = [n for n in range(len(BODY_25)) if n not in UNUSED_BODY_25]
    by_time = [float(a[s].median()) if s.any() else None for a, s in zip(away, seen, strict=True)]
    return {
        "id": each,
        "share": float(shown.float().mean()),
        "spans_s": _spans(shown, motion.fps),
        "detected": float(seen[shown][:, used].float().mean()),
        "missing_by_joint": {BODY_25[n]: 1 - float(seen[:, n].float().mean()) for n in used},
        "pixels": {
            "mean": float((weight * away).sum() / weight.sum()), "median": float(away[seen].median()), "rms": rms,
            "by_joint": {BODY_25[n]: float(away[:, n][seen[:, n]].mean()) for n in used if seen[:, n].any()},
            "by_time": by_time,
        },
        "surprise": surprise if np.isfinite(surprise) else None,
        "doubtful": not (surprise <= SURPRISED and rms <= MISFIT_WIDTH * fitted.camera.width),
        "bounds": {"surprise": SURPRISED, "rms": MISFIT_WIDTH * fitted.camera.width},
        "acceleration": float(pose.mean_acceleration(motion.positions, motion.fps)) if motion.frames > 2 else None,
        "contacts": dict(zip(motion.skeleton.contact_names, contacts, strict=True)),
        "contacts_by_time": {
            name: _spans(motion.contacts[:, n] > 0.5, motion.fps)
            for n, name in enumerate(motion.skeleton.contact_names) if name in FEET
        },
        "feet_above_floor_cm": 100 * float(above_floor(motion.positions[shown])),
        "feet_seen": float(feet_seen(fitted.seen.confidence[k])),
        "bones": dict(zip(body_shape.BONE_GROUPS, body_shape.from_skeleton(motion.skeleton).tolist(), strict=True)),
    }  # fmt: skip


def _spans(mask: Tensor, fps: float) -> list[list[float]]:
    """Beginning and end in seconds of the runs of True in a mask (T,)."""
    edges = torch.nn.functional.pad(mask.int(), (1, 1)).diff().nonzero()[:, 0].reshape(-1, 2)
    return [[a / fps, b / fps] for a, b in edges.tolist()]


def _ink(k: int) -> str:
    """The colour of the k-th fitted person."""
    return ROLE[PEOPLE[k % len(PEOPLE)]]


def lines(record: Record) -> list[str]:
    """Returns what a terminal shows of a record of ``fit.run_clip``."""
    said = [f"note: {note}" for note in record["notes"]]
    energy = {name: sum(values) for name, values in record["energy"].items()}
    terms = sorted(energy.items(), key=lambda item: -item[1])[:4]
    said += [
        f"energy: {sum(energy.values()):.1f} ({', '.join(f'{name} {value:.1f}' for name, value in terms)})",
        f"search ended: {_runs(record['ended'])}" + (" (stopped: the best so far)" if record["stopped"] else ""),
        f"camera {record['camera']['source']}; {_moving(record)}",
    ]
    for row in record["people"]:
        said += [
            f"person {row['id']}: in {100 * row['share']:.0f} % of the frames, {100 * row['detected']:.0f} % of the "
            f"keypoints detected; reprojection {row['pixels']['mean']:.1f} px mean, {row['pixels']['median']:.1f} px "
            f"median; acceleration {_acceleration(row)}",
            f"  {_doubt(row)}",
            *(f"  {text}" for text in not_known(row)),
            "  contacts: " + ", ".join(f"{n.replace('_', ' ')} {100 * c:.0f} %" for n, c in row["contacts"].items()),
            f"  AMASS: {row['amass']['says']}",
        ]
    return said


def _doubt(row: Record) -> str:
    """Says whether a person's fit is to be doubted, and why."""
    surprise, rms, bounds = row["surprise"], row["pixels"]["rms"], row["bounds"]
    prior = "no motion prior was used" if surprise is None else f"surprise of the prior {surprise:.2f}"
    text = f"{prior} (up to {bounds['surprise']:g} is usual), missed by {rms:.0f} px rms (up to {bounds['rms']:.0f})"
    text += f", seems {row['seems_m']:.2f} m tall" if "seems_m" in row else ""
    return f"doubtful: {text}" if row["doubtful"] else f"no doubts: {text}"


def not_known(row: Record) -> list[str]:
    """Returns what cannot be known of a person: whether somebody sits or stands whose feet were not seen; who seems
    to be no adult."""
    small = []
    if "seems_m" in row:
        small = [
            f"seems to be about {row['seems_m']:.2f} m tall, by where the feet stand, and is fitted as an adult: give "
            "the height (--height METRES)"
        ]
    if row["feet_seen"] >= FEET_SEEN:
        return small
    return [
        *small,
        f"not known whether this person sits or stands: the feet were seen in {100 * row['feet_seen']:.0f} % of the "
        "frames. The legs are a guess, and the height of the floor depends on it",
    ]


def _acceleration(row: Record) -> str:
    return "unknown" if row["acceleration"] is None else f"{row['acceleration']:.2f} m/s^2"


def _moving(record: Record) -> str:
    """Says whether the camera, which is assumed not to move, moved."""
    found = record["moving_camera"]
    if found.get("cuts_s"):
        when = ", ".join(f"{at:.1f} s" for at in found["cuts_s"][:9])
        return f"it is assumed not to move, BUT THE FILM IS CUT before {when}: fit each part by itself"
    if found["moved"] is None:
        return "it is assumed not to move, which nothing could check: no footage, or no texture behind the people"
    off = f"the background is off by up to {100 * found['background_drift']:.1f} % of the width"
    if found["moved"]:
        return f"it is assumed not to move, BUT IT DOES: {off}; places and floor are wrong by that"
    return f"it is assumed not to move, and does not: {off}"


def _runs(words: Sequence[str]) -> str:
    """Words in a row, each run of the same once with its length: "steps, closures (9)"."""
    counts = [(word, len(list(same))) for word, same in groupby(words)]
    return ", ".join(f"{word} ({n})" if n > 1 else word for word, n in counts)


def page(record: Record, poster: bytes = b"") -> str:
    """Returns the report of a record as one page, which plays ``overlay.mp4`` beside it."""
    keypoints, footage, people = record["keypoints"], record["footage"], record["people"]
    name = Path(footage["path"] if footage else keypoints["path"]).name
    still = f"data:image/jpeg;base64,{base64.b64encode(poster).decode()}"
    film = "over the footage, and from the camera's right" if footage else "through its camera, and from its right"
    stopped = "<p class=doubt>Stopped before it was done: the best so far.</p>" if record["stopped"] else ""
    focal = record["camera"]["intrinsics"][0][0]
    pieces = f"in {record['windows']} windows" if record["windows"] > 1 else "in one piece"
    facts = {
        "keypoints": f"{keypoints['path']}: {keypoints['detector']}, {keypoints['points']} points, "
        f"{keypoints['frames']} frames at {keypoints['fps']:g} per second",
        "footage": "none: drawn on paper"
        if footage is None
        else f"{footage['path']}: {footage['frames']} frames at "
        f"{footage['fps']:g} per second, {footage['size'][0]} x {footage['size'][1]} pixels",
        "camera": f"{record['camera']['source']}: focal length {focal:.0f} px, image of {record['camera']['width']} x "
        f"{record['camera']['height']}; {_moving(record)}",
        "fit": f"solver {record['solver']}{', quick' if record['quick'] else ''}, {record['frames']} frames at "
        f"{record['fps']:g} per second {pieces}; search ended: {_runs(record['ended'])}",
    }
    drawn = "overlay.mp4" in record["files"]
    everybody = [
        {"person": row["person"], "seen in %": f"{row['share %']:.0f}", "confidence": f"{row['confidence']:.2f}",
         "height, px": f"{row['height px']:.0f}", "fitted": "no" if row["person"] in record["left_out"] else "yes"}
        for row in keypoints["people"][:_LISTED]
    ]  # fmt: skip
    return "\n".join([
        "<!DOCTYPE html><html lang=en><head><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        f"<title>{escape(name)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>A scene from {escape(name)}</h1>{stopped}",
        f'<video controls loop muted playsinline src="overlay.mp4" poster="{still}"></video>'
        if drawn
        else "",
        f"<p>The fitted people {film}. Dots are detections.</p>" if drawn else "<p>There is no film; see Notes.</p>",
        "<p>Who is who: " + ", ".join(f"{_mark(k)} person {row['id']}" for k, row in enumerate(people)) + "</p>",
        _table([{"": key, " ": text} for key, text in facts.items()]),
        "<h2>People</h2>", _table(everybody),
        f"<p>and {more} more</p>" if (more := len(keypoints["people"]) - len(everybody)) else "",
        *(_person(row, _mark(k)) for k, row in enumerate(people)),
        "<h2>Distance from the detections</h2>",
        "<p>Median over the keypoints of a frame, pixels. A gap: nothing was seen.</p>",
        _chart([row["pixels"]["by_time"] for row in people], record["fps"], [f"person {row['id']}" for row in people]),
        "<h2>By joint</h2>", _table(_joints(people)),
        "<h2>Contacts with the floor</h2>", _strips(people, record["frames"] / record["fps"]),
        "<h2>Notes</h2><ul>", *(f"<li>{escape(note)}</li>" for note in record["notes"]), "</ul>",
        "</body></html>",
    ])  # fmt: skip


def _mark(k: int) -> str:
    """A spot in the colour of the k-th fitted person."""
    return f'<span style="color: {_ink(k)}">&#9679;</span>'


def _person(row: Record, mark: str) -> str:
    spans = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in row["spans_s"])
    doubted = ' class="doubt"' if row["doubtful"] else ""
    facts = {
        "there": spans,
        "detected": f"{100 * row['detected']:.0f} % of the keypoints",
        "reprojection": f"{row['pixels']['mean']:.1f} px mean, {row['pixels']['median']:.1f} px median",
        "acceleration": f"{_acceleration(row)}, mean over joints and frames",
        "feet": f"the lower one {round(row['feet_above_floor_cm'], 1) + 0.0:+.1f} cm from the floor (median)",
        "bones": ", ".join(f"{name} {beta:+.1f}" for name, beta in row["bones"].items()) + " (standard deviations)",
        "files": ", ".join(row["files"].values()),
        "AMASS": f"{row['amass']['says']}. betas: {row['amass']['betas']}",
    }
    head = f"<h3>{mark} Person {row['id']}</h3><p{doubted}>{escape(_doubt(row))}</p>"
    head += "".join(f'<p class="doubt">{escape(text)}</p>' for text in not_known(row))
    return head + _table([{"": key, " ": text} for key, text in facts.items()])


def _joints(people: Sequence[Record]) -> list[dict[str, str]]:
    rows = []
    for joint in people[0]["missing_by_joint"]:
        row = {"joint": joint.replace("_", " ")}
        for each in people:
            pixels = each["pixels"]["by_joint"].get(joint)
            row[f"person {each['id']}: px"] = "" if pixels is None else f"{pixels:.1f}"
            row[f"person {each['id']}: not seen, %"] = f"{100 * each['missing_by_joint'][joint]:.0f}"
        rows.append(row)
    return rows


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    head = "".join(f"<th>{escape(key)}</th>" for key in rows[0]) if any(key.strip() for key in rows[0]) else ""
    body = [
        "<tr>" + "".join(f"<td{_class(value)}>{escape(str(value))}</td>" for value in row.values()) + "</tr>"
        for row in rows
    ]
    return f"<table>{f'<tr>{head}</tr>' if head else ''}{''.join(body)}</table>"


def _class(value: object) -> str:
    return " class=n" if str(value).replace(".", "", 1).lstrip("+-").isdigit() else ""


def _chart(curves: Sequence[Sequence[float | None]], fps: float, names: Sequence[str]) -> str:
    """Draws curves over time as SVG; None is a gap."""
    top = max((v for curve in curves for v in curve if v is not None), default=1.0) or 1.0
    count = max(2, *(len(curve) for curve in curves))
    left, low = 46, _HIGH - 24

    def x(frame: float) -> float:
        return left + (_WIDE - left - 10) * frame / (count - 1)

    def y(value: float) -> float:
        return low - (low - 12) * value / top

    parts = [
        f'<text x="4" y="{y(v) + 4:.0f}">{v:.3g}</text><path d="M{left} {y(v):.1f}H{_WIDE - 10}" stroke="#c3c9d3"/>'
        for v in (0.0, top / 2, top)
    ]
    end = (count - 1) / fps
    parts += [
        f'<text x="{x(share * (count - 1)):.0f}" y="{_HIGH - 6}" text-anchor="{anchor}">{share * end:.1f} s</text>'
        for share, anchor in ((0, "start"), (0.5, "middle"), (1, "end"))
    ]
    for k, (curve, name) in enumerate(zip(curves, names, strict=True)):
        ink, path, pen = _ink(k), [], "M"
        for frame, value in enumerate(curve):
            if value is None:
                pen = "M"
            else:
                path.append(f"{pen}{x(frame):.1f} {y(value):.1f}")
                pen = "L"
        parts.append(f'<path d="{"".join(path)}" fill="none" stroke="{ink}" stroke-width="1.6"/>')
        parts.append(f'<text x="{left + 6 + 90 * k}" y="12" fill="{ink}">{escape(name)}</text>')
    return _svg(_HIGH, parts)


def _strips(people: Sequence[Record], seconds: float) -> str:
    """Draws when the feet of each person touch the floor, a line each, as SVG."""
    parts, row = [], 0
    for k, person in enumerate(people):
        for name, spans in person["contacts_by_time"].items():
            top = 6 + 18 * row
            parts.append(f'<text x="4" y="{top + 11}">{person["id"]} {escape(name.replace("_", " "))}</text>')
            parts += [
                f'<rect x="{120 + (_WIDE - 130) * a / seconds:.1f}" y="{top}" height="13" fill="{_ink(k)}" '
                f'width="{max((_WIDE - 130) * (b - a) / seconds, 1):.1f}"/>'
                for a, b in spans
            ]
            row += 1
    return _svg(12 + 18 * row, parts)


def _svg(high: int, parts: Sequence[str]) -> str:
    box = f'viewBox="0 0 {_WIDE} {high}" width="{_WIDE}" height="{high}" font-family="sans-serif" font-size="11"'
    return f"<svg {box}>{''.join(parts)}</svg>"
