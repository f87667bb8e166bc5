"""Which way of drawing stars HILSTAR_DRAW wants, and the library that OpenGL without a window
needs. Nothing here imports moderngl.
"""

import contextlib
import ctypes
import os
from typing import Literal

from hilstar.basics.errors import InputError

EGL_LIBRARY = "libEGL.so.1"
WAY_VARIABLE = "HILSTAR_DRAW"
Way = Literal["gl", "cpu"]
WAYS: tuple[Way, ...] = ("gl", "cpu")


def wanted_way() -> Way | None:
    """The way of drawing stars that HILSTAR_DRAW wants, None for the machine's own. InputError for
    another word.
    """
    wanted = os.environ.get(WAY_VARIABLE, "")
    if not wanted:
        return None
    for way in WAYS:
        if wanted == way:
            return way
    raise InputError(f"{WAY_VARIABLE}={wanted}: no way to draw stars; write {' or '.join(WAYS)}")


def leave_contexts() -> None:
    """Let this thread's headless context go: it stays current after its release, and a window's
    GLX then ends the process.
    """
    with contextlib.suppress(OSError, AttributeError):  # a machine without EGL has no such context
        ctypes.CDLL(EGL_LIBRARY).eglReleaseThread()
