"""How an image lies on a screen, and when the screen's rows light."""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Orientation:
    """How the image lies on the screen: columns or rows reversed, and quarter turns clockwise."""

    flip_x: bool = False
    flip_y: bool = False
    quarter_turns: int = 0

    def screen_px(self, resolution_px: tuple[int, int]) -> tuple[int, int]:
        """The screen that an image of `resolution_px` fills."""
        width, height = resolution_px
        if self.quarter_turns % 2 == 0:
            return width, height
        return height, width

    @property
    def down(self) -> tuple[int, int]:
        """The direction of the screen's rows, from first to last, in image axes (x right, y
        down).
        """
        by_turns = ((0, 1), (1, 0), (0, -1), (-1, 0))
        x, y = by_turns[self.quarter_turns % 4]
        if self.flip_y:
            return -x, -y
        return x, y

    def in_image(self, right: float, down: float) -> tuple[float, float]:
        """A step on the screen, right and down, in image axes."""
        if self.flip_x:
            right = -right
        if self.flip_y:
            down = -down
        for _ in range(self.quarter_turns % 4):
            right, down = down, -right
        return right, down

    def to_screen(
        self, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """The screen's pixels (n,) that show pixels (n,) of an image of `resolution_px`."""
        width, height = resolution_px
        for _ in range(self.quarter_turns % 4):
            x_px, y_px = height - 1 - y_px, x_px
            width, height = height, width
        return self._flipped(x_px, y_px, (width, height))

    def to_image(
        self, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """The pixels (n,) of an image of `resolution_px` that the screen's pixels (n,) show."""
        width, height = self.screen_px(resolution_px)
        x_px, y_px = self._flipped(x_px, y_px, (width, height))
        for _ in range(self.quarter_turns % 4):
            x_px, y_px = y_px, width - 1 - x_px
            width, height = height, width
        return x_px, y_px

    def _flipped(
        self, x_px: FloatArray, y_px: FloatArray, screen_px: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (n,) of a screen whose columns or rows are reversed; the way back is the same."""
        width, height = screen_px
        if self.flip_x:
            x_px = width - 1 - x_px
        if self.flip_y:
            y_px = height - 1 - y_px
        return x_px, y_px


@dataclass(frozen=True, slots=True)
class Scan:
    """How a screen lights up: its rows in turn over `scanout_s`, each for `hold_s`.

    `down` is the direction of the screen's rows in image axes (x right, y down), one of the four
    along an axis.
    """

    down: tuple[int, int] = (0, 1)
    scanout_s: float = 0.0
    hold_s: float = 0.0

    @property
    def whole_s(self) -> float:
        """The time from the first row's first light to the last row's last."""
        return self.scanout_s + self.hold_s

    @property
    def longest_s(self) -> float:
        """The longest time that a star of the frame may have moved, counted from the middle
        row's first light.
        """
        return self.scanout_s / 2 + self.hold_s

    def late_s(
        self, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int]
    ) -> FloatArray:
        """How long after the middle row the row of a pixel lights up; off the image as at its
        edge.
        """
        width, height = resolution_px
        down_x, down_y = self.down
        rows = width if down_x else height
        from_middle_x = x_px - (width - 1) / 2
        from_middle_y = y_px - (height - 1) / 2
        place = (down_x * from_middle_x + down_y * from_middle_y) / rows
        return np.asarray(np.clip(place, -0.5, 0.5) * self.scanout_s)
