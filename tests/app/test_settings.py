from __future__ import annotations

from pathlib import Path

import pytest

from famle_agent.app.settings import settings_table, write_table

MANUAL = Path(__file__).parents[2] / "docs" / "settings.md"


def test_manual_lists_all_settings() -> None:
    assert settings_table() in MANUAL.read_text(), "python -m famle_agent.app.settings docs/settings.md"


def test_table_of_settings_follows_the_files() -> None:
    table = {line.split("`")[1]: line for line in settings_table().splitlines() if line.startswith("| `")}
    assert "| 0.05 |" in table["likelihood_power"]  # of default.yaml
    assert "| 500000 | 0 | 0 | 0 | 0 |" in table["policy_steps"]  # robots with settings of their own need no policy


def test_table_of_settings_is_written_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- settings -->old<!-- /settings -->\nafter\n")
    write_table(page)
    write_table(page)
    assert page.read_text() == f"before\n<!-- settings -->\n\n{settings_table()}\n\n<!-- /settings -->\nafter\n"
    page.write_text("no marks")
    with pytest.raises(ValueError, match="no lines"):
        write_table(page)
    assert page.read_text() == "no marks"
