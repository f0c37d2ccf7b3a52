"""From a video and its keypoints to a scene, by HuMoR's test-time optimisation: ``python -m motionlab fit``.

``run_clip`` does one clip: motions as BVH and AMASS, the skinned people as one GLB, a film of them over the footage,
and a report. ``fit.json`` says at the end whether the folder is finished: not stopped, and nothing left to draw.
"""

import json
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.errors import DataError
from motionlab.files import write_whole, writing
from motionlab.footage import overlay as film
from motionlab.footage import scene_report
from motionlab.footage.clip import Clip, output_folder, read_clip
from motionlab.footage.scene_fit import SMALL, STATURE, SceneFit, SceneFitConfig, fit_people, seen_size
from motionlab.humor import body_shape, pretrained
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.io import bvh, gltf, smpl, video
from motionlab.motion import Motion, resample
from motionlab.observation import Camera, Observation2D, project
from motionlab.optimise import begins
from motionlab.posterior import Draws
from motionlab.retarget import retarget
from motionlab.skeleton import STANDARD

RESULT = "fit.json"
_READ = ("keypoints", "video", "camera", "prior", "pose_prior", "initial")
DRAWS = 64  # other motions of a person, at most
_SMALL = 320 * 240  # pixels of the film of a quick fit
_LEG = float(STANDARD.offsets[STANDARD.indices(["left_knee", "left_ankle"])].norm(dim=-1).sum())


def is_finished(out: str | Path, how: Mapping[str, object] | None = None) -> bool:
    """Says whether ``run_clip`` has written a folder, to the end and without having been stopped.

    how: arguments of ``run_clip`` by name; then only a folder made with the same, and after the files that it is of.
    """
    old = _earlier(Path(out))
    if how is None or old.get("finished") is not True:
        return old.get("finished") is True
    newest = max((each.stat().st_mtime for each in _files(how)), default=0.0)
    return old["asked"] == _asked(how) and newest <= (Path(out) / RESULT).stat().st_mtime


def _asked(given: Mapping[str, object]) -> dict[str, str]:
    """What decides about a fit: arguments of ``run_clip``, by default what they are then, and its files' bytes."""
    known = signature(run_clip).parameters.items()
    told = {name: str(given.get(name, one.default)) for name, one in known if name not in ("out", "progress")}
    return told | {"bytes": str(sum(each.stat().st_size for each in _files(given)))}


def _files(given: Mapping[str, object]) -> list[Path]:
    """The files that a fit is of, those in its folders, too."""
    paths = [Path(given[name]) for name in _READ if given.get(name) is not None]
    return [each for path in paths for each in (path, *path.glob("*")) if each.is_file()]


