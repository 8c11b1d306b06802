from __future__ import annotations

import copy
import gc
import importlib
import math
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch

from famle_envs import Situation
from famle_envs.ant import AntEnv
from famle_envs.reacher import ReacherEnv
from famle_envs.robot_env import RobotEnv
from tests.helpers import making

Array = npt.NDArray[Any]
Make = Callable[..., RobotEnv]
MakeEnv = Callable[..., gym.Env[Any, Any]]

REACHER, ANT = "FamleReacher-v0", "FamleAnt-v0"
CLASSES: dict[str, type[RobotEnv]] = {REACHER: ReacherEnv, ANT: AntEnv}
BROKEN = Situation(partial=True, motor_gain=(-1, 1, 1, 0))
DESCRIPTION = "joint 0 reversed, joint 3 dead"


@pytest.fixture(params=[REACHER, ANT], ids=["reacher", "ant"])
def env_id(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def make(env_id: str, engine: str) -> Iterator[Make]:
    """Makes bare environments, already reset, and closes them in the end."""
    with making(CLASSES[env_id], engine) as make_robot:
        yield make_robot


def commands(env: RobotEnv, seed: int = 0, steps: int = 40) -> Array:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, len(env.joints)))


def follow(env: RobotEnv, actions: Array) -> Array:
    """All observations after the actions, each with its reward."""
    return np.stack([np.append(*env.step(action)[:2]) for action in actions])


def episode(env: RobotEnv, seed: int = 0) -> Array:
    """The start and what random actions make of it, each with its reward."""
    start = np.append(env.reset(seed=seed)[0], 0.0)
    return np.vstack([start, follow(env, commands(env, seed))])


# --- Making ---


def test_every_preset_is_known_by_its_name(make: Make, env_id: str) -> None:
    presets = CLASSES[env_id].presets
    assert {situation.name for situation in CLASSES[env_id].training_situations} | {"paper"} == set(presets)
    env = make()
    for name, situation in presets.items():
        assert env.reset(options={"situation": name})[1]["situation"] == name
        assert env.situation == situation


@pytest.mark.parametrize("render_mode", ["human", "ansi"])
def test_unknown_render_mode_is_refused(env_id: str, render_mode: str) -> None:
    with pytest.raises(ValueError, match=rf"render_mode must be None or one of \['rgb_array'\], got '{render_mode}'"):
        CLASSES[env_id](render_mode=render_mode)


def test_old_module_still_works() -> None:
    with pytest.warns(DeprecationWarning, match=r"famle_envs\.robot_env now"):
        old = importlib.import_module("famle_envs.bullet_env")
    assert old.BulletEnv is RobotEnv


# --- Determinism ---


@pytest.mark.parametrize("situation", [None, "paper", "joint 1 locked, joint 3 locked", "joint 2 at gain 0.3"])
@pytest.mark.parametrize("before", ["joint 0 locked, joint 2 locked, joint 4 dead", "paper", "joint 1 reversed"])
def test_same_seed_gives_the_same_bits_after_another_history_and_elsewhere(
    make: Make, situation: Any, before: str
) -> None:
    fresh, used = make(situation=situation), make(situation=situation)
    expected = episode(fresh)
    follow(used, np.ones((40, len(used.joints))))  # against the joint limits
    used.set_situation(before)
    episode(used, seed=1)
    used.set_situation(situation)
    np.testing.assert_array_equal(episode(used), expected)
    np.testing.assert_array_equal(episode(fresh), expected)


def test_environments_in_one_process_do_not_disturb_each_other(make: Make) -> None:
    alone = episode(make())
    one, other = make(), make(situation="joint 0 locked")
    rows = [np.append(one.reset(seed=0)[0], 0.0)]
    for action in commands(one):
        rows.append(np.append(*one.step(action)[:2]))
        other.step(-action)
    np.testing.assert_array_equal(np.stack(rows), alone)


# --- Changing the situation ---


