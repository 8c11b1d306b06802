from __future__ import annotations

import math

import numpy as np

from famle_envs import Situation
from famle_envs.ant import AntEnv

JOINTS = range(8)


def test_training_situations_are_the_twenty_of_the_paper() -> None:
    expected = {Situation()}
    expected |= {Situation(motor_gain=[1] * joint + [0]) for joint in JOINTS}
    expected |= {Situation(orientation_error=math.radians(degrees)) for degrees in range(30, 360, 30)}
    assert AntEnv.training_situations[0].is_intact
    assert len(AntEnv.training_situations) == len(expected) == 20
    assert set(AntEnv.training_situations) == expected


def test_sampled_situation_is_an_unseen_one_of_a_dead_joint_and_a_yaw_error() -> None:
    rng = np.random.default_rng(0)
    sampled = [AntEnv.sample_situation(rng) for _ in range(200)]
    for situation in sampled:
        assert situation not in AntEnv.training_situations
        assert situation.faults == {"motor_gain", "orientation_error"}
        assert sorted(situation.motor_gain)[:2] in ([0.0], [0.0, 1.0])
        assert abs(situation.orientation_error) >= math.radians(15) - 1e-9
    assert len(set(sampled)) == 200
    assert {situation.motor_gain.index(0.0) for situation in sampled} == set(JOINTS)
    errors = [situation.orientation_error for situation in sampled]
    assert min(errors) < -2.5
    assert max(errors) > 2.5
