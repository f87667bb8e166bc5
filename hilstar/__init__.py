"""hilstar: the stars that a star tracker would see, on a monitor, with the flux that it would
collect.
"""

from typing import TYPE_CHECKING, Any

from hilstar.basics.version import __version__ as __version__

if TYPE_CHECKING:
    from hilstar.basics.errors import HilstarError, InputError, MachineError
    from hilstar.server.bench.build import load
    from hilstar.server.bench.drawn import Drawn
    from hilstar.server.bench.frame import Bench, Frame
    from hilstar.server.sender import Sender

__all__ = [
    "Bench",
    "Drawn",
    "Frame",
    "HilstarError",
    "InputError",
    "MachineError",
    "Sender",
    "load",
]


def __getattr__(name: str) -> Any:
    """The public names, imported at their first use: `hilstar doctor` needs no renderer to
    start.
    """
    if name not in __all__:
        raise AttributeError(f"module 'hilstar' has no attribute {name!r}")
    from hilstar.basics import errors

    if hasattr(errors, name):
        return getattr(errors, name)
    if name == "Sender":  # a simulator draws nothing
        from hilstar.server.sender import Sender

        return Sender
    from hilstar.server.bench import build, frame

    return getattr(build if name == "load" else frame, name)
