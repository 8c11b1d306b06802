"""The folder of a meta-learning run, so that a run that was stopped loses nothing."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from famle_agent.whole_file import whole_file

__all__ = ["RunFolder"]


class RunFolder:
    """Where a run keeps all transitions, the agent after each round, and how far the learning of a round has got.

    Args:
        path: The folder; made where it does not exist.
        fingerprint: What a run must have in common with the one that began the folder, as JSON types.

    Raises:
        ValueError: The folder is of another run.
    """

    def __init__(self, path: str | os.PathLike[str], fingerprint: dict[str, Any]) -> None:
        self._path = Path(path)
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

    def transitions(self, round_: int) -> Path:
        """The folder of a round's transitions."""
        return self._path / f"round-{round_}"

    def model(self, round_: int) -> Path:
        """The file of the agent after a round."""
        return self._path / f"round-{round_}.zip"

    def has_model(self, round_: int) -> bool:
        """Whether that round is done."""
        return self.model(round_).exists()

    def progress(self, round_: int, stage: str) -> Path:
        """The file of how far a stage of a round's learning has got."""
        return self._path / f"round-{round_}-{stage}.pt"

    def forget_progress(self, round_: int) -> None:
        """Removes these files, of a round that is done."""
        for file in self._path.glob(f"round-{round_}-*.pt"):
            file.unlink()
