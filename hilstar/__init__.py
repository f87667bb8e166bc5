"""hilstar: the stars that a star tracker would see, on a monitor, with the flux that it would collect."""

from hilstar.bench.assembly import Bench, Drawn, Frame, load
from hilstar.errors import HilstarError, InputError, MachineError

__version__ = "0.1.0"
__all__ = ["Bench", "Drawn", "Frame", "HilstarError", "InputError", "MachineError", "load"]
