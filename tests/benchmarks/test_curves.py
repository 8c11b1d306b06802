from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import curves, lives, reacher
from benchmarks.methods import METHODS
from famle_agent import ModelBasedAgent
from famle_envs.reacher import ReacherEnv
from tests.small_reacher import EPISODE, task_of

pytestmark = pytest.mark.usefixtures("small_reacher")


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Says which commit the code is of."""
    return lambda name: monkeypatch.setattr(lives, "commit", lambda: name)


def test_same_task_same_curve(cache: Path) -> None:
    runs = [curves.run(METHODS["ampc"].agent(task_of(seed, cache)), [task_of(seed, cache)], 15) for seed in (0, 0, 1)]
    (one,), (same,), (other,) = ([result["returns"] for result in run] for run in runs)
    assert one == same != other
    assert len(one) == 2  # the third episode has not ended


def test_curve_needs_an_episode(cache: Path) -> None:
    task = task_of(0, cache)
    with pytest.raises(ValueError, match=f"{EPISODE - 1} robot steps are no whole episode.*needs {EPISODE} at least"):
        curves.run(METHODS["famle"].agent(task), [task], EPISODE - 1)
    (result,) = curves.run(METHODS["famle"].agent(task), [task], EPISODE)
    assert len(result["returns"]) == 1


def test_robots_in_step_have_damages_and_curves_of_their_own(cache: Path) -> None:
    broken = [ReacherEnv.presets["joint 3 dead"], ReacherEnv.presets["joint 0 reversed"]]
    tasks = [task_of(seed, cache, situation) for seed, situation in enumerate(broken)]
    results = reacher.run_fleet("ampc", tasks, reacher.Args(steps=2 * EPISODE))
    assert [result["situation"] for result in results] == ["joint 3 dead", "joint 0 reversed"]
    assert all(result["lengths"] == [EPISODE] * 2 for result in results)
    assert results[0]["returns"] != results[1]["returns"]
    with pytest.raises(ValueError, match="run one by one, not 2 in step"):
        reacher.run_fleet("famle", tasks, reacher.Args(steps=2))


@pytest.mark.parametrize(
    ("method", "robots"), [("famle", 1), ("famle-original", 1), ("famle-paper", 1), ("ampc", 2), ("ampc-reptile", 2)]
)
def test_interrupted_life_ends_as_if_nothing_had_happened(
    method: str, robots: int, cache: Path, tmp_path: Path, code: Callable[[str], None]
) -> None:
    code("1a2b3c4")
    tasks, life = [task_of(seed, cache) for seed in range(robots)], tmp_path / "life.zip"

    def returns(episodes: int, saved: Path | None) -> list[list[float]]:
        results = curves.run(METHODS[method].on(tasks), tasks, episodes * EPISODE, saved, save_every=0.0)
        assert all(result["lengths"] == [EPISODE] * episodes for result in results)
        return [result["returns"] for result in results]

    whole = returns(5, None)
    assert returns(2, life) == [robot[:2] for robot in whole]
    assert returns(5, life) == whole
    assert returns(4, life) == [robot[:4] for robot in whole]


def test_long_life_is_not_lived_again(cache: Path, tmp_path: Path, code: Callable[[str], None]) -> None:
    code("1a2b3c4")
    task, life = task_of(0, cache), tmp_path / "life.zip"
    (long,) = curves.run(METHODS["famle"].agent(task), [task], 2 * EPISODE, life, save_every=0.0)
    (short,) = curves.run(METHODS["famle"].agent(task), [task], EPISODE, life, save_every=0.0)
    assert short["returns"] == long["returns"][:1]
    assert short["seconds_per_step"] == pytest.approx(long["seconds_per_step"], rel=0.2)


@pytest.mark.parametrize(
    ("before", "after"), [("1a2b3c4", "5d6e7f8"), ("1a-dirty", "1a-dirty"), ("unknown", "unknown")]
)
def test_life_of_other_code_begins_anew(
    before: str, after: str, cache: Path, tmp_path: Path, code: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    task, life = task_of(0, cache), tmp_path / "life.zip"
    code(before)
    curves.run(METHODS["famle"].agent(task), [task], EPISODE, life, save_every=0.0)
    assert life.exists()
    code(after)
    lived: list[int] = []
    learn = ModelBasedAgent.learn
    monkeypatch.setattr(
        ModelBasedAgent, "learn", lambda self, steps, **more: (lived.append(steps), learn(self, steps, **more))[1]
    )
    curves.run(METHODS["famle"].agent(task), [task], 2 * EPISODE, life)
    assert lived == [2 * EPISODE]


def test_interrupted_ppo_goes_on_with_what_it_has_learnt(
    cache: Path, tmp_path: Path, code: Callable[[str], None]
) -> None:
    """In rollouts of 8 steps, saved before each of them."""
    code("1a2b3c4")
    task, life = task_of(0, cache), tmp_path / "life.zip"
    (one,) = curves.run(METHODS["ppo"].agent(task), [task], 5 * EPISODE, life, save_every=0.0)
    assert one["lengths"] == [EPISODE] * 5
    agent, fresh = METHODS["ppo"].agent(task), METHODS["ppo"].agent(task)
    went_on_with: list[dict[str, torch.Tensor]] = []
    learn, steps = agent.learn, list[int]()

    def watch(total_timesteps: int, **kwargs: Any) -> Any:
        went_on_with.append({name: value.clone() for name, value in agent.policy.state_dict().items()})
        steps.append(total_timesteps)
        return learn(total_timesteps, **kwargs)

    agent.learn = watch  # type: ignore[method-assign]
    (other,) = curves.run(agent, [task], 9 * EPISODE, life, save_every=0.0)
    assert steps == [5 * EPISODE]  # four episodes had ended when the last of four rollouts began
    assert other["lengths"] == [EPISODE] * 9
    assert other["returns"][:4] == one["returns"][:4]
    weights = fresh.policy.state_dict()
    assert any(not torch.equal(value, weights[name]) for name, value in went_on_with[0].items())
    (whole,) = curves.run(fresh, [task], 9 * EPISODE)
    assert whole["returns"][:4] == one["returns"][:4]


def test_life_is_saved_now_and_then(cache: Path, tmp_path: Path) -> None:
    task, life = task_of(0, cache), tmp_path / "life.zip"
    curves.run(METHODS["famle"].agent(task), [task], 2 * EPISODE, life)
    assert not life.exists()  # not a minute has passed


def test_curve_that_takes_too_long_ends_with_its_episode(cache: Path) -> None:
    task = task_of(0, cache)
    (result,) = curves.run(METHODS["famle"].agent(task), [task], 9 * EPISODE, minutes=0.0)
    assert result["lengths"] == [EPISODE]


def test_test_robot_is_broken_as_the_task_says(cache: Path) -> None:
    task = task_of(0, cache)
    env = task.make()
    assert env.get_wrapper_attr("situation") == task.situation
    assert task.env_id == env.spec.id
    env.close()
