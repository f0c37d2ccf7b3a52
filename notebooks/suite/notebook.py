"""Lab: all that a notebook takes from the outside world and gives back to it.

Profile, seed, budgets and data folder come in; figures, tables, findings, verdicts and provenance go out.
"""

import hashlib
import io
import math
import os
import platform
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import torch
from IPython.display import HTML, Image, Markdown, display
from matplotlib.figure import Figure
from PIL import Image as Pillow
from torch import Tensor

from motionlab import checkpoint, viz
from motionlab.errors import DataError
from motionlab.io import load as io_load
from motionlab.metrics import interval
from motionlab.motion import FPS, Motion, resample
from motionlab.retarget import retarget
from suite import findings, ledger, staleness
from suite.findings import Claim, Criterion, Finding, Record

PROFILES = ("smoke", "full")
_scratch = cache(lambda: tempfile.TemporaryDirectory(prefix="motionlab-"))


def setup(
    notebook: str, *, profile: str | None, seed: int, budgets: Mapping[str, Mapping[str, object]],
    data: str | None = None,
) -> "Lab":  # fmt: skip
    """Opens the lab for one notebook ("02_rotations_that_jump") and prints where it runs.

    Args:
        profile: "smoke", "full" or None for $MOTIONLAB_PROFILE, else full. A profile sets budgets only.
        budgets: one mapping of numbers per profile; ``lab.budget`` is the chosen one.
        data: folder of unpacked recordings or None for $MOTIONLAB_DATA, else synthetic motion only.

    Raises:
        DataError: an unknown profile, a data folder that does not exist, or no claims.toml here.
    """
    profile = profile or os.environ.get("MOTIONLAB_PROFILE") or "full"
    if profile not in PROFILES or set(budgets) != set(PROFILES):
        raise DataError(f"profile {profile!r} with budgets {sorted(budgets)}", remedy=f"profiles are {PROFILES}")
    data = data or os.environ.get("MOTIONLAB_DATA") or None
    if data and not Path(data).is_dir():
        raise DataError("no such folder", path=data, remedy="set MOTIONLAB_DATA to the unpacked recordings")
    viz.draft = profile == "smoke" and bool(os.environ.get("MOTIONLAB_BATCH"))  # a person wants to see whole films
    if not os.environ.get("OMP_NUM_THREADS"):
        torch.set_num_threads(1)
    budget, file = SimpleNamespace(**budgets[profile]), Path.cwd() / f"{notebook}.ipynb"
    claims, record = findings.load_claims(file.parent / "claims.toml"), findings.record_of(file)
    code = staleness.code_hash(file) if file.exists() else ""
    lab = Lab(notebook, profile, seed, budget, Path(data) if data else None, claims, file.parent, record, code)
    lab.say(lab.headline())
    return lab