def _earlier(out: Path) -> dict[str, object]:
    """What an earlier run said of itself, ``RESULT`` among its files; nothing where there was none."""
    try:
        old = json.loads((out / RESULT).read_text(encoding="utf-8"))
        files = [RESULT, *(Path(str(name)).name for name in old["files"])]
        return old | {"files": files} if {"finished", "asked"} <= old.keys() else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def run_clip(
    keypoints: str | Path | None, out: str | Path, *, video: str | Path | None = None,
    person: str | int | Sequence[str | int] = "longest", fps: float | None = None, size: tuple[int, int] | None = None,
    layout: str | None = None, camera: str | Path | None = None, camera_name: str | None = None,
    prior: str | Path | None = None, pose_prior: str | Path | None = None, initial: str | Path | None = None,
    pelvis: Sequence[float] | None = None, height: float | None = None, draws: int = 0, solver: str = "shooting",
    quick: bool = False, progress: bool | str = False,
) -> dict[str, object]:  # fmt: skip
    """Fits the people of one clip and writes a folder: motions and report together, then the film. Returns what
    ``fit.json`` says.

    Ctrl-C keeps the best so far of a clip of up to 6 s, and says so; of a longer one the
    windows that are done are kept in the folder, and the same call goes on from there. While the film is drawn, it
    costs the film alone, and so does whatever else keeps it from being drawn; the windows of a long clip stay until
    there is one.

    Args:
        keypoints: what a 2-D pose detector wrote, see ``io.keypoints``; None: found in the video, see ``detect``.
        out: folder to write, made if it is not there.
        video: a video or a folder of images; None draws on paper.
        person: "longest", "largest", "all", an id, or several ids.
        fps, size, layout: of the keypoints; where neither they nor the video say it.
        camera, camera_name: see ``io.cameras.load_camera``; without one a level camera is assumed.
        height: of the one person who is fitted, in metres, where that is not about an adult's.
        draws: so many other motions of each person that explain as well what was seen, of at most ``DRAWS``, where a
            clip of up to 6 s leaves no doubts: their hidden limbs in the film, all of them in ``draws.glb``, and in the
            report how far off hidden joints may be.
        prior, pose_prior, initial, pelvis: see ``humor.pretrained.load_priors``.
        progress: show bars, or "lines": a line where a stage begins, on stderr.
        solver: "shooting", or "rollout" for the original's schedule.

    Raises:
        DataError: something cannot be read, used or written, or files that no fit has written are in the way, which is
            found before the fit. MissingData: no keypoints, and no detector.
        KeyboardInterrupt: stopped, and not finished.
    """
    asked = _asked(locals())
    if draws and (quick or solver != "shooting" or not 1 <= draws <= DRAWS):
        what = "a quick fit" if quick else f"the solver {solver}" if solver != "shooting" else f"{draws} draws"
        raise DataError(f"no draws for {what}", place="draws", remedy=f"ask for 1 to {DRAWS} of a usual fit")
    began, out = time.perf_counter(), output_folder(out)
    how = {"fps": fps, "size": size, "layout": layout, "progress": progress}
    how |= {"person": person, "camera": camera, "camera_name": camera_name}
    clip, ids, seen = read_clip(keypoints, video, out=out, **how)
    if height is not None and len(ids) > 1:
        raise DataError(f"{len(ids)} people and one height", place="height", remedy="fit one at a time: --person ID")
    _check_free(out, _stems(ids))
    pelvis, windows = None if pelvis is None else tuple(pelvis), out / "windows"
    priors = pretrained.load_priors(motion=prior, pose=pose_prior, initial=initial, pelvis=pelvis)
    begins("is the camera still?", progress)
    drift = np.zeros(0) if clip.video is None else clip.drift()  # before the fit, which it must not lose
    how = {"solver": solver, "quick": quick, "keep": windows, "progress": progress, "height": height, "draws": draws}
    fitted = fit_people(seen, SceneFitConfig(priors, clip.camera, clip.placed, clip.size, **how))
    record = _record(clip, ids, fitted, drift, height)
    record |= {"solver": solver, "quick": quick, "stopped": fitted.stopped, "asked": asked}
    others = {k: each for k, each in enumerate(fitted.draws) if not record["people"][k]["doubtful"]}
    body = BodyModel.from_anny()
    with writing(out), tempfile.TemporaryDirectory(prefix=".fit-", dir=out) as folder:
        part = Path(folder)
        files = _write(part, ids, fitted, others, record, body)
        record["files"] = [*files, "report.html"]
        for name in _earlier(out).get("files", ()):
            (out / name).unlink(missing_ok=True)
        for name in files:
            (part / name).replace(out / name)
        _report(out, record | {"finished": False, "notes": [*record["notes"], "the film is not drawn yet"]}, began)
        record["finished"] = not fitted.stopped
        try:
            _film(part / "overlay.mp4", clip, fitted, body, others, quick, progress)
            (part / "overlay.mp4").replace(out / "overlay.mp4")
            record["files"].insert(-1, "overlay.mp4")
        except Exception as error:  # of the machine, where the same call would not draw it either
            record["notes"].append(f"the film could not be drawn: {type(error).__name__}: {error}")
        _report(out, record, began)
    if "overlay.mp4" in record["files"]:
        shutil.rmtree(windows, ignore_errors=True)
    return record


