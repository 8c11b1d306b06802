import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joblib import delayed, parallel_config

from benchmarks import reacher
from benchmarks.harness import Fleet, Replicate, ReplicateError, is_stored, load_results, provenance, run_replicates
from benchmarks.identification import accuracy, across_the_wrap
from benchmarks.reporting.looks import look
from benchmarks.reporting.statistics import first_crossing, interquartile_mean, solved_at
from famle_agent import FAMLE, Transitions
from famle_agent.utils.parallel import as_completed, parallel
from famle_envs.reacher import ReacherEnv


def squared(seed: int, log: Path) -> dict[str, Any]:
    with log.open("a") as file:
        file.write(f"{seed}\n")
    if seed == 2:
        raise ArithmeticError("a replicate fails")
    return {"returns": [float(seed**2)] * 4, "lengths": [50] * 4, "seconds_per_step": 0.01}


def replicates(n: int, log: Path) -> list[Replicate]:
    return [Replicate("method", seed, partial(squared, seed, log)) for seed in range(n)]


def test_finished_replicates_are_stored_and_not_run_again(tmp_path: Path) -> None:
    log = tmp_path / "log"
    run_replicates(replicates(2, log), tmp_path / "out", jobs=1)
    run_replicates(replicates(2, log), tmp_path / "out", jobs=1)
    assert log.read_text().split() == ["0", "1"]
    results = load_results(tmp_path / "out")
    assert [result["seed"] for result in results] == [0, 1]
    assert {"command", "commit", "versions", "wall_seconds", "method"} <= results[0].keys()


def test_failing_replicate_ends_no_other(tmp_path: Path) -> None:
    """It is named, and raises when all others are stored."""
    with pytest.raises(ReplicateError, match=r"method, seed 2: (.|\n)*ArithmeticError: a replicate fails"):
        run_replicates(replicates(4, tmp_path / "log"), tmp_path / "out", jobs=1)
    assert [result["seed"] for result in load_results(tmp_path / "out")] == [0, 1, 3]
    assert not list((tmp_path / "out").glob("*.partial"))


def test_fleet_is_stored_by_replicate_and_runs_as_a_whole(tmp_path: Path) -> None:
    runs = []

    def results(seeds: tuple[int, ...]) -> list[dict[str, Any]]:
        runs.append(seeds)
        return [{"value": 10 * seed} for seed in seeds]

    fleet, more = (Fleet("method", seeds, partial(results, seeds)) for seeds in ((0, 3), (0, 3, 5)))
    assert not is_stored(fleet, tmp_path)
    for some in (fleet, fleet, more):
        run_replicates([some], tmp_path, jobs=1)
        assert is_stored(some, tmp_path)
    assert runs == [(0, 3), (0, 3, 5)]
    stored = load_results(tmp_path)
    assert [(result["seed"], result["value"], result["fleet"]) for result in stored] == [
        (0, 0, 3),
        (3, 30, 3),
        (5, 50, 3),
    ]
    single = Replicate("method", 3, partial(squared, 3, tmp_path / "log"))
    run_replicates([single], tmp_path, jobs=1)
    assert is_stored(single, tmp_path)
    assert not (tmp_path / "log").exists()


def test_fleet_that_forgets_a_replicate_is_not_stored(tmp_path: Path) -> None:
    with pytest.raises(ReplicateError, match="shorter"):
        run_replicates([Fleet("method", (0, 1), lambda: [{"value": 0}])], tmp_path, jobs=1)
    assert not list(tmp_path.iterdir())


# --- where work runs ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_number_of_processes_does_not_matter() -> None:
    digests = []
    for jobs in (1, 2):
        agent = FAMLE("reacher", seed=0, device="cpu", transitions_per_situation=5)
        with parallel("loky"):
            digests.append(agent.collect(n_jobs=jobs).digest())
        agent.get_env().close()
    assert digests[0] == digests[1]


@pytest.mark.parametrize("backend", ["loky", "sequential"])
def test_all_results_come(backend: str) -> None:
    with parallel_config(backend):
        calls = (delayed(abs)(-i) for i in range(5))
        assert sorted(as_completed(calls, n_jobs=1)) == [0, 1, 2, 3, 4]
        assert list(as_completed([], n_jobs=1)) == []


@pytest.mark.parametrize("missing", ["ray", "ray.util.joblib"])
def test_missing_ray_is_named_with_its_remedy(missing: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, missing, None)  # as if it were not installed
    with pytest.raises(ImportError, match=r'pip install "famle\[ray\]"'), parallel("ray"):
        pass
    with pytest.raises(ImportError, match="Ray is not installed"):
        run_replicates(replicates(1, tmp_path / "log"), tmp_path / "out", jobs=1, backend="ray")
    assert not (tmp_path / "log").exists()


