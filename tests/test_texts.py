"""What README and manual say: code that runs, commands that exist, links that lead somewhere, short sentences."""

from __future__ import annotations

import configparser
import doctest
import importlib
import importlib.util
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tyro

from benchmarks.reporting.report import Report
from famle_agent.app.cli import main, read_command

ROOT = Path(__file__).parent.parent
TEXTS = ["README.md", "CONTRIBUTING.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]
NEEDS = {"docs/rl-zoo.md": "rl_zoo3"}
"""What has to be installed beside the package for the code of a text."""
pytestmark = pytest.mark.usefixtures("tiny_budgets")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / text).read_text(), re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[tuple[str, bool]]:
    """The command lines of a text, and whether each is marked as one that takes long."""
    found = []
    for line in "".join(blocks(text, "console")).splitlines():
        if line.startswith("$ "):
            command, _, comment = line[2:].partition(" #")
            found.append((command.strip(), re.match(r"\s*(minutes|hours)\b", comment) is not None))
    return found


WITH_PYTHON = [text for text in TEXTS if blocks(text, "python")]
COMMANDS = sorted({command for text in TEXTS for command in commands(text)})


@pytest.mark.slow
@pytest.mark.parametrize("text", WITH_PYTHON)
def test_python_in_the_texts_runs(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, in one namespace, as someone would who copies block after block; policies are learnt for less long."""
    if text in NEEDS:
        pytest.importorskip(NEEDS[text])
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    for i, block in enumerate(blocks(text, "python")):
        short = re.sub(r"policy_steps=[\d_]+", "policy_steps=120", block)
        exec(compile(short, f"{text}, block {i}", "exec"), namespace)


# --- command lines ----------------------------------------------------------------------------------------------------


def check_make(args: list[str]) -> None:
    for target in args:
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target


def check_pip(args: list[str]) -> None:
    extra = re.fullmatch(r"\.(?:\[(\w+)\])?", args[-1])
    assert args[:-1] == ["install", "-e"]
    assert extra
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    assert extra[1] is None or extra[1] in setup["options.extras_require"]


def check_module(args: list[str]) -> None:
    if args[0].endswith(".py"):  # which the reader writes
        assert any(f"`{args[0]}`" in (ROOT / text).read_text() for text in TEXTS)
        return
    assert args[0] == "-m"
    if args[1].startswith("benchmarks."):
        module = importlib.import_module(args[1])
        tyro.cli(Report if args[1] == "benchmarks.reporting" else module.Args, args=args[2:])
    elif args[1].startswith("examples."):
        tyro.extras.get_parser(importlib.import_module(args[1]).main).parse_args(args[2:])
    else:
        assert importlib.util.find_spec(args[1]) is not None
        assert (ROOT / args[2]).exists()


CHECKS: dict[str, Callable[[list[str]], object]] = {
    "famle": read_command,
    "make": check_make,
    "pip": check_pip,
    "python": check_module,
    **dict.fromkeys(("cd", "cp", "export", "git", "mkdir", "ray", "tensorboard"), len),  # of others' making
}


@pytest.mark.parametrize("line", [command for command, _ in COMMANDS])
def test_command_lines_are_spelled_as_the_programs_want_them(line: str) -> None:
    for command in line.split("&&"):
        words = shlex.split(command)
        while "=" in words[0]:  # a variable of the environment
            words.pop(0)
        CHECKS[words[0]](words[1:])


@pytest.mark.slow
@pytest.mark.parametrize("line", [command for command, takes_long in COMMANDS if not takes_long])
def test_short_commands_run(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, *args = shlex.split(line)
    assert program == "famle", "mark it as one that takes minutes"
    monkeypatch.chdir(tmp_path)
    main(args)
    assert any(tmp_path.iterdir())


# --- links and names --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [*TEXTS, "CHANGELOG.md"])
def test_pages_that_the_texts_link_to_are_there(text: str) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / text).read_text()):
        assert (ROOT / text).parent.joinpath(target).exists(), target


def headings(text: str) -> set[str]:
    """The anchors of a page, as MkDocs and GitHub name them."""
    titles = re.findall(r"^#+ (.+)$", (ROOT / text).read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}


def test_sections_that_the_readme_links_to_are_there() -> None:
    links = re.findall(r"\]\(([^)#]+\.md)#([^)]+)\)", (ROOT / "README.md").read_text())
    assert links
    for page, anchor in links:
        assert anchor in headings(page), (page, anchor)


def test_files_that_the_readme_names_are_there() -> None:
    """Those without a folder are in that of the file before them."""
    text = (ROOT / "README.md").read_text()
    folder, named = ROOT, set[str]()
    for name in re.findall(
        r"`((?:(?:famle_agent|famle_envs|benchmarks|tests)/)?[\w/]+\.(?:py|md|yaml)|[\w/]+/)`", text
    ):
        if name == "site/":  # made by make docs
            continue
        path = ROOT / name if "/" in name or (ROOT / name).exists() else folder / name
        assert path.exists(), name
        named.add(path.name)
        folder = path.parent
    assert {"reacher.py", "planning.py", "runner.py"} <= named


def test_functions_that_the_manual_follows_are_where_it_says() -> None:
    text = (ROOT / "docs/adaptation.md").read_text()
    rows = re.findall(r"^\| (`[\w.`, ]+`) \| `([\w/]+\.py)` \|", text, re.MULTILINE)
    assert len(rows) > 15
    for names, file in rows:
        source = (ROOT / "famle_agent" / file).read_text()
        for name in re.findall(r"\w+", names):
            assert re.search(rf"^\s*(?:def|class) {name}\b", source, re.MULTILINE), (name, file)


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text()
    for text in TEXTS[1:]:
        assert text.removeprefix("docs/") in navigation, text


def test_citation_has_the_version_of_the_package() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    assert f"version: {setup['metadata']['version']}\n" in (ROOT / "CITATION.cff").read_text()


# --- language ---------------------------------------------------------------------------------------------------------


def paragraphs(text: str) -> list[str]:
    """The prose of a text: no code, tables, headings and pictures; each item of a list by itself."""
    prose = re.sub(r"^```.*?^```", "", (ROOT / text).read_text(), flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"^([#|!]).*$", "", prose, flags=re.MULTILINE)
    prose = re.sub(r"^(- |\d+\. )", "\n", prose, flags=re.MULTILINE)
    prose = re.sub(r"\]\([^)]*\)|`[^`]*`", "]", prose)  # links' targets and code
    return [" ".join(part.split()) for part in re.split(r"\n\s*\n", prose) if part.strip()]


def test_readme_is_short_and_plain() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 250
    for paragraph in paragraphs("README.md"):
        for sentence in re.split(r"(?<=[.?!])\s", paragraph):
            assert len(sentence.split()) <= 25, sentence
        assert len(re.findall(r"\d[\d.,]*", paragraph)) <= 3, paragraph


# --- docstrings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "module",
    [
        "famle_agent.agents.baselines",
        "famle_agent.utils.parallel",
        "famle_agent.agents.famle",
        "famle_agent.data.truncate_on_error",
        "famle_envs.situation",
        "famle_envs.faults",
        "famle_envs.reacher",
        "famle_envs.ant",
        "famle_envs.quadruped",
        "famle_envs.a1",
        "famle_envs.minitaur",
    ],
)
def test_examples_in_the_docstrings_run(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0
