"""A pattern on the screen until a key is pressed or its time is over."""

import math
import time
from typing import TYPE_CHECKING

from hilstar.basics.errors import MachineError
from hilstar.display.render.presenter import Presenter

if TYPE_CHECKING:
    from hilstar.display.window.window import Window

KEY_POLL_S = 0.02


def stays_until_key(window: "Window", presenter: Presenter, seconds: float | None) -> bool:
    """Present until space is pressed or `seconds` are over; False if q was pressed. Raises
    MachineError without the display.
    """
    if seconds is None:
        end_s = math.inf
    else:
        end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        presenter.present()
        window.swap()
        window.look_at_events()
        while window.keys:
            key = window.keys.popleft()
            if key in {"q", "escape"}:
                return False
            if key == "space":
                return True
        if window.gone is not None:
            raise MachineError(window.gone)
        if window.closing:
            return False
        time.sleep(KEY_POLL_S)
    return True