def test_unknown_backend_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match="loky, ray"), parallel("dask"):  # type: ignore[arg-type]
        pass


def test_stored_results_need_no_cluster(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    run_replicates([], tmp_path, jobs=1, backend="ray")


# --- reports ------------------------------------------------------------------------------------------------


def test_missing_results_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="holds no results"):
        load_results(tmp_path)


@pytest.mark.parametrize(
    ("returns", "solved", "crossed"),
    [
        ([10, 31, 31, 31], 100, 100),
        ([31, 10, 31, 31, 31], 150, 50),
        ([31, 31, 30], None, 50),
        ([1, 2, 3], None, None),
    ],
)
def test_solved_needs_three_episodes_in_a_row(returns: list[float], solved: int | None, crossed: int | None) -> None:
    lengths = [50] * len(returns)
    assert solved_at(returns, lengths, 30.0) == solved
    assert first_crossing(returns, lengths, 30.0) == crossed


def test_interquartile_mean_ignores_outliers_and_lies_in_its_interval() -> None:
    mean, interval = interquartile_mean([1.0, 10.0, 10.0, 11.0, 12.0, 1000.0, 9.0, 10.0])
    assert interval is not None
    assert interval[0] <= mean <= interval[1]
    assert mean == 10.25
    assert interquartile_mean([3.0] * 5) == (3.0, (3.0, 3.0))


def test_test_damages_are_unseen_and_differ_between_replicates() -> None:
    drawn = [reacher.situation_of("random", seed) for seed in range(20)]
    assert not set(drawn) & set(ReacherEnv.training_situations)
    assert len(set(drawn)) == 20
    assert reacher.situation_of("paper", 0) == reacher.situation_of("paper", 1)


@pytest.mark.slow
def test_reacher_benchmark_runs_every_fast_method_and_reports(
    tmp_path: Path, agent: FAMLE, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = tmp_path / "cache"
    agent.save(cache / "reacher-ours-0.zip")
    methods = ("famle", "famle-frozen", "famle-select", "ppo")
    args = reacher.Args(
        methods=methods, replicates=1, steps=150, ppo_steps=200, jobs=1, out=tmp_path / "results", cache=cache
    )
    reacher.main(args)
    table = capsys.readouterr().out
    assert all(look(method).label in table for method in methods)
    stored = {path.name: json.loads(path.read_text()) for path in (tmp_path / "results").glob("*/*.json")}
    assert stored.keys() == {f"{method}-0.json" for method in methods}
    assert len(stored["famle-0.json"]["returns"]) == 3
    assert stored["famle-0.json"]["returns"] != stored["famle-frozen-0.json"]["returns"]


def test_unknown_method_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="famle-frozen"):
        reacher.main(reacher.Args(methods=("magic",), out=tmp_path))


def test_turned_transition_crosses_the_wrap_and_stays_true(transitions: Transitions) -> None:
    turned = across_the_wrap(transitions, 3)
    before, after = turned.obs[:, 3, 0], turned.next_obs[:, 3, 0]
    moved = np.abs(transitions.next_obs[:, 3, 0] - transitions.obs[:, 3, 0]) > 1e-3
    assert moved.any()
    np.testing.assert_array_less(5.0, np.abs(after - before)[moved])
    # The tip keeps its distance from the base, and the link angles are its polar angle's.
    for values, original in ((turned.obs, transitions.obs), (turned.next_obs, transitions.next_obs)):
        np.testing.assert_allclose(
            np.linalg.norm(values[:, 3, 10:], axis=-1), np.linalg.norm(original[:, 3, 10:], axis=-1), atol=1e-5
        )
        links = np.cumsum(values[:, 3, :5], axis=-1)
        tip = 0.3 * np.stack([np.cos(links).sum(-1), np.sin(links).sum(-1)], axis=-1)
        np.testing.assert_allclose(values[:, 3, 10:], tip, atol=1e-4)


def test_identification_counts_right_answers(agent: FAMLE, transitions: Transitions) -> None:
    assert agent.dynamics is not None
    right = accuracy(agent.dynamics, transitions, size=50, windows=2, wrap=False)
    swapped = replace(transitions, obs=transitions.obs[::-1].copy(), next_obs=transitions.next_obs[::-1].copy())
    assert accuracy(agent.dynamics, swapped, size=50, windows=2, wrap=False) < 0.5 < right <= 1.0


@pytest.mark.parametrize("out", [["--out", "/somewhere/else"], ["--out=/somewhere/else"], []])
def test_command_of_a_result_names_no_path_of_a_machine(out: list[str]) -> None:
    argv = ["/a/machine/benchmarks/reacher.py", "--jobs", "1", *out, "--methods", "ppo"]
    assert provenance(argv)["command"] == "python -m benchmarks.reacher --jobs 1 --methods ppo"
