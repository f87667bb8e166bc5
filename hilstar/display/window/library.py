"""glfw, with the library that its own package brings.

Its own search begins a Python process that loads each library and says its version: 30 ms of every
start-up, and where a signal ends the start-up meanwhile, that process prints its traceback.
"""

import os
from importlib.util import find_spec
from pathlib import Path

__all__ = ["glfw"]


def _own_library() -> Path | None:
    """The library for X11 of glfw's own package, whatever the session; None where the package
    has none.
    """
    spec = find_spec("glfw")
    if spec is None or spec.origin is None:
        return None
    library = Path(spec.origin).parent / "x11" / "libglfw.so"
    return library if library.is_file() else None


if not os.environ.get("PYGLFW_LIBRARY"):
    _library = _own_library()
    if _library is not None:
        os.environ["PYGLFW_LIBRARY"] = str(_library)

import glfw  # noqa: E402 - it looks at the environment when it is imported
