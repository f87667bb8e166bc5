"""Headless OpenGL contexts through EGL, and what they can draw."""

from __future__ import annotations

import contextlib
import ctypes
from typing import Any

import moderngl

from hilstar.errors import InputError, MachineError
from hilstar.process.cores import drawing_threads_apart

EGL_LIBRARY = "libEGL.so.1"
INSTALL_EGL = "install it: apt-get install libegl1 libgl1-mesa-dri"
MIN_COMPUTE_VERSION = 430  # of OpenGL, for compute shaders
SOFTWARE = ("llvmpipe", "softpipe")
# Of llvmpipe: what its shaders write of a buffer, and rounds of all loops of a shader (65 535 end them without a word).
MAX_WRITTEN_BYTES, MAX_ROUNDS = 2**27, 60_000


def create_context() -> moderngl.Context:
    """A headless OpenGL 3.3 core context. Raises MachineError with what to install.

    Every GL function comes through libEGL's own loader: a bare machine has no libGL.so.
    """
    try:
        settings: Any = {"backend": "egl", "libgl": EGL_LIBRARY, "libegl": EGL_LIBRARY}
        with drawing_threads_apart():
            return moderngl.create_context(require=330, standalone=True, **settings)
    except Exception as error:  # moderngl and glcontext raise plain Exceptions here
        raise MachineError(f"OpenGL 3.3 through EGL is missing ({error}); {INSTALL_EGL}") from error


def check_limits(ctx: moderngl.Context, resolution_px: tuple[int, int], footprint_px: int, sigma: str) -> None:
    """Raise InputError where this GL cannot draw such an image, or points as large as its sprites; those are by `sigma`."""
    largest = int(min(ctx.info["GL_MAX_TEXTURE_SIZE"], *ctx.info["GL_MAX_VIEWPORT_DIMS"])) - 2 * footprint_px
    if max(resolution_px) > largest:
        raise InputError(f"resolution_px = {list(resolution_px)}: this GL draws at most {largest} px")
    points = ctx.info["GL_POINT_SIZE_RANGE"][1]
    if footprint_px > points:
        raise InputError(f"{sigma}: needs sprites of {footprint_px} px; this GL draws at most {points:g} px")


def computes_in_software(ctx: moderngl.Context) -> bool:
    """Whether this GL is a processor's and has compute shaders; a graphics card rasterises points in its stride."""
    return ctx.version_code >= MIN_COMPUTE_VERSION and str(ctx.info["GL_RENDERER"]).startswith(SOFTWARE)


def leave_contexts() -> None:
    """Let this thread's headless context go: it stays current after its release, and a window's GLX then ends the process."""
    with contextlib.suppress(OSError, AttributeError):  # a machine without EGL has no such context
        ctypes.CDLL(EGL_LIBRARY).eglReleaseThread()
