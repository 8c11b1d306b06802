from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import results as tables
from benchmarks.reporting.figures import figures
from benchmarks.reporting.pictures import draw, draw_times
from benchmarks.reporting.registry import Experiment, experiment_named
from benchmarks.reporting.study import Study, read_study
from tests.stored_results import store, store_curves, store_gaits, store_runs, store_walks


def study_of(results: Path, folder: str) -> Study:
    study = read_study(experiment_named(folder), results)
    assert study is not None
    return study


@pytest.mark.parametrize(("episodes", "panels"), [(4, 1), (40, 2)])
def test_longer_budget_gets_a_second_panel_over_all_its_steps(tmp_path: Path, episodes: int, panels: int) -> None:
    store_curves(tmp_path, "famle", [[1.0] * 4] * 3)
    store_curves(tmp_path, "ppo", [[2.0] * episodes] * 2)
    figure = draw([study_of(tmp_path, "reacher-paper")])
    assert [axes.get_xscale() for axes in figure.axes] == ["linear", "log"][:panels]
    longest = [max(line.get_xdata()[-1] for line in axes.get_lines()[:2]) for axes in figure.axes]
    assert longest == [200, 2000][:panels]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["FAMLE (n = 3)", "PPO (n = 2)", "solved"]


def test_curve_is_the_median_over_robot_steps(tmp_path: Path) -> None:
    store_curves(tmp_path, "famle", [[1.0, 2.0], [3.0, 4.0], [5.0, 9.0]])
    line = draw([study_of(tmp_path, "reacher-paper")]).axes[0].get_lines()[0]
    np.testing.assert_array_equal(line.get_xydata(), [[50, 3.0], [100, 4.0]])


def test_situations_stand_side_by_side_with_failures_and_the_paper_s_means(tmp_path: Path) -> None:
    store_gaits(tmp_path, "famle", [10, 20], "quadruped-yaw")
    store_gaits(tmp_path, "famle", [10, None, None], "quadruped-leg")
    store_gaits(tmp_path, "ampc", [None, None], "quadruped-leg")
    figure = draw([study_of(tmp_path, name) for name in ("quadruped-yaw", "quadruped-leg")])
    yaw, leg = figure.axes
    labels = [label.get_text() for label in yaw.get_yticklabels()]
    assert labels == ["FAMLE", "AMPC", "the paper's FAMLE", "the paper's AMPC-MAML"]
    assert [text.get_text() for text in yaw.texts] == []
    assert [text.get_text() for text in leg.texts] == ["2 of 3 fail", "2 of 2 fail"]
    boxes = [np.sort([patch.get_path().vertices[:, 0].mean() for patch in axes.patches]) for axes in (yaw, leg)]
    assert 12.5 < boxes[0][0] < 17.5 < boxes[1][0]  # of 10 and 20 gaits; of 10 and twice the limit
    marked = {tuple(np.ravel(line.get_xydata())) for line in yaw.get_lines() if line.get_marker() == "D"}
    assert marked == {(32.6, 2.0), (61.8, 3.0)}


def test_every_replicate_is_shown_beside_the_interquartile_mean(tmp_path: Path) -> None:
    store_walks(tmp_path, "famle", [[0.0, 1.0], [0.0, 2.0], [0.0, 3.0], [0.0, 10.0]])
    axes = draw([study_of(tmp_path, "minitaur-held-out")]).axes[0]
    assert sorted(axes.collections[0].get_offsets()[:, 0]) == [1.0, 2.0, 3.0, 10.0]
    assert axes.get_lines()[0].get_xdata()[0] == 2.5


def test_times_have_a_panel_an_experiment_and_one_entry_a_method_in_the_legend(tmp_path: Path) -> None:
    store_curves(tmp_path, "famle", [[1.0, 2.0]] * 2)
    store_runs(tmp_path, "famle", [2000.0, 2400.0])
    store_runs(tmp_path, "magic", [2000.0, 2400.0])
    figure = draw_times([study_of(tmp_path, name) for name in ("reacher-paper", "ant-unseen")])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["FAMLE", "magic"]
    arm, ant = figure.axes
    assert set(arm.get_lines()[0].get_xdata()) == {20.0}
    assert set(ant.get_lines()[0].get_xdata()) == {12.0}


def test_replicates_in_step_have_no_time_of_their_own(tmp_path: Path) -> None:
    store_curves(tmp_path, "famle", [[1.0, 2.0]] * 2)
    for seed in range(2):
        store(tmp_path, "reacher-paper", "ampc", seed, returns=[1.0], lengths=[50], seconds_per_step=0.001, fleet=2)
    study = study_of(tmp_path, "reacher-paper")
    assert study.times == {"famle": pytest.approx(20.0)}
    assert [text.get_text() for text in draw_times([study]).legends[0].get_texts()] == ["FAMLE"]
    assert np.isnan(figures(study).loc["ampc", "ms"])


def test_times_of_one_run_go_before_those_of_the_replicates(tmp_path: Path) -> None:
    store_curves(tmp_path, "famle", [[1.0, 2.0]] * 2)
    store_curves(tmp_path, "oracle", [[1.0, 2.0]] * 2)
    times = {"robot alone": [0.5, 0.5, 9.0], "famle": [30.0, 40.0, 10.0], "ppo": [1.0, 1.0, 1.0]}
    rows = [{"robot": "reacher", "part": "step in turns", "figure": name, "value": ms} for name, ms in times.items()]
    tables.store(tmp_path / "timing.csv", rows, keys=("robot", "part"))
    study = study_of(tmp_path, "reacher-paper")
    assert study.times == {"famle": 30.0}
    table = figures(study)
    assert table.loc["famle", ["ms", "step_ms", "times_robot_alone"]].tolist() == [20.0, 30.0, 60.0]
    assert np.isnan(table.loc["oracle", "step_ms"])


def test_new_robot_is_one_entry(tmp_path: Path) -> None:
    experiment = Experiment("hexapod-leg", "Hexapod", "curves", "python -m hexapod", "", budget=200, threshold=1.0)
    store_curves(tmp_path, "famle", [[1.0, 2.0, 3.0, 4.0]] * 2, experiment="hexapod-leg")
    study = read_study(experiment, tmp_path)
    assert study is not None
    assert experiment.robot == "hexapod"
    assert study.title == "Hexapod: 2 replicates"
    assert draw([study]).get_suptitle() == study.title
    assert read_study(experiment, tmp_path / "elsewhere") is None
