"""Checks what this machine has and lacks, and names the remedy for each lack."""

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
_DRAW = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere(), color="white")
if plotter.screenshot(return_img=True).std() < 1:
    raise SystemExit("it draws an empty picture")
report = dict(line.split(":", 1) for line in plotter.render_window.ReportCapabilities().splitlines() if ":" in line)
print(plotter.render_window.GetClassName(), report.get("OpenGL renderer string", "?").strip(), sep=", ")
"""


class Check(NamedTuple):
    """One line of the table: what was looked at, what was found, and the remedy if that is not enough."""

    name: str
    found: str
    remedy: str = ""


def examine(data: str | None = None) -> list[Check]:
    """Checks everything the suite needs; ``data`` is the folder of recordings, if there is one."""
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    checks = [Check("python", python), *_check_packages()]
    if all(check.found != "not installed" for check in checks):  # what follows needs them
        weights = sorted(path.stem for path in (ROOT / "motionlab" / "checkpoints").glob("*.safetensors"))
        ships = ", ".join(weights) or "none (notebooks 00-03 need none)"
        checks += [_check_device(), _check_rendering(), _check_body(), Check("checkpoints", ships)]
    return [*checks, _check_data(data)]


def _read_pins(path: Path) -> dict[str, str]:
    """Version by normalised name from a constraints file."""
    pins = re.findall(r"^([\w.-]+)==([^\s#;]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {_normal_name(name): version for name, version in pins}


def _normal_name(name: str) -> str:
    """A distribution's name as the registries compare it: ``rich_rst`` and ``Rich-RST`` are ``rich-rst``."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _check_packages() -> list[Check]:
    """The packages that motionlab asks for by name, against their pins where this is a checkout."""
    pins = _read_pins(ROOT / "constraints.txt") if (ROOT / "constraints.txt").exists() else {}
    try:
        asked = [line for line in metadata.requires("motionlab") if "extra ==" not in line]
    except metadata.PackageNotFoundError:
        return [Check("motionlab", "not installed", "make setup")]
    checks = []
    for name in (_normal_name(re.match(r"[\w.-]+", line)[0]) for line in asked):
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            version = "not installed"
        wanted = pins.get(name, version)
        agrees = version.split("+")[0] == wanted != "not installed"
        checks.append(Check(name, version, "" if agrees else f"pinned is {wanted}: make setup"))
    return checks


def _check_device() -> Check:
    """What torch computes on."""
    import torch  # doctor must be able to say that torch is missing

    gpu = f"cuda, {torch.cuda.get_device_name()}" if torch.cuda.is_available() else "cpu"
    return Check("device", f"{gpu}; {torch.get_num_threads()} threads on {os.cpu_count()} cores")


def _check_rendering() -> Check:
    """Really draw a sphere off screen, in a process of its own: a missing library can abort the interpreter."""
    from motionlab.viz.scene import RENDERING_REMEDY  # needs the packages that doctor may find missing

    try:
        drawn = subprocess.run([sys.executable, "-c", _DRAW], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return Check("rendering", "did not finish in 120 s", RENDERING_REMEDY)
    said = (drawn.stderr if drawn.returncode else drawn.stdout).splitlines()[-1:] or [f"exit status {drawn.returncode}"]
    if drawn.returncode or not drawn.stdout:
        return Check("rendering", f"no off-screen rendering: {said[0]}", RENDERING_REMEDY)
    return Check("rendering", said[0])


def _check_body() -> Check:
    """The body that is baked from anny once and kept."""
    from motionlab import body

    if not body.cache_path().exists():
        return Check("body", f"not baked yet ({body.cache_path()})", "python -m motionlab doctor --prepare")
    return Check("body", str(body.cache_path()))


def _check_data(data: str | None) -> Check:
    """The folder of recordings: one sub-folder per source."""
    if not data:
        return Check("recordings", "synthetic only; MOTIONLAB_DATA=<folder> adds real ones")
    sources = sorted(path.name for path in Path(data).glob("*/"))
    remedy = "" if sources else "point MOTIONLAB_DATA at the unpacked recordings, one folder per source"
    return Check("recordings", f"{data}: {', '.join(sources) or 'holds no folders'}", remedy)


def run(options: argparse.Namespace) -> int:
    """Says what is here and what is missing; or installs and bakes it."""
    if options.prepare:
        return int(not prepare())
    checks = examine(os.environ.get("MOTIONLAB_DATA"))
    width = max(len(check.name) for check in checks)
    for check in checks:
        print(f"{'-- ' if check.remedy else 'ok '} {check.name:<{width}}  {check.found}")
        if check.remedy:
            print(f"    {'':<{width}}  remedy: {check.remedy}")
    missing = sum(bool(check.remedy) for check in checks)
    print(f"{missing} thing{'s' * (missing > 1)} to mend" if missing else "all is well")
    return int(missing > 0)


def prepare() -> bool:
    """Installs what rendering needs (as root, else prints how), bakes the body, compiles loops; True if all is well."""
    from motionlab import body
    from motionlab.viz import scene

    rendering = _check_rendering()
    if rendering.remedy and shutil.which("apt-get") and os.geteuid() == 0:
        print(f"rendering: {rendering.found}; installing {scene.RENDERING_PACKAGES}", flush=True)
        subprocess.run(["env", "DEBIAN_FRONTEND=noninteractive", "sh", "-c", scene.RENDERING_REMEDY], check=False)
        rendering = _check_rendering()
    print(f"rendering: {rendering.found}", flush=True)
    if rendering.remedy:
        print(f"Run this as root, then again what you ran:\n  {scene.RENDERING_REMEDY}")
        return False
    if _check_body().remedy:
        print("body: baking it from anny, once (a minute, several where anny itself is new)", flush=True)
        body.BodyModel.from_anny()
    print(f"body: {body.cache_path()}\nroll-outs: compiling their loops, once (half a minute)", flush=True)
    _compile_loops()
    return True


def _compile_loops() -> None:
    """Roll out one step there and back, as a first fit would, so that no fit waits for the compiler."""
    import torch

    from motionlab.humor.priors import Cvae
    from motionlab.humor.rollout import steered_rollout
    from motionlab.humor.state import STATE

    z = torch.zeros(1, 1, 48, requires_grad=True)
    steered_rollout(Cvae(32), torch.zeros(1, STATE), z)[0].states.sum().backward()
