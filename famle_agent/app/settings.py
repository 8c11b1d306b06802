"""The table of all settings, made of the parts' docstrings and of the defaults.

``python -m famle_agent.app.settings docs/settings.md`` writes it into the manual again.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import docstring_parser

from famle_agent.agents.config import Config
from famle_agent.agents.keywords import CHOICES, described_by
from famle_agent.agents.presets import known_robots
from famle_agent.utils.marked_text import write_marked

__all__ = ["settings_table", "write_table"]

_SWITCHES = {
    "planner": "Which planner plans: " + ", ".join(f"`{name}`" for name in CHOICES["planner"]) + ".",
    "meta_learner": "What meta-learns: " + ", ".join(f"`{name}`" for name in CHOICES["meta_learner"]) + ".",
}
"""Settings that choose a part, and are no field of one."""


def settings_table() -> str:
    """Writes Markdown: a section a part, a row a setting with its defaults and its meaning.

    A default is empty where the setting has no effect beside the others.
    """
    robots = known_robots()
    unknown = robots["default"].config("ours").to_dict()
    others = {name: robot.config("ours").to_dict() for name, robot in robots.items() if name != "default"}
    titles = ["setting", "default", *others, "what it is"]
    lines, section = list[str](), ""
    for keyword, fields in described_by().items():
        part = fields[0][0] if fields else Config
        if part.__name__ != section:
            section = part.__name__
            summary = _plain((part.__doc__ or "").partition("\n")[0])
            lines += ["", f"### {section}", "", summary, "", _row(titles), _row(["---"] * len(titles))]
        differing = [_cell(of[keyword]) if _differs(of, unknown, keyword) else "" for of in others.values()]
        lines.append(_row([f"`{keyword}`", _cell(unknown.get(keyword)), *differing, _meaning(keyword, fields)]))
    return "\n".join(lines).strip()


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def write_table(path: Path) -> None:
    """Writes the table into a page, between its marks.

    Raises:
        ValueError: The page has no marks.
    """
    write_marked(path, "settings", settings_table())


def _plain(text: str) -> str:
    """Makes Markdown of a text of a docstring: names for Sphinx's roles, and nothing that would end a cell."""
    named = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", " ".join(text.split()))
    return named.replace("``", "`").replace("|", "\\|")


def _differs(settings: dict[str, Any], default: dict[str, Any], keyword: str) -> bool:
    return keyword in settings and settings[keyword] != default.get(keyword)


def _cell(value: Any) -> str:
    return "" if value is None or value == "" else f"{value:g}" if isinstance(value, float) else str(value)


def _meaning(keyword: str, fields: Sequence[tuple[type, str]]) -> str:
    """Takes the description of the first part that has a field of this keyword."""
    if keyword in _SWITCHES:
        return _SWITCHES[keyword]
    for part, name in fields or [(Config, keyword)]:
        for owner in part.__mro__:  # a field may be documented where it is inherited from
            for described in docstring_parser.parse(owner.__doc__ or "", docstring_parser.DocstringStyle.GOOGLE).params:
                if described.arg_name == name and described.description:
                    return _plain(described.description)
    raise ValueError(f"No docstring says what {keyword} means.")


if __name__ == "__main__":
    write_table(Path(sys.argv[1]))
