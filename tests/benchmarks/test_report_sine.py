from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.reporting.report import Report
from tests.stored_results import report, rows_of, store_curves

STORED: dict[str, Any] = {
    "title": "Mean squared error over x, 2 replicates of 5 unseen sines",
    "command": "python -m benchmarks.sine --replicates 2",
    "commit": "abc1234",
    "mean_squared_error": {
        method: {points: {"median": median, "quartiles": [0.5 * median, 2.0 * median]} for points in ("3", "5")}
        for method, median in (("FAMLE", 0.04), ("MAML", 0.2))
    },
    "famle_better_than_maml": {"3": 0.8, "5": 0.755},
}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Results of an arm and of sines."""
    folder = tmp_path / "results"
    store_curves(folder, "famle", [[35.0] * 4])
    (folder / "sine.json").write_text(json.dumps(STORED))
    (folder / "sine.png").write_bytes(b"a picture")
    return folder


def test_sines_have_a_section_with_the_stored_figures_and_the_picture(results: Path) -> None:
    text, out = report(results)
    assert "\n## Sines from three, four and five points (figure 2)\n" in text
    assert rows_of(text, "3") == [["3", "0.040 (0.020 to 0.080)", "0.200 (0.100 to 0.400)", "80 %"]]
    assert rows_of(text, "5")[0][-1] == "76 %"
    assert "`python -m benchmarks.sine --replicates 2` at `abc1234`" in text
    assert "](sine.png)" in text
    assert (out / "sine.png").read_bytes() == b"a picture"
    assert "| `sine.json` |" not in text


@pytest.mark.parametrize("missing", ["sine.json", "sine.png"])
def test_sines_that_were_not_measured_are_named_so(results: Path, missing: str) -> None:
    (results / missing).unlink()
    text, out = report(results)
    assert "| `sine.json` | `python -m benchmarks.sine` |" in text.split("## Not measured")[1]
    assert not (out / "sine.png").exists()


@pytest.mark.parametrize("content", ["", "[]", "{}", json.dumps(STORED | {"mean_squared_error": {"FAMLE": {}}})])
def test_damaged_sines_are_refused_with_the_remedy(results: Path, content: str) -> None:
    (results / "sine.json").write_text(content)
    with pytest.raises(ValueError, match=r"sine\.json is damaged.*python -m benchmarks\.sine"):
        Report(results, results.parent / "report")()
    assert not (results.parent / "report").exists()
