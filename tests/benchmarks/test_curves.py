from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import curves, reacher
from benchmarks.methods import METHODS
from famle_envs.reacher import ReacherEnv
from tests.small_reacher import EPISODE, task_of

pytestmark = pytest.mark.usefixtures("small_reacher")


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
    results = reacher.run("ampc", tasks, reacher.Args(steps=2 * EPISODE))
    assert [result["situation"] for result in results] == ["joint 3 dead", "joint 0 reversed"]
    assert all(result["lengths"] == [EPISODE] * 2 for result in results)
    assert results[0]["returns"] != results[1]["returns"]
    with pytest.raises(ValueError, match="run one by one, not 2 in step"):
        reacher.run("famle", tasks, reacher.Args(steps=2))


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
