"""`make pins`: write what is installed into constraints.txt and environment.yml."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from motionlab.commands.doctor import _normal_name, _read_pins

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS_HEAD = """\
# Every package of the environment, pinned: written by `make pins`, read by every install (pip -c constraints.txt).
# torch carries no local version, so that each machine takes its own build (CPU or CUDA) of the same release.
"""
ENVIRONMENT_HEAD = """\
# The conda path: `conda env create -f environment.yml && conda activate motionlab`, then `make test` as usual.
# Written by `make pins`: the same releases as constraints.txt, which also pins what these packages need.
name: motionlab
channels: [conda-forge]
dependencies:
  - python=3.11
  - pip
  - make
  - pip:
      - -c constraints.txt
"""


def requirements() -> list[str]:
    """What pyproject.toml asks for by name, with extras, as `name` or `name[extra]`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    return [re.match(r"[\w.-]+(\[[\w,-]+\])?", line)[0] for line in asked]


def constraints() -> str:
    """The text of constraints.txt for the running environment."""
    frozen = subprocess.run(
        [sys.executable, "-m", "pip", "freeze", "--exclude-editable"], capture_output=True, text=True, check=True
    ).stdout
    return CONSTRAINTS_HEAD + re.sub(r"\+[\w.]+$", "", frozen, flags=re.MULTILINE)


def environment(pins: dict[str, str]) -> str:
    """The text of environment.yml for these pins: torch first, so that nothing else chooses its build."""
    lines = [f"      - {name}=={pins[_normal_name(name.split('[')[0])]}\n" for name in requirements()]
    return ENVIRONMENT_HEAD + "".join(lines) + "      - -e .\n"


def main() -> None:
    path = ROOT / "constraints.txt"
    path.write_text(constraints(), encoding="utf-8")
    (ROOT / "environment.yml").write_text(environment(_read_pins(path)), encoding="utf-8")


if __name__ == "__main__":
    main()