def test_set_situation_acts_from_the_next_step_and_sticks_over_resets(make: Make) -> None:
    intact, broken = make(), make()
    actions = np.full((6, len(intact.joints)), 0.5)
    np.testing.assert_array_equal(follow(broken, actions[:5]), follow(intact, actions[:5]))
    broken.set_situation(DESCRIPTION)
    obs, *_, info = broken.step(actions[5])
    assert info["situation"] == DESCRIPTION
    assert np.abs(obs - intact.step(actions[5])[0]).max() > 0.01
    from_the_start = make(situation=DESCRIPTION)
    for seed in (1, 2):
        np.testing.assert_array_equal(episode(broken, seed), episode(from_the_start, seed))


def test_joint_that_is_unlocked_in_mid_run_moves_again(make: Make, env_id: str) -> None:
    env = make(situation="joint 0 locked")
    actions = np.full((10, len(env.joints)), 0.5)
    first = {REACHER: 0, ANT: 5}[env_id]  # of the joint angles in the observation
    locked = follow(env, actions)[:, first]
    assert np.ptp(locked) < 0.05
    env.set_situation(None)
    assert abs(follow(env, actions)[-1, first] - locked[-1]) > 0.2


def test_situation_in_reset_options_sticks_until_it_is_changed(make: Make) -> None:
    env, broken, intact = make(), make(situation=DESCRIPTION), make()
    assert env.reset(options={"situation": BROKEN})[1]["situation"] == DESCRIPTION
    np.testing.assert_array_equal(episode(env), episode(broken))
    env.reset(options={"situation": None})
    assert env.situation.is_intact
    np.testing.assert_array_equal(episode(env), episode(intact))


def test_unknown_reset_option_is_refused(make: Make) -> None:
    with pytest.raises(ValueError, match="no option 'situations'; the only one is 'situation'"):
        make().reset(options={"situations": "paper"})


@pytest.mark.parametrize(
    ("refusing", "fault"),
    [
        (REACHER, {"orientation_error": 0.5}),
        (REACHER, {"friction": 2.0}),
        (REACHER, {"base_mass": 1.5}),
        (ANT, {"joint_offset": [0.1]}),
        (ANT, {"base_mass": 1.5}),
    ],
)
def test_unsupported_fault_is_refused_by_name_and_changes_nothing(
    make_env: MakeEnv, refusing: str, fault: dict[str, Any]
) -> None:
    message = f"cannot have the fault '{next(iter(fault))}'"
    with pytest.raises(ValueError, match=message):
        CLASSES[refusing](situation=fault)
    env = make_env(refusing, situation="paper").unwrapped
    with pytest.raises(ValueError, match=message):
        env.set_situation(fault)
    with pytest.raises(ValueError, match=message):
        env.reset(options={"situation": fault})
    assert env.situation == CLASSES[refusing].presets["paper"]


def test_unknown_preset_is_refused_with_the_list_of_presets(make: Make) -> None:
    with pytest.raises(ValueError, match=r"'papper'; did you mean 'paper'\? Presets: intact; joint 0 dead; .*paper"):
        make(situation="papper")


def test_joint_beyond_the_last_is_refused(env_id: str) -> None:
    robot = CLASSES[env_id]
    n = len(robot.joints)
    with pytest.raises(ValueError, match=f"{n + 1} joints; those of {robot.__name__} are 0 to {n - 1}"):
        robot(situation=f"joint {n} dead")


def test_sampled_situation_is_reproducible(env_id: str) -> None:
    first, again, other = (
        [CLASSES[env_id].sample_situation(rng) for _ in range(5)] for rng in map(np.random.default_rng, (7, 7, 8))
    )
    assert first == again
    assert first != other


# --- Actions and rewards ---


@pytest.mark.parametrize(
    "malform",
    [
        lambda zeros: zeros[:-1],
        lambda zeros: zeros[None],
        lambda zeros: 0.0,
        lambda zeros: [math.nan, *zeros[1:]],
        lambda zeros: [math.inf, -math.inf, *zeros[2:]],
    ],
    ids=["short", "batched", "scalar", "nan", "inf"],
)
def test_malformed_action_is_refused(make: Make, malform: Callable[[Array], Any]) -> None:
    env = make()
    n = len(env.joints)
    with pytest.raises(ValueError, match=rf"must be \({n},\) finite numbers"):
        env.step(malform(np.zeros(n)))


