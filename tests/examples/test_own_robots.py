"""The examples of own robots: they run, and say what adaptation is worth."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import pytest
from gymnasium.utils.env_checker import check_env
from setuptools import find_packages

from examples import mujoco_faults, own_mjcf
from famle_agent import FAMLE

ROOT = Path(__file__).parents[2]


@pytest.mark.filterwarnings("ignore::UserWarning")  # of infinite bounds
def test_arm_is_a_robot_of_gymnasium() -> None:
    check_env(own_mjcf.Arm(), skip_render_check=True)


@pytest.mark.slow
def test_arm_with_two_faults_moves_on_with_adaptation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own_mjcf.main(transitions=600, iterations=600, out=tmp_path / "arm.zip")
    found = re.search(r"Return of 200 steps: ([-\d.]+) with adaptation, ([-\d.]+) without", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) > 4.0 * float(found[2])
    assert len(FAMLE.load(tmp_path / "arm.zip", "OwnArm-v0").situations) == 10


@pytest.mark.slow
@pytest.mark.usefixtures("tiny_budgets")
def test_faults_of_a_mujoco_model_are_learnt_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mujoco_faults.main(policy_steps=200, iterations=3, steps=15, out=tmp_path / "cheetah.zip")
    out = capsys.readouterr().out
    for situation in mujoco_faults.UNSEEN:
        assert re.search(rf"^{situation}: -?\d+ with adaptation, -?\d+ without", out, re.MULTILINE)
    assert re.search(r"better on [0-4] of 4 unseen robots", out)
    assert FAMLE.load(tmp_path / "cheetah.zip", "HalfCheetah-v5").situations == mujoco_faults.SITUATIONS


def test_wheel_holds_no_examples() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    packages = find_packages(str(ROOT), include=setup["options.packages.find"]["include"].split())
    assert {package.partition(".")[0] for package in packages} == {"famle_agent", "famle_envs"}
