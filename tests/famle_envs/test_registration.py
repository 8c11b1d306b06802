"""The robots by their Gymnasium ids: made, checked, and in Stable-Baselines3's hands."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_with_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_envs import Situation
from famle_envs.ant import AntEnv
from famle_envs.profile import Profile
from famle_envs.reacher import ReacherEnv
from famle_envs.robot_env import RobotEnv

MakeEnv = Callable[..., gym.Env[Any, Any]]

REACHER, ANT = "FamleReacher-v0", "FamleAnt-v0"
CLASSES: dict[str, type[RobotEnv]] = {REACHER: ReacherEnv, ANT: AntEnv}
BROKEN = Situation(partial=True, motor_gain=(-1, 1, 1, 0))
DESCRIPTION = "joint 0 reversed, joint 3 dead"
CHECKED = [
    *[(REACHER, name) for name in ReacherEnv.presets],
    *[(REACHER, fault) for fault in ("joint 1 sensor off by 20 deg", "joint 2 locked", "joint 3 at gain 0.3")],
    *[(ANT, fault) for fault in ("intact", "paper", "joint 2 locked", "friction x 0.3")],
]


@pytest.fixture(params=[REACHER, ANT], ids=["reacher", "ant"])
def env_id(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize(
    "written",
    [BROKEN, {"motor_gain": [-1, 1, 1, 0], "partial": True}, DESCRIPTION],
    ids=["situation", "mapping", "description"],
)
def test_make_takes_a_situation_in_every_form(make_env: MakeEnv, env_id: str, written: Any) -> None:
    env = make_env(env_id, situation=written)
    assert env.unwrapped.situation == BROKEN
    assert make_env(env_id).unwrapped.situation.is_intact
    assert env.reset()[1]["situation"] == DESCRIPTION


@pytest.mark.parametrize(("checked", "situation"), CHECKED)
@pytest.mark.parametrize("check", [check_with_gymnasium, check_with_sb3], ids=["gymnasium", "sb3"])
def test_environment_checkers_have_no_complaint(
    make_env: MakeEnv, check: Callable[[gym.Env], None], checked: str, situation: str
) -> None:
    env = make_env(checked, situation=situation, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if checked == ANT:  # whose velocities have no bounds
            warnings.filterwarnings("ignore", ".*observation space m.* value is -?infinity")
        check(env.unwrapped)


@pytest.mark.parametrize(
    "situation",
    [Situation(partial=True, motor_gain=(0.5,), locked_joints=(3,), name="mine"), {"locked_joints": (1,)}, None],
    ids=["situation", "mapping", "intact"],
)
def test_spec_makes_the_robot_again_also_from_json(make_env: MakeEnv, env_id: str, situation: Any) -> None:
    env = make_env(env_id, situation=situation)
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        copy = make_env(spec).unwrapped
        assert copy.situation == env.unwrapped.situation
        assert copy.situation.name == env.unwrapped.situation.name


def test_mapping_may_change_after_it_was_given(make_env: MakeEnv, env_id: str) -> None:
    gains = [0.5, 0.5]
    env = make_env(env_id, situation={"motor_gain": gains, "partial": True})
    gains[0] = 0.0
    env.reset()
    assert env.unwrapped.situation == Situation(motor_gain=(0.5, 0.5))


def test_episode_is_truncated_at_its_end_and_never_terminated(make_env: MakeEnv, env_id: str) -> None:
    steps = {REACHER: 50, ANT: 1000}[env_id]
    env = make_env(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    flags = [env.step(env.action_space.sample())[2:4] for _ in range(steps)]
    assert flags == [(False, False)] * (steps - 1) + [(False, True)]


def test_situation_reaches_one_environment_of_a_vec_env_and_survives_autoreset(env_id: str) -> None:
    vec_env = make_vec_env(env_id, n_envs=2, seed=0, env_kwargs={"situation": "paper", "max_episode_steps": 10})
    assert isinstance(vec_env, DummyVecEnv)
    vec_env.reset()
    vec_env.env_method("set_situation", "joint 1 dead", indices=[1])
    actions = np.ones((2, *vec_env.action_space.shape), dtype=np.float32)
    dones = [vec_env.step(actions)[2].all() for _ in range(10)]
    assert dones == [False] * 9 + [True]
    infos = vec_env.step(actions)[3]
    assert [info["situation"] for info in infos] == ["paper", "joint 1 dead"]
    assert vec_env.get_attr("situation") == [CLASSES[env_id].presets["paper"], Situation(motor_gain=(1, 0))]
    vec_env.close()


def test_ppo_learns_on_it_for_two_rollouts(env_id: str) -> None:
    vec_env = make_vec_env(env_id, n_envs=1, seed=0, env_kwargs={"situation": "joint 2 dead"})
    model = PPO("MlpPolicy", vec_env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = model.policy.action_net.weight.clone()
    model.learn(64)
    assert model.num_timesteps == 64
    assert not torch.equal(model.policy.action_net.weight, before)
    vec_env.close()


# --- numbers ------------------------------------------------------------------------------------------------


NUMBERS = [100, 100.0, np.int64(100), np.float32(100), np.array(100.0), Fraction(100), np.uint8(100)]


@pytest.mark.parametrize("rate", NUMBERS, ids=lambda value: type(value).__name__)
def test_numbers_are_numbers(rate: Any) -> None:
    env = gym.make("FamleAnt-v0", control_rate=rate)
    assert env.get_wrapper_attr("control_period") == pytest.approx(0.01)
    env.close()
    assert type(Profile("heavy", base_mass=rate, latency=rate).base_mass) is float
    assert Profile(base_mass=rate) == Profile(base_mass=100.0)


@pytest.mark.parametrize("rate", ["100", True, np.bool_(True), None, np.nan, [100.0], np.array([100.0, 1.0]), 1e9])
def test_what_is_no_rate_is_refused(rate: Any) -> None:
    with pytest.raises(ValueError, match="control_rate must be a number between"):
        gym.make("FamleAnt-v0", control_rate=rate)


@pytest.mark.parametrize("kind", [list, tuple, np.array, lambda goal: np.array(goal, np.float32)])
def test_goals_are_points(kind: Any) -> None:
    env = gym.make("FamleQuadruped-v0", goal=kind([1.5, -1.0]))
    assert env.get_wrapper_attr("goal") == (1.5, -1.0)
    env.close()
