"""The Zoo's train and enjoy, by the script, the settings and the commands that the manual shows."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "rl-zoo.md").read_text()
SHORT = {"train": ["-n", "20"], "enjoy": ["-n", "20"]}
"""What is added to a command so that it takes seconds."""


def block(language: str) -> str:
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return str(found)


@pytest.mark.slow
def test_the_zoo_trains_and_plays_as_the_manual_says(tmp_path: Path) -> None:
    (tmp_path / "zoo.py").write_text(block("python"))
    (tmp_path / "famle.yml").write_text(block("yaml"))
    commands = [
        shlex.split(line, comments=True) for line in re.findall(r"^\$ (python zoo\.py .*)$", PAGE, re.MULTILINE)
    ]
    assert [words[2] for words in commands] == ["train", "train", "enjoy"]
    shown = ""
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    for _, *words in commands:
        command = [sys.executable, *words, *SHORT[words[1]]]
        run = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        shown += run.stdout
    stored = tmp_path / "logs" / "famle"
    assert {file.name for file in (stored / "FamleAnt-v0_1").iterdir()} >= {"FamleAnt-v0.zip", "0.monitor.csv"}
    assert "Loading logs/famle/FamleAnt-v0_2/FamleAnt-v0.zip" in shown
    assert list((tmp_path / "runs").rglob("events.*"))
    more = ["--trained-agent", str(stored / "FamleAnt-v0_1" / "FamleAnt-v0.zip"), "-n", "5"]
    command = [sys.executable, *commands[0][1:], *more]
    subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, check=True)
    assert (stored / "FamleAnt-v0_3" / "FamleAnt-v0.zip").exists()
