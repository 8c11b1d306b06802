from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from famle_agent.utils.atomic_write import whole_file


def test_older_file_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("older")
    with whole_file(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "older"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("older", [True, False])
def test_failed_write_changes_nothing(older: bool, tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    if older:
        path.write_text("older")

    def fail() -> None:
        with whole_file(path) as partial:
            partial.write_text("ne")
            raise OSError("No space left on device")

    with pytest.raises(OSError, match="No space left"):
        fail()
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == ({"file.txt": "older"} if older else {})


def test_threads_may_write_the_same_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"

    def write(text: str) -> None:
        for _ in range(50):
            with whole_file(path) as partial:
                partial.write_text(text * 1000)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(write, "abcd"))
    assert path.read_text() in {text * 1000 for text in "abcd"}
    assert list(tmp_path.iterdir()) == [path]


def test_content_is_on_the_disk_before_it_has_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, synced = tmp_path / "file.txt", list[bool]()
    monkeypatch.setattr(os, "fsync", lambda _: synced.append(path.exists()))
    with whole_file(path) as partial:
        partial.write_text("new")
    assert synced == [False]
