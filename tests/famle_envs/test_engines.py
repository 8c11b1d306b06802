"""Each robot in each physics engine: chosen, missing, alike, checked, copied and closed."""

from __future__ import annotations

import copy
import gc
import math
import os
import pickle
import subprocess
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from famle_agent import FAMLE
from famle_envs.a1 import A1Env
from famle_envs.ant import AntEnv
from famle_envs.engines import ENGINES, make_world, resolve_engine
from famle_envs.engines.world import World
from famle_envs.minitaur import MinitaurEnv
from famle_envs.quadruped import QuadrupedEnv
from famle_envs.reacher import ReacherEnv
from famle_envs.robot_env import RobotEnv
from tests.helpers import draws
from tests.worlds import masses, place_of, put, without_gravity

Array = npt.NDArray[Any]
MakeEnv = Callable[..., gym.Env[Any, Any]]

ROBOTS: dict[str, type[RobotEnv]] = {
    "FamleReacher-v0": ReacherEnv,
    "FamleAnt-v0": AntEnv,
    "FamleQuadruped-v0": QuadrupedEnv,
    "FamleA1-v0": A1Env,
    "FamleMinitaur-v0": MinitaurEnv,
}
GAIT_ROBOTS = ["FamleQuadruped-v0", "FamleA1-v0", "FamleMinitaur-v0"]
ON_A_FLOOR = ["FamleAnt-v0", *GAIT_ROBOTS]
FAULTY = {
    "FamleReacher-v0": "joint 1 locked, joint 3 dead",
    "FamleAnt-v0": "joint 2 locked, friction x 0.3",
    "FamleQuadruped-v0": "joint 4 locked, friction x 0.5, base mass x 1.5",
    "FamleA1-v0": "joint 4 locked, motor 7 strength x 0.2, friction x 0.5, base mass x 1.5",
    "FamleMinitaur-v0": "joint 4 locked, friction x 0.5, base mass x 1.5",
}
NO_BULLET = """
from importlib.machinery import PathFinder
find_spec = PathFinder.find_spec
PathFinder.find_spec = lambda name, *args: None if name.startswith("pybullet") else find_spec(name, *args)
"""
"""What makes a process one in which PyBullet is not installed."""


