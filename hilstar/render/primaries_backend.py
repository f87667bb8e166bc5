"""Frames of primaries that are driven apart: a backend for each, side by side, and one picture of three codes a pixel."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hilstar.monitor.response import Levels
from hilstar.render.backend import Backend, ScreenView, Target
from hilstar.scene.sprites import Sprites


def _by_first(name: str) -> Callable[..., Any]:
    return lambda self, *given, **named: getattr(self._each[0], name)(*given, **named)


def _by_all(name: str) -> Callable[..., Any]:
    return lambda self: [getattr(one, name)() for one in self._each]


class PrimariesBackend(Backend):
    """Draws each primary of a Target by its own backend; all of them have one context, or none. See `Backend`."""

    def __init__(self, target: Target, drawn_by: Sequence[Backend]) -> None:
        first = drawn_by[0]
        self.target, self._each = target, tuple(drawn_by)
        self.context, self.gl_renderer, self.gl_version, self.path = (
            first.context,
            first.gl_renderer,
            first.gl_version,
            first.path,
        )
        self._planes: np.ndarray[Any, np.dtype[np.unsignedinteger[Any]]] = np.empty((0, 0, 0), np.uint8)

    draw_linear, linear, finish, close = map(_by_first, ("draw_linear", "linear", "finish", "close"))
    present, take_back_buffer = map(_by_first, ("present", "take_back_buffer"))
    changed_codes, fault = map(_by_first, ("changed_codes", "fault"))
    remember_tables, forget_images, begin_anew = map(_by_all, ("remember_tables", "forget_images", "begin_anew"))

    def draw(self, sprites: Sprites | None, frame: int = 0) -> None:
        """See `Backend.draw`."""
        for one, light in zip(self._each, (None,) * len(self._each) if sprites is None else sprites.primaries, strict=True):
            one.draw(light, frame)

    def levels(self) -> Levels:
        """See `Backend.levels`."""
        for k, one in enumerate(self._each):
            levels = one.levels()
            if not self._planes.size:
                self._planes = np.empty((len(self._each), *levels.shape), levels.dtype)
            np.copyto(self._planes[k], levels)
        return Levels(np.moveaxis(self._planes, 0, -1))

    def show_on(self, view: ScreenView, beside: Sequence[Backend] = ()) -> None:
        """See `Backend.show_on`."""
        self._each[0].show_on(view, self._each[1:])

    def changed_tables(self) -> int:
        """See `Backend.changed_tables`."""
        return sum(one.changed_tables() for one in self._each)
