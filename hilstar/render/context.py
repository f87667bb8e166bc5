"""Headless OpenGL contexts through EGL, and what they can draw."""

from __future__ import annotations

import contextlib
import ctypes
from typing import Any

import moderngl

from hilstar.errors import InputError, MachineError
from hilstar.process.cores import drawing_threads_apart
from hilstar.units import GL_VERSIONS

EGL_LIBRARY = "libEGL.so.1"
INSTALL_EGL = "install it: apt-get install libegl1 libgl1-mesa-dri"
MIN_COMPUTE_VERSION = 430  # of OpenGL, for compute shaders
Context = moderngl.Context
SOFTWARE = ("llvmpipe", "softpipe")
# Of llvmpipe: what its shaders write of a buffer, and rounds of all loops of a shader (65 535 end them without a word).
MAX_WRITTEN_BYTES, MAX_ROUNDS = 2**27, 60_000


def create_context() -> moderngl.Context:
    """A headless core context of the newest OpenGL, 3.3 at least. Raises MachineError with what to install.

    Every GL function comes through libEGL's own loader: a bare machine has no libGL.so.
    """
    settings: Any = {"backend": "egl", "libgl": EGL_LIBRARY, "libegl": EGL_LIBRARY}
    refusal = ""
    with drawing_threads_apart():
        for major, minor in GL_VERSIONS:
            try:
                return moderngl.create_context(require=100 * major + 10 * minor, standalone=True, **settings)
            except Exception as error:  # moderngl and glcontext raise plain Exceptions here
                refusal = str(error)
    raise MachineError(f"OpenGL 3.3 through EGL is missing ({refusal}); {INSTALL_EGL}")


def check_limits(ctx: moderngl.Context, resolution_px: tuple[int, int], footprint_px: int, sigma: str) -> None:
    """Raise InputError where this GL cannot draw such an image, or points as large as its sprites; those are by `sigma`."""
    largest = int(min(ctx.info["GL_MAX_TEXTURE_SIZE"], *ctx.info["GL_MAX_VIEWPORT_DIMS"])) - 2 * footprint_px
    if max(resolution_px) > largest:
        raise InputError(f"resolution_px = {list(resolution_px)}: this GL draws at most {largest} px")
    points = ctx.info["GL_POINT_SIZE_RANGE"][1]
    if footprint_px > points:
        raise InputError(f"{sigma}: needs sprites of {footprint_px} px; this GL draws at most {points:g} px")


def has_compute(ctx: Context) -> bool:
    """Whether this GL has compute shaders (OpenGL 4.3); without them `exact` and `temporal` choose their levels in NumPy."""
    return bool(ctx.version_code >= MIN_COMPUTE_VERSION)


def computes_in_software(ctx: moderngl.Context) -> bool:
    """Whether this GL is a processor's and has compute shaders; a graphics card rasterises points in its stride."""
    return has_compute(ctx) and is_software(ctx)


def is_software(ctx: moderngl.Context) -> bool:
    """Whether a processor draws, and no graphics card."""
    return str(ctx.info["GL_RENDERER"]).startswith(SOFTWARE)


def leave_contexts() -> None:
    """Let this thread's headless context go: it stays current after its release, and a window's GLX then ends the process."""
    with contextlib.suppress(OSError, AttributeError):  # a machine without EGL has no such context
        ctypes.CDLL(EGL_LIBRARY).eglReleaseThread()
