"""The test cases: what they hide, what they measure, noise and its removal, and motions that are joined."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torch import nn

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import rotation
from motionlab.diffusion import case_trials, cases, denoising, switching
from motionlab.diffusion.curves import curves
from motionlab.diffusion.denoising import Noise, Start
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.rivals import RIDGES, Rivals
from motionlab.diffusion.trained import Recipe, Trained
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError, ShapeError
from motionlab.metrics.inbetween import natural_changes
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT

FRAMES = 20


@pytest.fixture(scope="module")
def motion():
    """Six windows of 20 frames of somebody who walks about."""
    cut = gather([on_standard(perform_sequence(Corpus(seconds=6.0, seed=3), 0).motion)], FRAMES).evenly(6)
    return replace(cut, skeleton=STANDARD)


def walker(speed: float, count: int = 2, frames: int = FRAMES, turn: float = 0.0) -> Motion:
    """Somebody who glides at ``speed`` m/s straight ahead; ``turn`` radians off +y."""
    time = torch.arange(frames) / 30.0
    about = rotation.rotation_about("z", torch.tensor(turn))
    path = torch.stack((0 * time, speed * time, 0 * time + 1.0), -1) @ about.mT
    rot = torch.eye(3).repeat(frames, len(STANDARD), 1, 1)
    rot[:, 0] = about @ UPRIGHT
    whole = Motion(STANDARD, path, rot, 30.0, torch.zeros(frames, len(STANDARD.contact_names)))
    return replace(
        whole,
        root=whole.root.repeat(count, 1, 1),
        rot=whole.rot.repeat(count, 1, 1, 1, 1),
        contacts=whole.contacts.repeat(count, 1, 1),
    )


# ------------------------------------------------------------------------------------------------------- what is known
def test_occluded_legs_hide_eight_rotations_and_contacts_and_nothing_else():
    known = cases.columns(Layout(), cases.legs(3, 5))
    expected = Layout().mask(5, groups=("root",), joints=[n for n in STANDARD.names if n not in cases.HIDDEN])
    assert len(cases.HIDDEN) == 8 and torch.equal(known, expected.expand(3, -1, -1))


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_every_frame_has_its_own_joints_and_every_joint_its_frame(generator, share):
    known = cases.every_frame(40, 60, share, generator)
    joints = known[..., : cases.JOINTS]
    assert joints.float().mean() == pytest.approx(share, abs=0.02)
    assert joints.any(1).all() and (joints[:, 1:] != joints[:, :-1]).any()
    assert torch.equal(known[..., cases.JOINTS], known[..., 0]) and not known[..., -1].any()
    assert cases.every_frame(1, 4, 0.0, generator)[..., : cases.JOINTS].sum(1).eq(1).all()


def test_a_whole_window_keeps_the_same_joints_and_just_so_many(generator):
    known = cases.whole_window(40, 60, 0.25, generator)
    assert (known == known[:, :1]).all() and known[:, 0, : cases.JOINTS].sum(-1).eq(6).all()  # 5.5 rounds to even
    assert len(known[:, 0].unique(dim=0)) > 30
    assert cases.whole_window(5, 2, 0.0, generator)[:, 0, : cases.JOINTS].sum(-1).eq(1).all()


def test_a_gap_lies_in_the_middle_and_leaves_both_ends():
    known = cases.gap(2, 60, 45)[0, :, 0]
    assert (~known).sum() == 45 and (~known).nonzero()[0] == 7 and known[-8:].all()
    for length in (0, 59, 60):
        with pytest.raises(ShapeError, match="gap"):
            cases.gap(2, 60, length)


# ------------------------------------------------------------------------------------------------------------ measures
def test_error_counts_the_joints_asked_for_in_the_frames_that_hide_something(motion):
    known = cases.gap(len(motion.root), FRAMES, 4)
    assert cases.error_cm(motion, motion, known).abs().max() == 0
    root = motion.root.clone()
    root[:, 8:12] += torch.tensor([0.0, 0.0, 0.03])  # all joints of the gap 3 cm up
    assert cases.error_cm(replace(motion, root=root), motion, known, cases.LOWER).numpy() == pytest.approx(3, abs=1e-3)
    outside = motion.root.clone()
    outside[:, :8] += 1
    assert cases.error_cm(replace(motion, root=outside), motion, known).abs().max() < 1e-4
    with pytest.raises(DataError, match="all is known"):
        cases.error_cm(motion, motion, torch.ones_like(known))


def test_a_walk_played_backwards_is_a_walk_reversed_and_one_on_the_spot_is_not():
    time = torch.arange(60) / 30.0
    swing = 0.5 * torch.sin(2 * torch.pi * time)
    rot = walker(0.0, frames=60).rot.clone()
    for side, sign in (("left", 1), ("right", -1)):
        rot[:, :, STANDARD.index(f"{side}_hip")] = rotation.rotation_about("x", sign * swing)
        bent = (-sign * torch.cos(2 * torch.pi * time)).clamp(min=0)  # the knee that is bent belongs to the foot ahead
        rot[:, :, STANDARD.index(f"{side}_knee")] = rotation.rotation_about("x", bent)
    true = replace(walker(0.0, frames=60), rot=rot)
    back = replace(true, rot=rot.flip(1))
    speed = cases.stance_speed(true)
    assert speed.abs().min() > 0.3 and cases.stance_speed(back).numpy() == pytest.approx(-speed.numpy(), abs=1e-3)
    assert cases.reversed_walk(back, true).eq(1).all() and cases.reversed_walk(true, true).eq(0).all()
    gone = replace(true, root=walker(1.3, frames=60).root)
    assert cases.stance_speed(gone).numpy() == pytest.approx(speed.numpy(), abs=1e-4)  # the root does not count
    assert cases.reversed_walk(back, walker(1.0, frames=60)).isnan().all()  # nobody walks there


def test_what_is_chosen_has_the_least_error(motion):
    def moved(metres):
        return replace(motion, root=motion.root + metres)

    assert cases.chosen((0.3, -0.1, 0.2), moved, motion) == -0.1


# ----------------------------------------------------------------------------------------------------------- denoising
class Fixed(nn.Module):
    """An x_0 estimate that is given, or what it got, without the factor of its step."""

    def __init__(self, schedule, x0=None):
        super().__init__()
        self.schedule, self.x0, self.seen = schedule, x0, []
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, x, stamps, known=None, mask=None):
        self.seen.append(int(stamps[0]))
        return self.x0 if self.x0 is not None else x / self.schedule.alpha_bar[stamps[0]].sqrt().to(x)


def model_of(motion, x0=None):
    recipe = Recipe(frames=FRAMES)
    normaliser = Normaliser.measure(recipe.layout.encode(motion), recipe.layout)
    return Trained(Fixed(recipe.schedule, x0), recipe.schedule, recipe.layout, normaliser, recipe)


def test_noise_has_the_size_it_says_and_lasts_as_long(motion, generator):
    long = replace(motion, root=motion.root.repeat(40, 1, 1), rot=motion.rot.repeat(40, 1, 1, 1, 1), contacts=None)
    noise = Noise.of(5, 2, lasting=0.9)
    noisy = noise.on(long, generator)
    angle = rotation.geodesic(noisy.rot, long.rot)
    assert angle.square().mean().sqrt().rad2deg() == pytest.approx(5 * 3**0.5, rel=0.02)
    shift = noisy.root - long.root
    assert shift.std() == pytest.approx(0.02, rel=0.05)
    assert (shift[:, 1:] * shift[:, :-1]).mean() / shift.square().mean() == pytest.approx(0.9, abs=0.02)
    fresh = Noise.of(5, 2).on(long, generator).root - long.root
    assert (fresh[:, 1:] * fresh[:, :-1]).mean() / fresh.square().mean() == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("size", [0.05, 0.3, 2.0])
def test_the_reverse_process_begins_where_it_is_as_noisy(size):
    schedule = Recipe().schedule
    a = schedule.alpha_bar[denoising.begin(schedule, size)]
    assert ((1 - a) / a).sqrt() == pytest.approx(size, rel=0.05)


def test_denoising_comes_back_to_the_world_and_reads_the_noisy_motion(motion, generator):
    noise = Noise.of(5, 2)
    noisy = noise.on(motion, generator)
    same = denoising.denoise(model_of(motion), noisy, motion, noise, generator, Start(topped=False))
    assert (same.positions - noisy.positions).abs().max() < 1e-4  # taken as it is, it stays as it was
    rough = denoising.denoise(model_of(motion), noisy, motion, noise, generator, Start(topped=False, filtered=True))
    assert (rough.positions - motion.positions).abs().max() < 1e-4
    topped = denoising.denoise(model_of(motion), noisy, motion, noise, generator, Start())
    assert (topped.positions - noisy.positions).norm(dim=-1).mean() > 0.005


@pytest.mark.parametrize("start", [Start(), Start(steps=5), Start(looks=3, level=2.0)])
def test_a_perfect_denoiser_gives_the_truth_from_the_step_it_should_start_at(motion, generator, start):
    noise, plain = Noise.of(5, 2), model_of(motion)
    model = model_of(motion, plain.encode(motion))
    made = denoising.denoise(model, noise.on(motion, generator), motion, noise, generator, start)
    assert (made.positions - motion.positions).abs().max() < 1e-4
    seen = model.denoiser.seen
    layout = Layout("world")
    noisy = layout.encode(replace(noise.on(motion, generator), contacts=motion.contacts))
    off = ((noisy - layout.encode(motion)) / model.normaliser.scale)[..., : layout.slices["contacts"].start]
    size = off.square().mean().sqrt().item()
    assert len(seen) == start.steps * start.looks
    assert max(seen) == pytest.approx(denoising.begin(model.schedule, start.level * size), abs=40)


def test_the_pull_moves_an_estimate_to_the_measurement(motion, generator):
    noise = Noise.of(5, 2)
    noisy = noise.on(motion, generator)
    wrong = model_of(motion).encode(motion.clip([1, 2, 3, 4, 5, 0]))
    errors = []
    for pull in (0.0, 0.1, 1e6):
        made = denoising.denoise(model_of(motion, wrong), noisy, motion, noise, generator, Start(pull=pull))
        errors.append((made.positions - noisy.positions).norm(dim=-1).mean().item())
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1e-3


def test_denoising_says_what_it_cannot_do(motion, generator):
    with pytest.raises(DataError, match="no noise"):
        denoising.denoise(model_of(motion), motion, motion, Noise(0.0, 0.0), generator)
    moving = replace(model_of(motion), layout=Layout(velocities=True))
    with pytest.raises(DataError, match="velocities"):
        denoising.denoise(moving, motion, motion, Noise.of(5, 2), generator)


# ----------------------------------------------------------------------------------------------------------- switching
@pytest.mark.parametrize("gap", [1, 6])
def test_who_walks_straight_on_is_put_where_he_will_be(gap):
    whole = walker(1.2, turn=0.7)
    before, after = whole.cut(0, 8), whole.cut(8 + gap)
    elsewhere = walker(1.2, turn=-2.0).cut(8 + gap)
    for suffix in (after, elsewhere):
        found = switching.placed(suffix, before, gap)
        assert (found.positions - after.positions).abs().max() < 1e-5
    slower = switching.placed(walker(0.6, turn=1.0).cut(8 + gap), before, gap)
    way = (slower.root[:, 0] - before.root[:, -1]).norm(dim=-1)
    assert way.numpy() == pytest.approx((gap + 1) / 30 * 0.9, abs=1e-5)  # the mean of both paces


def test_joined_motions_keep_both_ends_and_everyone_follows_another(motion, generator):
    made, known = switching.pairs(motion, 6, generator)
    assert made.frames == FRAMES and (~known).sum(1).eq(6).all() and not known[:, 7:13].any()
    assert torch.equal(made.root[:, :7], motion.root[:, :7])
    ends, sources = made.rot[:, 13:, 1:], motion.rot[:, 13:, 1:]
    same = (ends[:, None] - sources[None]).abs().flatten(2).amax(-1) < 1e-6
    assert torch.equal(same.sum(1), torch.ones(6, dtype=torch.long)) and not same.diagonal().any()
    assert torch.equal(same.sum(0), torch.ones(6, dtype=torch.long))
    facing = [rotation.yaw(made.rot[:, t, 0]) for t in (6, 13)]
    assert torch.allclose(*facing, atol=1e-4)
    with pytest.raises(ShapeError, match="nothing to join"):
        switching.pairs(motion.clip(slice(0, 1)), 6, generator)


def test_a_jump_is_measured_where_it_is(motion):
    known = torch.ones(6, FRAMES, dtype=torch.bool)
    known[:, 7:13] = False
    natural = natural_changes(motion.positions, motion.fps)
    jumped = motion.root.clone()
    jumped[:, 7:13] += torch.tensor([0.2, 0.0, 0.0])
    smooth, rough = (switching.measures(m, known, natural) for m in (motion, replace(motion, root=jumped)))
    assert (rough["seam, m/s"] - smooth["seam, m/s"] > 3).all()  # 0.2 m in a thirtieth of a second
    assert rough["seam, percentile of natural"].min() == 100
    assert (rough["acceleration, m/s^2"] > smooth["acceleration, m/s^2"]).all()
    outside = motion.root.clone()
    outside[:, :3] += 1
    again = switching.measures(replace(motion, root=outside), known, natural)
    assert torch.allclose(again["acceleration, m/s^2"], smooth["acceleration, m/s^2"], atol=1e-3)


# ----------------------------------------------------------------------------------------------------------- all of it
@pytest.fixture(scope="module")
def bench(motion):
    """Models that know nothing, and rivals fitted to the windows themselves."""
    recipe = Recipe(size="small", frames=FRAMES, patch=2, spectral=True)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        networks = [replace(recipe, told=told).denoiser().eval().requires_grad_(False) for told in (False, True)]
    plain, told = (replace(model_of(motion), denoiser=n, recipe=replace(recipe, told=n.told)) for n in networks)
    rivals = Rivals.fit(motion, torch.Generator().manual_seed(0), parts=4)
    return case_trials.Bench(plain, told, rivals, steps=2)


@pytest.mark.parametrize("name", case_trials.WAYS)
def test_every_way_keeps_what_is_known_to_the_bit(motion, bench, name, generator):
    known = cases.every_frame(6, FRAMES, 0.5, generator)
    made = bench.fill(name, motion, known, generator)
    joints, place = known[..., : cases.JOINTS], known[..., cases.JOINTS]
    assert torch.equal(made.rot[joints], motion.rot[joints]) and torch.equal(made.root[place], motion.root[place])
    assert not torch.allclose(made.rot[~joints], motion.rot[~joints], atol=1e-3)


def test_without_the_last_overwrite_what_is_known_moves_and_with_a_finish_it_does_not(motion, bench, generator):
    known = cases.gap(6, FRAMES, 6)
    loose = bench.fill("Eq. 4.10", motion, known, generator, last=False)
    ended = bench.fill("Eq. 4.10", motion, known, generator, last=False, finish=2)
    ends = known[..., 0]
    assert (loose.root[ends] - motion.root[ends]).abs().max() > 1e-4
    assert torch.equal(ended.root[ends], motion.root[ends])


def test_a_contest_has_the_rivals_it_was_asked_for(motion, bench, generator):
    known = cases.gap(6, FRAMES, 6)
    how = {"plain": "imputed", "told": "told"}
    names = ["mean", "nearest", "ridge", "Eq. 4.10", "not told", "start alone", "told"]
    assert list(bench.contest(motion, known, generator, **how)) == names
    found = bench.contest(motion, known, generator, **how, regression=False, through_time=True)
    assert list(found) == ["hold", "slerp", "curves", *names[3:]]


def test_curves_know_nothing_but_the_mean_and_what_is_known(motion, bench, generator):
    known = cases.gap(6, FRAMES, 6)
    bench = replace(bench, told=replace(bench.told, denoiser=deepcopy(bench.told.denoiser)))
    for part in (bench.told.denoiser.start.factor, bench.told.denoiser.start.mean):
        part.normal_(generator=generator)
    found, start = (getattr(bench, name)(motion, known, generator) for name in ("curves", "start"))
    x, given = bench.told.encode(motion), cases.columns(bench.told.layout, known).expand(6, -1, -1)
    mean = bench.told.denoiser.start.mean.unflatten(0, x.shape[1:])
    expected = bench.told.decode(mean + curves(x - mean, given))
    assert (found.rot - expected.rot)[:, ~known[0, :, 0], 1:].abs().max() < 1e-4  # the pelvis turns with the frame
    assert (found.rot - start.rot).abs().max() > 1e-2
    again = bench.start(motion, known, generator)
    assert torch.allclose(again.rot, start.rot, atol=1e-3)  # what was asked of one is not the other's


def test_all_settings_of_a_cleaning_are_chosen_and_used(motion, bench, generator):
    long = replace(
        motion,
        root=motion.root.repeat(1, 2, 1),
        rot=motion.rot.repeat(1, 2, 1, 1, 1),
        contacts=motion.contacts.repeat(1, 2, 1),
    )  # the longest filter is longer than these windows
    rivals = Rivals.fit(long, torch.Generator().manual_seed(0), parts=4)
    here = replace(bench, rivals=rivals, free=model_of(long))
    chosen = case_trials.Cleaning.chosen(Noise.of(5, 2), here, long, generator)
    assert chosen.best in chosen.filters and chosen.start in case_trials.STARTS and chosen.ridge in RIDGES
    made = case_trials.cleaned(chosen.clean(chosen.noise.on(long, generator), here, generator), long)
    assert list(made) == ["noisy", *chosen.filters, "linear", "diffusion"]
    assert made[chosen.best]["error, cm"].mean() < made["noisy"]["error, cm"].mean()
    assert made["noisy"]["power"].shape == (6, len(cases.BANDS) - 1)


def test_groups_of_real_windows_are_near_and_those_of_others_are_far(motion):
    many = replace(
        motion, root=motion.root.repeat(3, 1, 1), rot=motion.rot.repeat(3, 1, 1, 1, 1), contacts=None
    )  # eighteen
    high = replace(many, root=many.root + torch.tensor([0.0, 0.0, 0.5]))
    near, far = (case_trials.kernel_distances(m, many, torch.Generator().manual_seed(0), 3) for m in (many, high))
    assert near.shape == (3,) and far.min() > near.max()
    with pytest.raises(ShapeError, match="groups"):
        case_trials.kernel_distances(motion, many, torch.Generator(), 8)


def test_windows_are_cut_from_the_middle_and_spread(motion):
    one = motion.clip(0)
    (cut,) = case_trials.middle([one, one.cut(0, 5)], 6, around=2)
    assert torch.equal(cut.root, one.root[5:15])
    assert torch.equal(case_trials.spread(motion, 2).root, motion.root[[0, 5]])


def test_groups_do_not_depend_on_the_order_of_windows(motion):
    many = replace(motion, root=motion.root.repeat(3, 1, 1), rot=motion.rot.repeat(3, 1, 1, 1, 1), contacts=None)
    high = torch.arange(18) < 6  # of three groups in a row one would be far
    many = replace(many, root=many.root + 0.5 * high[:, None, None] * torch.tensor([0.0, 0.0, 1.0]))
    spread = [case_trials.kernel_distances(many, many, torch.Generator().manual_seed(k), 3).std() for k in range(4)]
    assert min(spread) < 0.5 * max(spread)


def test_a_finish_brings_rivals_to_what_is_known_without_a_jump(motion, bench, generator):
    known = cases.gap(6, FRAMES, 6)
    jumps = []
    for finish in (0, 3):
        found = bench.contest(motion, known, generator, plain="imputed", told="told", last=False, finish=finish)
        made = found["mean"]
        assert torch.equal(made.root[known[..., cases.JOINTS]], motion.root[known[..., cases.JOINTS]])
        jumps.append(made.positions.diff(n=2, dim=1).norm(dim=-1).amax((1, 2)).mean())
    assert jumps[1] < 0.7 * jumps[0]
