"""How far iterations have got, kept in a file, so that what was stopped goes on from there."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from famle_agent.utils.archive import DAMAGE, pack, unpack
from famle_agent.utils.atomic_write import whole_file

__all__ = ["Progress", "Stateful"]

_STATES = "progress.json"


class Stateful(Protocol):
    """What PyTorch's modules, optimizers and schedules have in common."""

    def state_dict(self) -> dict[str, Any]:
        """All that changes."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Goes back to where it was."""


class Progress:
    """Counts iterations, and keeps in a file what it takes to go on with them.

    Args:
        file: Where; None keeps nothing, and always begins with the first one.
        skipped: Is told how many iterations had been done before.
        every: Seconds between two savings at least; the end is always saved.
    """

    def __init__(
        self, file: Path | None = None, skipped: Callable[[int], object] = lambda _: None, every: float = 60.0
    ) -> None:
        self._file, self._skipped, self._every = file, skipped, every

    def iterations(self, n: int, generator: torch.Generator, **parts: Stateful) -> Iterator[int]:
        """The numbers of the iterations that are left, of 0 to n - 1.

        Args:
            n: How many iterations there are.
            generator: Source of all their chance.
            **parts: All else that they change; these, and the generator, are brought to where a stopped run had got to.

        Raises:
            ValueError: The file is damaged, or of something else.
        """
        done = self._restore(generator, parts)
        saved_at = time.perf_counter()
        for iteration in range(done, n):
            yield iteration
            if iteration + 1 == n or time.perf_counter() - saved_at >= self._every:
                self._save(iteration + 1, generator, parts)
                saved_at = time.perf_counter()

    def _restore(self, generator: torch.Generator, parts: dict[str, Stateful]) -> int:
        if self._file is None or not self._file.exists():
            return 0
        content = io.BytesIO(self._file.read_bytes())
        try:
            saved = _with_tensors(*unpack(content, _STATES))
            for name, part in parts.items():
                part.load_state_dict(saved[name])
            generator.set_state(saved["generator"])
            done = int(saved["done"])
        except DAMAGE as error:
            raise ValueError(
                f"{self._file} is damaged, or of another run ({error!r}). Delete it to begin anew."
            ) from error
        self._skipped(done)
        return done

    def _save(self, done: int, generator: torch.Generator, parts: dict[str, Stateful]) -> None:
        if self._file is None:
            return
        states = {name: part.state_dict() for name, part in parts.items()}
        tensors: dict[str, Tensor] = {}
        described = _without_tensors({"done": done, "generator": generator.get_state(), **states}, tensors)
        with whole_file(self._file) as file:
            file.write_bytes(pack(described, tensors, _STATES))


def _without_tensors(state: Any, tensors: dict[str, Tensor]) -> Any:
    """A state as JSON types: a mapping is a list of pairs under "items", a tensor its name under "tensor"."""
    if isinstance(state, Tensor):
        name = f"{len(tensors)}"
        tensors[name] = state
        return {"tensor": name}
    if isinstance(state, Mapping):
        return {"items": [[key, _without_tensors(value, tensors)] for key, value in state.items()]}
    if isinstance(state, (list, tuple)):
        return [_without_tensors(value, tensors) for value in state]
    return state


def _with_tensors(described: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The inverse of :func:`_without_tensors`, but that tuples are lists."""
    if isinstance(described, list):
        return [_with_tensors(value, tensors) for value in described]
    if isinstance(described, dict):
        if "tensor" in described:
            return tensors[described["tensor"]]
        return {key: _with_tensors(value, tensors) for key, value in described["items"]}
    return described
