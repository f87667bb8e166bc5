"""How sharp a tracker is while somebody turns its ring: a figure for each image, or for the answers
of half a second, and the best so far. The figure of answers is the median width of their stars.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np
from msgspec.structs import replace

from hilstar.basics.errors import printable
from hilstar.basics.units import MAD_TO_SIGMA, NS_PER_S
from hilstar.server.answers.answer import Answer

SIGMAS_APART = 3.0  # by which a figure is worse than the best
STREAK_SIGMAS = 1.0  # of the PSF: a streak so long widens the fitted sigma by 2 %
STREAK_FACTOR = 1.5  # over the usual one: an astigmatic lens draws stars out in each image
BARS = "▁▂▃▄▅▆▇█"
CURVE_WIDTH = 40
MIN_SPAN_PX = 1e-3  # widths that are all the same are a flat curve
DECIMALS = 4  # of px
KEPT = 2000  # readings; the median streak and the curve are of these
READ_NS = NS_PER_S // 2  # of answers in one figure
MIN_WIDTHS = 3
MEDIAN_ERROR = math.sqrt(math.pi / 2)  # of a median of normal values, over that of their mean
NONE_AFTER = 10  # answers of stars, of which none has a width: this tracker reports none
NO_STARS = "the tracker reports no star"

Source = Literal["images", "answers"]
WHAT: dict[Source, str] = {"images": "PSF sigma", "answers": "star sigma"}


@dataclass(frozen=True, slots=True)
class FocusFigure:
    """How sharp one image is: the PSF's sigma and its error, by so many dots, and how far its
    stars are drawn out and in which direction (degrees from x to y), tracker px.

    Of answers it is the median of the widths that they report, by so many; their streak is not
    known, and 0.
    """

    psf_sigma_px: float
    error_px: float
    dots: int
    streak_px: float
    streak_deg: float


@dataclass(frozen=True, slots=True)
class FocusReading:
    """An image's number (from 1), when it came (s since the first), the code of its dots, and its
    figure; without one, `why` says what is wrong.
    """

    number: int
    t_s: float
    code: int
    figure: FocusFigure | None
    why: str = ""


class FocusState(msgspec.Struct, frozen=True, kw_only=True):
    """How sharp the tracker is: the newest figure's number, what it is ("PSF sigma" of images,
    "star sigma" of answers), its value and error, px, the best so far and how long ago that was,
    and a line of advice. A reading without a figure has none. `worse` is beyond both errors; an
    image of a tracker that moves is not `still`.
    """

    number: int
    what: str
    sigma_px: float | None = None
    error_px: float | None = None
    best_px: float | None = None
    best_ago_s: float | None = None
    count: int = 0
    line: str = ""
    still: bool = True
    worse: bool = False


@dataclass(slots=True)
class FocusCurve:
    """The newest readings, how many there were, and the best of those that held still."""

    source: Source = "images"
    readings: deque[FocusReading] = field(default_factory=lambda: deque(maxlen=KEPT))
    best: FocusReading | None = None
    count: int = 0

    def add(self, reading: FocusReading) -> None:
        """Take a reading."""
        self.readings.append(reading)
        self.count += 1
        if reading.figure is None or self.is_drawn_out(reading.figure):
            return
        if self.best is None or reading.figure.psf_sigma_px < self._best_figure.psf_sigma_px:
            self.best = reading

    @property
    def figures(self) -> list[FocusFigure]:
        """The figures of the images that have one."""
        return [reading.figure for reading in self.readings if reading.figure is not None]

    @property
    def _best_figure(self) -> FocusFigure:
        assert self.best is not None and self.best.figure is not None
        return self.best.figure

    def is_drawn_out(self, figure: FocusFigure) -> bool:
        """Whether an image's stars are drawn out more than a lens does it in all images."""
        if not figure.streak_px:
            return False
        usual_px = float(np.median([other.streak_px for other in self.figures]))
        limit_px = max(STREAK_SIGMAS * figure.psf_sigma_px, STREAK_FACTOR * usual_px)
        return figure.streak_px > limit_px

    def is_worse(self, figure: FocusFigure) -> bool:
        """Whether an image is less sharp than the best one, beyond both errors."""
        if self.best is None:
            return False
        apart_px = figure.psf_sigma_px - self._best_figure.psf_sigma_px
        return apart_px > SIGMAS_APART * math.hypot(figure.error_px, self._best_figure.error_px)

    def why_none(self) -> str:
        """Why there is no best image: the first that has a figure is one."""
        if not self.readings:
            return f"no {self.source.removesuffix('s')} came"
        return self.readings[-1].why

    def advice(self) -> str:
        """How the newest reading stands beside the best, or what is wrong with it."""
        reading = self.readings[-1]
        figure = reading.figure
        if figure is None:
            return reading.why
        if self.is_drawn_out(figure):
            length = f"{figure.streak_px:.1f} px at {figure.streak_deg:.0f} deg"
            return f"stars are drawn out {length}: hold the tracker still"
        if self.best is None or self.best is reading:
            return "the best so far"
        if self.is_worse(figure):
            ago_s = reading.t_s - self.best.t_s
            return f"best {self._best_figure.psf_sigma_px:.3f} px {ago_s:.0f} s ago"
        return "as the best"

    def state(self) -> FocusState | None:
        """The newest reading as a page shows it; None before the first."""
        if not self.readings:
            return None
        reading = self.readings[-1]
        figure = reading.figure
        state = FocusState(
            number=reading.number, what=WHAT[self.source], line=printable(self.advice())
        )
        if self.best is not None:
            state = replace(
                state,
                best_px=round(self._best_figure.psf_sigma_px, DECIMALS),
                best_ago_s=round(reading.t_s - self.best.t_s, 1),
            )
        if figure is None:
            return state
        return replace(
            state,
            sigma_px=round(figure.psf_sigma_px, DECIMALS),
            error_px=round(figure.error_px, DECIMALS),
            count=figure.dots,
            still=not self.is_drawn_out(figure),
            worse=self.is_worse(figure),
        )

    def line(self) -> str:
        """The newest reading beside the best, as a person at the ring reads it."""
        reading = self.readings[-1]
        if reading.figure is None:
            return f"{reading.number:4}  {reading.why}"
        figure = reading.figure
        text = f"{reading.number:4}  {WHAT[self.source]} {figure_text(figure)}"
        if self.is_drawn_out(figure):
            return f"{text}; {self.advice()}"
        sigmas_px = [other.psf_sigma_px for other in self.figures]
        curve = sparkline(sigmas_px, SIGMAS_APART * figure.error_px)
        return f"{text}, {self.advice()}  {curve}"


