import math
import warnings
from collections.abc import Callable, Iterator
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
from famle_envs.reacher import ReacherEnv

ID = "FamleReacher-v0"
JOINTS = range(5)
TIP = slice(10, 12)
FORWARD = np.full(5, 0.8)
PAPER = Situation(motor_gain=(-1, 1, 1, 0, 1))
CHECKED = [*ReacherEnv.presets, "joint 1 sensor off by 20 deg", "joint 2 locked", "joint 3 at gain 0.3"]

Make = Callable[..., ReacherEnv]


@pytest.fixture
def make() -> Iterator[Make]:
    """Makes bare environments, already reset, and closes them in the end."""
    made: list[ReacherEnv] = []

    def make_env(**kwargs: Any) -> ReacherEnv:
        made.append(ReacherEnv(**kwargs))
        made[-1].reset(seed=0)
        return made[-1]

    yield make_env
    for env in made:
        env.close()


def run(env: ReacherEnv, action: np.ndarray, steps: int) -> np.ndarray:
    """The last observation after repeating an action."""
    for _ in range(steps):
        obs = env.step(action)[0]
    return obs


def trajectory(env: ReacherEnv, seed: int = 0) -> np.ndarray:
    """All observations and rewards of an episode of random actions, (31, 13)."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (30, 5))
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    for action in actions:
        obs, reward, *_ = env.step(action)
        rows.append(np.append(obs, reward))
    return np.stack(rows)


# --- Making and checking ---


@pytest.mark.parametrize(
    "written",
    [PAPER, {"motor_gain": [-1, 1, 1, 0, 1]}, "paper", "joint 0 reversed, joint 3 dead"],
    ids=["situation", "mapping", "preset", "description"],
)
def test_make_takes_a_situation_in_every_form(written: Any) -> None:
    env = gym.make(ID, situation=written)
    assert env.unwrapped.situation == PAPER
    _, info = env.reset()
    assert info["situation"] == ("paper" if written == "paper" else "joint 0 reversed, joint 3 dead")
    env.close()


def test_robot_is_intact_by_default(make: Make) -> None:
    env = make()
    assert env.situation.is_intact
    assert env.situation.motor_gain == (1.0,) * 5


@pytest.mark.parametrize("situation", CHECKED)
@pytest.mark.parametrize("check", [check_with_gymnasium, check_with_sb3], ids=["gymnasium", "sb3"])
def test_environment_checkers_have_no_complaint(check: Callable[[gym.Env], None], situation: str) -> None:
    env = gym.make(ID, situation=situation, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(env.unwrapped)
    env.close()


@pytest.mark.parametrize(
    "situation",
    [Situation(motor_gain=(0.5,), locked_joints=(3,), joint_offset=(0.1,), name="mine"), {"locked_joints": (1,)}, None],
    ids=["situation", "mapping", "intact"],
)
def test_spec_round_trip_through_json_keeps_situation_and_goal(situation: Any) -> None:
    env = gym.make(ID, situation=situation, goal=(0.5, -0.5))
    copy = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert copy.unwrapped.situation == env.unwrapped.situation
    assert copy.unwrapped.situation.name == env.unwrapped.situation.name
    assert copy.unwrapped.goal == (0.5, -0.5)
    env.close()
    copy.close()


def test_episode_is_truncated_after_50_steps_and_never_terminated() -> None:
    env = gym.make(ID)
    env.reset(seed=0)
    flags = [env.step(env.action_space.sample())[2:4] for _ in range(50)]
    assert flags == [(False, False)] * 49 + [(False, True)]
    env.close()


@pytest.mark.parametrize("render_mode", ["human", "ansi"])
def test_unknown_render_mode_is_refused(render_mode: str) -> None:
    with pytest.raises(ValueError, match=rf"render_mode must be None or one of \['rgb_array'\], got '{render_mode}'"):
        ReacherEnv(render_mode=render_mode)


# --- Determinism ---


@pytest.mark.parametrize(
    "situation", [None, "paper", "joint 1 locked, joint 3 locked", "joint 2 at gain 0.3, joint 0 sensor off by 10 deg"]
)
def test_same_seed_gives_the_same_bits_after_another_history_and_elsewhere(make: Make, situation: Any) -> None:
    fresh, used = make(situation=situation), make(situation=situation)
    expected = trajectory(fresh)
    run(used, np.ones(5), 40)  # against the joint limits
    used.set_situation("joint 0 locked, joint 2 locked, joint 4 dead")
    trajectory(used, seed=1)
    used.set_situation(situation)
    np.testing.assert_array_equal(trajectory(used), expected)
    np.testing.assert_array_equal(trajectory(fresh), expected)


def test_different_situations_give_different_trajectories(make: Make) -> None:
    env = make()
    intact = trajectory(env)
    env.set_situation("paper")
    assert np.abs(trajectory(env)[-1, TIP] - intact[-1, TIP]).max() > 0.1


def test_environments_in_one_process_do_not_disturb_each_other(make: Make) -> None:
    alone = trajectory(make())
    one, other = make(), make(situation="joint 0 locked")
    rows = [one.reset(seed=0)[0]]
    for action in np.random.default_rng(0).uniform(-1, 1, (30, 5)):
        rows.append(one.step(action)[0])
        other.step(-action)
    np.testing.assert_array_equal(np.stack(rows), alone[:, :12])


# --- The physics of a situation ---


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("gain", [1.0, 0.5, 0.0, -0.5, -1.0])
def test_gain_scales_the_travel_of_its_joint_only(make: Make, joint: int, gain: float) -> None:
    env = make(situation={"motor_gain": [1.0] * joint + [gain]})
    commanded = np.where(np.arange(5) == joint, gain, 1.0) * 0.8 * 0.7  # rad in the 1 s of 10 steps
    np.testing.assert_allclose(run(env, FORWARD, 10)[:5], commanded, atol=0.075)


@pytest.mark.parametrize("joint", JOINTS)
def test_joint_locked_in_mid_run_stays_where_it_was_while_the_others_move(make: Make, joint: int) -> None:
    env = make()
    locked_at = run(env, FORWARD, 5)
    env.set_situation({"locked_joints": [joint]})
    later = run(env, -FORWARD, 10)
    assert later[joint] == pytest.approx(locked_at[joint], abs=0.03)
    assert np.delete(locked_at[:5] - later[:5], joint).min() > 0.4


def test_unlocked_joint_moves_again(make: Make) -> None:
    env = make(situation="joint 2 locked")
    assert run(env, FORWARD, 5)[2] == pytest.approx(0.0, abs=0.03)
    env.set_situation(None)
    assert run(env, FORWARD, 5)[2] > 0.15


def test_joint_locked_in_mid_run_is_locked_at_the_start_after_a_reset(make: Make) -> None:
    env = make()
    run(env, FORWARD, 5)
    env.set_situation("joint 1 locked")
    env.reset()
    assert run(env, FORWARD, 10)[1] == pytest.approx(0.0, abs=0.03)


def test_joint_offset_shifts_the_measured_angle_only(make: Make) -> None:
    intact = trajectory(make())
    shifted = trajectory(make(situation={"joint_offset": [0.0, 0.25, 0.0, -0.4]}))
    np.testing.assert_allclose(
        shifted[:, :5] - intact[:, :5], np.broadcast_to([0.0, 0.25, 0.0, -0.4, 0.0], (31, 5)), atol=1e-6
    )
    np.testing.assert_array_equal(shifted[:, 5:], intact[:, 5:])


@pytest.mark.parametrize("offset", [4.0, -4.0, 100.0])
def test_measured_angle_wraps(make: Make, offset: float) -> None:
    env = make(situation={"joint_offset": [0.0, offset]})
    measured = env.reset()[0][1]
    assert -math.pi <= measured <= math.pi
    assert math.cos(measured - offset) == pytest.approx(1.0)


def test_base_joint_turns_past_pi_and_its_measurement_wraps(make: Make) -> None:
    env = make()
    obs = run(env, np.array([1.0, 0.0, 0.0, 0.0, 0.0]), 50)
    assert obs[0] == pytest.approx(3.5 - 2 * math.pi, abs=0.02)
    np.testing.assert_allclose(obs[TIP], [1.5 * math.cos(3.5), 1.5 * math.sin(3.5)], atol=0.1)
    assert obs in env.observation_space


@pytest.mark.parametrize("situation", ["intact", "joint 0 dead", "joint 0 locked"])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_arm_driven_against_its_joint_limits_comes_to_rest_there(make: Make, situation: str, direction: float) -> None:
    obs = run(make(situation=situation), direction * np.array([0.0, 1.0, 1.0, 1.0, 1.0]), 45)
    np.testing.assert_allclose(obs[:5], direction * np.array([0.0, 1.0472, 1.0472, 1.0472, 1.0472]), atol=0.05)
    np.testing.assert_allclose(obs[5:10], 0.0, atol=0.05)


# --- Changing the situation ---


def test_set_situation_takes_effect_in_mid_episode_and_sticks_over_resets(make: Make) -> None:
    env = make()
    before = run(env, FORWARD, 3)[0]
    env.set_situation("joint 0 reversed")
    obs, *_, info = env.step(FORWARD)
    assert obs[0] < before - 0.03
    assert info["situation"] == "joint 0 reversed"
    for seed in (None, 1):
        _, info = env.reset(seed=seed)
        assert info["situation"] == "joint 0 reversed"
        assert run(env, FORWARD, 3)[0] < -0.1


def test_situation_in_reset_options_sticks_until_it_is_changed(make: Make) -> None:
    env = make()
    _, info = env.reset(options={"situation": {"motor_gain": [0.0]}})
    assert info["situation"] == "joint 0 dead"
    env.reset()
    assert run(env, FORWARD, 3)[0] == pytest.approx(0.0, abs=0.02)
    env.reset(options={"situation": None})
    assert env.situation.is_intact
    assert run(env, FORWARD, 3)[0] > 0.1


def test_unknown_reset_option_is_refused(make: Make) -> None:
    with pytest.raises(ValueError, match="no option 'situations'; the only one is 'situation'"):
        make().reset(options={"situations": "paper"})


@pytest.mark.parametrize(
    "fault", [{"orientation_error": 0.5}, {"friction": 2.0}, {"base_mass": 1.5}], ids=lambda fault: next(iter(fault))
)
def test_unsupported_fault_is_refused_by_name_and_changes_nothing(make: Make, fault: dict[str, float]) -> None:
    message = f"cannot have the fault '{next(iter(fault))}'"
    with pytest.raises(ValueError, match=message):
        gym.make(ID, situation=fault)
    env = make(situation="paper")
    with pytest.raises(ValueError, match=message):
        env.set_situation(fault)
    with pytest.raises(ValueError, match=message):
        env.reset(options={"situation": fault})
    assert env.situation == PAPER


def test_unknown_preset_is_refused_with_the_list_of_presets(make: Make) -> None:
    with pytest.raises(ValueError, match=r"'papper'; did you mean 'paper'\? Presets: intact, joint 0 dead, .*paper"):
        make(situation="papper")


def test_joint_beyond_the_arm_is_refused(make: Make) -> None:
    with pytest.raises(ValueError, match=r"motor_gain speaks of 6 joints; those of ReacherEnv are 0 to 4"):
        make(situation="joint 5 dead")


def test_training_situations_are_the_eleven_of_the_paper() -> None:
    expected = {Situation()} | {Situation(motor_gain=[1] * j + [g]) for j in JOINTS for g in (0, -1)}
    assert len(ReacherEnv.training_situations) == 11
    assert set(ReacherEnv.training_situations) == expected
    assert ReacherEnv.presets["paper"] == PAPER


@pytest.mark.parametrize("n_faults", range(1, 6))
def test_sampled_situation_is_unseen_and_has_that_many_faulty_joints(n_faults: int) -> None:
    rng = np.random.default_rng(n_faults)
    sampled = [ReacherEnv.sample_situation(rng, n_faults) for _ in range(60)]
    for situation in sampled:
        assert situation not in ReacherEnv.training_situations
        faulty = (np.array(situation.motor_gain) != 1.0) | (np.array(situation.joint_offset) != 0.0)
        assert faulty.sum() == n_faults
        assert situation.faults <= ReacherEnv.supported_faults
    assert len(set(sampled)) > 10


def test_sampled_situation_is_reproducible() -> None:
    first, again, other = (
        [ReacherEnv.sample_situation(rng) for _ in range(5)] for rng in map(np.random.default_rng, (7, 7, 8))
    )
    assert first == again
    assert first != other


@pytest.mark.parametrize("n_faults", [-1, 0, 6])
def test_impossible_number_of_faults_is_refused(n_faults: int) -> None:
    with pytest.raises(ValueError, match=f"between 1 and 5, got {n_faults}"):
        ReacherEnv.sample_situation(np.random.default_rng(0), n_faults)


# --- Actions and rewards ---


@pytest.mark.parametrize(
    "action",
    [np.zeros(4), np.zeros((1, 5)), 0.0, [0, 0, math.nan, 0, 0], [math.inf, 0, 0, 0, 0]],
    ids=["short", "batched", "scalar", "nan", "inf"],
)
def test_malformed_action_is_refused(make: Make, action: Any) -> None:
    with pytest.raises(ValueError, match=r"must be \(5,\) finite numbers"):
        make().step(action)


def test_action_outside_its_range_is_clipped(make: Make) -> None:
    sign = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    np.testing.assert_array_equal(run(make(), 3.0 * sign, 3), run(make(), sign, 3))


def test_weak_motor_scales_the_clipped_action(make: Make) -> None:
    weak = {"motor_gain": [0.5]}
    np.testing.assert_array_equal(
        run(make(situation=weak), np.full(5, 4.0), 3), run(make(situation=weak), np.ones(5), 3)
    )


@pytest.mark.parametrize("goal", [(-1.0, 1.0), (0.3, -0.7)])
def test_batched_reward_agrees_with_step_in_numpy_and_torch(make: Make, goal: tuple[float, float]) -> None:
    env = make(goal=goal)
    rows = trajectory(env)
    obs, next_obs, rewards = rows[:-1, :12].astype(np.float32), rows[1:, :12].astype(np.float32), rows[1:, 12]
    actions = np.zeros((30, 5), dtype=np.float32)
    np.testing.assert_allclose(rewards, np.exp(-np.linalg.norm(next_obs[:, TIP] - np.array(goal), axis=1)), rtol=1e-5)
    batched = env.reward_fn(obs, actions, next_obs)
    assert isinstance(batched, np.ndarray)
    np.testing.assert_allclose(batched, rewards, rtol=1e-5)
    tensors = env.reward_fn(torch.tensor(obs), torch.tensor(actions), torch.tensor(next_obs).reshape(5, 6, 12))
    assert isinstance(tensors, torch.Tensor)
    np.testing.assert_allclose(tensors.numpy(), rewards.reshape(5, 6), rtol=1e-5)


def test_reward_is_one_at_the_goal_and_less_elsewhere(make: Make) -> None:
    at_goal = make(goal=(1.5, 0.0)).step(np.zeros(5))[1]
    elsewhere = make().step(np.zeros(5))[1]
    assert isinstance(at_goal, float)
    assert at_goal == pytest.approx(1.0)
    assert elsewhere == pytest.approx(math.exp(-math.hypot(2.5, 1.0)))


@pytest.mark.parametrize("goal", [(1.0,), (1, 2, 3), (math.nan, 0.0), (0.0, math.inf), None, 1.0, "ab"], ids=str)
def test_bad_goal_is_refused(goal: Any) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 (NumPy's own words for what is not a number)
        ReacherEnv(goal=goal)


# --- Rendering and closing ---


def red_pixels(picture: np.ndarray) -> int:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return int(((red > 100) & (red > 2 * green) & (red > 2 * blue)).sum())


def test_picture_has_its_size_and_changes_when_the_arm_moves(make: Make) -> None:
    env = make(render_mode="rgb_array")
    before = env.render()
    assert before.shape == (480, 480, 3)
    assert before.dtype == np.uint8
    np.testing.assert_array_equal(env.render(), before)
    run(env, FORWARD, 5)
    assert (env.render() != before).any()


@pytest.mark.parametrize("situation", ["joint 2 dead", "joint 2 locked", "joint 2 reversed", "joint 2 at gain 0.4"])
def test_link_of_a_faulty_joint_is_red_until_it_is_repaired(make: Make, situation: str) -> None:
    env = make(render_mode="rgb_array")
    intact = env.render()
    assert red_pixels(intact) == 0
    env.set_situation(situation)
    assert red_pixels(env.render()) > 100
    env.set_situation(None)
    np.testing.assert_array_equal(env.render(), intact)


def test_situation_of_the_constructor_is_drawn_too(make: Make) -> None:
    assert red_pixels(make(render_mode="rgb_array", situation="joint 4 dead").render()) > 100


def test_goal_is_drawn(make: Make) -> None:
    pictures = [make(render_mode="rgb_array", goal=goal).render() for goal in ((-1.0, 1.0), (0.5, 0.5))]
    assert (pictures[0] != pictures[1]).any()


def test_render_without_a_mode_returns_none_and_says_why(make: Make) -> None:
    env = make()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        picture = env.render()
    assert picture is None


def test_closed_environment_closes_again_but_does_nothing_else(make: Make) -> None:
    env = make(render_mode="rgb_array")
    env.close()
    env.close()
    for use in (lambda: env.step(np.zeros(5)), env.reset, env.render, lambda: env.set_situation("paper")):
        with pytest.raises(RuntimeError, match="closed; make a new one"):
            use()


# --- Stable-Baselines3 ---


def test_situation_reaches_one_environment_of_a_vec_env_and_survives_autoreset() -> None:
    vec_env = make_vec_env(ID, n_envs=2, seed=0, env_kwargs={"situation": "paper"})
    assert isinstance(vec_env, DummyVecEnv)
    vec_env.reset()
    vec_env.env_method("set_situation", "joint 1 dead", indices=[1])
    dones = np.zeros(2, dtype=bool)
    for _ in range(50):
        _, _, dones, infos = vec_env.step(np.ones((2, 5), dtype=np.float32))
    assert dones.all()
    _, _, _, infos = vec_env.step(np.ones((2, 5), dtype=np.float32))
    assert [info["situation"] for info in infos] == ["paper", "joint 1 dead"]
    assert vec_env.get_attr("situation") == [PAPER, Situation(motor_gain=(1, 0))]
    vec_env.close()


def test_ppo_learns_on_it_for_two_rollouts() -> None:
    vec_env = make_vec_env(ID, n_envs=1, seed=0, env_kwargs={"situation": "joint 2 dead"})
    model = PPO("MlpPolicy", vec_env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = model.policy.action_net.weight.clone()
    model.learn(64)
    assert model.num_timesteps == 64
    assert not torch.equal(model.policy.action_net.weight, before)
    vec_env.close()
