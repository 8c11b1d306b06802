"""Pictures of a MuJoCo model without a window."""

from __future__ import annotations

import atexit
import os
import sys
import weakref
from contextlib import suppress
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from famle_envs.engines.mujoco_model import SEEN
from famle_envs.engines.world import PICTURE_SIZE, Camera

__all__ = ["Pictures"]


class Pictures:
    """Renders a model.

    Args:
        model: The ``mujoco.MjModel``.

    Raises:
        RuntimeError: There is no OpenGL.
    """

    def __init__(self, model: Any) -> None:
        try:
            self._context = _gl_context()(PICTURE_SIZE, PICTURE_SIZE)
            self._context.make_current()
            self._renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # each platform library has exceptions of its own
            raise RuntimeError(
                "MuJoCo found no OpenGL to render with. Without a screen it needs EGL (package libegl1 on Debian) or "
                "OSMesa (libosmesa6, and MUJOCO_GL=osmesa in the environment); or use engine='pybullet'."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._renderer)
        # MuJoCo before version 4 ends EGL with the process, and then complains of contexts that are left.
        atexit.register(_close, weakref.ref(self))
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[SEEN] = 1

    def take(self, model: Any, data: Any, camera: Camera) -> npt.NDArray[np.uint8]:
        """Returns a picture of the model in the state of its data, (PICTURE_SIZE, PICTURE_SIZE, 3)."""
        self._context.make_current()
        view = mujoco.MjvCamera()
        view.lookat[:], view.distance = camera.target, camera.distance
        view.azimuth, view.elevation = camera.yaw + 90.0, camera.pitch
        mujoco.mjv_updateScene(model, data, self._options, None, view, mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        pixels = np.empty((PICTURE_SIZE, PICTURE_SIZE, 3), dtype=np.uint8)
        rect = mujoco.MjrRect(0, 0, PICTURE_SIZE, PICTURE_SIZE)
        mujoco.mjr_render(rect, self._scene, self._renderer)
        mujoco.mjr_readPixels(pixels, None, rect, self._renderer)
        return np.flipud(pixels).copy()

    def close(self) -> None:
        """Frees what OpenGL holds."""
        if self._context is not None:
            self._context.make_current()
            self._renderer.free()
            self._context.free()
            self._context = None


def _close(pictures: weakref.ref[Pictures]) -> None:
    if (left := pictures()) is not None:
        left.close()


def _gl_context() -> Any:
    """MuJoCo's own choice, which is a window of the screen; EGL where there is none."""
    # Torch for CUDA imports Triton when it first optimises. Triton and OpenGL without a graphics card both bring an
    # LLVM, and the process crashes where OpenGL's is the first.
    with suppress(ImportError):
        import_module("triton")
    on_a_screen = {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"} & set(os.environ)
    if sys.platform == "linux" and not on_a_screen:
        from mujoco.egl import GLContext

        return GLContext
    return mujoco.GLContext
