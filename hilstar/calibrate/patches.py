"""Patches of a plan: as pictures in a directory, or on a display one after the other."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hilstar.bench.frame_files import write_codes_png
from hilstar.calibrate.measurements import PRIMARIES
from hilstar.calibrate.plan import Patch
from hilstar.errors import InputError, MachineError
from hilstar.files import make_directory
from hilstar.monitor.response import code_dtype
from hilstar.render.presenter import Presenter, View, level_texture, window_context

if TYPE_CHECKING:
    from hilstar.monitor.window.window import Window

KEY_POLL_S = 0.02
PATCH_SHARE = 1 / 3  # of the screen's smaller side
log = logging.getLogger(__name__)


def patch_image(patch: Patch, resolution_px: tuple[int, int], bits: int) -> npt.NDArray[np.uint8 | np.uint16]:
    """A square patch in the middle of a black screen: (height, width) for w, (height, width, 3) for one primary."""
    width, height = resolution_px
    side = max(1, round(min(width, height) * PATCH_SHARE))
    top, left = (height - side) // 2, (width - side) // 2
    grey = np.zeros((height, width), dtype=code_dtype(bits))
    grey[top : top + side, left : left + side] = patch.code
    if patch.channel == "w":
        return grey
    image = np.zeros((height, width, 3), dtype=grey.dtype)
    image[..., PRIMARIES.index(patch.channel)] = grey
    return image


def write_patches(folder: Path, planned: Sequence[Patch], resolution_px: tuple[int, int], bits: int) -> None:
    """Write a PNG of `resolution_px` (width, height) for each different patch. Raises InputError where that cannot be done."""
    make_directory(folder)
    patches = sorted(set(planned))
    if bits > 8 and any(patch.channel != "w" for patch in patches):
        raise InputError(
            "patches of r, g or b are written as PNG for up to 8 bits; leave the directory out, and show the codes of the plan"
        )
    for patch in patches:
        path = folder / f"{patch.channel}-{patch.code:05d}.png"
        write_codes_png(path, patch_image(patch, resolution_px, bits), bits)


def show_patches(planned: Sequence[Patch], bits: int, display: int | str, seconds: float | None) -> int:
    """Show each patch on a display until space is pressed, or for `seconds`; q quits. Returns how many were shown.

    Raises MachineError without a display or where that goes away, InputError for one that is not there.
    """
    from hilstar.monitor.window.window import Window, WindowSettings

    with Window(WindowSettings((640, 480), bits, display)) as window:
        size_px = window.size_px
        square = (patch_image(Patch(1, "w"), size_px, 8) > 0).astype(np.uint8)
        nothing = np.zeros((2, 3), dtype=np.uint16)
        view = View(size_px, size_px, bits, triples=nothing)
        presenter = Presenter(level_texture(window_context(), square), view)
        for shown, patch in enumerate(planned):
            triples = nothing.copy()
            triples[1, [PRIMARIES.index(patch.channel)] if patch.channel in PRIMARIES else [0, 1, 2]] = patch.code
            presenter.set_triples(triples)
            log.warning("patch %d of %d: code %d, channel %s", shown + 1, len(planned), patch.code, patch.channel)
            if not stays_until_key(window, presenter, seconds):
                return shown
    return len(planned)


def stays_until_key(window: Window, presenter: Presenter, seconds: float | None) -> bool:
    """Present until space is pressed, or for `seconds`; False for q. Raises MachineError where the display goes away."""
    end_s = math.inf if seconds is None else time.monotonic() + seconds
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