@dataclass
class Lab:
    """One notebook's bench, made by :func:`setup`. recorded, code: its record and a hash of its cells, as it opened."""

    notebook: str
    profile: str
    seed: int
    budget: SimpleNamespace
    data: Path | None
    claims: dict[str, Claim]
    folder: Path
    recorded: Record
    code: str
    found: list[Finding] = field(default_factory=list)
    marks: staleness.Fingerprint = field(default_factory=dict)
    opened: float = field(default_factory=time.perf_counter)

    def headline(self) -> str:
        """Returns profile, data, seed, device and versions, and how long a run took when it was last recorded."""
        packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "kornia", "pyvista"))
        where = "synthetic motion and the real recordings" if self.data else "synthetic motion"
        cpu = f"CPU, {torch.get_num_threads()} threads"
        device = torch.cuda.get_device_name() if torch.cuda.is_available() else cpu
        short = "  \nA short run: readings in the text are those of the full one." if self.profile == "smoke" else ""
        known, cost = self.recorded.provenance, "It was never recorded how long a run takes."
        if "seconds" in known:
            took, worked = (staleness.duration(known[name]) for name in ("seconds", "processor seconds"))
            brief = f"a full run took {took} ({worked} of a processor), a short one {known.get('smoke seconds', '?')} s"
            cost = f"When it was last recorded, {brief}."
        return (
            f"**{self.notebook}**, profile *{self.profile}*, seed {self.seed}, on {where}.  \n"
            f"Python {platform.python_version()}, {packages}; {device}.{short}  \n{cost}"
        )

    def generator(self, salt: object = "") -> torch.Generator:
        """Returns a fresh generator that depends on the notebook's seed and on ``salt`` only."""
        digest = hashlib.sha256(f"{self.seed}/{salt}".encode()).digest()
        return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)

    def say(self, markdown: str) -> None:
        """Shows a line of Markdown whose numbers come from code."""
        display(Markdown(markdown))

    def figure(self, picture: object, number: str, caption: str) -> None:
        """Shows a matplotlib Figure, an RGB array (H, W, 3) or a film, with its caption below."""
        file = io.BytesIO()
        if isinstance(picture, Figure):
            picture.savefig(file, dpi=110, bbox_inches=None if viz.draft else "tight")  # twice the time
            plt.close(picture)
        elif isinstance(picture, np.ndarray):
            small = Pillow.fromarray(picture).quantize(256, dither=Pillow.Dither.NONE)  # a third of the bytes
            small.save(file, "png", optimize=True)
        display(Image(file.getvalue()) if file.tell() else HTML(picture._repr_html_()))
        self.say(f"**Figure {number}.** {caption}")

    def scratch(self, name: str) -> Path:
        """Returns a path for a film or file of this run in a folder that is deleted afterwards."""
        return Path(_scratch().name) / name

    def table(self, rows: Sequence[Mapping[str, object]], caption: str = "") -> None:
        """Shows rows (all with the same keys) as a Markdown table; floats with three digits."""
        self.say(_markdown_table(rows) + (f"\n\n{caption}" if caption else ""))

    def fold(self, title: str, rows: Sequence[Mapping[str, object]]) -> None:
        """Shows rows as a table that opens with a click."""
        self.say(f"<details><summary>{title} ({len(rows)} rows)</summary>\n\n{_markdown_table(rows)}\n\n</details>")

    def own(self, file: str | Path) -> Motion:
        """Reads a person's own recording (BVH, AMC, AMASS npz, GLB) as one motion of the standard joints, 30 fps.

        Raises:
            DataError: as :func:`motionlab.io.load` and :func:`motionlab.retarget.retarget`.
        """
        return resample(retarget(io_load(file)).motion, FPS)

    def answers(self) -> None:
        """Shows what this notebook answers: verdict and answer of each of its claims.

        The numbers are this run's in the full profile. In the smoke profile they are those of the committed record.
        """
        found = self.settled() if self.profile == "full" else self.recorded.findings
        mine = [claim for claim in self.claims.values() if claim.notebook == staleness.number_of(self.notebook)]
        said = [(c, ledger.spoken(c, found), ledger.found_answer(c, found)) for c in mine]
        self.say("\n".join(f'- **{c.id}**, "{c.title}": **{verdict}.** {answer}' for c, verdict, answer in said))

    def show(self, widget: object) -> None:
        """Shows a live widget (a pyvista scene, a slider), or what a function makes of one, unless in a batch run."""
        if not os.environ.get("MOTIONLAB_BATCH"):
            display(widget() if callable(widget) else widget)

    def criterion(self, test: str) -> Criterion:
        """Returns the test with this id, "H06.excess".

        Raises:
            DataError: claims.toml has no such test; lists those it has.
        """
        known = findings.all_tests(self.claims)
        if test not in known:
            raise DataError(f"no test {test!r} in claims.toml", remedy=f"known: {', '.join(known)}")
        return known[test]

    def record(
        self, test: str, samples: Tensor | Sequence[float] | float, *, source: str = "synthetic",
        statistic: str = "mean", baseline: Tensor | Sequence[float] | float | None = None, note: str = "",
    ) -> Finding:  # fmt: skip
        """Measures a test: the statistic of samples, its interval, its verdict against the bound fixed beforehand.

        Args:
            samples: one number per independent unit (clip, event, vertex), in the unit of the test.
            source: "synthetic" or the recording set; one finding per test and source.
            statistic: as in :func:`motionlab.metrics.interval`; also applied to ``baseline``.
        """
        rule, name = self.criterion(test), f"{test}/{source}"
        rival = [] if baseline is None else baseline
        samples, rival = (torch.as_tensor(x, dtype=torch.float64).flatten() for x in (samples, rival))
        value, low, high = (math.nan,) * 3
        if n := len(samples):
            value, low, high = interval(samples, statistic, self.generator(name))
        base = interval(rival, statistic, self.generator(f"{name}/baseline"))[0] if len(rival) else None
        finding = Finding(
            test, source, value, low, high, n, rule.unit, statistic, rule.bound_text(),
            findings.judge(rule, low, high, n), self.notebook, self.profile, rule.baseline, base, note,
        )  # fmt: skip
        self.found = [f for f in self.found if (f.test, f.source) != (test, source)] + [finding]
        return finding

    def fingerprint(self, name: str, value: Tensor | float, *, tolerance: float = staleness.TOLERANCE) -> None:
        """Records a number that no claim asks for, but that the smoke run must give again. tolerance: share of it that
        another machine may be off."""
        self.marks[name] = staleness.mark(float(value), tolerance=tolerance)

    def _fingerprint(self) -> staleness.Fingerprint:
        """What this run measured, but for what the clock decides and what only this machine has."""
        marks = dict(self.marks)
        for f in self.found:
            rule, name = self.criterion(f.test), f.test if f.source == "synthetic" else f"{f.test}, {f.source}"
            if rule.clock or f.source.startswith("your "):
                continue
            scale = rule.bound or 1.0  # of a difference that is compared with 0: a thousandth of its unit is rounding
            marks |= {name: staleness.mark(f.value, scale), f"{name}: n": staleness.Mark(f.n, 0)}
            if f.baseline_value is not None:
                marks[f"{name}: baseline"] = staleness.mark(f.baseline_value, scale)
        return marks

    def stale(self) -> list[str]:
        """Lists how this smoke run differs from its record, a phrase each."""
        if self.profile != "smoke" or not self.recorded.source_hash:
            return []
        if not self.recorded.fingerprint:
            remedy = f"python -m suite regenerate --fingerprints {staleness.number_of(self.notebook)}"
            return [f"the record has no fingerprint: {remedy}"]
        return self.recorded.moved(self._measured())

    def settled(self) -> list[Finding]:
        """Returns this run's findings, with the recorded ones where this run may not judge. A test that needs the full
        profile or real recordings repeats what the last full run recorded, so that verdicts read the same on every
        machine. A full run takes over old rows only where the notebook's code is still theirs."""
        recorded = {(f.test, f.source): f for f in self.recorded.findings}
        fresh = {(f.test, f.source): f for f in self.found}
        away = {k: r for k, r in recorded.items() if self.data is None and k not in fresh and r.source != "synthetic"}
        if self.profile == "full":
            return [*(away if self.recorded.source_hash == self.code else {}).values(), *fresh.values()]
        slow = {k: r for k, r in recorded.items() if "full" in self.criterion(r.test).needs}
        return [value for key, value in (recorded | fresh | slow).items() if key in fresh | away | slow]

    def findings(self, *, fold: bool = False) -> None:
        """Shows every number measured in this run; fold: behind a click."""
        rows = [
            {"test": f.test, "source": f.source,
             f"measured (95 % interval), {self.profile}": f"{f.statistic} {f.value_text()}", "bound": f.bound,
             "baseline": "" if f.baseline_value is None else f"{f.baseline}: {f.baseline_value:.3g} {f.unit}",
             "note": f.note}
            for f in self.found
        ]  # fmt: skip
        self.fold("Every number measured in this run", rows) if fold else self.table(rows)

    def verdicts(self, *, fold: bool = False) -> None:
        """Shows the verdict table without any measured number, the same in both profiles; fold: behind a click.

        A source that only this machine has ("your SMPL") is judged in the numbers above, not here.
        """
        shown = [f for f in self.settled() if not f.source.startswith("your ")]
        rows = [
            {"test": f.test, "source": f.source, "we ask": self.criterion(f.test).definition, "bound": f.bound,
             "verdict": f"**{f.verdict}**"}
            for f in sorted(shown, key=lambda f: (f.test, f.source != "synthetic", f.source))
        ]  # fmt: skip
        self.fold("Test, bound and verdict", rows) if fold else self.table(rows)

    def close(self) -> None:
        """Writes this run's record into $MOTIONLAB_RESULTS, if set; compares a smoke run with the one on file.

        Raises:
            StaleRecord: a smoke run differs from its fingerprint, and $MOTIONLAB_VERIFY is set.
        """
        now = self._measured()
        if folder := os.environ.get("MOTIONLAB_RESULTS"):
            findings.save_record(Path(folder) / f"{staleness.number_of(self.notebook)}.json", now)
        if moved := self.stale():
            if os.environ.get("MOTIONLAB_VERIFY"):
                raise staleness.StaleRecord(self.notebook, moved, self.recorded.provenance)
            self.say("**The record is not what this code gives** (or a knob was turned): " + "; ".join(moved) + ".")
        took, worked = now.provenance["seconds"], now.provenance["processor seconds"]
        self.say(f"Ran in {took} s, {worked} s of processor time; {len(self.found)} findings.")

    def _measured(self) -> Record:
        """The record of this run."""
        provenance = {name: version(name) for name in ("torch", "kornia", "pyvista", "numpy")}
        provenance |= {"profile": self.profile, "seed": str(self.seed), "python": platform.python_version()}
        worked = sum(os.times()[:4])  # with what it waited for
        provenance |= {"seconds": f"{time.perf_counter() - self.opened:.0f}", "processor seconds": f"{worked:.0f}"}
        marks = self._fingerprint() if self.profile == "smoke" else {}
        seen = {"weights": checkpoint.loaded(), "recordings": staleness.recordings_digest(self.data)}
        return Record(self.notebook, self.code, tuple(self.settled()), provenance, marks, **seen)


def _markdown_table(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows as a Markdown table; an empty list says so."""
    if not rows:
        return "*(no rows)*"
    head = list(rows[0])
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(_cell(row[key]) for key in head) + " |" for row in rows]
    return "\n".join(lines)


def _cell(value: object) -> str:
    return (f"{value:.3g}" if isinstance(value, float) else str(value)).replace("|", "\\|").replace("\n", " ")
