"""Trains networks side by side on a GPU that is lent for minutes: every step of each is one CUDA graph on its stream.

    python tests/bench/gpu/train.py pack FOLDER windows.npz      # here: 28 MB
    python tests/bench/gpu/train.py run windows.npz plan.json OUT    # there

plan.json: {"seconds": 430, "runs": {"T": {"recipe": {...}, "share": 1.0}, "P": {"plain": {...}, "start": "P.pt"}}},
recipes of ``CompleterRecipe`` or ``DenoiserRecipe``. Each run ends after its share of the seconds, its rate falls by
that time, and how many steps come out is written beside the weights. OUT/NAME.pt holds float16 averages.

Differs from the library: no dropout in attention; Adam's second beta is 0.98 for denoisers, too; no masks of what goes
on; no completer of what was smoothed.

Learnt on 2026-11-27 with 15 minutes of an H100 (docs/experiments.md): a start takes 60 s; what launches kernels is the
bottleneck, so that 12 networks with batch 64 took 24 ms a round, 7 with batch 256 34 ms; what comes back is 64 MiB.
The machine gets the branch that is checked out: an orphan one with this folder, ``motionlab`` and the windows. What ran
there was a draft of these files, with the same losses; as they are here they have run on a CPU alone.
"""

from __future__ import annotations

import importlib.util
import json
import lzma
import math
import sys
import threading
import time
import types
from pathlib import Path

import numpy as np
import torch

if importlib.util.find_spec("kornia") is None:  # not on that machine, and not asked for
    for _name in ("kornia", "kornia.geometry"):
        sys.modules[_name] = types.ModuleType(_name)
        sys.modules[_name].conversions = sys.modules[_name].geometry = None
sys.path.insert(0, str(Path(__file__).parents[3]))

from motionlab import rotation
from motionlab.diffusion.completer import Completer, CompleterRecipe
from motionlab.diffusion.features import Normaliser, sizes
from motionlab.diffusion.model import DenoiserRecipe
from motionlab.diffusion.windows import Windows
from tests.bench.gpu import steps

_HEARD = ("size", "dropout", "noising", "steps", "batch", "lr", "warm_up", "average", "bf16", "seed")
_STEP = 6e-4  # radians and metres: what windows are rounded to, half of it off at most


def pack(windows: Windows, path: str) -> None:
    """Writes windows by person on the standard body, some of joints that were not recorded, as differences in time."""
    turns, counts = torch.cat([rotation.log(x) for x in windows.rot.split(20_000)]), windows.clip.bincount()
    turns = torch.cat([rotation.unroll_axis_angle(x, dim=0) for x in turns.split(counts.tolist())])
    whole = (torch.cat((turns.flatten(1), windows.root), 1) / _STEP).round().int()
    starts = counts.cumsum(0) - counts
    moved = torch.cat((whole[:1], whole.diff(dim=0)))
    moved[starts] = 0
    if moved.abs().max() > 32767:
        raise ValueError("a motion that jumps by more than 20 m or rad in a frame")
    low, high = (b.astype(np.uint8).T.tobytes() for b in ((moved.numpy() & 255), (moved.numpy() >> 8 & 255)))
    shut = lambda x: np.frombuffer(lzma.compress(x, preset=4), np.uint8)  # noqa: E731
    np.savez(
        path, counts=counts, first=whole[starts], seen=windows.seen, people=windows.people, moved=shut(low + high),
        contacts=shut(np.packbits(windows.contacts.numpy() > 0.5).tobytes()),
    )  # fmt: skip


def unpacked(path: str, device: torch.device) -> steps.Data:
    """Reads what ``pack`` wrote."""
    found = np.load(path)
    counts, seen, people = (torch.from_numpy(found[name]) for name in ("counts", "seen", "people"))
    opened = lambda name: np.frombuffer(lzma.decompress(found[name].tobytes()), np.uint8)  # noqa: E731
    low, high = opened("moved").astype(np.uint16).reshape(2, -1, int(counts.sum()))
    moved = torch.from_numpy((low | high << 8).view(np.int16).T.astype(np.int64)).to(device)
    clip, starts = torch.repeat_interleave(torch.arange(len(counts)), counts), counts.cumsum(0) - counts
    total = moved.cumsum(0)
    since = total[starts.to(device)] - torch.from_numpy(found["first"]).to(total)
    numbers = (total - since[clip.to(device)]).float() * _STEP
    rot = torch.cat([rotation.exp(x.unflatten(1, (-1, 3))) for x in numbers[:, :-3].split(50_000)])
    bits = np.unpackbits(opened("contacts"))[: len(clip) * steps.C].reshape(-1, steps.C)
    return steps.Data(numbers[:, -3:], rot, torch.from_numpy(bits).float().to(device), clip, seen, people)


