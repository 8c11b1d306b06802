"""Where parallel work runs: processes on this machine, or a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, Literal

from joblib import Parallel, effective_n_jobs, parallel_config
from joblib.parallel import get_active_backend

__all__ = ["Backend", "as_completed", "parallel"]

Backend = Literal["loky", "ray"]
"""Names of joblib backends."""


@contextmanager
def parallel(backend: Backend = "loky") -> Iterator[None]:
    """Sends the parallel work that is begun inside to a backend.

    Args:
        backend: ``"loky"`` for processes on this machine. ``"ray"`` for the Ray cluster that this process is connected
            to, else the one at the address in ``RAY_ADDRESS``, else one of this machine's cores, which ends with the
            work.

    Raises:
        ValueError: There is no such backend.
        ImportError: Ray is not installed.
        ConnectionError: There is no cluster at the address.

    Example:
        >>> from famle_agent import FAMLE
        >>> from famle_agent.utils.parallel import parallel
        >>> with parallel("loky"):
        ...     transitions = FAMLE("reacher", seed=0, transitions_per_situation=50).collect(n_jobs=2)
    """
    if backend == "loky":
        with parallel_config("loky"):
            yield
        return
    if backend != "ray":
        raise ValueError(f"There is no backend {backend!r}. Backends: loky, ray.")
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise ImportError('Ray is not installed; install it with: pip install "famle[ray]"') from error
    register_ray()  # type: ignore[no-untyped-call]
    connected = ray.is_initialized()
    if not connected:
        ray.init(address=os.environ.get("RAY_ADDRESS"), log_to_driver=False, configure_logging=False)
    try:
        with parallel_config("ray"):
            yield
    finally:
        if not connected:
            ray.shutdown()


def as_completed(calls: Iterable[Any], n_jobs: int) -> Iterator[Any]:
    """Runs calls in parallel and yields their results as they come.

    Args:
        calls: Made with ``joblib.delayed``.
        n_jobs: Calls that run at the same time, -1 for one a core of the machine or the cluster.
    """
    backend, _ = get_active_backend()
    if backend.supports_return_generator:
        yield from Parallel(n_jobs=n_jobs, return_as="generator_unordered")(calls)
        return
    # Ray gives no result before it has all of them, and so is given no more calls at a time than it has workers.
    waiting = iter(calls)
    with Parallel(n_jobs=n_jobs) as workers:
        while some := list(islice(waiting, effective_n_jobs(n_jobs))):
            yield from workers(some)
