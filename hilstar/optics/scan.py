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
        if self.quarter_turns % 2 == 0:
            return resolution_px
        return (resolution_px[1], resolution_px[0])

    @property
    def down(self) -> tuple[int, int]:
        """The direction of the screen's rows, from first to last, in image axes (x right, y
        down).
        """
        x, y = ((0, 1), (1, 0), (0, -1), (-1, 0))[self.quarter_turns % 4]
        return (-x, -y) if self.flip_y else (x, y)

    def in_image(self, right: float, down: float) -> tuple[float, float]:
        """A step on the screen, right and down, in image axes."""
        right = -right if self.flip_x else right
        down = -down if self.flip_y else down
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
        x_px = width - 1 - x_px if self.flip_x else x_px
        y_px = height - 1 - y_px if self.flip_y else y_px
        return x_px, y_px

    def to_image(
        self, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """The pixels (n,) of an image of `resolution_px` that the screen's pixels (n,) show."""
        width, height = self.screen_px(resolution_px)
        x_px = width - 1 - x_px if self.flip_x else x_px
        y_px = height - 1 - y_px if self.flip_y else y_px
        for _ in range(self.quarter_turns % 4):
            x_px, y_px = y_px, width - 1 - x_px
            width, height = height, width
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
        middle_x, middle_y = ((size - 1) / 2 for size in resolution_px)
        if self.down[0]:
            rows = resolution_px[0]
        else:
            rows = resolution_px[1]
        place = (self.down[0] * (x_px - middle_x) + self.down[1] * (y_px - middle_y)) / rows
        return np.asarray(np.clip(place, -0.5, 0.5) * self.scanout_s)
