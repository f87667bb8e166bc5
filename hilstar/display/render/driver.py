"""Calls to the GL driver that moderngl lacks, through ctypes: waiting with Python's lock free, and
whether the GPU is well.

moderngl keeps Python's lock in every call. That is right for calls that only queue work; where a
call waits for the GPU or for a back buffer, every other thread of the process would wait too.
"""

import ctypes
import os
from collections.abc import Callable
from typing import Any

import moderngl

from hilstar.basics.errors import GpuError
from hilstar.basics.units import NS_PER_S

# NVIDIA's driver yields in a loop while it waits, which at real-time priority keeps a core busy
# ("OpenGL Environment Variable Settings" of its README). Who has set it otherwise keeps that.
YIELDING, SLEEPING = "__GL_YIELD", "USLEEP"
GL_SYNC_GPU_COMMANDS_COMPLETE, GL_SYNC_FLUSH_COMMANDS_BIT = 0x9117, 0x0001
GL_TIMEOUT_EXPIRED, GL_WAIT_FAILED = 0x911B, 0x911D
GL_COLOR, GL_SCISSOR_TEST = 0x1800, 0x0C11
SLICE_NS = NS_PER_S // 10  # after which a signal is looked at
MAX_SLICES = 100
MAX_ERRORS = 16  # a lost context may give errors without end
ERRORS = {
    0x0500: "GL_INVALID_ENUM",
    0x0501: "GL_INVALID_VALUE",
    0x0502: "GL_INVALID_OPERATION",
    0x0505: "GL_OUT_OF_MEMORY",
    0x0506: "GL_INVALID_FRAMEBUFFER_OPERATION",
    0x0507: "GL_CONTEXT_LOST",
}
RESETS = {
    0x8253: "this program's work reset it",
    0x8254: "another program's work reset it",
    0x8255: "it was reset for an unknown reason",
    0x92BB: "its memory was purged",  # GL_PURGED_CONTEXT_RESET_NV
}
RESET_STATUS = {
    "GL_KHR_robustness": "glGetGraphicsResetStatus",
    "GL_ARB_robustness": "glGetGraphicsResetStatusARB",
}
RESET_STATUS_VERSION = 450  # the OpenGL that has glGetGraphicsResetStatus


def sleep_in_waits() -> None:
    """Have NVIDIA's driver sleep while it waits; call it before the first context."""
    os.environ.setdefault(YIELDING, SLEEPING)


class Driver:
    """The driver of a moderngl context, which is current in every call. moderngl keeps the
    functions' addresses to itself.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        # Private, for moderngl has no public way to its loader (looked at in 5.13.0): a loader
        # of our own would have to know GLX, EGL and WGL, and which of them made this context.
        load: Callable[[str], int] = ctx.mglo._context.load_opengl_function
        # PYFUNCTYPE keeps Python's lock, for calls that only queue work or ask; CFUNCTYPE frees it.
        self._fence = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint)(
            load("glFenceSync")
        )
        self._delete = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(load("glDeleteSync"))
        wait = (ctypes.c_uint, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint64)
        self._ask = ctypes.PYFUNCTYPE(*wait)(load("glClientWaitSync"))
        self._wait = ctypes.CFUNCTYPE(*wait)(load("glClientWaitSync"))
        self._error = ctypes.PYFUNCTYPE(ctypes.c_uint)(load("glGetError"))
        self._enable, self._disable = (
            ctypes.PYFUNCTYPE(None, ctypes.c_uint)(load(f"gl{what}able")) for what in ("En", "Dis")
        )
        self._scissor = ctypes.PYFUNCTYPE(None, *[ctypes.c_int] * 4)(load("glScissor"))
        self._clear = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)(
            load("glClearBufferfv")
        )
        self._black = (ctypes.c_float * 4)()
        name = "glGetGraphicsResetStatus"
        if ctx.version_code < RESET_STATUS_VERSION:
            name = next(
                (
                    function
                    for extension, function in RESET_STATUS.items()
                    if extension in ctx.extensions
                ),
                "",
            )
        address = load(name) if name else 0
        self._reset: Any = ctypes.PYFUNCTYPE(ctypes.c_uint)(address) if address else None

    def wait(self) -> None:
        """Wait until the GPU has done all that was asked of it. Raises GpuError where it does
        not within 10 s.
        """
        fence = self._fence(GL_SYNC_GPU_COMMANDS_COMPLETE, 0)
        try:
            result = self._ask(fence, GL_SYNC_FLUSH_COMMANDS_BIT, 0)
            for _ in range(MAX_SLICES):
                if result != GL_TIMEOUT_EXPIRED:
                    break
                result = self._wait(fence, 0, SLICE_NS)
        finally:
            self._delete(fence)
        if result == GL_TIMEOUT_EXPIRED:
            self.check()
            raise GpuError(
                f"the GPU has not finished a frame for {MAX_SLICES * SLICE_NS // NS_PER_S} s; see"
                " dmesg"
            )
        if result == GL_WAIT_FAILED:
            self.check()
            raise GpuError("the GPU's driver cannot wait for it; see dmesg")

    def take_back_buffer(self) -> None:
        """Wait for a back buffer of the window that is bound, by clearing a pixel: no clear by
        moderngl frees the lock.
        """
        self._scissor(0, 0, 1, 1)
        self._enable(GL_SCISSOR_TEST)
        self._clear(GL_COLOR, 0, self._black)
        self._disable(GL_SCISSOR_TEST)

    def fault(self) -> str:
        """A reset of the GPU or GL errors since the last call; "" where all is well."""
        status = 0 if self._reset is None else self._reset()
        if status:
            return f"the GPU is lost: {RESETS.get(status, f'reset status {status:#x}')}"
        errors: list[str] = []
        while len(errors) < MAX_ERRORS and (error := self._error()):
            errors.append(ERRORS.get(error, f"{error:#x}"))
        if errors:
            return f"the GL driver reports {', '.join(dict.fromkeys(errors))}"
        return ""

    def check(self) -> None:
        """Raise GpuError where the GPU is not well."""
        if fault := self.fault():
            raise GpuError(f"{fault}; begin the run again, and see dmesg where it happens again")
