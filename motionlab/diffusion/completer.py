"""A plain network that completes motions: given any part of a window, it adds to smooth curves through it.

    model = load("completer")
    made = model.complete(motion, known)        # known (B, T, 24): True where a unit of a frame is known

With ``diffusion`` it models what is to be added by diffusion: r, of about unit size, is shown as cos(a) r + sin(a) e
with noise e, from the angle a = pi / 2, where it says nothing, down to 0; the network says sin(a) r - cos(a) e, so that
it need not copy what it sees. The noise moves as what is to be added does (``motion_noise``): with other noise in every
frame, draws tremble and are too sure. Without, it is the same network at pi / 2 alone: one answer.

Source: thesis 4.2.1 and 4.4.1 (known parts as input), Eq. 4.3; Oreshkin et al. 2023, delta-interpolator (what to add to
an interpolation); Salimans and Ho 2022 (angles, v); Song et al. 2021 (DDIM). A pre-norm transformer encoder (Vaswani et
al. 2017; Xiong et al. 2020).
"""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab import checkpoint
from motionlab.baselines import smooth_curves
from motionlab.diffusion.features import MADE, MADE_AT, OWNERS, SIZE, UNITS, made, motion_of, restore_known, states
from motionlab.errors import ShapeError
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

_TIMES = 2  # numbers that say how far the known frames around are
_TREMBLE = 10.0  # per radian: what a model that refines is told instead
_FAR = 2.0  # seconds that count as no such frame
_SHIFT = 5.0  # of the schedule: half of the steps are where the signal is below a fifth of the noise
_WAVES = 8  # frequencies that an angle is told in
_BEND = 1.0  # Hz: from here on less and less of a motion moves
_LOUD = 0.6  # units of noise: about as large as what is to be added; with more of it draws shake
_ROOT = 0.1  # of the root's place
#: Odds of each kind of mask in training.
KINDS = (
    ("between", 0.3), ("keys", 0.15), ("gap", 0.1), ("legs", 0.25), ("joints", 0.12), ("entries", 0.03),
    ("frames", 0.05),
)  # fmt: skip


@dataclass(frozen=True)
class CompleterRecipe:
    """What a training run depends on, with its windows.

    frames: of a window. size, layers, patch: width and depth of the encoder, frames in a token. kinds: odds of each
    kind of mask (``windows.draw_units``). refines: it corrects a motion that trembled and was smoothed, of which
    nothing is known for certain. diffusion: draws, not one answer; pure_noise_share: of its windows. The learning rate
    rises over ``warm_up`` steps to ``lr`` and falls by a cosine to a fiftieth. decay: of the weights. average: of
    them, per step.
    """

    frames: int = 60
    size: int = 256
    layers: int = 4
    patch: int = 2
    kinds: tuple[tuple[str, float], ...] = KINDS
    diffusion: bool = False
    refines: bool = False
    pure_noise_share: float = 0.2
    steps: int = 20_000
    batch: int = 64
    lr: float = 1e-3
    warm_up: int = 200
    decay: float = 0.01
    average: float = 0.999
    seed: int = 0