class Run:
    """One network in training. how: its entry of the plan."""

    def __init__(self, name: str, how: dict, k: steps.Constants, data: steps.Data, table: steps.Masks) -> None:
        self.name, self.how, self.k, self.data, self.table, self.done = name, how, k, data, table, 0
        drawn = torch.Generator(k.device).manual_seed(0) if k.device.type != "meta" else None
        root, rot, contacts, _ = data.draw(2000, k, drawn)
        if "plain" in how:
            if strange := set(how["plain"]) - set(_HEARD):
                raise ValueError(f"{name}: {', '.join(sorted(strange))}: of a denoiser it hears {', '.join(_HEARD)}")
            self.recipe = DenoiserRecipe(**how["plain"])
            torch.manual_seed(self.recipe.seed)
            net, numbers = self.recipe.denoiser(), steps.numbers_of(root, rot, contacts)
            layers = net.seqTransEncoder.layers
            usual = Normaliser.measure(numbers, self.recipe.layout) if drawn else None  # which reads values
            self.units = (usual.mean, usual.scale) if drawn else (numbers[0, 0], numbers[0, 0])
            left = self.recipe.schedule.alpha_bar
            self.signal, self.noise = (x.float().sqrt().to(k.device) for x in (left, 1 - left))
            self.counts = self.recipe.weights
        else:
            self.recipe = CompleterRecipe.read(how["recipe"])
            if strange := {name for name, _ in self.recipe.kinds} - set(steps.ORDER):
                raise ValueError(f"{name}: {', '.join(sorted(strange))}: of masks it draws {', '.join(steps.ORDER)}")
            if self.recipe.refines:
                raise ValueError(f"{name}: rough: it shows nobody what was smoothed")
            torch.manual_seed(self.recipe.seed)
            net = Completer(self.recipe)
            net.mean, net.scale = sizes(steps.rows(root, rot, contacts, k))
            self.units, layers = net.sizes, net.encoder.layers
            odds = torch.tensor([dict(self.recipe.kinds).get(name, 0.0) for name in steps.ORDER])
            self.odds = (odds / odds.sum()).cumsum(0)[:-1].to(k.device)
        for layer in layers:
            layer.self_attn.dropout = 0.0  # its mask is drawn twice, and graphs side by side would draw two
        if "start" in how:
            kept = torch.load(how["start"], map_location="cpu")["weights"]
            net.load_state_dict(net.state_dict() | {name: x.float() for name, x in kept.items()})
        self.net = net.to(k.device).train()
        self.weights = list(self.net.parameters())
        self.average = [x.detach().clone() for x in self.weights]
        zero = lambda: torch.zeros((), device=k.device)  # noqa: E731
        self.rate, self.step, self.total, self.loss = zero(), zero(), zero() + self.recipe.steps, zero()
        self.generator = torch.Generator(k.device).manual_seed(self.recipe.seed) if drawn else None
        decay = 0.0 if "plain" in how else self.recipe.decay
        opt = {"lr": self.rate, "weight_decay": decay, "betas": (0.9, 0.98), "capturable": True, "fused": True}
        self.optimiser = torch.optim.AdamW(self.weights, **opt) if k.device.type == "cuda" else None

    def _loss(self) -> torch.Tensor:
        k, draws, size = self.k, self.generator, self.recipe.batch
        with torch.no_grad():
            if "plain" not in self.how:
                blind = self.recipe.pure_noise_share if self.recipe.diffusion else None
                batch = steps.drawn(size, self.data, self.table, self.odds, blind, k, draws)
            else:
                *motion, seen = self.data.draw(size, k, draws)
                truth = (steps.numbers_of(*motion) - self.units[0]) / self.units[1]
                t = (torch.rand(size, device=k.device, generator=draws) * len(self.signal)).long()
                noise = torch.randn(truth.shape, device=k.device, generator=draws)
                shown = self.signal[t][:, None, None] * truth + self.noise[t][:, None, None] * noise
        if "plain" not in self.how:
            *batch, noise = batch
            return steps.completer_loss(self.net, *batch, self.units, noise, k)
        with torch.autocast("cuda", torch.bfloat16, enabled=k.device.type == "cuda", cache_enabled=False):
            said = self.net(shown, t)
        return steps.plain_loss(said.float(), truth, *self.units, self.counts, seen[:, k.owners], k)

    def advance(self) -> None:
        """One step, all of it on the device; a gradient that is not finite counts as none."""
        with torch.no_grad():
            warm = ((self.step + 1) / self.recipe.warm_up).clamp(max=1.0)
            past = math.pi * (self.step / self.total).clamp(max=1.0)
            self.rate.copy_(self.recipe.lr * warm * (0.51 + 0.49 * past.cos()))
        loss = self._loss()
        slopes = torch.autograd.grad(loss, self.weights)
        with torch.no_grad():
            size = torch.stack([x.square().sum() for x in slopes]).sum().sqrt()
            share = torch.where(size.isfinite(), (1.0 / (size + 1e-6)).clamp(max=1.0), 0.0)
            for weight, slope in zip(self.weights, slopes, strict=True):
                weight.grad = torch.empty_like(weight) if weight.grad is None else weight.grad
                weight.grad.copy_(torch.where(size.isfinite(), slope * share, 0.0))
            if self.optimiser:
                self.optimiser.step()
            self.step += 1
            keep = ((1 + self.step) / (10 + self.step)).clamp(max=self.recipe.average)
            for average, weight in zip(self.average, self.weights, strict=True):
                average.add_((weight - average) * (1 - keep))
            self.loss.lerp_(torch.where(size.isfinite(), loss, self.loss), 0.002)

    def capture(self) -> None:
        """Makes the graph of a step."""
        self.stream, self.graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            for _ in range(3):
                self.advance()
        self.stream.synchronize()
        self.graph.register_generator_state(self.generator)
        with torch.cuda.graph(self.graph, stream=self.stream, capture_error_mode="thread_local"):
            self.advance()
        self.step.zero_(), self.loss.zero_()

    def go(self, until: float) -> None:
        """Trains until a time."""
        with torch.cuda.stream(self.stream):
            while time.time() < until:
                self.graph.replay()
                self.done += 1
                if self.done % 20 == 0:
                    self.stream.synchronize()
            self.stream.synchronize()

    @property
    def left(self) -> float:
        """The loss, a mean over some 500 steps."""
        return float(self.loss) / max(1 - 0.998**self.done, 1e-9)

    @property
    def state(self) -> dict:
        """Averaged weights as float16, measured sizes, and how many steps they took."""
        names = [name for name, _ in self.net.named_parameters()]
        kept = self.net.state_dict()
        found = {name: x.cpu() for name, x in kept.items() if name not in names}
        found |= {name: x.half().cpu() for name, x in zip(names, self.average, strict=True)}
        units = [x.cpu() for x in self.units]
        return {"weights": found, "units": units, "how": self.how, "steps": self.done, "loss": self.left}


