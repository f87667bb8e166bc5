"""hilstar: the stars that a star tracker would see, on a monitor, with the flux that it would
collect.

>>> import hilstar
>>> with hilstar.load("bench.toml") as bench:
...     frame = bench.frame([0.6987226, 0.7135120, -0.0370377, 0.0362700])
>>> print(len(frame.truth), "stars")
218 stars
"""

import sys
from typing import TYPE_CHECKING, Any

from hilstar.basics.version import __version__ as __version__

if TYPE_CHECKING:
    from hilstar import rotation, testing
    from hilstar.api import OpenBench as Bench
    from hilstar.api import SkyFrame as Frame
    from hilstar.api import assess, load
    from hilstar.basics.errors import HilstarError, InputError, MachineError
    from hilstar.instruments.compare import compare
    from hilstar.server.bench.drawn import Drawn
    from hilstar.server.sender import Sender

__all__ = [
    "Bench",
    "Drawn",
    "Frame",
    "HilstarError",
    "InputError",
    "MachineError",
    "Sender",
    "assess",
    "compare",
    "load",
    "rotation",
    "testing",
]


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def __getattr__(name: str) -> Any:
    """The public names, imported at their first use: `hilstar doctor` needs no renderer to
    start.
    """
    if name not in __all__:
        from hilstar.basics.errors import did_you_mean

        # private names are asked for by tools, which read no advice
        meant = "" if name.startswith("_") else did_you_mean(name, __all__).strip()
        raise AttributeError(
            f"module 'hilstar' has no attribute {name!r}{meant and '; '}{meant}",
            name=name,
            obj=sys.modules[__name__],
        )
    from importlib import import_module

    if name in {"rotation", "testing"}:
        return import_module(f"hilstar.{name}")
    from hilstar.basics import errors

    if hasattr(errors, name):
        return getattr(errors, name)
    if name == "Sender":  # a simulator draws nothing
        from hilstar.server.sender import Sender

        return Sender
    if name == "compare":
        from hilstar.instruments.compare import compare

        return compare
    from hilstar import api

    return getattr(api, {"Bench": "OpenBench", "Frame": "SkyFrame"}.get(name, name))
