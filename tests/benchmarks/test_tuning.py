from pathlib import Path

import numpy as np
import pytest

from benchmarks import tuning
from benchmarks.results import load
from benchmarks.tuning import ROBOTS, Args, RobotName, method_with, score
from famle_agent import ModelBasedAgent
from famle_envs.profile import Profile
from tests.small_reacher import EPISODE, task_of


@pytest.mark.usefixtures("small_reacher")
def test_values_of_a_setting_are_compared_on_the_same_robots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = Args(
        robot="reacher",
        methods=("ampc",),
        setting="adapt_lr",
        values=("1e-2", "1e-3"),
        replicates=2,
        steps=EPISODE,
        jobs=1,
        out=tmp_path / "out",
        cache=tmp_path / "cache",
    )
    tuning.main(args)
    results = load(tmp_path / "out" / f"reacher-{EPISODE}.csv").to_dict("records")
    assert [result["method"] for result in results] == ["ampc-adapt_lr=1e-2"] * 2 + ["ampc-adapt_lr=1e-3"] * 2
    assert results[0]["situation"] == results[2]["situation"] != results[1]["situation"]
    shown = capsys.readouterr().out.splitlines()
    mean = np.mean([result["returns"][0] for result in results[:2]])
    assert shown[0].startswith(f"reacher, ampc-adapt_lr=1e-2: {mean:.1f} of ")


@pytest.mark.usefixtures("small_reacher")
def test_method_has_the_value_and_a_model_of_its_own(tmp_path: Path) -> None:
    task = task_of(0, tmp_path)
    agents = [method_with("ampc-maml", "inner_lr", value).agent(task) for value in ("0.01", "0.1")]
    assert [agent.config.to_dict()["inner_lr"] for agent in agents if isinstance(agent, ModelBasedAgent)] == [0.01, 0.1]
    assert {path.stem for path in tmp_path.glob("*.zip")} == {"reacher-maml-inner_lr=0.01", "reacher-maml-inner_lr=0.1"}


def test_method_that_is_not_meta_trained_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'ppo' is not meta-trained for the benchmark\. Those"):
        method_with("ppo", "n_steps", "10")


@pytest.mark.parametrize("robot", ROBOTS)
def test_robots_are_drawn_again_as_they_were(robot: RobotName, tmp_path: Path) -> None:
    robots = [ROBOTS[robot](i, tmp_path) for i in (0, 1, 2, 3, 3)]
    assert robots[3] == robots[4]
    assert len(set(robots)) == 4
    drawn = [task.profile for task in robots if isinstance(task.profile, Profile)]
    assert len(drawn) in (0, 5)
    assert all("zero_errors" in str(profile) for profile in drawn)


def test_gaits_of_a_robot_that_does_not_arrive_are_one_more_than_there_are() -> None:
    assert score({"gaits": 12, "reached": True}, "quadruped") == 12
    assert score({"gaits": 12, "reached": False}, "quadruped") == 81
