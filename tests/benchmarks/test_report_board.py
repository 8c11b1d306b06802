from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2

from benchmarks.reporting.board import METRICS
from benchmarks.reporting.report import Report
from tests.stored_results import store_curves, store_gaits, store_runs


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What TensorBoard shows of three experiments."""
    parent = tmp_path_factory.mktemp("board")
    results, folder = parent / "results", parent / "board"
    store_curves(results, "famle", [[20.0, 35.0, 35.0, 35.0], [35.0, 35.0, 35.0, 35.0]])
    store_curves(results, "ppo", [[1.0] * 8, [2.0] * 8])
    store_gaits(results, "famle", [10, 20])
    store_runs(results, "famle", [2000.0])
    Report(results, parent / "report", folder)()
    return folder


def read(run: Path) -> EventAccumulator:
    events = EventAccumulator(str(run))
    events.Reload()
    return events


def scalars(run: Path, tag: str) -> list[tuple[int, float]]:
    return [(event.step, event.value) for event in read(run).Scalars(tag)]


def hparams(run: Path, tag: str) -> Any:
    content = read(run).SummaryMetadata(tag).plugin_data.content
    return plugin_data_pb2.HParamsPluginData.FromString(content)


def test_curves_are_returns_over_robot_steps_and_journeys_ways_over_gaits(board: Path) -> None:
    curve = scalars(board / "reacher-paper" / "famle" / "seed-0", "rollout/ep_rew_mean")
    assert curve == [(50, 20.0), (100, 35.0), (150, 35.0), (200, 35.0)]
    way = scalars(board / "quadruped-yaw" / "famle" / "seed-1", "journey/x")
    assert way[0] == (0, 0.0)
    assert way[-1] == (20, pytest.approx(2.0))
    assert scalars(board / "quadruped-yaw" / "famle" / "seed-1", "score/gaits") == [(0, 20.0)]
    speed = scalars(board / "ant-unseen" / "famle" / "seed-0", "rollout/speed")
    assert (speed[0], speed[-1]) == ((50, 2.0), (1000, 2.0))


def test_hyperparameters_have_the_same_keys_in_all_runs(board: Path) -> None:
    runs = sorted(board.glob("*/*/seed-*"))
    assert len(runs) == 7
    keys, metrics = set(), set()
    for run in runs:
        info = hparams(run, "_hparams_/session_start_info").session_start_info
        keys.add(tuple(sorted(info.hparams)))
        experiment = hparams(run, "_hparams_/experiment").experiment
        metrics.add(tuple(metric.name.tag for metric in experiment.metric_infos))
        assert info.hparams["method"].string_value == run.parent.name
        assert info.hparams["experiment"].string_value == run.parent.parent.name
        assert run.name == f"seed-{info.hparams['seed'].number_value:.0f}"
    assert keys == {("experiment", "method", "robot", "seed")}
    assert metrics == {METRICS}


def test_metrics_of_a_run_are_its_figures_and_what_it_has_not_is_left_blank(board: Path) -> None:
    solved, unsolved = board / "reacher-paper" / "famle" / "seed-0", board / "reacher-paper" / "ppo" / "seed-0"
    assert scalars(solved, "score/solved_at") == [(0, 100.0)]
    assert scalars(solved, "score/first_episode") == [(0, 20.0)]
    assert "score/solved_at" not in read(unsolved).Tags()["scalars"]
    assert scalars(board / "ant-unseen" / "famle" / "seed-0", "score/first_episode") == [(0, 2000.0)]


def test_charts_find_the_quartiles_of_every_method(board: Path) -> None:
    tensor = read(board / "layout").Tensors("custom_scalars__config__")[0].tensor_proto
    layout = layout_pb2.Layout.FromString(tensor.string_val[0])
    titles = [category.title for category in layout.category]
    assert len(titles) == len(set(titles)) == 4
    charts = {chart.title: chart for chart in layout.category[0].chart}
    margin = charts["median and quartiles"].margin.series[0]
    for method in ("famle", "ppo"):
        run = board / "reacher-paper" / method / "quartiles"
        assert {margin.value, margin.lower, margin.upper} == set(read(run).Tags()["scalars"])
    famle = board / "reacher-paper" / "famle" / "quartiles"
    assert scalars(famle, margin.value)[0] == (50, 27.5)
    assert scalars(famle, margin.lower)[0] == (50, 23.75)
    assert scalars(famle, margin.upper)[0] == (50, 31.25)


def test_event_files_of_an_earlier_call_are_replaced_and_others_are_kept(tmp_path: Path) -> None:
    folder, run = tmp_path / "board", tmp_path / "board" / "ant-unseen" / "famle" / "seed-0"
    for value in (1000.0, 2000.0):
        store_runs(tmp_path / "results", "famle", [value])
        Report(tmp_path / "results", tmp_path / "report", folder)()
        (folder / "events.out.tfevents.mine").touch()
    assert len(list(run.glob("events.out.tfevents.*"))) == 1
    assert scalars(run, "score/first_episode") == [(0, 2000.0)]
    assert (folder / "events.out.tfevents.mine").exists()
