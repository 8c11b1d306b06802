"""Faults of motors and sensors, in robots that know nothing of situations."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from famle_envs import Situation
from famle_envs.faults import FaultWrapper, actuator_faults, make_faulty
from famle_envs.wrappers import RandomSituation

Array = npt.NDArray[Any]
MakeEnv = Callable[..., gym.Env[Any, Any]]
ROBOTS = ("HalfCheetah-v5", "Ant-v5", "InvertedPendulum-v5", "Pendulum-v1")
few = settings(max_examples=8)


class Echo(gym.Env[Array, Array]):
    """Two motors, three sensors that show the number of the step, and a record of the commands that arrive."""

    action_space = spaces.Box(-2.0, 2.0, (2,), np.float64)
    observation_space = spaces.Box(-10.0, 10.0, (3,), np.float64)
    angle_dims = (2,)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.time, self.told, self.options = 0, [], options
        return self.observe(), {}

    def step(self, action: Array) -> Any:
        self.time += 1
        self.told.append(tuple(action))
        return self.observe(), float(action[0]), False, False, {}

    def observe(self) -> Array:
        return np.full(3, float(self.time))

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return next_obs[..., 0]


def commands(situation: str, *actions: tuple[float, float]) -> list[tuple[float, float]]:
    env = FaultWrapper(Echo(), situation)
    env.reset(seed=0)
    for action in actions:
        env.step(np.array(action))
    return env.unwrapped.told


def readings(situation: str | None, steps: int = 5, seed: int = 0) -> Array:
    env = FaultWrapper(Echo(), situation)
    first = env.reset(seed=seed)[0]
    return np.array([first, *(env.step(np.zeros(2))[0] for _ in range(steps))])


def life(env: gym.Env[Any, Any], steps: int = 20, seed: int = 3) -> list[Any]:
    """All that an agent sees of an episode with random actions, to the last bit."""
    obs, _ = env.reset(seed=seed)
    rng, seen = np.random.default_rng(seed), [obs.tobytes()]
    space: Any = env.action_space
    for _ in range(steps):
        obs, reward, terminated, truncated, _ = env.step(rng.uniform(space.low, space.high).astype(space.dtype))
        seen.append((obs.tobytes(), obs.dtype, float(reward), terminated, truncated))
    return seen


# --- motors ---------------------------------------------------------------------------------------------------


def test_gain_is_a_factor_on_the_command_that_was_clipped() -> None:
    assert commands("motor 0 dead, motor 1 at gain 0.5", (1, 1), (2, 9)) == [(0, 0.5), (0, 1)]
    assert commands("motor 0 reversed", (0.5, 0.5)) == [(-0.5, 0.5)]


def test_stuck_motor_does_the_same_whatever_it_is_told() -> None:
    assert commands("motor 1 stuck at 1.5", (1, 1), (2, -1)) == [(1, 1.5), (2, 1.5)]


def test_motor_may_be_stuck_at_a_bound_that_is_rounded() -> None:
    env = Echo()
    env.action_space = spaces.Box(-0.7, 0.7, (2,), np.float32)  # whose bound is a little less
    assert FaultWrapper(env, "motor 0 stuck at 0.7").situation.motor_stuck == (0.7, None)


def test_late_motor_is_still_until_it_is_told() -> None:
    assert commands("motor 0 delayed by 2 steps", (1, 5), (2, 6), (0.5, 7), (0, 0)) == [(0, 2), (0, 2), (1, 2), (2, 0)]


def test_action_of_the_user_is_not_changed() -> None:
    action = np.array([1.0, 1.0])
    env = FaultWrapper(Echo(), "motor 0 dead")
    env.reset()
    env.step(action)
    assert action.tolist() == [1.0, 1.0]


def test_reward_is_of_what_the_motors_do() -> None:
    env = FaultWrapper(Echo(), "motor 0 dead")
    env.reset()
    assert env.step(np.array([1.0, 1.0]))[1] == 0.0


def test_action_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(2,\), got \(3,\)"):
        commands("motor 0 dead", (1, 1, 1))


# --- sensors --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("situation", "sensor", "expected"),
    [
        ("sensor 0 off by 0.5", 0, [0.5, 1.5, 2.5, 3.5, 4.5, 5.5]),
        ("sensor 1 at gain 2, sensor 1 off by 1", 1, [1, 3, 5, 7, 9, 10]),  # and saturates
        ("sensor 0 dead", 0, [0, 0, 0, 0, 0, 0]),
        ("sensor 1 delayed by 2 steps", 1, [0, 0, 0, 1, 2, 3]),
        ("sensor 1 frozen", 1, [0, 0, 0, 0, 0, 0]),
    ],
)
def test_sensor_reads_what_its_fault_makes_of_it(situation: str, sensor: int, expected: list[float]) -> None:
    read = readings(situation)
    assert read[:, sensor].tolist() == expected
    others = [i for i in range(3) if i != sensor]
    np.testing.assert_array_equal(read[:, others], readings(None)[:, others])


def test_angle_that_is_off_comes_round() -> None:
    read = readings("sensor 2 off by 1", steps=3)[:, 2]
    np.testing.assert_allclose(read, [1, 2, 3, 4 - 2 * math.pi])


def test_noise_has_its_deviation_and_follows_the_seed() -> None:
    errors = readings("sensor 0 noise 0.1", steps=9)[:, 0] - np.arange(10)
    assert 0.02 < errors.std() < 0.3
    np.testing.assert_array_equal(readings("sensor 0 noise 0.1"), readings("sensor 0 noise 0.1"))
    assert (readings("sensor 0 noise 0.1")[:, 0] != readings("sensor 0 noise 0.1", seed=1)[:, 0]).all()


def test_lost_reading_repeats_the_last_one() -> None:
    read = readings("sensor 1 loses 0.5 of its readings", steps=200)[:, 1]
    kept = np.diff(np.minimum(read, 9.0)[:9]) != 0  # the space ends at 10
    assert 0 < kept.sum() < 8
    assert (read[:10] <= np.arange(10)).all()


def test_sensor_freezes_at_its_last_reading_and_thaws() -> None:
    env = FaultWrapper(Echo())
    env.reset()
    env.step(np.zeros(2))
    env.set_situation("sensor 0 frozen")
    assert [env.step(np.zeros(2))[0][0] for _ in range(2)] == [1, 1]
    env.set_situation("intact")
    assert env.step(np.zeros(2))[0][0] == 4


# --- the interface of the robots of famle_envs ---------------------------------------------------------------


@pytest.mark.parametrize(
    "written", [Situation(motor_gain=(1, 0)), {"motor_gain": [1, 0]}, "joint 1 dead", "motor 1 dead"], ids=str
)
def test_situation_may_be_written_in_every_form(written: Any) -> None:
    env = FaultWrapper(Echo(), written)
    assert env.situation == Situation(motor_gain=(1, 0))
    assert env.reset()[1]["situation"] == "joint 1 dead"
    assert env.step(np.zeros(2))[4]["situation"] == "joint 1 dead"


def test_situation_stays_until_it_is_changed() -> None:
    env = FaultWrapper(Echo())
    env.set_situation("joint 0 dead")
    env.reset()
    assert env.reset()[1]["situation"] == "joint 0 dead"
    _, info = env.reset(options={"situation": "intact", "mine": 1})
    assert info["situation"] == "intact"
    assert env.unwrapped.options == {"mine": 1}


def test_name_of_a_situation_is_its_label() -> None:
    env = FaultWrapper(Echo(), Situation(partial=True, motor_gain=(0,), name="lame"))
    assert env.reset()[1]["situation"] == "lame"


def test_attributes_of_the_robot_are_there() -> None:
    env = FaultWrapper(Echo(), "sensor 0 noise 0.1")
    assert env.get_wrapper_attr("angle_dims") == (2,)
    assert env.get_wrapper_attr("reward_fn")(0, 0, np.array([3.0])) == 3.0
    assert env.observation_space is env.unwrapped.observation_space


def test_it_draws_situations_at_random() -> None:
    env = RandomSituation(FaultWrapper(Echo()))
    drawn = {env.reset(seed=i)[1]["situation"] for i in range(40)}
    assert drawn == {situation.label for situation in actuator_faults(env)}


@pytest.mark.parametrize("robot", ROBOTS)
def test_spec_makes_the_broken_robot_again_also_from_json(make_env: MakeEnv, robot: str) -> None:
    env = make_faulty(
        robot, Situation(partial=True, motor_gain=(0.5,), sensor_noise=(0, 0.1), name="mine"), max_episode_steps=9
    )
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        made = make_env(spec)
        assert made.get_wrapper_attr("situation") == env.get_wrapper_attr("situation")
        assert made.get_wrapper_attr("situation").name == "mine"
        assert life(made) == life(env)
    env.close()


def test_copy_is_as_broken(make_env: MakeEnv) -> None:
    env = FaultWrapper(make_env("HalfCheetah-v5"), "mass x 2, joint 1 locked, motor 0 delayed by 1 step")
    assert life(copy.deepcopy(env)) == life(env)


def test_make_faulty_breaks_our_robots_too(make_env: MakeEnv) -> None:
    env = make_faulty("FamleReacher-v0", "joint 1 locked")
    assert env.unwrapped.situation == Situation(locked_joints=(1,))
    env.close()


@pytest.mark.parametrize("robot", ROBOTS)
def test_checker_of_gymnasium_has_no_complaint(make_env: MakeEnv, robot: str) -> None:
    env = FaultWrapper(make_env(robot).unwrapped, "motor 0 delayed by 1 step, sensor 0 noise 0.1, sensor 1 frozen")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*(infinity|from the unwrapped|symmetric and normalized).*")
        check_env(env, skip_render_check=True)


def test_actuator_faults_are_each_motor_dead_weak_and_reversed() -> None:
    names = [situation.label for situation in actuator_faults(Echo())]
    assert names[:3] == ["intact", "joint 0 dead", "joint 1 dead"]
    assert names[3:] == [f"joint {i} {fault}" for fault in ("at gain 0.5", "reversed") for i in (0, 1)]
    assert [situation.label for situation in actuator_faults(Echo(), gains=[0.2])[1:]] == [
        "joint 0 at gain 0.2",
        "joint 1 at gain 0.2",
    ]


def test_motor_that_only_pushes_is_not_reversed() -> None:
    env = Echo()
    env.action_space = spaces.Box(np.array([0.0, -1.0]), np.array([1.0, 1.0]), dtype=np.float64)
    assert [s.label for s in actuator_faults(env, gains=[-1.0])] == ["intact", "joint 1 reversed"]


# --- laws -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ROBOTS)
def test_intact_robot_is_the_bare_environment_to_the_last_bit(make_env: MakeEnv, robot: str) -> None:
    bare, wrapped = make_env(robot), FaultWrapper(make_env(robot))
    assert life(wrapped, steps=60) == life(bare, steps=60)


def signals(n_motors: int, n_sensors: int) -> st.SearchStrategy[Situation]:
    """Faults of the motors and sensors of a robot whose action space holds [-1, 1]."""
    numbers = st.floats(-100, 100)
    return st.builds(
        Situation,
        motor_gain=st.lists(st.floats(-1, 1), max_size=n_motors),
        motor_delay=st.lists(st.integers(0, 5), max_size=n_motors),
        motor_stuck=st.lists(st.none() | st.floats(-1, 1), max_size=n_motors),
        sensor_gain=st.lists(numbers, max_size=n_sensors),
        sensor_offset=st.lists(numbers, max_size=n_sensors),
        sensor_noise=st.lists(st.floats(0, 10), max_size=n_sensors),
        sensor_delay=st.lists(st.integers(0, 5), max_size=n_sensors),
        sensor_dropout=st.lists(st.floats(0, 1), max_size=n_sensors),
    )


@few
@given(signals(1, 3))
def test_what_a_robot_prints_it_reads(situation: Situation) -> None:
    env = FaultWrapper(gym.make("Pendulum-v1"), situation)
    text = str(env.situation)
    assert env.reset(seed=0)[1]["situation"] == text
    life_before = life(env)
    env.set_situation("intact")
    env.set_situation(text)
    assert env.situation == situation
    assert life(env) == life_before
    env.close()


@few
@given(signals(1, 3))
def test_readings_stay_in_their_space_and_the_repaired_robot_is_intact(situation: Situation) -> None:
    env = FaultWrapper(gym.make("Pendulum-v1"), situation)
    obs, _ = env.reset(seed=0)
    for _ in range(5):
        assert env.observation_space.contains(obs)
        obs, *_ = env.step(env.action_space.sample())
    env.set_situation(None)
    assert life(env) == life(gym.make("Pendulum-v1"))
    env.close()


# --- what is refused ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("motor 7 dead", "motor_gain speaks of 8 joints; those of Pendulum-v1 are 0 to 0"),
        ("sensor 3 frozen", "sensor_dropout speaks of 4 sensors; those of Pendulum-v1 are 0 to 2"),
        ({"motor_gain": [math.nan]}, "motor_gain must be finite"),
        ({"motor_gain": [1, 1, 1]}, "motor_gain speaks of 3 joints"),
        ({"motor_gains": [1]}, "did you mean 'motor_gain'"),
        ("motor 0 stuck at 3", "must lie in the action space; motor 0 of Pendulum-v1 goes from -2 to 2, got 3"),
        ("motor 0\ndead", r"Cannot read 'motor 0\\ndead'. Write faults like 'joint 3 dead"),
        ("moteur 0 détruit", "Cannot read 'moteur 0 détruit'"),
        ("motor ٣ dead", "Cannot read"),
        ("", "Cannot read ''"),
        ("motor 0 dead, motor 0 reversed", "contradicts"),
        ("motor 99999 dead", "No robot has"),
        ("friction x -1", "friction .* above 0, got -1"),
        ("friction x 0.5", "'friction' needs a MuJoCo model .* which Pendulum-v1 has not"),
        ("joint 0 locked", "'locked_joints' needs a MuJoCo model"),
        ("joint 0 sensor off by 5 deg", "cannot have the fault 'joint_offset'; .*sensor_offset"),
        ("yaw sensor off by 5 deg", "cannot have the fault 'orientation_error'"),
    ],
)
def test_situation_that_makes_no_sense_is_refused_with_the_remedy(written: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_faulty("Pendulum-v1", written)


def test_refused_situation_changes_nothing() -> None:
    env = FaultWrapper(Echo(), "joint 0 dead")
    with pytest.raises(ValueError, match="joints"):
        env.set_situation("motor 9 dead")
    assert env.situation == Situation(motor_gain=(0,))


def test_situation_of_another_type_is_refused() -> None:
    with pytest.raises(TypeError, match="got int"):
        make_faulty("Pendulum-v1", 3)


@pytest.mark.parametrize("robot", ["CartPole-v1", "FrozenLake-v1"])
def test_robot_without_continuous_actions_is_refused(make_env: MakeEnv, robot: str) -> None:
    with pytest.raises(ValueError, match="action space must be a one-dimensional Box of floats, got Discrete"):
        FaultWrapper(make_env(robot))


def test_robot_that_takes_situations_is_not_given_others(make_env: MakeEnv) -> None:
    for env in (make_env("FamleReacher-v0"), FaultWrapper(make_env("Pendulum-v1"))):
        with pytest.raises(ValueError, match=r"takes situations by itself; call set_situation\(\)"):
            FaultWrapper(env)
