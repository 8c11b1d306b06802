from __future__ import annotations

import sys

import pytest
from joblib import delayed, parallel_config

from famle_agent import FAMLE
from famle_agent.utils.parallel import as_completed, parallel


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
def test_missing_ray_is_named_with_its_remedy(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)  # as if it were not installed
    with pytest.raises(ImportError, match=r'pip install "famle\[ray\]"'), parallel("ray"):
        pass


def test_unknown_backend_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match="loky, ray"), parallel("dask"):  # type: ignore[arg-type]
        pass
