"""Deprecated name of :mod:`famle_agent.utils.parallel`."""

import warnings

from famle_agent.utils.parallel import Backend, as_completed, parallel

__all__ = ["Backend", "as_completed", "parallel"]

warnings.warn(
    "famle_agent.cluster is famle_agent.utils.parallel now; the old name goes with the next version.",
    DeprecationWarning,
    stacklevel=2,
)