def run(path: str, plan: str, out: str) -> None:
    """Trains what the plan says, side by side, and writes it."""
    begin, device, plan = time.time(), torch.device("cuda"), json.loads(Path(plan).read_text(encoding="utf-8"))
    torch.backends.cuda.matmul.allow_tf32 = True
    k = steps.Constants(device)
    data, table = unpacked(path, device), steps.Masks(k)
    runs = [Run(name, how, k, data, table) for name, how in plan["runs"].items()]
    for each in runs:
        each.capture()
    at, last, said = time.time(), begin + plan["seconds"], time.time()
    print(f"{at - begin:.0f} s to begin", flush=True)
    ends = {each.name: at + each.how.get("share", 1.0) * (last - at) for each in runs}
    while live := [each for each in runs if time.time() < ends[each.name]]:
        soon = time.time() + 2.5
        threads = [threading.Thread(target=each.go, args=(min(soon, ends[each.name]),)) for each in live]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        now = time.time()
        for each in live:  # by time: how many steps there will be is known at the end
            each.total.fill_(max(1.0, each.done * (ends[each.name] - at) / (now - at)))
        if now - said > 30:
            said = now
            print(f"{now - begin:.0f}", {each.name: (each.done, round(each.left, 3)) for each in runs}, flush=True)
    for each in runs:
        torch.save(each.state, Path(out) / f"{each.name}.pt")


if __name__ == "__main__":
    if sys.argv[1] == "pack":
        from motionlab.training.courses import learnt_from

        pack(learnt_from(sys.argv[2], steps.T)[0], sys.argv[3])
    else:
        run(*sys.argv[2:])