class Completer(nn.Module):
    """Guessed states (B, T, ``SIZE``), units known (B, T, ``UNITS``) -> what to add (B, T, ``MADE``), in unit sizes.

    ``diffusion``: also what to add with noise (B, T, ``MADE``), and the angles (B,) of that. halves: it computes in
    bfloat16, as in training where that is faster; it costs about a millimetre.
    """

    halves = False

    def __init__(self, recipe: CompleterRecipe) -> None:
        super().__init__()
        self.recipe, size = recipe, recipe.size
        self.taken = nn.Linear((SIZE + UNITS + _TIMES) * recipe.patch, size)
        if recipe.diffusion:
            self.noisy, self.angle = nn.Linear(MADE * recipe.patch, size), nn.Linear(2 * _WAVES, size)
        self.place = nn.Parameter(torch.randn(recipe.frames // recipe.patch, size) * 0.02)
        how = {"dropout": 0.0, "activation": "gelu", "norm_first": True, "batch_first": True}
        layer = nn.TransformerEncoderLayer(size, max(4, size // 64), 2 * size, **how)
        self.encoder = nn.TransformerEncoder(layer, recipe.layers, nn.LayerNorm(size), enable_nested_tensor=False)
        self.said = nn.Linear(size, MADE * recipe.patch)
        nn.init.zeros_(self.said.weight), nn.init.zeros_(self.said.bias)
        self.register_buffer("mean", torch.zeros(SIZE))
        self.register_buffer("scale", torch.ones(SIZE))

    @property
    def sizes(self) -> tuple[Tensor, Tensor]:
        """Mean and scale (``MADE``,) of what is made."""
        return self.mean[MADE_AT], self.scale[MADE_AT]

    def forward(
        self, states: Tensor, known: Tensor, fps: float, noisy: Tensor | None = None, angle: Tensor | None = None,
        tremble: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Computes what to add to a guess; nothing where a number is known."""
        told = time_to_known(known, fps)
        if tremble is not None:
            told = (_TREMBLE * tremble[:, None, None]).expand_as(told)
        x = torch.cat(((states - self.mean) / self.scale, known.to(states), told), -1)
        tokens = self.taken(x.unflatten(1, (-1, self.recipe.patch)).flatten(2)) + self.place
        if noisy is not None:
            waves = angle[:, None] * 2.0 ** torch.arange(_WAVES).to(angle)
            tokens = tokens + self.noisy(noisy.unflatten(1, (-1, self.recipe.patch)).flatten(2))
            tokens = tokens + self.angle(torch.cat((waves.sin(), waves.cos()), -1))[:, None]
        said = self.said(self.encoder(tokens)).unflatten(2, (self.recipe.patch, -1)).flatten(1, 2)
        return binomial_smoothed(said * ~known[..., OWNERS.to(known.device)])

    def filled(
        self, motion: Motion, known: Tensor, angle: Tensor | None = None, noise: Tensor | None = None,
        tremble: Tensor | None = None,
    ) -> Motion:  # fmt: skip
        """Computes windows (B, T) that are told ``known`` (B, T, ``UNITS``) of windows in their stuck frame; contacts
        are near 0 or 1. Elsewhere the motion is never read, but by ``diffusion``, as much as the angle (B,) leaves of
        it under noise (B, T, ``MADE``; ``motion_noise``); None: nothing. One that ``refines`` reads all of it, and by
        how much joints trembled (B,), radians."""
        begun, open_ = self._begun(motion, known)
        scale, shown = self.sizes[1], None
        if angle is not None:
            turned = angle[:, None, None]
            shown = (turned.cos() * (made(motion) - begun) / scale + turned.sin() * noise) * open_
        elif self.recipe.diffusion:
            angle, shown = torch.full((len(begun),), math.pi / 2).to(begun), torch.zeros_like(begun)
        return motion_of(begun + self._added(motion, begun, known, shown, angle, tremble) * scale * open_, motion)

    def _begun(self, motion: Motion, known: Tensor) -> tuple[Tensor, Tensor]:
        """The guess (B, T, ``MADE``), and which of its numbers are open."""
        if motion.frames != self.recipe.frames or known.shape != (*motion.root.shape[:2], UNITS):
            want = f"windows of {self.recipe.frames} frames, and {UNITS} units of each"
            raise ShapeError(f"expected {want}, got {tuple(motion.root.shape)} and {tuple(known.shape)}")
        begun = made(motion) if self.recipe.refines else guess(motion, known, *self.sizes)
        return begun, ~known[..., OWNERS.to(known.device)]

    def _added(
        self, motion: Motion, begun: Tensor, known: Tensor, shown: Tensor | None, angle: Tensor | None,
        tremble: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        seen = states(motion_of(begun, motion))
        with torch.autocast(begun.device.type, torch.bfloat16, enabled=self.halves):
            said = self(seen, known, motion.fps, shown, angle, tremble).float()
        return said if angle is None else angle.cos()[:, None, None] * shown + angle.sin()[:, None, None] * said

    def _drawn(self, motion: Motion, known: Tensor, generator: torch.Generator, steps: int) -> Motion:
        """One draw for each window: DDIM, most steps near pure noise (``shifted_angles``)."""
        begun, open_ = self._begun(motion, known)
        x = motion_noise(known, motion.fps, generator).to(begun)
        angles = shifted_angles(torch.linspace(math.pi / 2, 0.0, steps + 1))
        for a, after in zip(angles[:-1].tolist(), angles[1:].tolist(), strict=True):
            added = self._added(motion, begun, known, x, torch.full((len(x),), a).to(x)) * open_
            whole = motion_of(begun + added * self.sizes[1], motion)
            added = (made(whole) - begun) / self.sizes[1] * open_  # as in training, of 6-D numbers in order
            noise = (x - math.cos(a) * added) / math.sin(a)
            x = math.cos(after) * added + math.sin(after) * noise
        for _ in range(2):  # a little noise is left
            x = binomial_smoothed(x) * open_
        return motion_of(begun + x * self.sizes[1], motion)

    @torch.no_grad()
    def complete(
        self, motion: Motion, known: Tensor, generator: torch.Generator | None = None, *, steps: int = 10,
        tremble: float | None = None, batch: int = 64,
    ) -> Motion:  # fmt: skip
        """Computes motions (B, T) in the world from what is known of them; known rotations and places stay to the bit.

        The place and heading of the first frame are taken as given, known or not; contacts that a motion lacks are
        unknown. generator: for draws by ``diffusion``, in so many steps; None: one answer. tremble: where it
        ``refines``, by how much joints trembled before the motion was smoothed, radians.

        Raises:
            ShapeError: windows of another length. ValueError: draws from a model without noise; one that ``refines``
                and is not told how much joints trembled, or another one that is.
        """
        if (generator is not None and not self.recipe.diffusion) or self.recipe.refines != (tremble is not None):
            raise ValueError("generator: of a model by diffusion alone; tremble: of one that refines, and of no other")
        if motion.contacts is None:
            none = motion.root.new_zeros(*motion.root.shape[:-1], len(STANDARD.contact_names))
            motion, known = replace(motion, contacts=none), known.clone()
            known[..., -1] = False
        local, frame = stuck_root(motion)
        parts = []
        for at in torch.arange(len(motion.root)).split(batch):
            some = local.clip(at), known[at]
            size = None if tremble is None else torch.full((len(at),), tremble).to(local.root)
            parts.append(self._drawn(*some, generator, steps) if generator else self.filled(*some, tremble=size))
        root, rot, contacts = (torch.cat([getattr(p, name) for p in parts]) for name in ("root", "rot", "contacts"))
        world = local_to_world(frame, replace(local, root=root, rot=rot, contacts=(contacts > 0.5).to(root)))
        contacts = torch.where(known[..., -1:], motion.contacts, world.contacts)
        return replace(restore_known(world, motion, known), contacts=contacts)


def binomial_smoothed(x: Tensor) -> Tensor:
    """Computes means (B, T, D) over three frames, the middle one weighted twice: what alternates from frame to frame is
    taken away."""
    wide = torch.cat((x[:, :1], x, x[:, -1:]), 1)
    return (wide[:, :-2] + 2 * x + wide[:, 2:]) / 4


def shifted_angles(angle: Tensor) -> Tensor:
    """Moves even angles to where a motion is decided: near pure noise, as sixty frames say together what each alone
    says far too faintly.

    Source: Chen 2023, "On the importance of noise scheduling", and Esser et al. 2024 (shifted schedules).
    """
    return torch.atan2(_SHIFT * angle.sin(), angle.cos())


def motion_noise(known: Tensor, fps: float, generator: torch.Generator) -> Tensor:
    """Draws noise (B, T, ``MADE``) that is nothing where a unit is known (B, T, ``UNITS``), and elsewhere about as
    large as what is to be added (``_LOUD``, ``_ROOT``).

    In time it is as smooth as motion (``motion_waves``); what curves through the known frames would make of it is
    taken away, as it is of the motion.
    """
    count, frames = known.shape[:2]
    noise = motion_waves(frames, fps) @ torch.randn(count, frames, MADE, generator=generator)
    noise *= noise.new_tensor([_ROOT] * 3 + [_LOUD] * (MADE - 3))
    return noise - smooth_curves(noise, known.cpu(), OWNERS)


def motion_waves(frames: int, fps: float) -> Tensor:
    """Computes cosine waves (T, K) whose amplitudes fall as motion's do: with the square of the frequency, from
    ``_BEND`` on. With a standard normal weight each they add up to a deviation of 1, in the mean over time."""
    wave = torch.arange(frames, dtype=torch.float32)
    size = 1 / (1 + (fps * wave / (2 * frames) / _BEND).square())
    size[0] /= 2**0.5  # as in the orthonormal transform: the mean of cos^2 is a half
    waves = torch.cos(math.pi / frames * (wave[:, None] + 0.5) * wave) * size
    return waves / waves.square().mean(0).sum().sqrt()


def guess(motion: Motion, known: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Computes the numbers (B, T, ``MADE``) of smooth curves through what is known, the mean where nothing is."""
    drawn = smooth_curves((made(motion) - mean) / scale, known, OWNERS.to(known.device)) * scale + mean
    return made(motion_of(drawn, motion))  # 6-D numbers of rotations, not short ones


def time_to_known(known: Tensor, fps: float) -> Tensor:
    """Computes the seconds (B, T, 2) since and until a frame of which a rotation is known; at most ``_FAR``. Not of all
    rotations: most figures lack some."""
    some = known[..., :-2].any(-1)[:, None]
    time = torch.arange(some.shape[-1], device=some.device)
    away = (time[:, None] - time).to(torch.float32) / fps
    sides = (torch.where(some & (x >= 0), x, _FAR).amin(-1) for x in (away, -away))
    return torch.stack(tuple(sides), -1).clamp(max=_FAR)


def save(path: Path | str, model: Completer, about: dict) -> None:
    """Writes ``path`` (.safetensors, weights as float16) and its recipe (.json), with ``about`` beside it."""
    checkpoint.save(path, model.state_dict(), about | {"recipe": asdict(model.recipe)}, exact=("mean", "scale"))


def load(path: Path | str) -> Completer:
    """Reads a model that ships, as "completer", or the one at a path, frozen. A bare name is a file here, if there is
    one, and else what ships.

    Raises:
        DataError: a file is missing, damaged, or of another model.
    """
    path = path if Path(path).with_suffix(".safetensors").exists() else checkpoint.shipped(path)
    tensors, about = checkpoint.load(path)
    with checkpoint.rebuilding(path, "completes no motions"):
        return checkpoint.frozen(lambda: Completer(CompleterRecipe(**about["recipe"])), tensors)
