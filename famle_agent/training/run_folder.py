"""The folder of a meta-learning run, so that a run that was stopped loses nothing."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from famle_agent.utils.atomic_write import whole_file

__all__ = ["RunFolder"]


class RunFolder:
    """Where a run keeps all transitions, the agent after each round, and how far the learning of a round has got.

    Args:
        path: The folder; made where it does not exist. None keeps nothing.
        fingerprint: What a run must have in common with the one that began the folder, as JSON types.

    Raises:
        ValueError: The folder is of another run.
    """

    def __init__(self, path: str | os.PathLike[str] | None, fingerprint: dict[str, Any]) -> None:
        self._path = None if path is None else Path(path)
        if self._path is None:
            return
        self._path.mkdir(parents=True, exist_ok=True)
        file, wanted = self._path / "run.json", json.loads(json.dumps(fingerprint))
        if not file.exists():
            with whole_file(file) as partial:
                partial.write_text(json.dumps(wanted, indent=1) + "\n")
            return
        try:
            found = json.loads(file.read_text())
        except ValueError:
            found = {}
        if found != wanted:
            differing = [key for key in wanted if not isinstance(found, dict) or found.get(key) != wanted[key]]
            raise ValueError(
                f"{self._path} holds a run that differs in: {', '.join(differing)}. Give another folder, delete this "
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
        return self._path and self._path / f"round-{round_}-{stage}.pt"

    def finished(self, round_: int) -> Path | None:
        """The file of the agent after a round, where that is done."""
        file = self._model(round_)
        return file if file is not None and file.exists() else None

    def finish(self, round_: int, save: Callable[[Path], object]) -> None:
        """Stores the agent after a round, and no longer how far that had got."""
        file = self._model(round_)
        if file is not None:
            save(file)
            for progress in file.parent.glob(f"round-{round_}-*.pt"):
                progress.unlink()

    def _model(self, round_: int) -> Path | None:
        return self._path and self._path / f"round-{round_}.zip"
