"""The training loop of every network: resumable to the bit, with averaged weights and skipped bad batches.

A trainer derives from :class:`TrainingRun` and adds what differs: its batches and their loss, and, where it does, what
is made of the network. A run is saved whole or not at all, and read without executing anything.

Source: Polyak and Juditsky 1992, averaged weights, here with a moving average that warms up.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from tqdm import tqdm

from motionlab.errors import DataError

AFRESH = "start afresh, without --more"


def warmed_cosine(rate: float, step: int, steps: int, warm_up: int, least: float = 0.02) -> float:
    """Computes the learning rate at a step: it rises over ``warm_up`` steps and falls by a cosine to ``least``."""
    warm = min(1.0, (step + 1) / max(warm_up, 1))
    return rate * warm * ((1 + least) / 2 + (1 - least) / 2 * math.cos(math.pi * step / steps))


def fast_halves() -> bool:
    """Whether bfloat16 is faster on this processor: on those with AVX512-BF16; on others it is slower."""
    return torch.cpu._is_avx512_bf16_supported()


def seeded(seed: int, build: Callable[[], nn.Module]) -> nn.Module:
    """Builds a network with new weights from a seed; torch's own generator stays as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


class TrainingRun(ABC):
    """A training run: everything that decides how it goes on.

    recipe: a dataclass (``Recipe``) with at least ``steps``, of the optimiser, and ``average``, the share of the
    averaged weights that stays at each step. model, average: its weights, and their moving average. generator:
    everything random is drawn from it. curve: rows of step, loss, its parts and measures. best: step, measure and
    averaged weights that the judge liked best, if there was one. skipped, in_a_row: batches without a finite gradient,
    all and since a good one; the run ends at ``give_up`` in a row. earlier: steps that its first weights had behind
    them. clip: largest norm of the gradient. warm_up, least: of the learning rate (``warmed_cosine``), where the recipe
    does not say the first. extra: what else is saved, by name.
    """

    Recipe: ClassVar[type]
    give_up, clip = 20, 1.0
    warm_up, least = 100, 0.02

    def __init__(
        self, recipe: Any, digest: str, generator: torch.Generator, model: nn.Module, optimiser: torch.optim.Optimizer,
        **extra: Any,
    ) -> None:  # fmt: skip
        self.recipe, self.digest, self.generator, self.model = recipe, digest, generator, model
        self.average = {name: value.clone() for name, value in model.state_dict().items()}
        self.optimiser, self.extra = optimiser, extra
        self.curve: list[dict] = []
        self.best: dict | None = None
        self.step = self.skipped = self.in_a_row = self.earlier = 0

    @abstractmethod
    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a new batch, and the parts that it is made of."""

    def _rate(self) -> float:
        """The learning rate at this step."""
        warm_up = getattr(self.recipe, "warm_up", self.warm_up)
        return warmed_cosine(self.recipe.lr, self.step, self.recipe.steps, warm_up, self.least)

    def _ready(self, model: nn.Module) -> Any:
        """What is used of a frozen network."""
        return model

    def _made(self, weights: dict[str, Tensor]) -> Any:
        model = deepcopy(self.model).eval().requires_grad_(False)
        model.load_state_dict(weights)
        return self._ready(model)

    @property
    def averaged(self) -> Any:
        """The model of the averaged weights as they are now, frozen."""
        return self._made(self.average)

    @property
    def shipped(self) -> Any:
        """The averaged model that the judge liked best; without a judge the last."""
        return self._made(self.best["weights"] if self.best else self.average)

    def run(
        self, *, until: int | None = None, keep: Path | None = None, every: int = 500, judge: Callable | None = None,
        judge_every: int = 2500, progress: bool = False,
    ) -> Self:  # fmt: skip
        """Trains on to the last step, or to ``until``; saves to ``keep`` every ``every`` steps and at the end.

        judge: measures of the averaged model, of which the first chooses ``best`` (less is better), every
        ``judge_every`` steps (a multiple of ``every``) and at the last one.

        Ctrl-C, as a kill, leaves what was saved last.

        Raises:
            DataError: ``give_up`` batches in a row have no finite gradient.
        """
        steps = self.recipe.steps
        last = min(steps, until or steps)
        with tqdm(total=steps, initial=self.step, disable=not progress, unit="step") as bar:
            while self.step < last:
                row = self.advance()
                bar.update()
                if self.step % every and self.step != last:
                    continue
                if judge and (self.step % judge_every == 0 or self.step == last):
                    row |= self._judged(judge)
                self.curve.append({"step": self.earlier + self.step, **row})
                if progress:
                    tqdm.write(f"{self.step}: " + ", ".join(f"{name} {value:.3g}" for name, value in row.items()))
                if keep:
                    self.save(keep)
        return self

    def advance(self) -> dict[str, float]:
        """Trains one step; returns the loss and its parts, but nothing of a batch that was skipped."""
        for group in self.optimiser.param_groups:
            group["lr"] = self._rate()
        loss, parts = self._loss()
        self.optimiser.zero_grad()
        loss.backward()
        if not nn.utils.clip_grad_norm_(self.model.parameters(), self.clip).isfinite():
            self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
            if self.in_a_row == self.give_up:
                what = f"the {'gradient' if loss.isfinite() else 'loss'} is not finite, {self.give_up} batches in a row"
                raise DataError(what, place=f"step {self.step}", remedy="lower the learning rate")
            self.step += 1
            return {"skipped": self.skipped}
        self.optimiser.step()
        self.in_a_row = 0
        self.step += 1
        keep = min(self.recipe.average, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                average = self.average[name]
                average.lerp_(value, 1 - keep) if value.is_floating_point() else average.copy_(value)
        return {"loss": loss.item(), **{name: value.item() for name, value in parts.items()}, "skipped": self.skipped}

    def _judged(self, judge: Callable) -> dict[str, float]:
        row = judge(self.averaged)
        name, value = next(iter(row.items()))
        if value < (self.best[name] if self.best else math.inf):
            weights = {key: x.clone() for key, x in self.average.items()}
            self.best = {"step": self.step, name: value, "weights": weights}
        return row

    def save(self, path: Path | str) -> None:
        """Writes all that ``resume`` needs; a reader never sees half a file."""
        path = Path(path)
        part = path.with_name(f".{path.name}.part")
        content = {
            "recipe": asdict(self.recipe), "windows": self.digest, "step": self.step, "curve": self.curve,
            "model": self.model.state_dict(), "average": self.average, "best": self.best,
            "optimiser": self.optimiser.state_dict(), "generator": self.generator.get_state(),
            "skipped": (self.skipped, self.in_a_row), "earlier": self.earlier,
        }  # fmt: skip
        torch.save(content | self.extra, part)
        part.replace(path)

    @classmethod
    def resume(cls, path: Path | str, data: Any) -> Self:
        """Reads a run on these data as it was when it was saved; it goes on as if it had never stopped.

        Raises:
            DataError: the file is missing, damaged, or was trained on other data.
        """
        try:
            found = torch.load(path, map_location="cpu", weights_only=True)
            if found["windows"] != data.digest:
                raise DataError("trained on other windows", path=path, remedy=AFRESH)
            run = cls(cls.Recipe(**found["recipe"]), data)
            run.model.load_state_dict(found["model"])
            for name, value in found["average"].items():
                run.average[name].copy_(value)
            run.optimiser.load_state_dict(found["optimiser"])
            run.generator.set_state(found["generator"])
            run.step, run.curve, run.best = found["step"], found["curve"], found["best"]
            (run.skipped, run.in_a_row), run.earlier = found["skipped"], found["earlier"]
            run.extra = {name: found[name] for name in run.extra}
        except DataError:
            raise
        except Exception as error:  # whatever it is, the file is at fault
            raise DataError(f"not a saved run ({type(error).__name__})", path=path, remedy=AFRESH) from error
        return run
