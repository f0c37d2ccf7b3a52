"""The LAFAN1 benchmark against a scalar reading of its description, from the text of a BVH file to the three numbers;
and the seam and the keyframes in metres."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.skeleton import UPRIGHT, Skeleton
from studies.shared import inbetween_measures as inbetween
from studies.shared import lafan_benchmark as lafan
from tests.draws import seeded


# -------------------------------------------------------------- naive twins, quaternion by quaternion in numpy
def product(a, b):
    w, x, y, z = a
    return np.array(
        [
            w * b[0] - x * b[1] - y * b[2] - z * b[3],
            w * b[1] + x * b[0] + y * b[3] - z * b[2],
            w * b[2] - x * b[3] + y * b[0] + z * b[1],
            w * b[3] + x * b[2] - y * b[1] + z * b[0],
        ]
    )


def conjugate(q):
    return q * np.array([1, -1, -1, -1])


def turned(q, v):
    return product(product(q, np.array([0, *v])), conjugate(q))[1:]


def twin_file(path):
    """Root positions (T, 3) cm, local quaternions (T, J, 4) without flips, offsets (J, 3), from the text alone."""
    lines = path.read_text().splitlines()
    joints = [k for k, line in enumerate(lines) if line.split()[0] in ("ROOT", "JOINT")]
    offsets = np.array([[float(x) for x in lines[k + 2].split()[1:]] for k in joints])
    assert all(lines[k + 3].split()[-3:] == ["Zrotation", "Xrotation", "Yrotation"] for k in joints)
    start = next(k for k, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    values = np.array([[float(x) for x in line.split()] for line in lines[start:]])
    quats = np.zeros((len(values), len(joints), 4))
    for t, row in enumerate(np.radians(values[:, 3:]).reshape(len(values), -1, 3)):
        for j, angles in enumerate(row):
            q = np.array([1.0, 0, 0, 0])
            for axis, angle in zip((3, 1, 2), angles, strict=True):
                part = np.zeros(4)
                part[0], part[axis] = math.cos(angle / 2), math.sin(angle / 2)
                q = product(q, part)
            if t and np.dot(q, quats[t - 1, j]) < np.dot(-q, quats[t - 1, j]):
                q = -q
            quats[t, j] = q
    return values[:, :3], quats, offsets


def twin_fk(root, quats, offsets):
    q, p = [quats[0]], [root]
    for j, parent in enumerate(lafan.PARENTS[1:], start=1):
        p.append(p[parent] + turned(q[parent], offsets[j]))
        q.append(product(q[parent], quats[j]))
    return np.array(q), np.array(p)


def twin_windows(path, length, offset):
    root, quats, offsets = twin_file(path)
    found, i = [], 0
    while i + length < len(root):
        r, q = root[i : i + length].copy(), quats[i : i + length].copy()
        r[:, [0, 2]] -= r[:, [0, 2]].mean(0)
        forward = turned(q[9, 0], np.array([0, 1.0, 0])) * np.array([1, 0, 1])
        forward /= np.linalg.norm(forward)
        yaw = np.array([1 + forward[0], *np.cross([1.0, 0, 0], forward)])
        back = conjugate(yaw / np.linalg.norm(yaw))
        for t in range(length):
            r[t], q[t, 0] = turned(back, r[t]), product(back, q[t, 0])
        found.append((r, q))
        i += offset
    return found, offsets


def twin_slerp(x, y, w):
    near = np.dot(x, y)
    if near < 0:
        near, y = -near, -y
    if 1 - near < 0.01:
        q = (1 - w) * x + w * y
    else:
        angle = math.acos(near)
        q = math.sin((1 - w) * angle) / math.sin(angle) * x + math.sin(w * angle) / math.sin(angle) * y
    return q / np.linalg.norm(q)


def twin_fill(method, root, quats, gap):
    poses = []
    for k in range(1, gap + 1):
        w = k / (gap + 1) if method == "interpolation" else 0.0
        q = [twin_slerp(quats[9, j], quats[10 + gap, j], w) for j in range(22)] if w else quats[9]
        poses.append((root[9] + w * (root[10 + gap] - root[9]), np.array(q)))
    return poses


def twin_npss(found, true):
    """(N, T, D) both; the transform as its defining sum."""
    n, frames, d = true.shape
    emd, weight = np.zeros((n, d)), np.zeros((n, d))
    for i in range(n):
        for k in range(d):
            powers = []
            for x in (found[i, :, k], true[i, :, k]):
                real = [sum(v * math.cos(2 * math.pi * f * t / frames) for t, v in enumerate(x)) for f in range(frames)]
                powers.append([c * c for c in real])
            weight[i, k] = sum(powers[1])
            total = [0.0, 0.0]
            for a, b in zip(*powers, strict=True):
                total = [total[0] + a / sum(powers[0]), total[1] + b / sum(powers[1])]
                emd[i, k] += abs(total[0] - total[1])
    return (emd * weight).sum() / weight.sum()


def twin_benchmark(folder, method, gap, train, test):
    stats = []
    for path in sorted(folder.glob("*.bvh")):
        if path.stem.split("_")[1] in train:
            cuts, offsets = twin_windows(path, 50, 20)
            stats += [twin_fk(r[t], q[t], offsets)[1].ravel() for r, q in cuts for t in range(50)]
    mean, std = np.mean(stats, 0), np.std(stats, 0)
    bones = twin_file(min(p for p in folder.glob("*.bvh") if p.stem.split("_")[1] == train[0]))[2]
    l2q, l2p, quats = [], [], ([], [])
    for path in sorted(folder.glob("*.bvh")):
        if path.stem.split("_")[1] not in test:
            continue
        for r, q in twin_windows(path, 65, 40)[0]:
            signals = ([], [])
            for t, (root, local) in enumerate(twin_fill(method, r, q, gap), start=10):
                (a, x), (b, y) = twin_fk(root, local, bones), twin_fk(r[t], q[t], bones)
                l2q.append(math.sqrt(((a - b) ** 2).sum()))
                l2p.append(math.sqrt((((x.ravel() - mean) / std - (y.ravel() - mean) / std) ** 2).sum()))
                signals[0].append(a.ravel())
                signals[1].append(b.ravel())
            quats[0].append(signals[0])
            quats[1].append(signals[1])
    return np.mean(l2q), np.mean(l2p), twin_npss(np.array(quats[0]), np.array(quats[1])), len(quats[0])


# ------------------------------------------------------------------------------------------ a made-up data set


def take(frames, seed, scale=1.0):
    """A made-up take on LAFAN1's tree: it walks about, turns all the way round, and one arm passes half turns."""
    source = seeded(seed)
    offsets = 0.2 * torch.randn(22, 3, generator=seeded(99), dtype=torch.float64) * scale
    skeleton = Skeleton(tuple(f"joint{j}" for j in range(22)), lafan.PARENTS, offsets)
    t = torch.arange(frames, dtype=torch.float64)[:, None, None] / 30
    rate, phase = (torch.rand(22, 3, generator=source, dtype=torch.float64) for _ in range(2))
    angle = 0.8 * (2 * math.pi * (phase + (0.2 + rate) * t)).sin()
    angle[:, 16] = torch.tensor([0.0, 3.5, 0.0]) * t[:, 0] + phase[16]
    rot = rotation.exp(angle)
    rot[:, 0] = rotation.rotation_about("z", 1.5 * t[:, 0, 0] + seed) @ UPRIGHT.double() @ rot[:, 0]
    height = 0.9 + 0.1 * torch.sin(3 * t[:, 0, 0])
    root = torch.stack((2 + t[:, 0, 0] * rate[0, 0], torch.sin(t[:, 0, 0]) - 3, height), -1)
    return Motion(skeleton, root, rot, 30.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three subjects; one file is exactly one window long and so gives none; two have bones of their own."""
    at = tmp_path_factory.mktemp("takes")
    clips = {"walk1_subject1": (95, 1), "run2_subject1": (75, 2), "dance1_subject2": (80, 3)}
    for name, (frames, seed) in (clips | {"jumps1_subject5": (150, 4), "fight1_subject5": (65, 5)}).items():
        size = {"dance1_subject2": 1.1, "jumps1_subject5": 0.9}.get(name, 1.0)
        bvh.save(at / f"{name}.bvh", take(frames, seed, size))
    (at / "notes.bvh.txt").write_text("not a recording")
    return at


SPLIT = {"train": ("subject1", "subject2"), "test": ("subject5",)}


@pytest.fixture(scope="module")
def data(folder):
    return lafan.load_lafan(folder, **SPLIT)


@pytest.mark.parametrize(("method", "gap"), [("zero velocity", 5), ("interpolation", 5), ("interpolation", 15)])
def test_the_whole_benchmark_agrees_with_a_scalar_reading(folder, data, method, gap):
    row = next(r for r in lafan.evaluate(data, gaps=[gap]) if r["method"] == method)
    expected = twin_benchmark(folder, method, gap, **SPLIT)
    assert (row["l2q"], row["l2p"], row["npss"]) == pytest.approx(expected[:3], rel=2e-5)
    assert row["n"] == expected[3] == 3
    assert min(expected[:3]) > 0.001
    assert "published" not in row and not data.whole  # a made-up folder is not measured by official numbers


# -------------------------------------------------------------------------------------------------- invariances


def test_perfect_filling_scores_zero_and_worse_filling_worse(data):
    truth, gap = data.windows, 15
    perfect = lafan.score(truth, truth, data.statistics, gap)
    assert perfect.l2q.max() < 1e-6 and perfect.l2p.max() < 1e-6 and perfect.npss < 1e-9 and perfect.n == 3
    last = 0.0
    for size in (0.01, 0.1, 0.5):
        noise = size * torch.randn(truth.rot.shape[:-1], generator=seeded(0))
        score = lafan.score(replace(truth, rot=truth.rot @ rotation.exp(noise)), truth, data.statistics, gap)
        assert score.l2q.mean() > 2 * last
        last = score.l2q.mean().item()
    assert lafan.score(lafan.zero_velocity(truth, gap), truth, data.statistics, gap).l2p.mean() > 1


def test_a_method_sees_no_frame_of_the_gap_and_none_after_the_target(data):
    seen = {}

    def spy(cuts, gap):
        seen[gap] = cuts
        return cuts

    rows = lafan.evaluate(data, {"spy": spy}, gaps=[5, 30])
    zero = lafan.evaluate(data, {"zero velocity": lafan.zero_velocity}, gaps=[5, 30])
    assert [r["l2p"] for r in rows] == [r["l2p"] for r in zero]
    for gap, cuts in seen.items():
        assert cuts.frames == 10 + gap + 1
        assert torch.equal(cuts.root[:, 10:-1], data.windows.root[:, 9:10].expand(-1, gap, -1))
        assert torch.equal(cuts.rot[:, -1], data.windows.rot[:, 10 + gap])


# ------------------------------------------------------------------------------------------ the three measures


def test_sign_flips_change_l2q_and_not_npss():
    q = torch.nn.functional.normalize(torch.randn(2, 12, 3, 4, generator=seeded(1), dtype=torch.float64), dim=-1)
    p = torch.nn.functional.normalize(q + 0.1 * torch.randn(q.shape, generator=seeded(2)), dim=-1)
    flip = torch.tensor([1.0, -1.0, 1.0])[:, None]  # one joint throughout
    assert inbetween.l2q(flip * p, q).mean() > 1.5 > 0.5 > inbetween.l2q(p, q).mean()
    assert inbetween.l2q(flip * p, flip * q) == pytest.approx(inbetween.l2q(p, q))
    together = inbetween.npss(p.flatten(2), q.flatten(2))
    assert inbetween.npss((flip * p).flatten(2), q.flatten(2)) == pytest.approx(together)
    jump = torch.where(torch.arange(12) < 6, 1.0, -1.0)[:, None, None]  # a flip in time is a change of spectrum
    assert inbetween.npss((jump * p).flatten(2), q.flatten(2)) > 3 * together


def test_a_method_that_returns_the_truth_is_not_charged_for_its_signs(data):
    """An arm passes w = 0 inside the windows: signs by w >= 0 would make the truth its own worst enemy."""
    local = lafan._file_quaternions(data.windows)
    assert (local[..., 16, 0] < 0).any()
    naive = rotation.matrix_to_quaternion(data.windows.rot.double())
    parents = data.windows.skeleton.parents
    a, b = (lafan._global_quaternions(x[:, 10:40], parents) for x in (naive, local))
    assert (
        inbetween.l2q(a, b).max() > 1 and lafan.score(data.windows, data.windows, data.statistics, 30).l2q.max() < 1e-6
    )


def test_signs_continue_across_the_edge_of_the_gap():
    """A joint passes the half turn, where w changes its sign, between the last past frame and the first of the gap."""
    motion = take(21, 1)
    rot = motion.rot.clone()
    rot[:, 16] = rotation.rotation_about("x", torch.deg2rad(179 + 2 * (torch.arange(21).double() - 9)))
    truth = replace(motion, root=motion.root[None], rot=rot[None])
    stats = lafan.Statistics(torch.zeros(22, 3).double(), torch.ones(22, 3).double(), 1)
    assert lafan.score(truth, truth, stats, 5).l2q < 1e-6
    behind = rot.clone()
    behind[:, 16] = rot[:, 16] @ rotation.rotation_about("x", torch.tensor(math.radians(-6)).double())
    late = replace(truth, rot=behind[None])  # on the other side of the half turn, 6 degrees away
    assert lafan.score(late, truth, stats, 5).l2q < 0.3


def test_npss_agrees_with_the_defining_sum_and_not_with_the_usual_power():
    truth = torch.randn(3, 11, 4, generator=seeded(1), dtype=torch.float64)
    found = truth + 0.5 * torch.randn(truth.shape, generator=seeded(2), dtype=torch.float64)
    assert inbetween.npss(found, truth) == pytest.approx(twin_npss(found.numpy(), truth.numpy()), rel=1e-9)
    assert inbetween.npss(truth, truth) == 0
    assert inbetween.npss(3 * found, truth) == pytest.approx(inbetween.npss(found, truth))  # the size is divided out
    late = truth.roll(3, dims=1)  # |F| is blind to a shift; the real part is not
    assert inbetween.npss(late, truth) > 0.05


def test_signals_without_power():
    truth, found = torch.ones(1, 4, 2), torch.ones(1, 4, 2)
    truth[..., 1], found[..., 1] = 0, torch.tensor([1.0, 2, 3, 4])
    assert inbetween.npss(found, truth) == 0  # a true signal of zero weighs nothing
    found[..., 0] = 0
    assert inbetween.npss(found, truth) == pytest.approx(4)
    with pytest.raises(DataError, match="remedy"):
        inbetween.npss(found, torch.zeros(1, 4, 2))


# -------------------------------------------------------------------------------------------- seam and keyframes
def straight(frames=12, speed=1.5):
    t = torch.arange(frames, dtype=torch.float64)[:, None, None] / 30
    return (t * torch.tensor([speed, 0.0, 0.0])).expand(-1, 4, 3).clone()


def test_seam_of_a_steady_walk_is_nothing_and_a_jump_is_its_size():
    known = torch.tensor([True] * 4 + [False] * 4 + [True] * 4)
    natural = torch.linspace(0, 1, 101, dtype=torch.float64)
    still = inbetween.seam(straight(), known, 30.0, natural)
    assert still.jump_mps < 1e-9 and still.worst_mps < 1e-9
    shifted = straight()
    shifted[4:8, :, 1] += 0.02  # the filled part lies 2 cm beside: 0.6 m/s in and out
    found = inbetween.seam(shifted, known, 30.0, natural)
    assert found.jump_mps.item() == pytest.approx(math.hypot(0.6, 0), rel=1e-6)
    assert found.percentile.item() == pytest.approx(100 * 61 / 101, abs=1)
    one_sided = straight()
    one_sided[7:, :, 1] += 0.02  # inside the filled part, next to the last seam
    at_end = inbetween.seam(one_sided, known, 30.0, natural)
    assert at_end.worst_mps.item() == pytest.approx(0.6) and at_end.jump_mps.item() == pytest.approx(0.3)


def test_a_jump_away_from_the_seams_is_not_charged_to_them():
    known = torch.tensor([True] * 8 + [False] * 4)
    p = straight()
    p[3:, :, 2] += 0.5
    assert inbetween.seam(p, known, 30.0, torch.ones(1).double()).jump_mps < 1e-9
    nothing = inbetween.seam(p, torch.ones(12, dtype=torch.bool), 30.0, torch.ones(1).double())
    assert all(x.isnan() for x in nothing)


def test_step_changes_agree_with_loops():
    p = torch.randn(2, 7, 3, 3, generator=seeded(1), dtype=torch.float64)
    found = inbetween.step_changes(p, 30.0)
    change = {
        (i, t): np.mean([math.dist(p[i, t + 1, j] - p[i, t, j], p[i, t, j] - p[i, t - 1, j]) for j in range(3)]) * 30
        for i in range(2)
        for t in range(1, 6)
    }
    for i in range(2):
        for step in range(6):
            assert found[i, step] == pytest.approx(max(change.get((i, t), -1) for t in (step, step + 1)))
    assert len(inbetween.natural_changes(p, 30.0)) == 2 * 4
    with pytest.raises(ShapeError, match="three frames"):
        inbetween.step_changes(p[:, :2], 30.0)


def test_keyframe_error_looks_at_known_frames_only():
    truth = straight()
    found = truth.clone()
    known = torch.zeros(12, dtype=torch.bool)
    known[[0, 11]] = True
    found[5] += 9.0
    assert inbetween.keyframe_error(found, truth, known) == (0, 0)
    found[11, 2, 1] += 0.04
    error = inbetween.keyframe_error(found, truth, known)
    assert error.mean_m.item() == pytest.approx(0.04 / 8) and error.worst_m.item() == pytest.approx(0.04)
    assert all(x.isnan() for x in inbetween.keyframe_error(found, truth, torch.zeros(12)))


# ------------------------------------------------------------------------------------------------------ refusals
def test_a_folder_that_is_not_lafan(folder, tmp_path):
    for place in (tmp_path, tmp_path / "absent"):
        with pytest.raises(DataError, match=r"subject1.*remedy: unzip"):
            lafan.load_lafan(place)
    with pytest.raises(DataError, match="subject3"):
        lafan.load_lafan(folder)
    with pytest.raises(DataError, match="longer than 65"):
        only = tmp_path / "short"
        only.mkdir()
        for name in ("walk1_subject1", "fight1_subject5"):
            (only / f"{name}.bvh").write_bytes((folder / f"{name}.bvh").read_bytes())
        lafan.load_lafan(only, train=["subject1"])


def test_another_skeleton_or_rate_is_refused(tmp_path):
    whole = take(70, 1)
    fewer = Skeleton(whole.skeleton.names[:21], lafan.PARENTS[:21], whole.skeleton.offsets[:21])
    for wrong in (replace(whole, skeleton=fewer, rot=whole.rot[:, :21]), replace(whole, fps=60.0)):
        bvh.save(tmp_path / "walk1_subject1.bvh", wrong)
        with pytest.raises(DataError, match="LAFAN1's tree"):
            lafan.load_lafan(tmp_path, train=["subject1"], test=["subject1"])


@pytest.mark.parametrize("gap", [0, 55, 56])
def test_windows_too_short_for_the_gap(data, gap):
    with pytest.raises(ShapeError, match="gap"):
        lafan.hidden(data.windows, gap)


def test_scores_refuse_other_shapes(data):
    with pytest.raises(ShapeError, match="20 or more"):
        lafan.score(data.windows.cut(0, 15), data.windows, data.statistics, 10)
    with pytest.raises(DataError, match="no training recording"):
        lafan.statistics([])
    with pytest.raises(ShapeError):
        inbetween.l2q(torch.zeros(1, 3, 2, 4), torch.zeros(1, 1, 2, 4))
    with pytest.raises(DataError, match="never changes"):
        inbetween.l2p(torch.zeros(3, 2, 3), torch.zeros(3, 2, 3), torch.zeros(2, 3), torch.zeros(2, 3))


def test_published_numbers_are_agreed_with_to_their_tolerance():
    for name in ("zero velocity", "interpolation"):
        for k, gap in enumerate(lafan.GAPS):
            exact = {m: lafan.PUBLISHED[name, m][k] for m in lafan.TOLERANCE}
            assert lafan._agrees(name, gap, exact)
            for m, near in lafan.TOLERANCE.items():
                assert not lafan._agrees(name, gap, exact | {m: exact[m] + 1.1 * near})
    assert not lafan._agrees("interpolation", 5, {m: lafan.PUBLISHED["zero velocity", m][0] for m in lafan.TOLERANCE})
