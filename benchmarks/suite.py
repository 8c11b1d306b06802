"""The benchmarks of the paper's figures and tables, as one command each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import arg, subcommand

from benchmarks import ant, minitaur, quadruped, reacher, sine

__all__ = ["BENCHMARKS", "Benchmark"]

BENCHMARKS: Mapping[type, Callable[[Any], None]] = {
    module.Args: module.main for module in (reacher, ant, quadruped, minitaur, sine)
}
"""What runs a benchmark, by the kind of its arguments."""


@dataclass(frozen=True)
class Benchmark:
    """Measure FAMLE and its rivals: the paper's figures and tables. What is stored is not measured again."""

    of: Annotated[
        Annotated[reacher.Args, subcommand("reacher", prefix_name=False)]
        | Annotated[ant.Args, subcommand("ant", prefix_name=False)]
        | Annotated[quadruped.Args, subcommand("quadruped", prefix_name=False)]
        | Annotated[minitaur.Args, subcommand("minitaur", prefix_name=False)]
        | Annotated[sine.Args, subcommand("sine", prefix_name=False)],
        arg(name=""),
    ]

    def __call__(self) -> None:
        """Runs it."""
        BENCHMARKS[type(self.of)](self.of)