def test_step_before_the_first_reset_is_refused(env_id: str) -> None:
    env = CLASSES[env_id]()
    with pytest.raises(gym.error.ResetNeeded, match="Call reset"):
        env.step(np.zeros(env.action_space.shape))
    env.close()


@pytest.mark.parametrize("situation", [None, "joint 0 at gain 0.5"])
def test_action_outside_its_range_is_clipped_before_a_weak_motor_scales_it(make: Make, situation: Any) -> None:
    one, other = make(situation=situation), make(situation=situation)
    signs = np.sign(commands(one, steps=3))
    np.testing.assert_array_equal(follow(one, 4.0 * signs), follow(other, signs))


def test_batched_reward_agrees_with_step_in_numpy_and_torch(make: Make) -> None:
    env = make()
    rows = episode(env)
    obs, next_obs, rewards = rows[:-1, :-1].astype(np.float32), rows[1:, :-1].astype(np.float32), rows[1:, -1]
    actions = commands(env).astype(np.float32)
    batched = env.reward_fn(obs, actions, next_obs)
    assert isinstance(batched, np.ndarray)
    np.testing.assert_allclose(batched, rewards, rtol=1e-5)
    tensors = env.reward_fn(torch.tensor(obs), torch.tensor(actions), torch.tensor(next_obs).reshape(5, 8, -1))
    assert isinstance(tensors, torch.Tensor)
    np.testing.assert_allclose(tensors.numpy(), rewards.reshape(5, 8), rtol=1e-5)


# --- Rendering and closing ---


def red_pixels(picture: Array) -> int:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return int(((red > 100) & (red > 2 * green) & (red > 2 * blue)).sum())


def test_picture_has_its_size_and_changes_when_the_robot_moves(make: Make) -> None:
    env = make(render_mode="rgb_array")
    before = env.render()
    assert before.shape == (480, 480, 3)
    assert before.dtype == np.uint8
    np.testing.assert_array_equal(env.render(), before)
    follow(env, np.full((5, len(env.joints)), 0.8))
    assert (env.render() != before).any()


def test_pictures_do_not_change_the_physics(make: Make) -> None:
    blind, seen = make(), make(render_mode="rgb_array")
    for i, action in enumerate(commands(blind)):
        if i % 10 == 0:
            seen.render()
        np.testing.assert_array_equal(seen.step(action)[0], blind.step(action)[0])


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


def test_render_without_a_mode_returns_none_and_says_why(make: Make) -> None:
    env = make()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        picture = env.render()
    assert picture is None


def test_closed_environment_closes_again_but_does_nothing_else(make: Make) -> None:
    env = make(render_mode="rgb_array")
    env.close()
    env.close()
    action = np.zeros(len(env.joints))
    for use in (lambda: env.step(action), env.reset, env.render, lambda: env.set_situation("paper")):
        with pytest.raises(RuntimeError, match="closed; make a new one"):
            use()


def pickled(env: RobotEnv) -> RobotEnv:
    return pickle.loads(pickle.dumps(env))  # type: ignore[no-any-return]  # noqa: S301 (our own)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
def test_copy_has_a_world_of_its_own(make: Make, copied: Callable[[RobotEnv], RobotEnv]) -> None:
    env, twin = make(situation=BROKEN), make(situation=BROKEN)
    action = np.full(env.action_space.shape, 0.5)
    copy_of_it = copied(env)
    with pytest.raises(gym.error.ResetNeeded):
        copy_of_it.step(action)
    obs, _ = copy_of_it.reset(seed=0)
    np.testing.assert_array_equal(obs, twin.reset(seed=0)[0])
    np.testing.assert_array_equal(copy_of_it.step(action)[0], twin.step(action)[0])
    del copy_of_it
    gc.collect()
    assert np.isfinite(env.step(action)[0]).all()


def test_copy_of_a_closed_robot_is_closed(make: Make) -> None:
    env = make()
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        copy.deepcopy(env).reset()
