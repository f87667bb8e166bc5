"""Frames of primaries that are driven apart: a backend for each, side by side, and one picture of three codes a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hilstar.arrays import Float32Array
from hilstar.monitor.response import Levels
from hilstar.render.backend import Backend, ScreenView, Target
from hilstar.scene.sprites import Sprites


class PrimariesBackend(Backend):
    """Draws each primary of a Target by its own backend; all of them have one context, or none."""

    def __init__(self, target: Target, drawn_by: Sequence[Backend]) -> None:
        first = drawn_by[0]
        self.target, self._each = target, tuple(drawn_by)
        self.context, self.gl_renderer, self.gl_version, self.path = (
            first.context,
            first.gl_renderer,
            first.gl_version,
            first.path,
        )
        self._planes: np.ndarray[Any, np.dtype[np.unsignedinteger[Any]]] | None = None

    def draw(self, sprites: Sprites | None, frame: int = 0) -> None:
        """See `Backend.draw`."""
        for one, light in zip(self._each, (None,) * len(self._each) if sprites is None else sprites.primaries, strict=True):
            one.draw(light, frame)

    def draw_linear(self, sprites: Sprites) -> None:
        """See `Backend.draw_linear`."""
        self._each[0].draw_linear(sprites)

    def linear(self) -> Float32Array:
        """The image of the last `draw_linear`."""
        return self._each[0].linear()

    def levels(self) -> Levels:
        """See `Backend.levels`."""
        planes = self._planes
        for k, one in enumerate(self._each):
            levels = one.levels()
            if planes is None or planes.dtype != levels.dtype:
                planes = self._planes = np.empty((len(self._each), *levels.shape), levels.dtype)
            np.copyto(planes[k], levels)
        if planes is None:
            raise AssertionError("a target has primaries")
        return Levels(np.moveaxis(planes, 0, -1))

    def show_on(self, view: ScreenView, beside: Sequence[Backend] = ()) -> None:
        """See `Backend.show_on`."""
        self._each[0].show_on(view, self._each[1:])

    def present(self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)) -> None:
        """See `Backend.present`."""
        self._each[0].present(overlay, patch_code, marker)

    def take_back_buffer(self) -> None:
        """See `Backend.take_back_buffer`."""
        self._each[0].take_back_buffer()

    def changed_codes(self) -> str:
        """See `Backend.changed_codes`."""
        return self._each[0].changed_codes()

    def fault(self) -> str:
        """See `Backend.fault`."""
        return self._each[0].fault()

    def remember_tables(self) -> None:
        """See `Backend.remember_tables`."""
        for one in self._each:
            one.remember_tables()

    def changed_tables(self) -> int:
        """See `Backend.changed_tables`."""
        return sum(one.changed_tables() for one in self._each)

    def forget_images(self) -> None:
        """See `Backend.forget_images`."""
        for one in self._each:
            one.forget_images()

    def begin_anew(self) -> None:
        """See `Backend.begin_anew`."""
        for one in self._each:
            one.begin_anew()

    def finish(self) -> None:
        """See `Backend.finish`."""
        self._each[0].finish()

    def close(self) -> None:
        """Free the GL context and everything in it."""
        self._each[0].close()
