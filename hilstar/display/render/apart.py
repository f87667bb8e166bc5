"""Primaries that are driven apart: one backend for each, which knows of no other.

What a monitor of three primaries has that a grey one has not is here alone: whose light is whose,
the order in which `exact` chooses their levels, and how their levels come together.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from hilstar.basics.arrays import Float32Array
from hilstar.display.exact import ExactQuantiser, Turn
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.backend import Backend, ScreenView
from hilstar.display.render.target import Target
from hilstar.display.response import Levels
from hilstar.optics.sprites import FrameLight, by_primary

# opens the backend of a grey target, and of those before it in the order of choice
OpenPanel = Callable[[Target, Sequence[Backend]], Backend]


def turns_of(target: Target) -> dict[int, Turn]:
    """The turn of each primary, in the order in which they choose their levels.

    `exact` goes by falling electrons a step, for the last leave least. Each makes up for those
    before it, by the light of the channels. In `temporal` each makes up for its own light alone.
    """
    panels = target.primaries
    step = np.array([panel.response.light[1] * panel.flux_at_white_e_per_s for panel in panels])
    order = np.argsort(-step, kind="stable").tolist()
    quantiser = QUANTISERS[target.quantisation]
    if not issubclass(quantiser, ExactQuantiser) or quantiser.remembers:
        return dict.fromkeys(order, Turn())
    share = target.together / target.together.diagonal() * step[:, None] / step
    # What a primary leaves has in it what it began with: `errors` (3, 3) are its own errors by
    # what each leaves.
    errors = np.zeros_like(share)
    turns = {}
    for place, k in enumerate(order):
        makes_up = share[:, k] @ errors
        errors[k] = -makes_up
        errors[k, k] += 1
        turns[k] = Turn(tuple(makes_up[order[:place]].tolist()), k != order[-1])
    return turns


class ApartBackend(Backend):
    """Draws a target of primaries, each by a backend of its own; levels are (height, width, 3).

    Extended light and stars of each primary are moved to where its light has to be drawn.
    """

    def __init__(self, target: Target, open_panel: OpenPanel) -> None:
        self.target = target
        self._open_panel = open_panel
        self._turns = turns_of(target)
        chosen: list[Backend] = []
        for k, turn in self._turns.items():
            before = chosen[: len(turn.makes_up)]
            chosen.append(open_panel(target.of_primary(k, turn), before))
        panel_of = dict(zip(self._turns, chosen, strict=True))
        self.panels = [panel_of[k] for k in range(len(chosen))]
        first = self.panels[0]
        self.gl_renderer = first.gl_renderer
        self.gl_version = first.gl_version
        self.path = first.path
        self.context = first.context

    @cached_property
    def _white(self) -> Backend:
        """What draws linear images, of which a target of primaries has none of its own."""
        return self._open_panel(Target(self.target.resolution_px, self.target.psf), ())

    def draw(self, sprites: FrameLight | None, frame: int = 0) -> None:
        """See `Backend.draw`."""
        for k in self._turns:
            light = sprites
            if sprites is not None:
                light = by_primary(sprites, self.target.places_px, k)
            self.panels[k].draw(light, frame)

    def draw_linear(self, sprites: FrameLight) -> None:
        """See `Backend.draw_linear`."""
        self._white.draw_linear(sprites)

    def linear(self) -> Float32Array:
        """See `Backend.linear`; that of the last `draw_linear`."""
        return self._white.linear()

    def levels(self) -> Levels:
        """See `Backend.levels`."""
        # Primary by primary in memory: a pixel's three side by side take 12 times as long to write,
        # and the lit pixels of all three 25 times as long to find (1920 x 1080).
        stacked = np.stack([panel.levels() for panel in self.panels])
        return Levels(np.moveaxis(stacked, 0, -1))

    def show_on(self, view: ScreenView, beside: Sequence[Backend] = ()) -> None:
        """See `Backend.show_on`."""
        self.panels[0].show_on(view, self.panels[1:])

    def present(
        self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)
    ) -> None:
        """See `Backend.present`."""
        self.panels[0].present(overlay, patch_code, marker)

    def take_back_buffer(self) -> None:
        """See `Backend.take_back_buffer`."""
        self.panels[0].take_back_buffer()

    def changed_codes(self) -> str:
        """See `Backend.changed_codes`."""
        return self.panels[0].changed_codes()

    def fault(self) -> str:
        """See `Backend.fault`; all draw by one GPU."""
        return self.panels[0].fault()

    def remember_tables(self) -> None:
        """See `Backend.remember_tables`."""
        for panel in self.panels:
            panel.remember_tables()

    def changed_tables(self) -> int:
        """See `Backend.changed_tables`."""
        return sum(panel.changed_tables() for panel in self.panels)

    def forget_images(self) -> None:
        """See `Backend.forget_images`."""
        for panel in self.panels:
            panel.forget_images()

    def begin_anew(self) -> None:
        """See `Backend.begin_anew`."""
        for panel in self.panels:
            panel.begin_anew()

    def finish(self) -> None:
        """See `Backend.finish`; all draw by one GPU."""
        self.panels[0].finish()

    def close(self) -> None:
        """Free the GL context, which all share, and everything in it."""
        self.panels[0].close()
