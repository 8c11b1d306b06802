from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch

import famle_agent
from famle_agent import FAMLE
from famle_agent.app import demo
from famle_agent.app.cli import main
from famle_envs.reacher import ReacherEnv

pytestmark = pytest.mark.usefixtures("tiny_budgets")


def test_meta_learned_agent_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "arm.zip"
    args = ["--tensorboard", str(tmp_path / "tb"), "--seed", "3", "--jobs", "1"]
    main(["meta-learn", "--robot", "reacher", "--out", str(path), *args])
    assert path.exists()
    assert (tmp_path / "tb" / "FAMLE_meta_1").is_dir()
    shown = []
    for _ in range(2):
        capsys.readouterr()
        main(["run", str(path), "--situation", "joint 2 dead", "--episodes", "2"])
        shown.append(capsys.readouterr().out)
    assert "episode 0: return" in shown[0]
    assert "episode 1: return" in shown[0]
    assert "believes joint" in shown[0] or "believes intact" in shown[0]
    assert shown[0] == shown[1]  # the same seed


def test_meta_learning_goes_on_in_its_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["meta-learn", "--jobs", "1", "--folder", str(tmp_path / "run"), "--out"]
    main([*command, str(tmp_path / "one.zip")])
    stored = (tmp_path / "run" / "round-0.zip").read_bytes()
    main([*command, str(tmp_path / "again.zip")])
    assert (tmp_path / "run" / "round-0.zip").read_bytes() == stored
    one, again = (FAMLE.load(tmp_path / f"{name}.zip", device="cpu") for name in ("one", "again"))
    assert torch.equal(one.dynamics.embeddings, again.dynamics.embeddings)
    for agent in (one, again):
        agent.get_env().close()
    with pytest.raises(SystemExit) as caught:
        main([*command, str(tmp_path / "other.zip"), "--seed", "1"])
    assert caught.value.code == 2
    assert "differs in: seed" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "other.zip").exists()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["demo", "--situation", "joint 9 dead"], "joint"),
        (["demo", "--situation", "tired"], "No situation is called 'tired'"),
        (["demo", "--robot", "walker"], "reacher"),
        (["demo", "--robot", "default"], "default"),
        (["meta-learn", "--robot", "walker"], "reacher"),
        (["meta-learn", "--robot", "Pendulum-v1"], "no training situations"),
        (["meta-learn", "--mode", "best"], "mode must be one of"),
        (["meta-learn", "--robot", "no_such_module:Walker-v0"], "no_such_module"),
        (["demo", "--situation", "[/joint 3 dead]"], "[/joint 3 dead]"),
        (["run", "nothing.zip"], "nothing.zip"),
        (["run", "."], "directory"),
    ],
)
def test_mistakes_end_with_advice(
    args: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(args)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in " ".join(error.split())
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_situation_that_the_robot_cannot_have(agent_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["run", str(agent_file), "--situation", "friction x 0.5"])
    assert caught.value.code == 2
    assert "friction" in capsys.readouterr().err


def test_agent_whose_environment_is_not_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unregistered = ReacherEnv()
    FAMLE(unregistered, device="cpu").save(tmp_path / "arm.zip")
    unregistered.close()
    with pytest.raises(SystemExit) as caught:
        main(["run", str(tmp_path / "arm.zip")])
    assert caught.value.code == 2
    assert "environment" in capsys.readouterr().err


@pytest.mark.parametrize("args", [[], ["fly"], ["run"], ["demo", "--episodes", "many"]])
def test_wrong_command_line(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(args)
    assert caught.value.code == 2
    assert capsys.readouterr().err


def test_help_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    shown = capsys.readouterr().out
    for command in ("demo", "meta-learn", "run"):
        assert command in shown


@pytest.mark.parametrize(
    "command", [[str(Path(sys.executable).with_name("famle"))], [sys.executable, "-m", "famle_agent"]]
)
def test_version_from_the_command_line(command: list[str]) -> None:
    shown = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == f"famle {famle_agent.__version__}"
    assert shown.stderr == ""


def test_help_needs_no_physics_and_no_torch() -> None:
    code = "import sys; from famle_agent.app.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "print([name for name in ('torch', 'pybullet', 'gymnasium', 'benchmarks') if name in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1] == "[]"
    assert "build time" not in shown.stdout + shown.stderr  # PyBullet's greeting


def test_public_names_are_there_when_they_are_asked_for() -> None:
    assert {*famle_agent.__all__} <= {*dir(famle_agent)}
    assert all(getattr(famle_agent, name) is not None for name in famle_agent.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'FAMLES'"):
        famle_agent.FAMLES  # noqa: B018


def test_robot_that_comes_with_a_model_is_not_taught_by_a_demo(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--robot", "ant", "--meta-iterations", "2", "--out", str(tmp_path / "out")])
    assert "--meta-iterations is for the arm alone" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_command_line_knows_which_robots_it_can_show(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--robot", "octopus"])
    assert "ant" in capsys.readouterr().err


# --- text that goes elsewhere ---------------------------------------------------------------------------------


@pytest.fixture
def learns_nothing(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Notes that an agent should have learnt, which has a model already."""
    asked: list[str] = []

    def meta_learn(agent: FAMLE, *_: Any, **__: Any) -> FAMLE:
        asked.append("meta-learn")
        return agent

    monkeypatch.setattr(FAMLE, "meta_learn", meta_learn)
    return asked


@pytest.mark.parametrize(
    "name", ["[v1]/a.zip", "x[/b]/a.zip", "[red]a.zip", ":dog:.zip", "a b.zip", f"{'long/' * 30}a.zip"]
)
def test_path_is_printed_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], learns_nothing: list[str], name: str
) -> None:
    main(["meta-learn", "--robot", "ant", "--out", str(tmp_path / name)])
    assert capsys.readouterr().out == f"Saved {tmp_path / name}.\n"
    assert (tmp_path / name).is_file()


@pytest.mark.parametrize(
    ("command", "out"),
    [("meta-learn", "file/a.zip"), ("meta-learn", "folder/agent.zip"), ("demo", "file"), ("demo", "file/demo")],
)
def test_path_that_cannot_be_written_is_refused_before_learning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], learns_nothing: list[str], command: str, out: str
) -> None:
    (tmp_path / "file").write_text("something else")
    (tmp_path / "folder" / "agent.zip").mkdir(parents=True)
    with pytest.raises(SystemExit) as caught:
        main([command, "--robot", "reacher", "--out", str(tmp_path / out)])
    assert caught.value.code == 2
    assert str(tmp_path) in capsys.readouterr().err.replace("\n", "")
    assert learns_nothing == []
    assert (tmp_path / "file").read_text() == "something else"


def test_trying_a_path_leaves_the_older_agent_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "agent.zip"
    path.write_text("older")

    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("learning failed")

    monkeypatch.setattr(FAMLE, "meta_learn", fail)
    with pytest.raises(SystemExit):
        main(["meta-learn", "--robot", "ant", "--out", str(path)])
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("agent.zip", "older")]


def test_episodes_last_as_long_as_those_of_the_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, lengths = tmp_path / "short.zip", []
    agent = FAMLE(gym.make("FamleReacher-v0", max_episode_steps=4), seed=0, device="cpu").meta_learn()
    agent.save(path)
    roll_out = famle_agent.rollout.rollout

    def watched(*args: Any, **kwargs: Any) -> Any:
        lengths.append((run := roll_out(*args, **kwargs)).steps)
        return run

    monkeypatch.setattr(famle_agent.rollout, "rollout", watched)
    main(["run", str(path), "--episodes", "2"])
    assert lengths == [4, 4]


@pytest.mark.parametrize("command", ["meta-learn", "demo"])
def test_interruption_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FAMLE, "meta_learn", interrupt)
    monkeypatch.setattr(demo, "_run", interrupt)
    with pytest.raises(SystemExit) as caught:
        main([command, "--robot", "reacher", "--out", str(tmp_path / "out")])
    assert caught.value.code == 130
    assert capsys.readouterr().err == "famle: stopped.\n"
