from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import results as tables
from benchmarks.reporting.registry import EXPERIMENTS, STYLES, Experiment, in_order, style_of
from benchmarks.reporting.report import Report, show
from benchmarks.reporting.statistics import p_value
from benchmarks.results import load
from tests.stored_results import (
    by_name,
    report,
    rows_of,
    store,
    store_curves,
    store_gaits,
    store_run,
    store_runs,
    store_walks,
)

PNG = b"\x89PNG"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of the results, empty."""
    return tmp_path / "results"


@pytest.fixture
def arm(results: Path) -> Path:
    """Learning curves of FAMLE and the oracle, four episodes of 50 steps."""
    store_curves(results, "famle", [[20.0, 35.0, 35.0, 35.0], [35.0, 35.0, 35.0, 35.0]])
    store_curves(results, "oracle", [[40.0] * 4] * 2)
    return results


@pytest.fixture
def ant(results: Path) -> Path:
    """First episodes of FAMLE, with and without adaptation."""
    store_runs(results, "famle", [2000.0, 2400.0])
    store_runs(results, "famle-frozen", [700.0, 900.0])
    return results


@pytest.fixture
def quadruped(results: Path) -> Path:
    """Journeys of FAMLE and a rival that fails once."""
    store_gaits(results, "famle", [10, 20])
    store_gaits(results, "ampc-reptile", [40, None])
    return results


@pytest.fixture
def minitaur(results: Path) -> Path:
    """Walks of FAMLE, one of which ends behind where it has been."""
    store_walks(results, "famle", [[0.0, 3.0, 5.0, 4.0], [0.0, 3.0, 4.0, 5.0]])
    return results


def test_report_has_a_section_a_picture_and_a_table_for_every_experiment_that_is_stored(
    results: Path, arm: Path, ant: Path, quadruped: Path, minitaur: Path
) -> None:
    text, out = report(results)
    ways = ("quadruped-yaw-paths", "minitaur-held-out-paths")
    for name in ("reacher-paper", "ant-unseen", "quadruped", "minitaur-held-out", "time", *ways):
        assert (out / f"{name}.png").read_bytes().startswith(PNG)
        assert f"]({name}.png)" in text
    assert {path.stem for path in out.glob("*.csv")} == {
        *("reacher-paper", "ant-unseen", "quadruped-yaw", "minitaur-held-out")
    }
    assert text.count("\n## Arm, the paper's damage") == 1
    assert "- `python -m benchmarks.x --methods famle` at `abc1234`: FAMLE (`famle`)" in text
    assert not list(out.glob("*.partial"))


def test_experiments_without_results_are_named_as_not_measured(arm: Path) -> None:
    text, _ = report(arm)
    shown, missing = text.split("## Not measured")
    assert "`ant-curves`" in missing
    assert "python -m benchmarks.ant --experiment curves" in missing
    assert "`reacher-paper`" not in missing
    assert "figure 4" not in shown


def test_tables_that_no_experiment_knows_are_named(ant: Path) -> None:
    store_runs(ant, "famle", [1.0], experiment="ant-moon")
    assert "`ant-moon`" in report(ant)[0].split("## Stored and not shown")[1]


def test_figures_of_curves_are_those_of_the_replicates(arm: Path) -> None:
    text, out = report(arm)
    row = by_name(out / "reacher-paper.csv")["famle"]
    assert float(row["first_episode_median"]) == 27.5
    assert float(row["mean_return_median"]) == pytest.approx((31.25 + 35.0) / 2)
    assert float(row["first_episode_of_oracle"]) == pytest.approx(27.5 / 40.0, abs=1e-4)
    assert float(row["solved_at"]) == 75.0
    assert float(row["solved_in_common_steps"]) == 2
    assert float(row["ms"]) == 20.0
    assert rows_of(text, "FAMLE")[0][-1] == "solved at about 500 steps"


def test_curves_are_compared_over_the_steps_that_all_have_and_long_budgets_are_told_apart(arm: Path) -> None:
    store_curves(arm, "ppo", [[0.0] * 10 + [50.0] * 10] * 2)
    text, out = report(arm)
    rows = by_name(out / "reacher-paper.csv")
    assert float(rows["ppo"]["mean_return_median"]) == 0.0
    assert [float(rows["ppo"][name]) for name in ("solved_in_common_steps", "solved")] == [0, 2]
    assert (rows["ppo"]["robot_steps"], rows["famle"]["robot_steps"]) == ("1000", "200")
    assert float(rows["ppo"]["solved_at"]) == 550.0
    assert float(rows["ppo"]["famle_matched_at"]) == 550.0  # the first of three above the mean of 20, 35, 35 and 35
    assert (rows["famle"]["famle_matched_at"], rows["oracle"]["famle_matched_at"]) == ("", "50")
    assert (float(rows["ppo"]["end_median"]), float(rows["famle"]["end_median"])) == (50.0, (31.25 + 35.0) / 2)
    assert float(rows["ppo"]["famle_faster_by"]) == pytest.approx(550.0 / 75.0 - 1.0, abs=1e-4)
    assert "mean return over 200 robot steps" in text
    assert "200 robot steps instead of 1,000" in text


def test_method_with_fewer_steps_is_compared_by_what_it_has(arm: Path) -> None:
    store_curves(arm, "famle-paper", [[10.0, 35.0]] * 2)
    store_curves(arm, "famle-original", [[10.0, 35.0]] * 2)
    store_curves(arm, "ampc", [[10.0]] * 2)
    text, out = report(arm)
    row = by_name(out / "reacher-paper.csv")["famle-paper"]
    figures = ("robot_steps", "first_episode_median", "first_episode_famle_better")
    assert [float(row[name]) for name in figures] == [100, 10, 1]
    compared = ("mean_return_median", "last_median", "mean_return_famle_better", "solved_in_common_steps")
    assert [row[name] for name in compared] == [""] * 4
    alike = "100 robot steps of FAMLE, the paper's settings / FAMLE, the authors' code's settings"
    assert f"{alike}; 50 robot steps of AMPC\n" in text
    assert "mean return over 200 robot steps" in text


def test_episode_says_which_robots_walk_again(ant: Path) -> None:
    for seed, steps in enumerate((0, 100, 300, None)):
        store_run(ant, "famle", seed, 2000.0, recovery=steps, break_at=300)
    text, out = report(ant)
    row = by_name(out / "ant-unseen.csv")["famle"]
    walking = ("walks_on", "recovered", "recovery", "slowest_recovery")
    assert [float(row[name]) for name in walking] == [1, 3, 200, 300]
    assert rows_of(text, "FAMLE")[0][3:7] == ["1 of 4", "3 of 4", "200", "300"]


def test_robot_that_was_broken_from_the_first_step_does_not_walk_on(ant: Path) -> None:
    text, _ = report(ant)
    assert "| walks on |" not in text


def test_benchmark_shows_the_section_of_its_experiment(ant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show(ant, "ant-unseen")
    shown = capsys.readouterr().out
    assert "Ant, unseen damage" in shown
    assert "2200" in shown  # the median of FAMLE
    with pytest.raises(FileNotFoundError, match="run the benchmark first"):
        show(ant, "reacher-paper")
    with pytest.raises(ValueError, match=r"ant-moon.*experiments\.yaml"):
        show(ant, "ant-moon")


def test_success_rate_and_gaits_stand_beside_the_paper_s(quadruped: Path) -> None:
    text, out = report(quadruped)
    ours, rival = rows_of(text, "FAMLE"), rows_of(text, "AMPC-MAML (Reptile)")[0]
    table = next(row for row in ours if "32.6" in row[-1])
    assert table[2:4] == ["15.0 +- 7.1", "100 %"]
    assert table[-1] == "32.6 +- 2.3 gaits, 63.4 +- 4.5 s, 100 %"
    assert rival[2:5] == ["40.0", "50 %", "167 %"]
    assert rival[-1].startswith("61.8 +- 7.2 gaits, 120.1 +- 13.9 s, 40 %")
    assert rows_of(text, "AMPC, in the paper alone")[0][-1] == "0 %"
    rows = by_name(out / "quadruped-yaw.csv")
    assert float(rows["ampc-reptile"]["gaits_median"]) == (40 + 81) / 2
    assert float(rows["ampc-reptile"]["gaits_famle_better"]) == 1.0


def test_distance_is_the_furthest_and_the_time_until_there(minitaur: Path) -> None:
    text, out = report(minitaur)
    table = next(row for row in rows_of(text, "FAMLE") if row[-1] == "4.8 m in 60 s")
    assert table[2:4] == ["5.0", "2"]
    rivals = [row[-1] for row in rows_of(text, "AMPC-MAML, in the paper alone")]
    assert "1.6 m in 90 s, FAMLE about 50 % faster" in rivals
    assert float(by_name(out / "minitaur-held-out.csv")["famle"]["distance_median"]) == 4.5


def test_famle_s_time_to_where_another_method_gets_stands_beside_it(minitaur: Path) -> None:
    store_walks(minitaur, "ampc", [[0.0, 1.0, 2.0, 3.0]] * 2)
    store_walks(minitaur, "oracle", [[0.0, 4.0, 8.0, 9.0]] * 2)
    text, out = report(minitaur)
    rows = by_name(out / "minitaur-held-out.csv")
    assert [rows[name]["famle_there_after"] for name in ("ampc", "oracle", "famle")] == ["1.0", "inf", ""]
    assert rows_of(text, "oracle")[0][4] == "never"


def test_probability_of_improvement_is_of_famle_over_the_others(ant: Path) -> None:
    store_runs(ant, "famle-nearest", [2000.0, 2400.0])
    rows = by_name(report(ant)[1] / "ant-unseen.csv")
    assert float(rows["famle-frozen"]["return_famle_better"]) == 1.0
    assert float(rows["famle-nearest"]["return_famle_better"]) == 0.5
    assert rows["famle"]["return_famle_better"] == ""
    assert rows["famle-frozen"]["solved"] == "1"


def test_baselines_that_win_are_named(arm: Path) -> None:
    store_curves(arm, "famle", [[30.0] * 10] * 6)
    store_curves(arm, "oracle", [[40.0] * 10] * 6)
    store_curves(arm, "ampc", [[1.0] * 5 + [38.0] * 5] * 6)
    store_curves(arm, "ppo", [[50.0] * 10] * 2)  # too few to be sure of
    line = next(line for line in report(arm)[0].splitlines() if line.startswith("Better than FAMLE"))
    first, mean, last = line.split(";")
    assert first.endswith(": oracle (return of the first episode)")
    assert mean == " oracle (mean return over 500 robot steps)"
    assert last == " AMPC / oracle (mean return of the last 5 episodes within 500 robot steps)."


def test_many_comparisons_are_corrected_for(arm: Path) -> None:
    rng = np.random.default_rng(0)
    store_curves(arm, "famle", rng.normal(20.0, 1.0, (8, 4)).tolist())
    for name in ("ampc", "ampc-reptile", "ampc-fomaml", "ampc-maml"):
        store_curves(arm, name, rng.normal(20.0, 1.0, (8, 4)).tolist())
    store_curves(arm, "ppo", rng.normal(17.5, 1.0, (8, 4)).tolist())
    alone = by_name(report(arm)[1] / "reacher-paper.csv")
    p = [float(row["first_episode_famle_better_p"]) for name, row in alone.items() if name not in ("famle", "oracle")]
    assert len(p) == 5
    assert min(p) == pytest.approx(float(alone["ppo"]["first_episode_famle_better_p"]))
    assert min(p) > 1.5 * p_value(*(first_returns(arm, name) for name in ("famle", "ppo")))


def first_returns(results: Path, method: str) -> list[float]:
    table = load(results / "reacher-paper.csv")
    return [returns[0] for returns in table["returns"][table["method"] == method]]


def test_replicates_whose_adaptations_diverge_are_marked(arm: Path) -> None:
    curve = {"returns": [20.0, 35.0, 35.0, 35.0], "lengths": [50] * 4, "seconds_per_step": 0.02}
    for seed, diverged in enumerate((3, 2)):
        store(arm, "reacher-paper", "famle", seed, **curve, adaptations=20, diverged=diverged)
    text, out = report(arm)
    row = by_name(out / "reacher-paper.csv")["famle"]
    assert (float(row["diverged"]), float(row["diverged_replicates"])) == (0.125, 1)
    title = next(line for line in text.splitlines() if line.startswith("## Arm"))
    assert "more than one in ten adaptations diverged in 1 replicates of FAMLE" in title
    assert any("12.5 %, over 10 % in 1 of 2" in cell for cell in rows_of(text, "FAMLE")[0])
    assert by_name(out / "reacher-paper.csv")["oracle"]["diverged"] == ""  # nobody counted


def test_replicates_with_damages_of_their_own_are_compared_on_the_same_damage(results: Path) -> None:
    returns = {"famle": [100.0, 1000.0, 2000.0], "ampc": [90.0, 1000.0], "ampc-maml": [90.0, 1900.0, 1900.0]}
    for method, values in returns.items():
        for seed, value in enumerate(values):
            store_run(results, method, seed, value, situation=f"joint {seed} dead")
    text, out = report(results)
    rows = by_name(out / "ant-unseen.csv")
    assert float(rows["ampc"]["return_famle_better"]) == 0.75
    assert float(rows["ampc-maml"]["return_famle_better"]) == pytest.approx(2 / 3, abs=1e-4)
    assert rows_of(text, "AMPC")[-1][-1] == "0.75"


def test_return_of_a_robot_that_breaks_on_the_way_counts_from_then_on(results: Path) -> None:
    for seed, value in enumerate((560.0, 570.0)):
        store_run(results, "famle", seed, value, "ant-break", break_at=300, recovery=10)
    text, out = report(results)
    row = by_name(out / "ant-break.csv")["famle"]
    assert float(row["return_median"]) == pytest.approx(565.0 / 0.7, abs=1e-3)
    assert row["solved"] == "1"  # 570 in 700 steps is above 800 in 1,000
    assert "return since the damage, per 1,000 robot steps" in text


def test_results_without_famle_are_reported_all_the_same(tmp_path: Path) -> None:
    store_curves(tmp_path / "results", "ampc", [[1.0, 2.0, 3.0]])
    text, _ = report(tmp_path / "results")
    assert rows_of(text, "AMPC")
    assert "| method | n | P(FAMLE better)" not in text


def test_unknown_method_is_shown_under_its_own_name_after_the_known_ones(arm: Path) -> None:
    store_curves(arm, "magic", [[1.0, 2.0, 3.0, 4.0]] * 2)
    text, out = report(arm)
    assert rows_of(text, "magic")
    assert list(by_name(out / "reacher-paper.csv"))[:3] == ["famle", "oracle", "magic"]
    assert style_of("magic").label == "magic"
    assert in_order(["magic", "oracle", "famle"]) == ["famle", "oracle", "magic"]


def test_fewer_replicates_than_others_or_the_paper_are_said_in_the_title(arm: Path) -> None:
    store_curves(arm, "ampc", [[1.0, 2.0, 3.0, 4.0]])
    title = next(line for line in report(arm)[0].splitlines() if line.startswith("## Arm"))
    assert "2 replicates, the paper has 30; 1 of AMPC" in title


def test_replicates_of_different_settings_are_said_in_the_title(results: Path) -> None:
    for method, settings in (("famle", ("aa", "aa", "bb")), ("ampc", ("cc", "cc", "cc"))):
        for seed, name in enumerate(settings):
            store_run(results, method, seed, 100.0, settings=name)
    store_run(results, "ppo", 0, 1.0)  # of a time when nobody kept them
    title = next(line for line in report(results)[0].splitlines() if line.startswith("## Ant"))
    assert title.endswith("settings that differ between replicates of FAMLE")


def test_oracle_is_compared_over_the_seeds_that_both_have(ant: Path) -> None:
    store_runs(ant, "oracle", [4000.0])
    text, out = report(ant)
    row = by_name(out / "ant-unseen.csv")["famle"]
    assert (float(row["return_of_oracle"]), float(row["return_oracle_seeds"])) == (0.5, 1)
    assert any(row[-1] == "50 % (1)" for row in rows_of(text, "FAMLE"))


def test_without_results_the_remedy_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"run a benchmark first, such as: python -m benchmarks\.reacher"):
        Report(tmp_path / "results", tmp_path / "report")()
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize("figures", [{}, {"returns": []}, {"returns": [1.0], "lengths": [50], "command": None}])
def test_row_without_what_its_experiment_needs_is_named_and_nothing_is_written(arm: Path, figures: Any) -> None:
    tables.store(arm / "reacher-paper.csv", [{"method": "ampc", "seed": 0, "commit": "abc1234", **figures}])
    with pytest.raises(ValueError, match=r"reacher-paper\.csv is damaged \(a row has no .*delete that row and run"):
        report(arm)
    assert not (arm.parent / "report").exists()


# --- sines, which have no robot -------------------------------------------------------------------------------


@pytest.fixture
def sines(arm: Path) -> Path:
    """Results of an arm and of sines."""
    source = {"command": "python -m benchmarks.sine --replicates 2", "commit": "abc1234", "title": "Errors"}
    better = {3: 0.8, 5: 0.755}
    rows = [
        {
            "method": method,
            "points": n,
            "median": x,
            "quartiles": [0.5 * x, 2.0 * x],
            "famle_better_than_maml": better[n],
        }
        for method, x in (("FAMLE", 0.04), ("MAML", 0.2))
        for n in better
    ]
    tables.store(arm / "sine.csv", [row | source for row in rows], keys=("method", "points"))
    (arm / "sine.png").write_bytes(b"a picture")
    return arm


def test_sines_have_a_section_with_the_stored_figures_and_the_picture(sines: Path) -> None:
    text, out = report(sines)
    assert "\n## Sines from three, four and five points (figure 2)\n" in text
    assert rows_of(text, "3") == [["3", "0.040 (0.020 to 0.080)", "0.200 (0.100 to 0.400)", "80 %"]]
    assert rows_of(text, "5")[0][-1] == "76 %"
    assert "`python -m benchmarks.sine --replicates 2` at `abc1234`" in text
    assert (out / "sine.png").read_bytes() == b"a picture"
    assert "| `sine` |" not in text


def test_sines_that_were_not_measured_are_named_so(arm: Path) -> None:
    assert "| `sine` | `python -m benchmarks.sine` |" in report(arm)[0].split("## Not measured")[1]


def test_report_is_the_same_the_second_time(quadruped: Path) -> None:
    first, out = report(quadruped)
    tables = {path.name: path.read_bytes() for path in out.glob("*.csv")}
    assert report(quadruped)[0] == first
    assert tables == {path.name: path.read_bytes() for path in out.glob("*.csv")}


def test_registry_names_every_experiment_once_and_the_paper_s_methods_as_the_styles_do() -> None:
    assert len({experiment.name for experiment in EXPERIMENTS}) == len(EXPERIMENTS)
    stands_beside = {style.paper for style in STYLES.values()}
    assert {row.method for experiment in EXPERIMENTS for row in experiment.paper} <= stands_beside


def test_curves_cannot_share_a_picture() -> None:
    with pytest.raises(ValueError, match="side by side"):
        Experiment("arm-x", "Arm", "curves", "python", "", budget=100, picture="arms")
