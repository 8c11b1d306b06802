"""Stored results in TensorBoard: a run a replicate, the quartiles of each method, and charts that overlay the methods.

Runs are ``<experiment>/<method>/seed-<n>`` and ``<experiment>/<method>/quartiles``. TensorBoard gives each run a
colour, so that the quartiles of each method are a run of their own. Charts find them in all runs by their tags, which
therefore begin with the experiment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from benchmarks.harness import Result
from benchmarks.reporting.looks import in_order
from benchmarks.reporting.registry import Kind
from benchmarks.reporting.statistics import solved_at
from benchmarks.reporting.study import Study, quartiles_over_steps

__all__ = ["METRICS", "TRACES", "write_board"]

TRACES: Mapping[Kind, str] = {
    "curves": "rollout/ep_rew_mean",
    "episode": "rollout/speed",
    "gaits": "journey/x",
    "distance": "journey/x",
}
"""The tag of what a replicate's life is shown by; of returns that of Stable-Baselines3."""

METRICS = (
    "score/first_episode",
    "score/mean_return",
    "score/last",
    "score/solved_at",
    "score/gaits",
    "score/distance",
    "score/ms",
)
"""What the HParams page can sort by. TensorBoard shows the keys of the first run alone, hence all runs have these."""

_QUARTILES = ("low", "median", "high")


def write_board(studies: Sequence[Study], folder: Path) -> None:
    """Writes the event files of all studies; those of an earlier call are replaced.

    Args:
        studies: What was stored.
        folder: The folder for ``tensorboard --logdir``.
    """
    for name in ("layout", *(study.experiment.folder for study in studies)):
        for stale in (folder / name).rglob("events.out.tfevents.*"):
            stale.unlink()
    known = _known(studies)
    for study in studies:
        for method, runs in study.runs.items():
            for run in runs:
                _write_replicate(study, method, run, known, folder)
            _write_quartiles(study, method, folder)
    with SummaryWriter(str(folder / "layout")) as writer:
        writer.add_custom_scalars(_layout(studies))


def _known(studies: Sequence[Study]) -> dict[str, list[str]]:
    """All values of the hyperparameters that have few, so that the HParams page can filter by them."""
    return {
        "experiment": [study.experiment.folder for study in studies],
        "robot": list(dict.fromkeys(study.experiment.robot for study in studies)),
        "method": in_order({method for study in studies for method in study.runs}),
    }


def _write_replicate(study: Study, method: str, run: Result, known: dict[str, list[str]], folder: Path) -> None:
    experiment = study.experiment
    parameters = {"experiment": experiment.folder, "robot": experiment.robot, "method": method, "seed": run["seed"]}
    scores = _scores(study, run)
    with SummaryWriter(str(folder / experiment.folder / method / f"seed-{run['seed']}")) as writer:
        for summary in hparams(parameters, dict.fromkeys(METRICS), known):  # type: ignore[no-untyped-call]
            writer._get_file_writer().add_summary(summary)  # noqa: SLF001 - no public way to add one
        for tag, value in scores.items():
            writer.add_scalar(tag, value)
        for step, value in zip(*study.trace(run), strict=True):
            writer.add_scalar(TRACES[experiment.kind], value, round(step))


def _write_quartiles(study: Study, method: str, folder: Path) -> None:
    experiment = study.experiment
    traces = [study.trace(run) for run in study.runs[method]]
    steps, values = quartiles_over_steps(traces, hold=experiment.kind in ("gaits", "distance"))
    with SummaryWriter(str(folder / experiment.folder / method / "quartiles")) as writer:
        for name, row in zip(_QUARTILES, values, strict=True):
            for step, value in zip(steps, row, strict=True):
                writer.add_scalar(f"{experiment.folder}/{name}", value, round(step))


def _scores(study: Study, run: Result) -> dict[str, float]:
    """The metrics that this kind of experiment has; TensorBoard leaves the others blank."""
    names = {"return": "first_episode"}
    measures = [measure for measure in study.measures if study.has(run["method"], measure)]
    scores = {f"score/{names.get(measure.key, measure.key)}": measure.score(run) for measure in measures}
    if study.experiment.kind == "curves":
        solved = solved_at(run["returns"], run["lengths"], study.experiment.threshold)
        scores |= {} if solved is None else {"score/solved_at": float(solved)}
    milliseconds = study.milliseconds(run)
    return scores | ({} if milliseconds is None else {"score/ms": milliseconds})


def _layout(studies: Sequence[Study]) -> dict[str, dict[str, list[Any]]]:
    """The charts of the custom-scalars page, a group an experiment; plain charts take regular expressions for tags."""
    layout: dict[str, dict[str, list[Any]]] = {}
    for study in studies:
        folder = study.experiment.folder
        low, median, high = (f"{folder}/{name}" for name in _QUARTILES)
        layout[study.experiment.title] = {
            "median and quartiles": ["Margin", [median, low, high]],
            "median": ["Multiline", [f"{re.escape(median)}$"]],
        }
    tags = dict.fromkeys(TRACES[study.experiment.kind] for study in studies)
    layout["Every replicate"] = {tag: ["Multiline", [f"{re.escape(tag)}$"]] for tag in tags}
    return layout
