"""Training of a denoiser: guess x_0 from x_t at a random step; resumable to the bit, on one device or several.

Source: thesis 4.1.2; MDM (Tevet et al. 2022): AdamW without decay of the weights, steps drawn evenly.
Differs: warm-up, cosine decay, clipped gradients; what ships is a moving average, chosen by a judge where there is one
(MDM: by FID, by hand; thesis: by eye); dropout follows the run's own generator; not finite gradients are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab import kept
from motionlab.diffusion import handles, losses, masks
from motionlab.diffusion.denoiser import Denoiser, widened
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.sampling import noise_like
from motionlab.diffusion.spectral import Spectral, power
from motionlab.diffusion.trained import FPS, GAIN, Recipe, Trained, gain
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError
from motionlab.motion import Motion

GIVE_UP = 20  # batches in a row whose gradients are not finite
CHOOSE = ("kid", "filling error")  # the judge's measure, one of these, that chooses the checkpoint; less is better
BEGIN = "choose the preset and size that it was made with"
MEASURED = 2000  # windows that the normaliser is measured on

Judge = Callable[[Trained], dict[str, float]]


@dataclass(eq=False)
class Training:
    """A run: everything that decides how it goes on.

    accelerator: of ``accelerate.Accelerator``, for several processes with a device each: all draw the same batch, each
    takes its share, and gradients are averaged; None: one process, on ``device``. start: the model to begin from, with
    its normaliser, as for motions of one's own; None: new weights. curve: rows of step, loss per part
    and measures. best: step, KID and weights of the best average so far, if a judge said. skipped, in_a_row: batches.
    """

    recipe: Recipe
    windows: Windows
    device: torch.device | str = "cpu"
    accelerator: object | None = None
    start: Trained | None = None
    normaliser: Normaliser = field(init=False)
    model: Denoiser | Spectral = field(init=False)
    average: dict[str, Tensor] = field(init=False)
    curve: list[dict] = field(default_factory=list)
    best: dict | None = None
    step: int = 0
    skipped: int = 0
    in_a_row: int = 0

    def __post_init__(self) -> None:
        recipe, data = self.recipe, self.windows
        if data.length != recipe.frames or data.fps != FPS:
            message = f"windows of {data.length} frames at {data.fps:g} fps; expected {recipe.frames} at {FPS:g}"
            raise DataError(message, remedy="gather windows of the recipe's length from motions at 30 fps")
        self.rank, self.share = 0, 1
        if self.accelerator is not None:
            self.device = self.accelerator.device
            self.rank, self.share = self.accelerator.process_index, self.accelerator.num_processes
        if recipe.batch % self.share:
            message = f"a batch of {recipe.batch} does not divide among {self.share} processes"
            raise DataError(message, remedy="choose a multiple")
        self.layout, self.schedule = recipe.layout, recipe.schedule
        self._counts = recipe.weights.counts(self.schedule)
        some = self.layout.encode(data.draw(MEASURED, torch.Generator().manual_seed(0)))
        if self.start is not None and self.start.layout != self.layout:
            raise DataError("the model to begin from has other features", remedy=BEGIN)
        unit = recipe.root_unit
        self.normaliser = self.start.normaliser if self.start else Normaliser.measure(some, self.layout, root_unit=unit)
        self.generator = torch.Generator().manual_seed(recipe.seed)
        self.drawn_from, self.torn = self.generator.get_state(), False
        with self._torch_seeded(recipe.seed):
            self.model = recipe.denoiser()
        if recipe.linear:
            self.model.measure(self.normaliser.apply(some), self.normaliser)
        elif recipe.spectral:
            self.model.spectrum.copy_(power(self.normaliser.apply(some)))
        if (recipe.linear and recipe.recalls) or (recipe.spectral and recipe.told):
            many, clips = data.drawn(max(MEASURED, recipe.recalls), torch.Generator().manual_seed(1))
            self.model.recall(self.normaliser.apply(self.layout.encode(many)), clips)
        if self.start is not None:
            self._begin(self.start)
        self.model.to(self.device)
        self.average = {name: value.clone() for name, value in self.model.state_dict().items()}
        self.optimiser = torch.optim.AdamW(self.model.parameters(), lr=recipe.lr, weight_decay=0.0)
        self.network = self.model if self.accelerator is None else self.accelerator.prepare_model(self.model)

    def _begin(self, other: Trained) -> None:
        weights = other.denoiser.state_dict()  # of the same kind; or, if this is told what is known, told nothing
        if self.recipe.told and not other.recipe.told:
            own = {name: x for name, x in self.model.state_dict().items() if name.startswith("start.")}
            weights = own | widened(weights, self.layout.size)
        try:
            self.model.load_state_dict(weights)
        except RuntimeError as error:
            raise DataError(f"the model to begin from is another one: {error}"[:300], remedy=BEGIN) from error

    @property
    def averaged(self) -> Trained:
        """The model of averaged weights, as it is now, frozen."""
        return self._made(self.average)

    @property
    def shipped(self) -> Trained:
        """The averaged model of the least KID; without a judge the last."""
        return self._made(self.best["weights"] if self.best else self.average)

    def _made(self, weights: dict[str, Tensor]) -> Trained:
        model = deepcopy(self.model).eval().requires_grad_(False)
        model.load_state_dict(weights)
        return Trained(model, self.schedule, self.layout, self.normaliser, self.recipe)

    def run(
        self,
        *,
        until: int | None = None,
        keep: Path | None = None,
        held: Motion | None = None,
        judge: Judge | None = None,
        every: int = 500,
        judge_every: int = 2500,
        judge_from: float = 0.0,
        progress: bool = False,
    ) -> Training:
        """Train on to the last step, or to ``until``; write the state to ``keep`` every ``every`` steps and at the end.

        Args:
            held: windows (B, T) on which the error of x_0 is measured every ``every`` steps. judge: measures of the
                averaged model, every ``judge_every`` steps (a multiple of ``every``) and at the last step; none in the
                first ``judge_from`` of all steps.
        Ctrl-C keeps what was reached (between weights and their average: what was written last) and raises on.
        """
        last = min(self.recipe.steps, until or self.recipe.steps)
        keep = keep if self.rank == 0 else None
        bar = tqdm(total=self.recipe.steps, initial=self.step, disable=not progress or self.rank > 0, unit="step")
        try:
            while self.step < last:
                row = self._advance()
                bar.update()
                if self.step % every and self.step != last:
                    continue
                due = self.step % judge_every == 0 and self.step >= judge_from * self.recipe.steps
                row |= self._measured(held, judge if due or self.step == last else None)
                self.curve.append({"step": self.step, **row})
                bar.set_postfix({name: f"{row[name]:.3g}" for name in ("loss", GAIN, *CHOOSE) if name in row})
                if keep:
                    self.save(keep)
        except KeyboardInterrupt:
            if keep and not self.torn:
                self.generator.set_state(self.drawn_from)
                self.save(keep)
            raise
        finally:
            bar.close()
        return self

    def _measured(self, held: Motion | None, judge: Judge | None) -> dict[str, float]:
        if self.rank or (held is None and judge is None):
            return {}
        model, row = self.averaged, {}
        if held is not None:
            row = model.errors(held, torch.Generator().manual_seed(0))
            row |= gain(model, held, row) if self.recipe.spectral else {}
        if judge is not None:
            row |= judge(model)
            chosen = next((name for name in CHOOSE if name in row), None)
            if chosen and row[chosen] < (self.best[chosen] if self.best else math.inf):
                weights = {name: value.clone() for name, value in self.average.items()}
                self.best = {"step": self.step, chosen: row[chosen], "weights": weights}
        return row

    def _advance(self) -> dict[str, float]:
        recipe = self.recipe
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.rate(self.step)
        motion, clips = self.windows.drawn(recipe.batch, self.generator)
        x0 = self.normaliser.apply(self.layout.encode(motion))
        t = torch.randint(len(self.schedule), (recipe.batch,), generator=self.generator)
        if recipe.blind:
            blind = torch.rand(recipe.batch, generator=self.generator) < recipe.blind
            t = torch.where(blind, len(self.schedule) - 1, t)
        xt = self.schedule.noised(x0, t, noise_like(x0, self.generator))
        signal, count = self.schedule.alpha_bar[t].to(x0), self._counts[t].to(x0)
        known = masks.draw(self.layout, recipe.frames, recipe.batch, self.generator) if recipe.told else None
        held = handles.draw(motion, self.generator) if recipe.handles or recipe.weights.handles else None
        seed = int(torch.randint(2**31, (), generator=self.generator)) + self.rank
        batch = (x0, xt, self.schedule.stamps[t], motion.skeleton.offsets[:, 0], signal, count, known, held, clips)
        x0, xt, stamps, offsets, signal, count, known, held, clips = (
            None if each is None else each[self.rank :: self.share].to(self.device) for each in batch
        )
        told = {"known": x0, "mask": known} if recipe.told else {}
        told |= {"own": clips} if recipe.recalls else {}
        told |= {"handles": held} if recipe.handles else {}
        with self._torch_seeded(seed), torch.autocast(torch.device(self.device).type, torch.bfloat16, recipe.bf16):
            estimate = self.network(xt, stamps, **told).float()
        weights = recipe.weights.at(self.step / recipe.steps, self.layout, recipe.told)
        trust = signal if known is None else torch.maximum(signal, known.float().mean((1, 2)))
        parts = losses.compare(
            estimate, x0, self.layout, self.normaliser, offsets, parts=weights, gate=recipe.weights.gate,
            even=recipe.weights.even, known=known, handles=held, trust=trust if recipe.weights.by_signal else None,
            count=count,
        )  # fmt: skip
        loss = sum(weight * parts[name] for name, weight in weights.items())
        used = self._descend(loss)
        self.step += 1
        if used:
            keep = min(recipe.average, (1 + self.step) / (10 + self.step))
            with torch.no_grad():
                for name, value in self.model.state_dict().items():
                    self.average[name].lerp_(value, 1 - keep)
        self.drawn_from, self.torn = self.generator.get_state(), False
        row = {"loss": loss.item()} | {name: value.item() for name, value in parts.items()}
        return (row if used else {}) | {"skipped": self.skipped}

    def _descend(self, loss: Tensor) -> bool:
        """One step of the optimiser; False, and nothing changed, where the gradients are not finite."""
        self.optimiser.zero_grad()
        loss.backward() if self.accelerator is None else self.accelerator.backward(loss)
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.recipe.clip)
        self.torn = True
        if norm.isfinite():  # of averaged gradients: all processes agree
            self.optimiser.step()
            self.in_a_row = 0
            return True
        self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
        if self.in_a_row < GIVE_UP:
            return False
        message = f"loss or gradients are not finite, {GIVE_UP} batches in a row"
        raise DataError(message, place=f"step {self.step}", remedy="lower the learning rate")

    @contextmanager
    def _torch_seeded(self, seed: int) -> Iterator[None]:
        """torch's global generators, which dropout and new layers draw from, seeded here and as before behind."""
        device = torch.device(self.device)
        with torch.random.fork_rng(devices=[device.index or 0] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            yield

    def save(self, path: Path) -> None:
        """Write all that ``resume`` needs, whole or not at all."""
        content = {
            "recipe": asdict(self.recipe), "windows": self.windows.digest, "step": self.step, "curve": self.curve,
            "model": self.model.state_dict(), "average": self.average, "best": self.best,
            "optimiser": self.optimiser.state_dict(), "generator": self.generator.get_state(),
            "skipped": (self.skipped, self.in_a_row), "normaliser": (self.normaliser.mean, self.normaliser.scale),
        }  # fmt: skip
        kept.write(path, content)


def kept_recipe(path: Path | str) -> Recipe:
    """The recipe of a saved run.

    Raises:
        DataError: the file is missing or damaged.
    """
    return _read(path)[0]


def resume(
    path: Path | str, windows: Windows, device: torch.device | str = "cpu", accelerator: object | None = None
) -> Training:
    """A run as it was when it was saved; it goes on as if it had never stopped.

    Raises:
        DataError: the file is missing, damaged, or was trained on other windows.
    """
    recipe, found = _read(path)
    if found.get("windows") != windows.digest:
        raise DataError("trained on other windows", path=path, remedy=kept.AFRESH)
    run = Training(recipe, windows, device, accelerator)
    with kept.reading(path):
        run.model.load_state_dict(found["model"])
        for name, value in found["average"].items():
            run.average[name].copy_(value)
        run.optimiser.load_state_dict(found["optimiser"])
        run.generator.set_state(found["generator"])
        run.drawn_from = run.generator.get_state()
        run.step, run.curve, run.best = found["step"], found["curve"], found["best"]
        run.skipped, run.in_a_row = found["skipped"]
        run.normaliser = Normaliser(*found["normaliser"])
    return run


def _read(path: Path | str) -> tuple[Recipe, dict]:
    found = kept.read(path)
    with kept.reading(path):
        return Recipe.read(found["recipe"]), found
