"""Faults of a robot's body, through its MuJoCo model."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from famle_envs import Situation
from famle_envs.faults import FaultWrapper, make_faulty
from tests.famle_envs.test_faults import life

MakeEnv = Callable[..., gym.Env[Any, Any]]
ROBOTS = ("HalfCheetah-v5", "Ant-v5", "InvertedPendulum-v5")
MULTIPLIERS = st.floats(0.1, 10.0)


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> Any:
    """A robot to break, the same without a wrapper, and what an agent sees of that one."""
    env, bare = FaultWrapper(gym.make(request.param)), gym.make(request.param)
    yield env, bare, life(bare)
    env.close()
    bare.close()


def arrays(env: gym.Env[Any, Any]) -> dict[str, bytes]:
    model = env.unwrapped.model
    values = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: value.tobytes() for name, value in values.items() if isinstance(value, np.ndarray)}


@settings(max_examples=8)
@given(data=st.data())
def test_repaired_robot_is_the_bare_one_to_the_last_bit(robot: Any, data: st.DataObject) -> None:
    env, bare, bare_life = robot
    motors = env.action_space.shape[0]
    situation = data.draw(
        st.builds(
            Situation,
            friction=MULTIPLIERS,
            base_mass=MULTIPLIERS,
            mass=MULTIPLIERS,
            body_mass=st.lists(MULTIPLIERS, max_size=2),
            damping=MULTIPLIERS,
            motor_strength=st.lists(MULTIPLIERS, max_size=motors),
            locked_joints=st.lists(st.integers(0, motors - 1), max_size=2),
        )
    )
    env.set_situation(str(situation))
    assert env.situation == situation
    life(env, steps=3)
    env.set_situation(None)
    assert arrays(env) == arrays(bare)
    assert life(env) == bare_life


def test_situation_that_comes_and_goes_between_two_steps_leaves_no_trace(robot: Any) -> None:
    env, _, bare_life = robot
    step = env.step

    def broken_before(action: Any) -> Any:
        env.set_situation("mass x 2, friction x 0.1, joint 0 locked, damping x 3")
        env.set_situation("intact")
        return step(action)

    env.step = broken_before
    try:
        assert life(env) == bare_life
    finally:
        env.step = step


def test_situations_do_not_add_up(make_env: MakeEnv) -> None:
    env = FaultWrapper(make_env("HalfCheetah-v5"), "mass x 2, friction x 3")
    for _ in range(3):
        env.set_situation("mass x 3")
        env.reset()
    once = FaultWrapper(make_env("HalfCheetah-v5"), "mass x 3")
    once.reset()
    assert arrays(env) == arrays(once)


@pytest.mark.parametrize(
    ("situation", "name", "factors"),
    [
        ("friction x 0.5", "geom_friction", 0.5),
        ("damping x 2", "dof_damping", 2.0),
        ("mass x 2", "body_mass", 2.0),
        ("mass x 2", "body_inertia", 2.0),
        ("base mass x 3", "body_mass", [1, 3, 1]),
        ("body 1 mass x 0.5", "body_mass", [1, 1, 0.5]),
        ("body 1 mass x 0.5, mass x 2, base mass x 3", "body_mass", [1, 6, 1]),
    ],
)
def test_fault_scales_the_models_own_values(make_env: MakeEnv, situation: str, name: str, factors: Any) -> None:
    own = getattr(make_env("InvertedPendulum-v5").unwrapped.model, name)
    broken = getattr(FaultWrapper(make_env("InvertedPendulum-v5"), situation).unwrapped.model, name)
    np.testing.assert_allclose(broken, own * (np.reshape(factors, (-1, *[1] * (own.ndim - 1)))))


def test_strength_is_a_factor_on_the_force(make_env: MakeEnv) -> None:
    env = FaultWrapper(make_env("InvertedPendulum-v5"), "motor 0 strength x 1.5")
    env.reset(seed=0)
    env.step(np.array([1.0], np.float32))
    assert env.unwrapped.data.qfrc_actuator[0] == pytest.approx(1.5 * 100.0)


@pytest.mark.parametrize("robot_id", ["HalfCheetah-v5", "Ant-v5", "Hopper-v5"])
def test_locked_joint_stays_where_it_was_whatever_its_motor_does(make_env: MakeEnv, robot_id: str) -> None:
    env = FaultWrapper(make_env(robot_id))
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(5):
        env.step(env.action_space.sample())
    model, data = env.unwrapped.model, env.unwrapped.data
    angle = model.jnt_qposadr[model.actuator_trnid[1, 0]]
    held = data.qpos[angle]
    env.set_situation("joint 1 locked")
    far = []
    for action in [env.action_space.high] * 15 + [env.action_space.low] * 15:
        env.unwrapped.step(action)
        far.append(abs(data.qpos[angle] - held))
    assert max(far) < 0.05  # rad, in a hard landing
    assert far[-1] < 0.002
    env.set_situation(None)
    moved = []
    for _ in range(20):
        env.unwrapped.step(env.action_space.sample())
        moved.append(abs(data.qpos[angle] - held))
    assert max(moved) > 0.1


def test_robot_starts_where_it_does_and_its_joint_is_locked_there(make_env: MakeEnv) -> None:
    env, bare = FaultWrapper(make_env("Hopper-v5"), "joint 2 locked"), make_env("Hopper-v5")
    for seed in (0, 1):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], bare.reset(seed=seed)[0])
        start = env.unwrapped.data.qpos[5]
        env.step(env.action_space.high)
        assert env.unwrapped.data.qpos[5] == pytest.approx(start, abs=0.01)


def test_model_that_is_built_anew_is_broken_too(make_env: MakeEnv) -> None:
    env = FaultWrapper(make_env("InvertedPendulum-v5"), "mass x 2")
    other = make_env("InvertedPendulum-v5").unwrapped
    own = other.model.body_mass.copy()
    reset_model = env.unwrapped.reset_model

    def rebuild() -> Any:
        env.unwrapped.model, env.unwrapped.data = other.model, other.data
        return reset_model()

    env.unwrapped.reset_model = rebuild
    env.reset(seed=0)
    np.testing.assert_array_equal(env.unwrapped.model.body_mass, 2.0 * own)


def test_body_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="body_mass speaks of 3 bodies; those of InvertedPendulum-v5 are 0 to 1"):
        make_faulty("InvertedPendulum-v5", "body 2 mass x 2")
    with pytest.raises(ValueError, match="locked_joints names joint 1; the joints of InvertedPendulum-v5 are 0 to 0"):
        make_faulty("InvertedPendulum-v5", "joint 1 locked")


@pytest.mark.parametrize(
    "situation",
    [
        *("friction x 1e308", "mass x 1e-320", "base mass x 1e4", "body 1 mass x 1e5", "damping x 1e9"),
        "motor 0 strength x 1e-4",
    ],
)
def test_multiplier_that_nothing_can_simulate_is_refused(situation: str) -> None:
    with pytest.raises(ValueError, match=r"between 0.001 and 1000 times the robot's own"):
        make_faulty("InvertedPendulum-v5", situation)


WITHOUT_MUJOCO = """
import sys
import famle_envs.faults as faults, gymnasium as gym
faults.make_faulty("Pendulum-v1", "motor 0 dead").reset()
assert "mujoco" not in sys.modules
sys.modules["mujoco"] = None  # as if it were not installed
try:
    faults.make_faulty("HalfCheetah-v5", "motor 0 dead")
except gym.error.DependencyNotInstalled as error:
    print(error)
"""


def test_mujoco_is_asked_for_where_it_is_needed() -> None:
    result = subprocess.run([sys.executable, "-c", WITHOUT_MUJOCO], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == (
        "HalfCheetah-v5 needs MuJoCo, which is not installed; run `pip install 'famle[mujoco]'`."
    )
