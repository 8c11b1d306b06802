"""The command line of a benchmark."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

import tyro
from rich.console import Console

from benchmarks.harness import ReplicateError

__all__ = ["run"]

Args = TypeVar("Args")


def run(main: Callable[[Args], object], arguments: type[Args], args: list[str] | None = None) -> None:
    """Runs a benchmark with the arguments of the command line; a mistake ends with advice and the status 2.

    Args:
        main: The benchmark.
        arguments: What it can be told.
        args: The command line without the program's name; None takes the process's own.
    """
    try:
        main(tyro.cli(arguments, args=args))
    except (ImportError, OSError, ReplicateError, TypeError, ValueError) as error:
        Console(stderr=True).print(str(error), markup=False, highlight=False)
        sys.exit(2)
