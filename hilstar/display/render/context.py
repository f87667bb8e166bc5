"""Headless OpenGL contexts through EGL, on which GPU, and what they can draw."""

import contextlib
import ctypes
import math
import mmap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt
from glcontext import egl

from hilstar.basics.errors import InputError, MachineError, NotThereError, did_you_mean
from hilstar.basics.units import COMPUTE_VERSION, GL_VERSIONS
from hilstar.display.egl import EGL_LIBRARY
from hilstar.display.render.way import wanted_way

INSTALL_EGL = "install it: apt-get install libegl1 libgl1-mesa-dri"
Context = moderngl.Context
# parts of a GL_RENDERER; zink names the Vulkan that it draws by, "zink Vulkan 1.3(llvmpipe ...)"
SOFTWARE = ("llvmpipe", "softpipe", "lavapipe")
MAX_WRITTEN_BYTES = 2**27  # what llvmpipe's shaders write of a buffer at most
MAX_GPUS = 32
PINNED_MEMORY = "GL_AMD_pinned_memory"
# constants of that extension and of OpenGL
EXTERNAL_VIRTUAL_MEMORY_BUFFER, DYNAMIC_COPY = 0x9160, 0x88EA


@dataclass(frozen=True, slots=True)
class Gpu:
    """A device of EGL's list: its index, and its GL_RENDERER ("" where no context can be made on
    it).
    """

    index: int
    renderer: str

    def line(self) -> str:
        """The GPU for a person."""
        return f"{self.index}: {self.renderer or 'opens no OpenGL 3.3'}"


def gpus() -> list[Gpu]:
    """EGL's devices in its order, a context made on each; none where EGL has no list of them."""
    listed = []
    for index in range(_device_count()):
        renderer = ""
        with contextlib.suppress(MachineError):
            ctx = _context_on(index)
            renderer = str(ctx.info["GL_RENDERER"])
            ctx.release()
        listed.append(Gpu(index, renderer))
    return listed


def _device_count() -> int:
    """How many devices EGL lists (EGL_EXT_device_enumeration)."""
    device_count = ctypes.c_int()
    with contextlib.suppress(OSError, AttributeError):
        find = ctypes.CDLL(EGL_LIBRARY).eglGetProcAddress
        find.restype = ctypes.c_void_p
        find.argtypes = [ctypes.c_char_p]
        if address := find(b"eglQueryDevicesEXT"):
            devices = (ctypes.c_void_p * MAX_GPUS)()
            query = ctypes.CFUNCTYPE(
                ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int)
            )(address)
            query(MAX_GPUS, devices, ctypes.byref(device_count))
    return device_count.value


def create_context(gpu: int | str | None = None) -> moderngl.Context:
    """A headless core context of the newest OpenGL, 3.3 at least. Raises MachineError with what to
    install.

    `gpu` is an index of EGL's list or a part of a GL_RENDERER (NotThereError where there is no such
    one), by default EGL's first. Every GL function comes through libEGL's own loader: a bare
    machine has no libGL.so.
    """
    if gpu is None or (isinstance(gpu, int) and gpu < _device_count()):
        return _context_on(gpu)
    listed = gpus()
    for candidate in listed:
        if isinstance(gpu, str) and gpu.lower() in candidate.renderer.lower():
            return _context_on(candidate.index)
    known = "; ".join(candidate.line() for candidate in listed) or "none: EGL lists no devices"
    meant = did_you_mean(gpu, (candidate.renderer for candidate in listed))
    raise NotThereError(
        f"[render] gpu = {gpu!r}: no such GPU; {meant}write the index or name of one of {known}"
    )


def _context_on(index: int | None) -> moderngl.Context:
    settings: Any = {"libgl": EGL_LIBRARY, "libegl": EGL_LIBRARY}
    refusal = ""
    for major, minor in GL_VERSIONS:
        version = 100 * major + 10 * minor
        try:
            if index is None:
                return moderngl.create_context(
                    require=version, standalone=True, **settings | {"backend": "egl"}
                )
            # moderngl's own way to an index gives way to a variable of the environment.
            on_device = egl.create_context(
                glversion=version, mode="standalone", device_index=index, **settings
            )
            return moderngl.create_context(require=version, standalone=True, context=on_device)
        except Exception as error:  # moderngl and glcontext raise plain Exceptions here
            refusal = str(error)
    raise MachineError(f"OpenGL 3.3 through EGL is missing ({refusal}); {INSTALL_EGL}")


