"""EGL, the library of OpenGL without a window: its name, and how a thread's contexts end. Nothing
here imports moderngl.
"""

import contextlib
import ctypes

EGL_LIBRARY = "libEGL.so.1"


def leave_contexts() -> None:
    """Let this thread's headless context go: it stays current after its release, and a window's
    GLX then ends the process.
    """
    with contextlib.suppress(OSError, AttributeError):  # a machine without EGL has no such context
        ctypes.CDLL(EGL_LIBRARY).eglReleaseThread()
