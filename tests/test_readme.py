from __future__ import annotations

import doctest
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.usefixtures("tiny_budgets")


TEXTS = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]


@pytest.mark.slow
@pytest.mark.parametrize("text", TEXTS)
def test_python_in_the_texts_runs(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, in one namespace, as someone would who copies block after block."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / text).read_text(), re.MULTILINE | re.DOTALL)
    assert blocks
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    for i, block in enumerate(blocks):
        exec(compile(block, f"{text}, block {i}", "exec"), namespace)


@pytest.mark.parametrize("text", TEXTS)
def test_pages_that_the_texts_link_to_are_there(text: str) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / text).read_text()):
        assert (ROOT / text).parent.joinpath(target).exists(), target


def test_files_that_the_readme_names_are_there() -> None:
    """Those without a folder are in that of the file before them."""
    text = (ROOT / "README.md").read_text()
    folder, named = ROOT, set[str]()
    for name in re.findall(
        r"`((?:(?:famle_agent|famle_envs|benchmarks|tests)/)?[\w/]+\.(?:py|md|yaml)|[\w/]+/)`", text
    ):
        path = ROOT / name if "/" in name or (ROOT / name).exists() else folder / name
        assert path.exists(), name
        named.add(path.name)
        folder = path.parent
    assert {"reacher.py", "planning.py", "runner.py", "NOTES.md"} <= named


@pytest.mark.parametrize(
    "module",
    [
        "famle_agent.agents.baselines",
        "famle_agent.utils.parallel",
        "famle_agent.agents.famle",
        "famle_envs.situation",
        "famle_envs.faults",
        "famle_envs.reacher",
        "famle_envs.ant",
        "famle_envs.quadruped",
        "famle_envs.minitaur",
    ],
)
def test_examples_in_the_docstrings_run(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0
