"""Writes the report of a fit: terminal summary and one offline HTML page."""

from collections.abc import Mapping
from pathlib import Path

import jinja2
import numpy as np
from torch import Tensor

from motionlab.footage.scene_fit import USED, SceneFit
from motionlab.humor import body_shape
from motionlab.humor.evidence import FEET_SEEN, feet_seen
from motionlab.humor.start import above_floor
from motionlab.humor.testops import MAX_LATENT_CHI2, MISFIT_WIDTH
from motionlab.motion import runs
from motionlab.observation import BODY_25
from motionlab.skeleton import FEET
from motionlab.viz.palette import ROLE

#: The colours of the people, in the film and here, one after the other.
PEOPLE = ("ours", "baseline", "6d", "axis-angle", "quaternion", "synthetic", "stage2", "stage3")
_PAGE = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
).get_template("scene_report.html")

Record = Mapping[str, object]


def person_row(k: int, each: int, fitted: SceneFit, away: Tensor, weight: Tensor) -> dict[str, object]:
    """Returns the record's row of the k-th fitted person, whose id is ``each``.

    away, weight: (T, 25), as ``fit.pixel_distances`` gives them.
    """
    motion, shown, seen = fitted.motions[k], fitted.shown[k], weight > 0
    rms, latent_chi2 = float(away[seen].square().mean().sqrt()), float(fitted.latent_chi2[k])
    return {
        "id": each,
        "share": float(shown.float().mean()),
        "spans_s": _spans(shown, motion.fps),
        "detected": float(seen[shown][:, USED].float().mean()),
        "missing_by_joint": {BODY_25[n]: 1 - float(seen[:, n].float().mean()) for n in USED},
        "pixels": {"mean": float((weight * away).sum() / weight.sum()),
                   "median": float(away[seen].median()), "rms": rms,
                   "by_joint": {BODY_25[n]: float(away[:, n][seen[:, n]].mean()) for n in USED if seen[:, n].any()},
                   "by_time": [float(a[s].median()) if s.any() else None for a, s in zip(away, seen, strict=True)]},
        "latent_chi2": latent_chi2 if np.isfinite(latent_chi2) else None,
        "doubtful": not (latent_chi2 <= MAX_LATENT_CHI2 and rms <= MISFIT_WIDTH * fitted.camera.width),
        "bounds": {"latent_chi2": MAX_LATENT_CHI2, "rms": MISFIT_WIDTH * fitted.camera.width},
        "contacts_by_time": {name: _spans(motion.contacts[:, n] > 0.5, motion.fps)
                             for n, name in enumerate(motion.skeleton.contact_names) if name in FEET},
        "feet_above_floor_cm": 100 * float(above_floor(motion.positions[shown])),
        "feet_seen": float(feet_seen(fitted.seen.confidence[k])),
        "bones": dict(zip(body_shape.BONE_GROUPS, body_shape.from_skeleton(motion.skeleton).tolist(), strict=True)),
    }  # fmt: skip


def _spans(mask: Tensor, fps: float) -> list[list[float]]:
    """Beginning and end in seconds of the runs of True in a mask (T,)."""
    return [[a / fps, b / fps] for a, b in runs(mask)]


def lines(record: Record) -> list[str]:
    """Returns what a terminal shows of a record of ``fit.run_clip``."""
    said = [f"note: {note}" for note in record["notes"]] + ["stopped: the best so far"] * record["stopped"]
    said.append(f"camera {record['camera']['source']}; {_moving(record)}")
    for row in record["people"]:
        facts = "; ".join(f"{key} {text}" for key, text in _facts(row).items())
        said += [
            f"person {row['id']}: in {100 * row['share']:.0f} % of the frames; {facts}",
            f"  {_doubt(row)}",
            *(f"  {text}" for text in (*not_known(row), *row.get("open", ()))),
            f"  AMASS: {row['amass']['says']}",
        ]
    return said


def _doubt(row: Record) -> str:
    """Says whether a person's fit is to be doubted, and why."""
    latent_chi2, rms, bounds = row["latent_chi2"], row["pixels"]["rms"], row["bounds"]
    usual = f"surprise of the prior {latent_chi2 or 0:.2f} (up to {bounds['latent_chi2']:g} is usual)"
    prior = "no motion prior was used" if latent_chi2 is None else usual
    text = f"{prior}, missed by {rms:.0f} px rms (up to {bounds['rms']:.0f})"
    text += f", seems {row['seems_m']:.2f} m tall" if "seems_m" in row else ""
    return f"doubtful: {text}" if row["doubtful"] else f"no doubts: {text}"


def not_known(row: Record) -> list[str]:
    """Returns what cannot be known of a person: whether somebody sits or stands whose feet were not seen; who seems
    to be no adult."""
    said = []
    if "seems_m" in row:
        tall = f"seems to be about {row['seems_m']:.2f} m tall, by where the feet stand"
        said.append(f"{tall}, and is fitted as an adult: give the height (--height METRES)")
    if row["feet_seen"] < FEET_SEEN:
        share = f"the feet were seen in {100 * row['feet_seen']:.0f} % of the frames"
        guess = "The legs are a guess, and the height of the floor depends on it"
        said.append(f"not known whether this person sits or stands: {share}. {guess}")
    return said


def _moving(record: Record) -> str:
    """Says whether the camera, which is assumed not to move, moved."""
    found, said = record["moving_camera"], "it is assumed not to move, "
    if found["cuts_s"]:
        when = ", ".join(f"{at:.1f} s" for at in found["cuts_s"][:9])
        return f"{said}BUT THE FILM IS CUT before {when}: fit each part by itself"
    if found["moved"] is None:
        return f"{said}which nothing could check: no footage, or no texture behind the people"
    off = f"the background is off by up to {100 * found['background_drift']:.1f} % of the width"
    if found["moved"]:
        return f"{said}BUT IT DOES: {off}; places and floor are wrong by that"
    return f"{said}and does not: {off}"


def page(record: Record) -> str:
    """Returns the report of a record as one page, which plays ``overlay.mp4`` beside it."""
    values = [value for row in record["people"] for value in row["pixels"]["by_time"] if value is not None]
    people = []
    for k, row in enumerate(record["people"]):
        said = {"doubt": _doubt(row), "unknown": not_known(row), "facts": _facts(row)}
        people.append(row | said | {"ink": ROLE[PEOPLE[k % len(PEOPLE)]]})
    return _PAGE.render(
        name=Path((record["footage"] or record["keypoints"])["path"]).name, record=record, people=people,
        moving=_moving(record), top=max(values, default=1.0) or 1.0,
        last=max(1, len(record["people"][0]["pixels"]["by_time"]) - 1),
        strips=[(row, name, spans) for row in people for name, spans in row["contacts_by_time"].items()],
    )  # fmt: skip


def _facts(row: Record) -> dict[str, str]:
    return {
        "detected": f"{100 * row['detected']:.0f} % of the keypoints",
        "reprojection": f"{row['pixels']['mean']:.1f} px mean, {row['pixels']['median']:.1f} px median",
    }
