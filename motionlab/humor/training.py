"""Training of the transition prior: from single steps to roll-outs on its own predictions; resumable to the bit.

Source: HuMoR (Rempe et al. 2021), section 3.3 and its official training code: first every step sees the truth, then the
truth with falling probability (scheduled sampling), then only the model's own states; Adamax; KL annealed.
Differs, in the compact recipe: see ``losses``; gradients flow through ``chain`` steps before the state is cut off (the
official code cuts off every one) and are clipped; the KL weight starts at a tenth; truth or prediction is drawn per
window, not per batch; cosine decay; the shipped weights are a moving average; a loss that is not finite ends the run.
Differs, in both: steps instead of epochs, so that KL weight and truth change at every step; windows drawn evenly over
all frames, not over clips, and from mirror images too; the last weights ship, not those with the least loss on
validation; no loss on vertices; gradients that are infinite, not just NaN, are skipped too (official) or end the run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab import kept
from motionlab.errors import DataError
from motionlab.humor import losses
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.examples import Examples
from motionlab.humor.state import globalise, heading, localise


@dataclass(frozen=True)
class Recipe:
    """What a training run depends on, with its examples.

    width: of the networks. steps: of the optimiser. batch: windows of ``length`` transitions each. chain: transitions
    that gradients flow through. supervised, sampled: shares of the steps that see the truth, and by which it has faded
    out. kl: weight per nat; annealed: share of the steps over which it grows to that (from a tenth it gets there a
    little sooner). kinematics, contact, slide: weights of those losses. average: of the weights, per step. varied,
    varied_recordings: copies on other bodies, held otherwise, of every synthetic motion and every recording (see
    ``variety``). official: its losses, scales, schedules and what it does about numbers that are not finite.
    """

    width: int = 512
    steps: int = 6600
    batch: int = 160
    length: int = 10
    chain: int = 5
    lr: float = 4e-3
    supervised: float = 0.1
    sampled: float = 0.35
    kl: float = 0.006
    annealed: float = 0.2
    kinematics: float = 0.5
    contact: float = 0.7
    slide: float = 0.1
    average: float = 0.998
    varied: int = 1
    varied_recordings: int = 2
    seed: int = 0
    official: bool = False


#: "official": 200 epochs of the official training set are about 400,000 steps; its rate falls at epochs 50, 80 and 140.
PRESETS = {
    "compact": Recipe(),
    "official": Recipe(
        width=1024, steps=400_000, batch=200, chain=1, lr=1e-4, supervised=0.05, sampled=0.10, kl=4e-4, annealed=0.25,
        kinematics=1.0, contact=0.01, slide=0.01, average=0.0, varied=0, varied_recordings=0,
        official=True,
    ),
}  # fmt: skip
DECAYS = (0.25, 0.40, 0.70)
GIVE_UP = 100  # batches in a row whose loss or gradients are not finite


@dataclass(eq=False)
class Training:
    """A run: everything that decides how it goes on.

    curve: every ``every`` steps a row of step, loss per part and what ``validate`` returned; with the official recipe
    also the batches skipped so far, and no losses where the last one was. in_a_row: batches skipped since a good one.
    """

    recipe: Recipe
    examples: Examples
    scales: losses.Scales = field(init=False)
    model: Cvae = field(init=False)
    average: dict[str, Tensor] = field(init=False)
    curve: list[dict] = field(default_factory=list)
    step: int = 0
    skipped: int = 0
    in_a_row: int = 0

    def __post_init__(self) -> None:
        recipe, data = self.recipe, self.examples
        if data.length != recipe.length + 1:
            raise DataError(f"windows of {data.length} frames for {recipe.length} transitions")
        self.generator = torch.Generator().manual_seed(recipe.seed)
        self.scales = losses.Scales.none()
        if not recipe.official:
            some, _, _ = data.draw(2000, torch.Generator().manual_seed(recipe.seed))
            self.scales = losses.Scales.measure(*losses.pairs(some))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            self.model = Cvae(recipe.width)
        self.average = {name: value.clone() for name, value in self.model.state_dict().items()}
        self.optimiser = torch.optim.Adamax(self.model.parameters(), lr=recipe.lr)

    @property
    def prior(self) -> Cvae:
        """The averaged model as it is shipped: official architecture, frozen."""
        model = Cvae(self.recipe.width)
        model.load_state_dict(self.average)
        return self.scales.folded(model).frozen()

    def run(
        self,
        *,
        until: int | None = None,
        keep: Path | None = None,
        validate: Callable[[Cvae], dict] | None = None,
        every: int = 250,
        progress: bool = False,
    ) -> Training:
        """Train on to the last step, or to ``until``; write the state to ``keep`` every ``every`` steps and at the end.

        Ctrl-C keeps what was reached and raises on.
        """
        last = min(self.recipe.steps, until or self.recipe.steps)
        bar = tqdm(total=self.recipe.steps, initial=self.step, disable=not progress, unit="step")
        began = time.monotonic()
        try:
            while self.step < last:
                row = self._advance()
                bar.update()
                bar.set_postfix({name: f"{row[name]:.4g}" for name in ("loss", "kl", "skipped") if name in row})
                if self.step % every == 0 or self.step == last:
                    row |= validate(self.prior) if validate else {}
                    self.curve.append({"step": self.step, **row})
                    if progress and validate:
                        tqdm.write(f"{self.step}: " + ", ".join(f"{k} {v:.3g}" for k, v in row.items()))
                    if keep:
                        self.save(keep)
        except KeyboardInterrupt:
            if keep:
                self.save(keep)
            raise
        finally:
            bar.close()
        self.seconds = time.monotonic() - began
        return self

    def _advance(self) -> dict[str, float]:
        recipe, share = self.recipe, self.step / self.recipe.steps
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.lr * self._rate(share)
        truth = min(1.0, max(0.0, 1 - (share - recipe.supervised) / (recipe.sampled - recipe.supervised)))
        states, contacts, offsets = self.examples.draw(recipe.batch, self.generator)
        x, steps, targets = states[:, 0], [], []
        for t in range(recipe.length):
            frame = heading(x)
            past = localise(x, frame)
            now = localise(states[:, t + 1], heading(states[:, t]) if recipe.official else frame)
            found = losses.predict(self.model, self.scales, past, now, self.generator)
            steps.append(found)
            targets.append(now)
            given = torch.rand(1 if recipe.official else recipe.batch, 1, generator=self.generator) < truth
            x = torch.where(given, states[:, t + 1], globalise(found.after, frame))
            if (t + 1) % recipe.chain == 0:
                x = x.detach()
        together = losses.Predicted(
            torch.cat([each.after for each in steps]), torch.cat([each.logits for each in steps]),
            Gaussian(*map(torch.cat, zip(*(each.q for each in steps), strict=True))),
            Gaussian(*map(torch.cat, zip(*(each.p for each in steps), strict=True))),
        )  # fmt: skip
        parts = losses.compare(
            together, torch.cat(targets), contacts[:, 1:].transpose(0, 1).flatten(0, 1),
            offsets.repeat(recipe.length, 1, 1), official=recipe.official,
        )  # fmt: skip
        weights = {
            "reconstruction": 1.0, "kinematics": recipe.kinematics, "kl": self._kl(share), "contact": recipe.contact,
            "slide": recipe.slide,
        }  # fmt: skip
        loss = sum(w * parts[name] for name, w in weights.items())
        used = self._descend(loss)
        self.step += 1
        if used:
            keep = min(recipe.average, (1 + self.step) / (10 + self.step))
            with torch.no_grad():
                for name, value in self.model.state_dict().items():
                    self.average[name].lerp_(value, 1 - keep)
        row = {"loss": loss.item()} | {name: value.item() for name, value in parts.items()} if used else {}
        return row | ({"skipped": self.skipped} if recipe.official else {})

    def _descend(self, loss: Tensor) -> bool:
        """One step of the optimiser; False, and nothing changed, for a batch that the official recipe skips."""
        parameters, official = list(self.model.parameters()), self.recipe.official
        norm = torch.tensor(math.nan)
        self.optimiser.zero_grad()
        if loss.isfinite():
            loss.backward()
            norm = (
                torch.nn.utils.get_total_norm([p.grad for p in parameters])
                if official else torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            )  # fmt: skip
        if norm.isfinite():
            self.optimiser.step()
            self.in_a_row = 0
            return True
        self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
        if official and self.in_a_row < GIVE_UP:
            return False
        what = "the gradient" if loss.isfinite() else "the loss"
        what += f" is not finite, {GIVE_UP} batches in a row" if official else " is not finite"
        raise DataError(what, place=f"step {self.step}", remedy="lower the learning rate")

    def _kl(self, share: float) -> float:
        """Weight of the KL divergence."""
        return self.recipe.kl * min(1.0, (0.0 if self.recipe.official else 0.1) + share / self.recipe.annealed)

    def _rate(self, share: float) -> float:
        if self.recipe.official:
            return 0.5 ** sum(share >= at for at in DECAYS)
        return min(1.0, (self.step + 1) / 50) * (0.51 + 0.49 * math.cos(math.pi * share))

    def save(self, path: Path) -> None:
        """Write all that ``resume`` needs, whole or not at all."""
        content = {
            "recipe": asdict(self.recipe), "examples": self.examples.digest, "step": self.step,
            "curve": self.curve, "model": self.model.state_dict(), "average": self.average,
            "optimiser": self.optimiser.state_dict(), "generator": self.generator.get_state(),
            "skipped": (self.skipped, self.in_a_row),
        }  # fmt: skip
        kept.write(path, content)


def kept_recipe(path: Path | str) -> Recipe:
    """The recipe of a saved run.

    Raises:
        DataError: the file is missing or damaged.
    """
    return _read(path)[0]


def resume(path: Path | str, examples: Examples) -> Training:
    """A run as it was when it was saved; it goes on as if it had never stopped.

    Raises:
        DataError: the file is missing, damaged, or was trained on other examples.
    """
    recipe, found = _read(path)
    if found.get("examples") != examples.digest:
        raise DataError("trained on other examples", path=path, remedy=kept.AFRESH)
    run = Training(recipe, examples)
    with kept.reading(path):
        run.model.load_state_dict(found["model"])
        run.average = found["average"]
        run.optimiser.load_state_dict(found["optimiser"])
        run.generator.set_state(found["generator"])
        run.step, run.curve = found["step"], found["curve"]
        run.skipped, run.in_a_row = found.get("skipped", (0, 0))
    return run


def _read(path: Path | str) -> tuple[Recipe, dict]:
    found = kept.read(path)
    with kept.reading(path):
        return Recipe(**found["recipe"]), found
