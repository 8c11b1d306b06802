"""The folder of a meta-learning run, so that a run that was stopped loses nothing."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from famle_agent.utils.atomic_write import whole_file

__all__ = ["RunFolder"]

_FILES = ("round-*", "policy.*")
_LATER = {"environment", "reward_fn", "termination_fn", "sources"}
"""What folders of version 0.1 do not say."""


class RunFolder:
    """Where a run keeps all transitions, the agent after each round, and how far the learning of a round has got.

    Args:
        path: The folder; made where it does not exist. None keeps nothing.
        fingerprint: What a run must have in common with the one that began the folder, as JSON types.

    Raises:
        OSError: Nothing can be written there.
        ValueError: The folder is of another run, or does not say of which.
    """

    def __init__(self, path: str | os.PathLike[str] | None, fingerprint: dict[str, Any]) -> None:
        self._path = None if path is None else Path(path)
        if self._path is None:
            return
        self._path.mkdir(parents=True, exist_ok=True)
        file, wanted = self._path / "run.json", json.loads(json.dumps(fingerprint))
        self._check(file, wanted)
        with whole_file(file) as partial:  # be it there or not: a run that cannot write should say so at once
            partial.write_text(json.dumps(wanted, indent=1) + "\n")

    def _check(self, file: Path, wanted: dict[str, Any]) -> None:
        """Refuses a folder of another run."""
        if not file.exists():
            if any(any(file.parent.glob(pattern)) for pattern in _FILES):
                raise ValueError(f"{file.parent} holds a run, but no {file.name} that says which. Give another folder.")
            return
        try:
            found = json.loads(file.read_text())
        except (RecursionError, ValueError):
            found = {}
        found = found if isinstance(found, dict) else {}
        known = wanted.keys() - (_LATER - found.keys())
        if differing := [key for key in wanted if key in known and found.get(key) != wanted[key]]:
            raise ValueError(
                f"{file.parent} holds a run that differs in: {', '.join(differing)}. Give another folder, delete this "
                "one, or go on with the settings in its run.json."
            )

    def transitions(self, round_: int) -> Path | None:
        """The folder of a round's transitions."""
        return self._path and self._path / f"round-{round_}"

    def search(self) -> tuple[Path | None, Path | None]:
        """The files of a policy search: its transitions, and its weights, which are written last."""
        return self._path and self._path / "policy.npz", self._path and self._path / "policy.safetensors"

    def progress(self, round_: int, stage: str) -> Path | None:
        """The file of how far a stage of a round's learning has got."""
        return self._path and self._path / f"round-{round_}-{stage}.progress"

    def finished(self, round_: int) -> Path | None:
        """The file of the agent after a round, where that is done."""
        file = self._model(round_)
        return file if file is not None and file.exists() else None

    def finish(self, round_: int, save: Callable[[Path], object]) -> None:
        """Stores the agent after a round, and no longer how far that had got."""
        file = self._model(round_)
        if file is not None:
            save(file)
            for progress in file.parent.glob(f"round-{round_}-*.p*"):  # .pt in version 0.1
                progress.unlink(missing_ok=True)

    def _model(self, round_: int) -> Path | None:
        return self._path and self._path / f"round-{round_}.zip"
