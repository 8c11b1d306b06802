"""Deprecated name of :mod:`famle_envs.profile`."""

import warnings

from famle_envs.profile import SIMULATOR, Profile, resolve_profile

__all__ = ["SIMULATOR", "Profile", "resolve_profile"]

warnings.warn(
    "famle_envs.reality is famle_envs.profile now; the old name goes with the next version.",
    DeprecationWarning,
    stacklevel=2,
)