def figure_text(figure: FocusFigure) -> str:
    """A figure with its error."""
    return f"{figure.psf_sigma_px:.3f} +- {figure.error_px:.3f} px"


def sparkline(values: list[float], least_span: float) -> str:
    """The last CURVE_WIDTH values as bars, the smallest the lowest; the highest bar is at least
    `least_span` above it, so that noise is no curve.
    """
    shown = np.array(values[-CURVE_WIDTH:])
    span = max(float(np.ptp(shown)), least_span, MIN_SPAN_PX)
    heights = np.rint((shown - shown.min()) / span * (len(BARS) - 1)).astype(int)
    return "".join(BARS[height] for height in heights)


def width_figure(widths_px: Sequence[float]) -> FocusFigure:
    """The median of the widths of stars (n,), px, and its standard error by their scatter.

    The median, because a star that saturates or that another stands beside looks wide.
    """
    widths = np.array(widths_px)
    median_px = float(np.median(widths))
    scatter_px = MAD_TO_SIGMA * float(np.median(np.abs(widths - median_px)))
    error_px = MEDIAN_ERROR * scatter_px / math.sqrt(len(widths))
    return FocusFigure(median_px, error_px, len(widths), 0.0, 0.0)


class AnswerWidths:
    """The focus by answers: a reading of each READ_NS of them, in `curve`. Another thread may read
    `state`, the newest one.

    `reports_none` says that a tracker reports stars without any width.
    """

    def __init__(self) -> None:
        self.curve = FocusCurve("answers")
        self.state: FocusState | None = None
        self._widths_px: list[float] = []
        self._without = 0
        self._ever = False
        self._has_seen = False  # a star, since the last reading
        self._first_ns: int | None = None
        self._begun_ns = 0

    @property
    def reports_none(self) -> bool:
        """Whether NONE_AFTER answers of stars came before any width."""
        return not self._ever and self._without >= NONE_AFTER

    def take(self, answer: Answer) -> FocusReading | None:
        """Take an answer; the reading that it completes, or None.

        A reading of no star has no figure. There is none of stars without widths.
        """
        widths_px = [star.width_px for star in answer.centroids if star.width_px is not None]
        has_seen = bool(answer.centroids) or answer.q_icrs_to_cam is not None
        self._ever = self._ever or bool(widths_px)
        self._without += has_seen and not widths_px
        self._has_seen = self._has_seen or has_seen
        self._widths_px += widths_px
        if self._first_ns is None:
            self._first_ns = self._begun_ns = answer.host_ns
        if answer.host_ns - self._begun_ns < READ_NS:
            return None
        self._begun_ns = answer.host_ns
        reading = self._reading((answer.host_ns - self._first_ns) / NS_PER_S)
        self._widths_px = []
        self._has_seen = False
        if reading is None:
            return None
        self.curve.add(reading)
        if self._ever:
            self.state = self.curve.state()
        return reading

    def _reading(self, t_s: float) -> FocusReading | None:
        """The reading of the widths so far; None of stars without widths."""
        number = self.curve.count + 1
        count = len(self._widths_px)
        if count >= MIN_WIDTHS:
            return FocusReading(number, t_s, 0, width_figure(self._widths_px))
        if not self._has_seen:
            return FocusReading(number, t_s, 0, None, NO_STARS)
        if not self._ever:
            return None
        why = f"the tracker reports {count} widths of stars, {MIN_WIDTHS} at least are needed"
        return FocusReading(number, t_s, 0, None, why)
