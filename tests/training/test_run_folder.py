from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from famle_agent.training.run_folder import RunFolder

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


@pytest.mark.parametrize("content", ["", "[" * 100_000, '{"agent": "FAM', "[]", "3"])
def test_folder_whose_description_is_damaged_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(ValueError, match="delete this one"):
        RunFolder(tmp_path, FINGERPRINT)


def test_round_is_done_once_its_model_is_there(tmp_path: Path) -> None:
    run = RunFolder(tmp_path, FINGERPRINT)
    assert run.finished(0) is None
    run.finish(0, lambda file: file.write_text("agent"))
    file = run.finished(0)
    assert file is not None
    assert file.read_text() == "agent"
    assert run.finished(1) is None
    places = [file, *(run.transitions(i) for i in range(2)), *(run.progress(i, "meta") for i in range(2))]
    assert len(set(places)) == 5
    assert all(place is not None and place.parent == tmp_path for place in places)


def test_progress_of_a_round_that_is_done_is_removed(tmp_path: Path) -> None:
    run = RunFolder(tmp_path, FINGERPRINT)
    files = [run.progress(round_, stage) for round_ in (0, 1, 10) for stage in ("joint", "meta")]
    for file in files:
        assert file is not None
        file.write_bytes(b"")
    run.finish(1, lambda file: file.write_bytes(b""))
    assert [file.exists() for file in files if file is not None] == [True, True, False, False, True, True]


def test_agent_that_cannot_be_stored_keeps_its_progress(tmp_path: Path) -> None:
    run = RunFolder(tmp_path, FINGERPRINT)
    progress = run.progress(0, "meta")
    assert progress is not None
    progress.write_bytes(b"")

    def fail(file: Path) -> None:
        raise OSError("No space left on device")

    with pytest.raises(OSError, match="No space left"):
        run.finish(0, fail)
    assert progress.exists()
    assert run.finished(0) is None


def test_no_folder_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = RunFolder(None, FINGERPRINT)
    run.finish(0, lambda file: file.write_bytes(b""))
    assert run.finished(0) is run.transitions(0) is run.progress(0, "meta") is None
    assert list(tmp_path.iterdir()) == []


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


@pytest.mark.parametrize("name", ["round-0", "round-1.zip", "policy.npz"])
def test_folder_that_does_not_say_of_which_run_it_is_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(ValueError, match=r"holds a run, but no run\.json"):
        RunFolder(tmp_path, FINGERPRINT)
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_folder_without_a_run_in_it_is_taken(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    RunFolder(tmp_path, FINGERPRINT)


def test_folder_of_an_earlier_version_goes_on(tmp_path: Path) -> None:
    later = {"environment": "a", "reward_fn": "b", "termination_fn": None, "sources": ["c"]}
    RunFolder(tmp_path, FINGERPRINT)
    RunFolder(tmp_path, FINGERPRINT | later)
    with pytest.raises(ValueError, match=r"differs in: reward_fn\."):
        RunFolder(tmp_path, FINGERPRINT | later | {"reward_fn": "another"})


def test_folder_that_cannot_be_written_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    RunFolder(tmp_path, FINGERPRINT)
    before = (tmp_path / "run.json").read_bytes()

    def fail(*_: Any) -> None:
        raise PermissionError("Read-only file system")

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises(PermissionError, match="Read-only"):
        RunFolder(tmp_path, FINGERPRINT)
    assert (tmp_path / "run.json").read_bytes() == before