def described() -> str:
    """The headless OpenGL of this machine for a person: who draws, and how. Raises MachineError
    with what to install.
    """
    ctx = create_context()
    try:
        info = ctx.info
        what = (
            f"{info['GL_RENDERER']}, OpenGL {info['GL_VERSION']}, points up to"
            f" {info['GL_POINT_SIZE_RANGE'][1]:g} px"
        )
        if ctx.version_code >= COMPUTE_VERSION:
            exact = "compute shaders"
        else:
            exact = "NumPy (slow: their shaders need OpenGL 4.3)"
        stars = "CPU" if draws_by_cpu(str(info["GL_RENDERER"])) else "points"
        return f"{what}; round by {stars}, exact and temporal by {exact}"
    finally:
        ctx.release()


def check_limits(
    info: Mapping[str, Any], resolution_px: tuple[int, int], footprint_px: int, sigma: str
) -> None:
    """Raise InputError where a GL with such a context's `info` cannot draw such an image, or points
    as large as its sprites; those are by `sigma`.
    """
    largest = (
        int(min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"])) - 2 * footprint_px
    )
    if max(resolution_px) > largest:
        raise InputError(
            f"resolution_px = {list(resolution_px)}: this GL draws at most {largest} px"
        )
    points = info["GL_POINT_SIZE_RANGE"][1]
    if footprint_px > points:
        raise InputError(
            f"{sigma}: needs sprites of {footprint_px} px; this GL draws at most {points:g} px"
        )


def draws_by_cpu(renderer: str) -> bool:
    """Whether stars are drawn by `cpu_stars` beside the GL of a renderer: HILSTAR_DRAW, else where
    that is a processor, too.
    """
    wanted = wanted_way()
    if wanted is None:
        return is_processor(renderer)
    return wanted == "cpu"


def shares_memory(ctx: moderngl.Context) -> bool:
    """Whether this GL's compute shaders read and write the process's own memory."""
    return (
        bool(ctx.version_code >= COMPUTE_VERSION)
        and is_software(ctx)
        and PINNED_MEMORY in ctx.extensions
    )


def is_software(ctx: moderngl.Context) -> bool:
    """Whether a processor draws, and no graphics card."""
    return is_processor(str(ctx.info["GL_RENDERER"]))


def is_processor(renderer: str) -> bool:
    """Whether GL_RENDERER names a processor, and no graphics card."""
    return any(name in renderer for name in SOFTWARE)


def pinned(
    ctx: moderngl.Context, shape: tuple[int, ...], dtype: npt.DTypeLike
) -> tuple[npt.NDArray[Any], moderngl.Buffer]:
    """A black array in whole pages, which it keeps for as long as somebody holds it, and a
    buffer of the same memory.
    """
    # whole words, too
    count = math.prod(shape)
    size = -(-math.prod(shape) * np.dtype(dtype).itemsize // 4) * 4
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    values = np.frombuffer(pages, dtype, count).reshape(shape)
    find = ctypes.CDLL(EGL_LIBRARY).eglGetProcAddress
    find.restype = ctypes.c_void_p
    find.argtypes = [ctypes.c_char_p]
    bind = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_uint)(find(b"glBindBuffer"))
    specify = ctypes.CFUNCTYPE(
        None, ctypes.c_uint, ctypes.c_ssize_t, ctypes.c_void_p, ctypes.c_uint
    )(find(b"glBufferData"))
    buffer = ctx.buffer(reserve=size)
    bind(EXTERNAL_VIRTUAL_MEMORY_BUFFER, buffer.glo)
    specify(EXTERNAL_VIRTUAL_MEMORY_BUFFER, size, values.ctypes.data, DYNAMIC_COPY)
    bind(EXTERNAL_VIRTUAL_MEMORY_BUFFER, 0)
    return values, buffer
