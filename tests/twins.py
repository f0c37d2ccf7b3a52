"""Naive twins: literal scalar transcriptions that the vectorised library must agree with."""

from __future__ import annotations

import math

import numpy as np


def fk(parents, offsets, root, rot):
    """Forward kinematics of one frame, joint by joint in numpy: positions (J, 3), orientations (J, 3, 3)."""
    positions, orientations = [np.asarray(root)], [np.asarray(rot[0])]
    for joint in range(1, len(parents)):
        up = parents[joint]
        positions.append(positions[up] + orientations[up] @ offsets[joint])
        orientations.append(orientations[up] @ rot[joint])
    return np.array(positions), np.array(orientations)


def unroll_axis_angle(vectors):
    """Each vector (T, 3) replaced by the nearest of its equivalents to the one chosen before, turn by turn."""
    chosen = [np.asarray(vectors[0])]
    for a in np.asarray(vectors)[1:]:
        angle = np.linalg.norm(a)
        axis = a / angle if angle > 1e-15 else chosen[-1] / max(np.linalg.norm(chosen[-1]), 1e-300)
        candidates = [(angle + 2 * math.pi * k) * axis for k in range(-40, 41)]
        chosen.append(min(candidates, key=lambda c: np.linalg.norm(c - chosen[-1])))
    return np.array(chosen)


def hysteresis(on, off):
    """State that switches on where ``on``, off where ``off``, and else stays, starting off; lists of bool."""
    state, states = False, []
    for turn_on, turn_off in zip(on, off, strict=True):
        state = (state or bool(turn_on)) and not turn_off
        states.append(state)
    return states


def one_euro(x, fps, min_cutoff, beta, d_cutoff):
    """The one-euro filter on one list of numbers, after Casiez et al. 2012, Algorithm 1."""

    def alpha(cutoff):
        return 1 / (1 + fps / (2 * math.pi * cutoff))

    smooth, speed, out = x[0], 0.0, [x[0]]
    for now, before in zip(x[1:], x[:-1], strict=True):
        a = alpha(d_cutoff)
        speed = a * (now - before) * fps + (1 - a) * speed
        a = alpha(min_cutoff + beta * abs(speed))
        smooth = a * now + (1 - a) * smooth
        out.append(smooth)
    return out


def lbs(positions, orientations, bind_rot, joints, weights, template):
    """Linear blend skinning of one posed frame, vertex by vertex and joint by joint in numpy: (V, 3)."""
    posed = []
    for v, row in zip(template, weights, strict=True):
        terms = [
            w * (orientations[j] @ bind_rot[j].T @ (v - joints[j]) + positions[j]) for j, w in enumerate(row) if w > 0
        ]
        posed.append(sum(terms))
    return np.array(posed)