@pytest.fixture(params=list(ROBOTS))
def env_id(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def both(env_id: str) -> Iterator[dict[str, RobotEnv]]:
    """A robot in each engine, already reset with the same seed."""
    for name in ENGINES:
        pytest.importorskip(name)
    robots = {name: ROBOTS[env_id](engine=name) for name in ENGINES}
    for robot in robots.values():
        robot.reset(seed=0)
    yield robots
    for robot in robots.values():
        robot.close()


def follow(env: gym.Env[Any, Any], seed: int, steps: int = 3) -> Array:
    """The start and what random actions make of it, each with its reward."""
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    for action in np.random.default_rng(seed).uniform(-1, 1, (steps, *env.action_space.shape)):
        rows.append(np.append(*env.step(action)[:2]))
    return np.stack(rows)


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def refused(robot: str, engine: str) -> str:
    """Code that prints why a robot cannot be made without PyBullet."""
    return (
        f"{NO_BULLET}\nimport gymnasium as gym, famle_envs\ntry:\n    gym.make({robot!r}, engine={engine!r})\n"
        "except gym.error.DependencyNotInstalled as error:\n    print(error)"
    )


# --- Choosing an engine ---


def test_no_engine_is_imported_before_a_robot_is_made() -> None:
    modules = "famle_envs, famle_envs.a1, famle_envs.ant, famle_envs.minitaur, famle_envs.quadruped, famle_envs.reacher"
    done = run(f"import sys, {modules}; print([name for name in ('pybullet', 'mujoco') if name in sys.modules])")
    assert done.stdout.strip() == "[]", done.stderr


def test_robot_runs_in_the_engine_that_was_asked_for(make_env: MakeEnv, env_id: str, engine: str) -> None:
    env = make_env(env_id, engine=engine)
    assert env.unwrapped.engine == engine
    assert type(env.unwrapped.world).__name__ == {"pybullet": "BulletWorld", "mujoco": "MujocoWorld"}[engine]


def test_default_is_the_first_engine_that_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    for installed, chosen in (({"pybullet", "mujoco"}, "pybullet"), ({"pybullet"}, "pybullet"), ({"mujoco"}, "mujoco")):
        monkeypatch.setattr("famle_envs.engines.find_spec", lambda name, known=installed: name in known or None)
        assert resolve_engine(None) == chosen


@pytest.mark.parametrize("name", ["bullet", "MuJoCo", "", 1])
def test_unknown_engine_is_refused(env_id: str, name: Any) -> None:
    with pytest.raises(ValueError, match="engine must be None or one of pybullet, mujoco, got"):
        ROBOTS[env_id](engine=name)


@pytest.mark.parametrize("robot", [robot for robot in ROBOTS if robot != "FamleA1-v0"])
def test_robot_without_pybullet_runs_in_mujoco(robot: str) -> None:
    done = run(
        f"{NO_BULLET}\nimport gymnasium as gym, famle_envs\nenv = gym.make({robot!r})\n"
        "env.reset(seed=0)\nenv.step(env.action_space.sample())\nprint(env.unwrapped.engine)"
    )
    assert done.stdout.strip() == "mujoco", done.stderr


def test_missing_pybullet_is_refused_with_the_remedy() -> None:
    done = run(refused("FamleAnt-v0", "pybullet"))
    assert done.stdout.startswith("pybullet is not installed"), done.stderr
    assert 'pip install "famle[pybullet]"' in done.stdout
    assert "compiler" in done.stdout


def test_robot_that_pybullet_describes_is_refused_without_it_with_the_remedy() -> None:
    done = run(refused("FamleA1-v0", "mujoco"))
    assert done.stdout.startswith("pybullet_data is not installed"), done.stderr
    assert 'pip install "famle[pybullet]"' in done.stdout


def test_command_without_what_its_robot_needs_ends_with_the_remedy(tmp_path: Path) -> None:
    command = ["demo", "--robot", "a1", "--out", str(tmp_path)]
    done = run(f"{NO_BULLET}\nfrom famle_agent.app.cli import main\nmain({command})")
    assert done.returncode == 2
    assert done.stderr.startswith("famle: pybullet_data is not installed"), done.stderr


def test_opengl_does_not_load_its_llvm_before_that_of_triton(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not draws("mujoco"):
        pytest.skip("MuJoCo cannot render here.")
    stub = "import sys\nprint([name for name in ('mujoco.egl', 'mujoco.osmesa', 'OpenGL') if name in sys.modules])"
    (tmp_path / "triton.py").write_text(stub)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    robot = "gym.make('FamleReacher-v0', engine='mujoco', render_mode='rgb_array')"
    done = run(f"import gymnasium as gym, famle_envs\nenv = {robot}\nenv.reset()\nprint(env.render().shape)")
    assert done.stdout.split("\n")[:2] == ["[]", "(480, 480, 3)"], done.stderr


def test_spec_and_copies_keep_the_engine(make_env: MakeEnv, env_id: str, engine: str) -> None:
    env = make_env(env_id, engine=engine, situation=FAULTY[env_id])
    expected = follow(env, seed=0)
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        assert make_env(spec).unwrapped.engine == engine
    for copied in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):  # noqa: S301 (our own)
        assert copied.unwrapped.engine == engine
        np.testing.assert_array_equal(follow(copied, seed=0), expected)
        copied.close()


def test_shipped_model_is_taken_for_a_robot_in_either_engine(engine: str) -> None:
    env = gym.make("FamleAnt-v0", engine=engine)
    agent = FAMLE(env, device="cpu")
    assert agent.dynamics is not None
    env.close()


def test_agent_simulates_in_the_engine_of_its_robot(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env, engines = gym.make("FamleReacher-v0", engine=engine), []

    def make_and_note(engine: str, *args: Any) -> World:
        engines.append(engine)
        return make_world(engine, *args)

    monkeypatch.setattr("famle_envs.robot_env.make_world", make_and_note)
    FAMLE(env, seed=0, device="cpu", transitions_per_situation=1).collect()
    assert len(engines) >= 11
    assert set(engines) == {engine}
    env.close()


# --- The same laws in each engine ---


@pytest.mark.parametrize("check", [check_with_gymnasium, check_with_sb3], ids=["gymnasium", "sb3"])
def test_checkers_have_no_complaint(make_env: MakeEnv, check: Any, env_id: str, engine: str) -> None:
    env = make_env(env_id, engine=engine, situation=FAULTY[env_id])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*observation space m.* value is -?infinity")
        warnings.filterwarnings("ignore", ".*render.*")
        check(env.unwrapped)


def test_same_seed_gives_the_same_bits_after_another_history(make_env: MakeEnv, env_id: str, engine: str) -> None:
    env = make_env(env_id, engine=engine).unwrapped
    expected = follow(env, seed=0)
    env.set_situation(FAULTY[env_id])
    assert np.abs(follow(env, seed=0) - expected).max() > 1e-3
    env.set_situation(None)
    np.testing.assert_array_equal(follow(env, seed=0), expected)


@pytest.mark.parametrize("robot", GAIT_ROBOTS)
def test_a_dead_weight_falls_as_gravity_lets_it(make_env: MakeEnv, robot: str, engine: str) -> None:
    env = make_env(robot, engine=engine).unwrapped
    env.reset(seed=0)
    put(env, (0.0, 0.0, 20.0))
    env.step(np.array([0.0, 0.0, -1.0, 0.0]))
    # A step of semi-implicit Euler at a time; PyBullet's drag takes some.
    assert env.position[2] == pytest.approx(20.0 - 9.81 / 2, abs=0.03 if engine == "mujoco" else 0.4)


@pytest.mark.parametrize("robot", ON_A_FLOOR)
def test_robot_without_commands_stands_and_stays_where_it_is(make_env: MakeEnv, robot: str, engine: str) -> None:
    env = make_env(robot, engine=engine).unwrapped
    env.reset(seed=0)
    still = np.array([0.0, 0.0, -1.0, 0.0]) if robot in GAIT_ROBOTS else np.zeros(8)
    steps = 2 if robot in GAIT_ROBOTS else 120
    for _ in range(steps):
        env.step(still)
    before = place_of(env)
    for _ in range(steps):
        env.step(still)
    np.testing.assert_allclose(place_of(env), before, atol=0.05)  # the Minitaur creeps in PyBullet


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_dead_joint_moves_only_as_it_is_moved(make_env: MakeEnv, robot: str, engine: str) -> None:
    env = make_env(robot, engine=engine).unwrapped
    if "motor_gain" not in env.supported_faults:
        pytest.skip("has no dead joints")
    env.reset(seed=0, options={"situation": "joint 1 dead"})
    if not env.body.fixed:
        without_gravity(env)
        put(env, (0.0, 0.0, 5.0))
    start = env.world.joint_states()[0]
    for _ in range(5):
        env.step(np.eye(len(env.joints))[1])  # only the dead joint is told to move
    np.testing.assert_allclose(env.world.joint_states()[0], start, atol=1e-3)


# --- What both engines have in common ---


def test_masses_and_joint_limits_are_equal(both: dict[str, RobotEnv], env_id: str) -> None:
    bullet, mujoco = both["pybullet"], both["mujoco"]
    # PyBullet takes a base that is bolted down for the world.
    first = 1 if bullet.body.fixed else 0
    one, other = (np.sort(masses(env)[first:]) for env in (bullet, mujoco))
    np.testing.assert_allclose(one, other, rtol=1e-6)
    np.testing.assert_allclose(bullet.joint_limits, mujoco.joint_limits)
    assert bullet.control_period == mujoco.control_period
    assert bullet.observation_space == mujoco.observation_space


def test_robots_start_alike(both: dict[str, RobotEnv]) -> None:
    one, other = (env.reset(seed=3)[0] for env in both.values())
    np.testing.assert_allclose(one, other, atol=0.02)


@pytest.mark.parametrize("env_id", ["FamleAnt-v0"], indirect=True)
def test_torques_turn_the_joints_of_a_weightless_ant_alike(both: dict[str, RobotEnv]) -> None:
    ends = []
    for env in both.values():
        without_gravity(env)
        put(env, (0.0, 0.0, 5.0))
        for _ in range(3):
            obs = env.step(0.02 * np.array([1, 0.5, 0, 0, -1, 0, 0, 0.5]))[0]
        ends.append(obs[13:])
    np.testing.assert_allclose(ends[0], ends[1], atol=0.02)
    assert np.abs(ends[0]).max() > 0.5


@pytest.mark.parametrize("env_id", ["FamleReacher-v0"], indirect=True)
def test_arm_goes_the_same_way(both: dict[str, RobotEnv]) -> None:
    for seed in range(3):
        one, other = (follow(env, seed, steps=20) for env in both.values())
        np.testing.assert_allclose(one[:, 10:12], other[:, 10:12], atol=0.1)


@pytest.mark.parametrize("env_id", GAIT_ROBOTS, indirect=True)
@pytest.mark.parametrize("gait", [[0, 1, 0, 0], [0, -1, 0, 0]], ids=["forwards", "backwards"])
def test_gait_goes_about_as_far(both: dict[str, RobotEnv], gait: list[float]) -> None:
    ways = []
    for env in both.values():
        start = place_of(env)
        for _ in range(3):
            env.step(np.array(gait, dtype=np.float64))
        ways.append(place_of(env)[0] - start[0])
    assert ways[1] == pytest.approx(ways[0], rel=0.25)


# --- The end ---


def test_closed_world_is_gone(make_env: MakeEnv, env_id: str, engine: str) -> None:
    env = make_env(env_id, engine=engine).unwrapped
    env.reset(seed=0)
    world = weakref.ref(env.world)
    env.close()
    env.close()
    gc.collect()
    assert world() is None
    with pytest.raises(RuntimeError, match="closed; make a new one"):
        env.reset()


def test_forgotten_robots_leave_no_worlds_behind(engine: str) -> None:
    worlds = [weakref.ref(ReacherEnv(engine=engine).world) for _ in range(30)]
    gc.collect()
    assert not any(world() for world in worlds)


@pytest.mark.parametrize("used", ["env.render()", "env.step(env.action_space.sample())"])
def test_robot_that_is_not_closed_ends_quietly_with_the_process(engine: str, used: str) -> None:
    mode = repr("rgb_array" if draws(engine) else None)
    done = run(
        f"import gymnasium as gym, famle_envs\nenv = gym.make('FamleAnt-v0', engine={engine!r}, render_mode={mode})\n"
        f"env.reset(seed=0)\n{used}"
    )
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


def test_missing_opengl_is_named_with_the_remedy() -> None:
    pytest.importorskip("mujoco")
    done = run(
        "import os\nos.environ['MUJOCO_GL'] = 'disabled'\nimport gymnasium as gym, famle_envs\n"
        "env = gym.make('FamleAnt-v0', engine='mujoco', render_mode='rgb_array')\nenv.reset(seed=0)\nenv.render()"
    )
    assert "MuJoCo found no OpenGL to render with" in done.stderr


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.0, math.pi / 2])
def test_base_moves_and_turns_in_world_axes(engine: str, angle: float) -> None:
    """The change of pose in a short step is what the velocities say, wherever the robot looks."""
    env = AntEnv(engine=engine, control_rate=500)
    env.reset(seed=0)
    without_gravity(env)
    put(env, (0.0, 0.0, 5.0), (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)))
    for _ in range(20):
        env.step(np.array([0.1, 0.2, -0.1, 0.0, 0.1, 0.2, 0.0, 0.1]))
    before = place_of(env)
    obs = env.step(np.zeros(8))[0]
    np.testing.assert_allclose((place_of(env) - before) * 500, obs[13:16], atol=0.02)
    env.close()
