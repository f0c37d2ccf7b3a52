"""The test cases run: every way of a model and every rival on the same windows with the same masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.bench import cases, rivals
from motionlab.bench.rivals import Rivals
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.model import Trained, silenced
from motionlab.motion import Motion

#: Each way's model and how it is used; steps are set by the trial unless they are the point.
WAYS: Mapping[str, tuple[str, Way]] = {
    "Eq. 4.10": ("free", Way()),
    "imputed": ("free", Way(put="imputed")),
    "guided": ("free", Way(put="imputed", weight=5.0)),
    "told": ("told", Way(put="imputed")),
    "told, 5 steps": ("told", Way(put="imputed", steps=5)),
    "told, one look": ("told", Way(put="imputed", steps=1)),
    "start, guided": ("free", Way(put="imputed", weight=5.0, begin=0.75)),
}
PLAIN = ("Eq. 4.10", "imputed", "guided")
#: Of these "start, guided" is the free model, begun from what the told one starts from.
TOLD = tuple(name for name in WAYS if name not in PLAIN)


@dataclass(frozen=True, eq=False)
class Bench:
    """free, told: models. rivals: fitted to training windows. steps: of the sampler."""

    free: Trained
    told: Trained
    rivals: Rivals
    steps: int = 25

    def fill(
        self, name: str, motion: Motion, known: Tensor, generator: torch.Generator, **changes: float | bool
    ) -> Motion:
        """Motions (B, T) filled by one of ``WAYS``, or by that way with ``changes`` to it.

        What is known stays as it is to the bit, unless the way leaves out the last overwrite and has no finish.
        """
        which, way = WAYS[name]
        way = replace(way, steps=min(way.steps, self.steps), **changes)
        model = self.free if which == "free" else self.told
        guess = self.start(motion, known, generator) if way.begin < 1 else None
        made = repair(model, motion, cases.columns(model.layout, known), generator, way, guess=guess)
        return made if way.put == "overwrite" and not way.last and not way.finish else cases.pasted(made, motion, known)

    def best(
        self,
        names: Sequence[str],
        practice: Motion,
        known: Tensor,
        generator: torch.Generator,
        joints: tuple[str, ...] | None = None,
        **changes: float | bool,
    ) -> str:
        """The way of the least error on windows that settings are chosen on."""
        return cases.chosen(
            names, lambda name: self.fill(name, practice, known, generator, **changes), practice, known, joints
        )

    def contest(
        self,
        motion: Motion,
        known: Tensor,
        generator: torch.Generator,
        *,
        plain: str,
        told: str,
        regression: bool = True,
        through_time: bool = False,
        **changes: float | bool,
    ) -> dict[str, Motion]:
        """Everybody's answer for the same windows. plain, told: the ways that were chosen; ``changes`` are theirs.

        regression: the rivals that know other windows. through_time: those that know only this one.
        """
        found = {}
        if regression:
            finish = int(changes.get("finish", 0))
            for name, fill in {"mean": "mean", "nearest": "nearest", "ridge": "regression"}.items():
                found[name] = getattr(self.rivals, fill)(motion, known, finish)
        if through_time:
            found |= {"hold": rivals.held(motion, known), "slerp": rivals.interpolated(motion, known)}
            found["curves"] = self.curves(motion, known, generator)
        found["Eq. 4.10"] = self.fill("Eq. 4.10", motion, known, generator)
        found["not told"] = self.fill(plain, motion, known, generator, **changes)
        found["start alone"] = self.start(motion, known, generator)
        return found | {"told": self.fill(told, motion, known, generator, **changes)}

    def start(self, motion: Motion, known: Tensor, generator: torch.Generator) -> Motion:
        """What the told model would say without its network: training motion recalled, and smooth curves."""
        return self._silent(silenced(self.told), motion, known, generator)

    def curves(self, motion: Motion, known: Tensor, generator: torch.Generator) -> Motion:
        """Smooth curves through what is known, drawn to the mean of all training windows: a start without recall."""
        model = silenced(self.told)
        model.denoiser.start.factor.zero_()
        model.denoiser.start.last = None
        return self._silent(model, motion, known, generator)

    @staticmethod
    def _silent(model: Trained, motion: Motion, known: Tensor, generator: torch.Generator) -> Motion:
        way = WAYS["told, one look"][1]
        return cases.pasted(repair(model, motion, cases.columns(model.layout, known), generator, way), motion, known)
