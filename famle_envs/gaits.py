"""Four numbers -> a gait: periodic swings and lifts of four legs, two of which move together at a time (a trot)."""

from __future__ import annotations

import math

import numpy as np

from famle_envs.engines.world import Array

__all__ = ["GAIT_DIM", "trot"]

GAIT_DIM = 4  # steer, step, extension, offset
FREQUENCY = 2.0  # cycles per second
_SWING = 0.5  # amplitude of a leg's swing, at step 1
_MAX_LIFT = 0.4  # at extension 1
_STEEPNESS = 3.0  # of the lift, which is a sine cut off at both ends
_SIDE = np.array([1.0, 1.0, -1.0, -1.0])  # of the legs: left, left, right, right
_PHASE = np.array([math.pi, 0.0, math.pi, 0.0])  # back left, front left, front right, back right


def trot(action: Array, t: Array) -> tuple[Array, Array]:
    """How far each leg has swung backwards and how high it is lifted, over time.

    With w = 4 pi rad/s, A = clip(step + steer, -1, 1) on the left and clip(step - steer, -1, 1) on the right,
    E = 0.2 (extension + 1), and phi = 0 for front left and back right, pi for the others:

        swing = 0.5 A sin(w t + phi)
        lift  = clip(-3 cos(w t + phi), clip(0.4 offset - E, -E, 0), clip(0.4 offset + E, 0, E))

    Args:
        action: steer, step, extension and offset, (4,), in [-1, 1].
        t: Times in s, (n,).

    Returns:
        Swings, (n, 4), and lifts, (n, 4), in units of the robot's own; legs in the order back left, front left,
        front right, back right. A leg that swings backwards is on the ground: the robot walks forwards where the step
        is positive.
    """
    steer, step, extension, offset = action
    amplitude = np.clip(step + _SIDE * steer, -1.0, 1.0)
    height = 0.5 * _MAX_LIFT * (extension + 1.0)
    low = np.clip(_MAX_LIFT * offset - height, -height, 0.0)
    high = np.clip(_MAX_LIFT * offset + height, 0.0, height)
    phase = 2.0 * math.pi * FREQUENCY * t[:, None] + _PHASE
    return _SWING * amplitude * np.sin(phase), np.clip(-_STEEPNESS * np.cos(phase), low, high)
