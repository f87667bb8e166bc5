"""A solver that is a Python callable: `python:module:function`."""

from __future__ import annotations

import contextlib
import importlib
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hilstar.campaign.solvers.answer import Answer, SolverFault, Tracker, checked_attitude
from hilstar.errors import InputError, one_line
from hilstar.twin.simulator import Exposure

FORM = "write --solver python:MODULE:FUNCTION"


class FunctionSolver:
    """Calls `function(image, tracker)`: DN, uint16 (height, width), and what a tracker's software knows of its optics.

    It returns q_icrs_to_cam (w, x, y, z), or None where it finds none. `folder` is searched for the module first.
    Raises InputError where there is no such function.
    """

    def __init__(self, name: str, folder: Path, timeout_s: float) -> None:
        self.name, self._timeout_s = name, timeout_s
        module, _, function = name.removeprefix("python:").partition(":")
        if not module or not function:
            raise InputError(f"--solver {name}: names no function; {FORM}")
        with _importing_from(folder):
            try:
                found: Any = getattr(importlib.import_module(module), function, None)
            except Exception as error:
                reason = one_line(f"{type(error).__name__}: {error}")
                raise InputError(f"--solver {name}: {module} cannot be imported ({reason}); {FORM}") from error
        if not callable(found):
            raise InputError(f"--solver {name}: {module} has no function {function}; {FORM}")
        self._function: Callable[..., Any] = found

    def solve(self, exposure: Exposure, tracker: Tracker) -> Answer:
        """The function's answer. Raises SolverFault where it raises, takes too long or answers what is no attitude."""
        try:
            with time_limit(self._timeout_s):
                answer = self._function(exposure.dn.copy(), tracker_facts(tracker))
        except TimeoutError as error:
            raise SolverFault(f"the solver took longer than {self._timeout_s:g} s") from error
        except Exception as error:
            raise SolverFault(one_line(f"the solver raised {type(error).__name__}: {error}")) from error
        if answer is None:
            return Answer(None, "the solver found no attitude")
        return Answer(checked_attitude(answer, "the solver"))


def tracker_facts(tracker: Tracker) -> dict[str, Any]:
    """What a tracker's software knows of its own optics, and nothing of where it looks."""
    settings = tracker.config.tracker
    width, height = settings.resolution_px
    focal_length_px = settings.focal_length_mm * 1e3 / settings.pixel_pitch_um
    return {
        "resolution_px": (width, height),
        "focal_length_px": focal_length_px,
        "principal_point_px": settings.principal_point_px or ((width - 1) / 2, (height - 1) / 2),
        "fov_deg": math.degrees(2 * math.atan(width / 2 / focal_length_px)),
        "psf_sigma_px": settings.psf_sigma_px,
        "exposure_s": settings.exposure_s,
        "epoch_jyear": tracker.config.sky.epoch_jyear,
    }


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raises TimeoutError in the main thread after so long; in another thread nothing can be interrupted, and nothing is."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def too_long(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