def _stems(ids: Sequence[int]) -> list[str]:
    return ["motion"] if len(ids) == 1 else [f"motion_{each}" for each in ids]


def _check_free(out: Path, stems: Sequence[str]) -> None:
    """Checks that only files of an earlier fit are overwritten."""
    names = {f"{stem}.{suffix}" for stem in stems for suffix in ("bvh", "npz")}
    names |= {"scene.glb", "draws.glb", "overlay.mp4", "report.html", RESULT}
    if others := sorted(name for name in names - {*_earlier(out).get("files", ())} if (out / name).exists()):
        message = f"{', '.join(others)} would be overwritten, and no earlier fit wrote that"
        raise DataError(message, path=out, remedy="move it away, or name another folder: --out OUT/")


def _write(
    folder: Path, ids: Sequence[int], fitted: SceneFit, draws: dict[int, Draws], record: dict, body: BodyModel
) -> list[str]:
    """Writes all but film and report; adds to the record what concerns the files; returns their names."""
    files = []
    for stem, motion, row in zip(_stems(ids), fitted.motions, record["people"], strict=True):
        bvh.save(folder / f"{stem}.bvh", motion)
        standard = retarget(replace(motion, contacts=None), proportions="standard", leg=_LEG)
        smpl.save_motion(folder / f"{stem}.npz", replace(standard.motion, contacts=motion.contacts))
        row["files"] = {"bvh": f"{stem}.bvh", "amass": f"{stem}.npz"}
        says = (f"put on a body of standard size, {standard.scale:.3f} times as large, path and all; its feet stand on "
                "z = 0. BVH and GLB have the fitted bones. trans is the pelvis, without SMPL's J_0. betas are zero: no "
                "function of bone lengths alone")  # fmt: skip
        row["amass"] = {"scale": standard.scale, "raised_m": standard.floor, "says": says}
        files += row["files"].values()
    names = [f"person {each}" for each in ids]
    gltf.save(folder / "scene.glb", fitted.motions[0] if len(ids) == 1 else fitted.motions, body=body, names=names)
    if draws:
        several = [(k, n) for k, each in draws.items() for n in range(len(each.motions.root))]
        motions = [draws[k].motions.clip(n) for k, n in several]
        gltf.save(folder / "draws.glb", motions, names=[f"person {ids[k]}, {n}" for k, n in several])
        files.append("draws.glb")
    return [*files, "scene.glb"]


def _report(out: Path, record: dict[str, object], began: float) -> None:
    record["seconds"] = time.perf_counter() - began
    write_whole(out / "report.html", scene_report.page(record))
    write_whole(out / RESULT, json.dumps(record, indent=1, allow_nan=False))


def _film(
    path: Path, clip: Clip, fitted: SceneFit, body: BodyModel, draws: dict[int, Draws], quick: bool, bars: str | bool
) -> None:
    count, rate, fps = clip.count, clip.rate, fitted.seen.fps
    at = (torch.arange(count) / rate * fps).round().long().clamp(max=fitted.seen.frames - 1)
    played = [resample(replace(motion, contacts=None), rate) for motion in fitted.motions]
    motions = [m.clip(torch.arange(count).clamp(max=m.frames - 1)) for m in played]  # held behind the last sample
    both = zip(fitted.seen.keypoints, fitted.seen.confidence, strict=True)
    seen = [replace(fitted.seen, keypoints=points[at], confidence=sure[at], fps=rate) for points, sure in both]
    pictures = None if clip.video is None else clip.pictures(range(count))
    roles = [scene_report.PEOPLE[k % len(scene_report.PEOPLE)] for k in range(len(motions))]
    how = {"roles": roles, "shown": fitted.shown[:, at].tolist(), "seen": seen, "progress": begins("film", bars)}
    how |= {"area": _SMALL} if quick else {}
    places = {k: project(fitted.camera, each.motions.positions[:, at])[0] for k, each in draws.items()}
    how["ghosts"] = {k: (places[k], each.hidden[at]) for k, each in draws.items()}
    film.over_footage(motions, fitted.camera, pictures, path, body, **how)


