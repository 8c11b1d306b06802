from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from famle_agent.run_folder import RunFolder

FINGERPRINT: dict[str, Any] = {"agent": "FAMLE", "seed": 0, "hyperparameters": {"rounds": 2, "hidden": (70, 50)}}


def test_folder_is_made_and_known_again(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "run"
    RunFolder(path, FINGERPRINT)
    assert [file.name for file in path.iterdir()] == ["run.json"]
    stored = (path / "run.json").read_bytes()
    RunFolder(str(path), FINGERPRINT)  # tuples are lists in JSON, and no reason to refuse
    assert (path / "run.json").read_bytes() == stored


@pytest.mark.parametrize(
    ("change", "differing"),
    [
        ({"seed": 1}, "seed"),
        ({"seed": None}, "seed"),
        ({"agent": "Other", "hyperparameters": {"rounds": 3, "hidden": (70, 50)}}, "agent, hyperparameters"),
    ],
)
def test_run_of_another_kind_is_refused(tmp_path: Path, change: dict[str, Any], differing: str) -> None:
    RunFolder(tmp_path, FINGERPRINT)
    before = (tmp_path / "run.json").read_bytes()
    with pytest.raises(ValueError, match=rf"differs in: {differing}\. Give another folder, delete this one"):
        RunFolder(tmp_path, FINGERPRINT | change)
    assert (tmp_path / "run.json").read_bytes() == before


@pytest.mark.parametrize("content", ["", '{"agent": "FAM', "[]", "3"])
def test_folder_whose_description_is_damaged_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(ValueError, match="delete this one"):
        RunFolder(tmp_path, FINGERPRINT)


def test_round_is_done_once_its_model_is_there(tmp_path: Path) -> None:
    run = RunFolder(tmp_path, FINGERPRINT)
    assert not run.has_model(0)
    run.model(0).write_bytes(b"")
    assert run.has_model(0)
    assert not run.has_model(1)
    places = [run.model(0), run.model(1), run.transitions(0), run.transitions(1)]
    assert len(set(places)) == 4
    assert all(place.parent == tmp_path for place in places)


def test_failed_write_leaves_no_description(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Path, *_: Any) -> None:
        with open(self, "w") as file:
            file.write(json.dumps(FINGERPRINT)[:10])
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises(OSError, match="No space left"):
        RunFolder(tmp_path, FINGERPRINT)
    monkeypatch.undo()
    RunFolder(tmp_path, FINGERPRINT)
    RunFolder(tmp_path, FINGERPRINT)
