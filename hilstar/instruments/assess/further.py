"""What a run's answers carry beside the attitude: reported rates, the jitter of their stamps, and
single stars, each with its 95 % interval.

The figures are those of an acceptance (docs/accept.md). The unit that is independent of others is
one of STRETCHES stretches of the run.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.attitude.clock.rate_check import cause_in
from hilstar.attitude.logs.telemetry import Telemetry
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.bounded_figures import BoundedFigure, TooFewCases
from hilstar.instruments.assess.budget import DecomposedRun
from hilstar.instruments.assess.case_fits import summed
from hilstar.instruments.assess.figure_rows import COUNT, FigureRow
from hilstar.instruments.assess.places import spread_rows
from hilstar.instruments.assess.rate_figures import LEFT_OUT, RateTable, rate_figure
from hilstar.instruments.assess.star_figures import (
    StarTable,
    false_stars,
    star_figure,
    without_turns,
)
from hilstar.instruments.assess.time_figures import stamp_jitter
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.stars import ShownStars
from hilstar.server.record.commanded import Commanded

STRETCHES = 40
END = 0.975  # confidence of each end of a 95 % interval
ACCELERATION_S = 0.1  # from either side of an answer to the rates that tell its acceleration
STAR_ANSWERS = 2000  # whose stars are judged, spread evenly over the run
SEED = 0
AXES = {"cross": [0, 1], "roll": [2]}
RATE_NAMES = {
    "rate-bias": ("rate bias", "deg/s"),
    "rate-noise": ("rate noise", "deg/s"),
    "rate-scale": ("rate scale", COUNT),
    "rate-lag": ("rate lag", "s"),
}
STAR_NAMES = {
    "star-noise": ("star noise", "px"),
    "star-fov-error": ("star field error", "px"),
    "star-colour": ("star colour", "mag/mag"),
    "star-limit": ("star limit", "mag"),
}
FALSE_STARS, JITTER = "false stars a frame", "stamp jitter"


@dataclass
class FurtherFigures:
    """The figures as rows of budget.csv; of one that the run does not tell the value is None, and
    `why` says why. `stars` are the judged ones, None where no answer has any.
    """

    rows: list[FigureRow] = field(default_factory=list)
    why: dict[str, str] = field(default_factory=dict)
    stars: StarTable | None = None
    notes: list[str] = field(default_factory=list)

    def add(self, name: str, axis: str, unit: str, figure: BoundedFigure) -> None:
        """Add a figure with its interval; an end without a bound is left out."""
        low, high = _finite(figure.low), _finite(figure.high)
        self.rows.append(FigureRow(name, axis, figure.value, unit, low, high))

    def miss(self, name: str, axis: str, unit: str, why: TooFewCases) -> None:
        """Add a figure that is not told."""
        self.rows.append(FigureRow(name, axis, None, unit))
        self.why[name] = str(why)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def add_rates(
    further: FurtherFigures, telemetry: Telemetry, commanded: Commanded, found: DecomposedRun
) -> None:
    """Add the figures of the reported rates, if there are any."""
    rows = np.flatnonzero(telemetry.valid)[found.row]
    reported = telemetry.rate_cam_rad_s
    if reported is None or not np.isfinite(reported[rows]).any():
        return
    reported_deg_s = np.degrees(reported[rows])
    rates_deg_s = np.degrees(found.rate_rad_s)
    t_s = found.clock.t_s[found.row]
    after = commanded.at(t_s + ACCELERATION_S).rate_rad_s
    before = commanded.at(t_s - ACCELERATION_S).rate_rad_s
    acceleration = np.degrees(after - before) / (2 * ACCELERATION_S)
    errors_deg_s = reported_deg_s - rates_deg_s
    # at an end of what was shown the acceleration is not known
    errors_deg_s[~np.isfinite(acceleration).all(axis=1)] = np.nan
    table = RateTable(stretches(len(rows)), rates_deg_s, errors_deg_s, acceleration)
    for quantity, (name, unit) in RATE_NAMES.items():
        for axis, axes in AXES.items():
            rng = np.random.default_rng(SEED)
            try:
                figure = rate_figure(quantity, table, axes, END, rng)
            except TooFewCases as few:
                further.miss(name, axis, unit, few)
            else:
                further.add(name, axis, unit, figure)
                if LEFT_OUT in figure.method:
                    further.notes.append(f"{name}, {axis}: {figure.method}")
    further.notes += rate_notes(telemetry.t_ns[rows], telemetry.q[rows], reported[rows])


def stretches(count: int) -> IntArray:
    """The stretch (n,) of each of so many answers, in their order."""
    return np.arange(count) * STRETCHES // max(count, 1)


def rate_notes(t_ns: IntArray, q: FloatArray, rates_rad_s: FloatArray) -> Iterator[str]:
    """A note where reported rates (n, 3), NaN for none, are not the turn of their own attitudes
    (n, 4): of another unit, sign or frame.
    """
    samples = []
    for row in np.flatnonzero(np.isfinite(rates_rad_s).all(axis=1)).tolist():
        samples.append(AttitudeSample(int(t_ns[row]), q[row], rates_rad_s[row]))
    cause = cause_in(samples)
    if cause is not None:
        yield f"the reported rates are not the turn of the reported attitudes: {cause.text}"


def add_jitter(further: FurtherFigures, found: DecomposedRun) -> None:
    """Add the jitter of the stamps, by what is left of the errors along slews and across them."""
    parts = found.components
    count = len(found.row)
    freedom = max(count - parts.fov.freedom - parts.pixel.freedom - 1, 1.0)
    left = parts.left * math.sqrt(count / freedom)
    rates_arcsec_s = ARCSEC_PER_RAD * found.rate_rad_s
    rng = np.random.default_rng(SEED)
    try:
        figure = stamp_jitter(left, rates_arcsec_s, stretches(count), END, rng)
    except TooFewCases as few:
        further.miss(JITTER, "", "s", few)
    else:
        further.add(JITTER, "", "s", figure)


def add_stars(
    further: FurtherFigures,
    shown: ShownStars,
    centroids: Sequence[Sequence[ReportedStar]],
    found: DecomposedRun,
) -> None:
    """Add the figures of single stars by those of each right answer."""
    rows = np.array([k for k, stars in enumerate(centroids) if stars], dtype=np.intp)
    if not len(rows):
        return
    rows = rows[spread_rows(len(rows), STAR_ANSWERS)]
    parts = []
    false = np.zeros(len(rows))
    for k, row in enumerate(rows.tolist()):
        judged = shown.judged(tuple(centroids[row]), found.commanded_q[row])
        lit = judged.lit
        of_answer = np.full(len(lit.x_px), float(k))
        columns = (of_answer, lit.x_px, lit.y_px, lit.v_mag, lit.bv)
        errors = (judged.dx_px, judged.dy_px, judged.signal_mag, lit.lit_mag)
        parts.append(np.stack([*columns, *errors], axis=1))
        false[k] = judged.false
    case = stretches(len(rows))
    number, *columns_of_stars = np.concatenate(parts).T
    answer = number.astype(np.intp)
    further.stars = StarTable(case[answer], *columns_of_stars)
    with contextlib.suppress(TooFewCases):  # too few for a map: no figure needs it then
        further.stars = without_turns(further.stars, answer, shown.size_px)
    for quantity, (name, unit) in STAR_NAMES.items():
        rng = np.random.default_rng(SEED)
        stars = further.stars
        if quantity == "star-colour":
            # a run sees the same stars again and again: what one of them is off by is off always
            stars = replace(stars, case=np.unique(stars.lit_mag, return_inverse=True)[1])
        try:
            figure = star_figure(quantity, stars, shown.size_px, END, rng)
        except TooFewCases as few:
            further.miss(name, "", unit, few)
        else:
            further.add(name, "", unit, figure)
    frames = summed(np.ones(len(rows)), case)
    figure = false_stars(summed(false, case), frames, END, np.random.default_rng(SEED))
    further.add(FALSE_STARS, "", "a frame", figure)