def _record(clip: Clip, ids: Sequence[int], fitted: SceneFit, drift: np.ndarray, height: float | None) -> dict:
    """What there is to say, as plain numbers; see ``scene_report.page``."""
    camera, read = fitted.camera, clip.footage
    pixels = torch.stack([project(camera, landmarks_of(motion))[0] for motion in fitted.motions])
    away, weight = pixel_distances(pixels, fitted.seen)
    people = [scene_report.person_row(k, each, fitted, away[k], weight[k]) for k, each in enumerate(ids)]
    worst = max((float(off) for off in drift[1:] if np.isfinite(off)), default=None)
    cuts = [clip.samples[k] / clip.rate for k in np.flatnonzero(np.isinf(drift))]
    given = clip.camera is not None
    if clip.placed and height is None:
        for row, share in zip(people, seen_size(fitted.seen, clip.camera), strict=True):
            if share < SMALL:
                row |= {"doubtful": True, "seems_m": share * STATURE}
    for row, each in zip(people, fitted.draws, strict=False):  # none, where none were asked for
        row["open"] = ["no other motions are drawn: the fit is doubtful"] if row["doubtful"] else each.summary()
    source = "given, and its place" if clip.placed else "given, its place found" if given else "assumed, level at first"
    return {
        "keypoints": {"path": str(read.path), "detector": read.detector, "points": len(read.names), "fps": read.fps,
                      "frames": read.frames, "size": clip.size, "people": read.table()},
        "footage": clip.video and {"path": str(clip.video.path), "fps": clip.rate, "frames": clip.video.frames,
                                   "size": clip.video.size, "first": clip.first},
        "camera": {"source": source, "width": camera.width, "height": camera.height,
                   **{key: getattr(camera, key).tolist() for key in ("intrinsics", "rotation", "translation")},
                   "distortion": list(clip.camera.distortion) if given else []},
        "moving_camera": {"assumed": "the camera does not move", "background_drift": worst,
                          "moved": True if cuts else None if worst is None else worst > video.MOVED, "cuts_s": cuts},
        "people": people, "frames": fitted.seen.frames, "fps": fitted.seen.fps,
        "windows": fitted.windows,
        "notes": [*clip.notes, *fitted.notes],
    }  # fmt: skip


def landmarks_of(motion: Motion) -> Tensor:
    """Computes the 25 keypoints (..., T, 25, 3), world, from a fitted motion; its skeleton says its shape."""
    betas = body_shape.from_skeleton(motion.skeleton)
    if betas.ndim > 1:  # offsets (G, 1, 22, 3): one body per recording
        betas = betas[..., 0, :]
    return body_shape.landmarks(*motion.world, betas)


def pixels_of(motion: Motion, cameras: list[Camera]) -> Tensor:
    """Computes the pixels (G, T, 25, 2) of the landmarks of fitted motions (G, T)."""
    points = landmarks_of(motion)
    return torch.stack([project(camera, clip)[0] for camera, clip in zip(cameras, points, strict=True)])


def pixel_distances(pixels: Tensor, observation: Observation2D) -> tuple[Tensor, Tensor]:
    """Computes distances in pixels (G, T, 25) of landmarks from the detections, and the weight of each: its confidence.

    The observation is of BODY_25; what was not detected, neck and hips weigh nothing.
    """
    keypoints, weight = observation.keypoints, observation.confidence.clone()
    weight[..., list(UNUSED_BODY_25)] = 0.0
    seen = (weight > 0) & keypoints.isfinite().all(-1)
    away = (pixels - torch.where(seen[..., None], keypoints, 0.0)).norm(dim=-1)
    return torch.where(seen, away, 0.0), torch.where(seen, weight, 0.0)
