"""Where hilstar itself fails: each of its methods against what stresses it, and its tolerance.

Every error is measured here, by hilstar's own functions against a truth of another kind: an
integral, a movement in closed form, held-out spectra, rays onto a tilted plane. The tolerances are
those that a bench file has by default, `[render] tolerance_px` and `tolerance_mag`; a direction's
is `tolerance_px` on the demo's monitor.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, RED, SMALL_PT, capital, chart, two_digits
from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    normalise,
    propagate,
    to_radec_roll_deg,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S, flux_ratio, magnitude
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.assess.bench_effects import turn_between
from hilstar.instruments.study import codes
from hilstar.instruments.study.engine import write_rows
from hilstar.instruments.study.predictors import ORION, predictors, rate_of, slew_attitude
from hilstar.instruments.study.study_benches import held_out_errors, study_optics
from hilstar.optics.psf import GaussianPsf, pixel_shares
from hilstar.optics.sprites import brightest, max_stars
from hilstar.server.bench.config import RenderSettings
from hilstar.server.sync import Exposures, beat
from hilstar.sky.electrons import Photometry, library_electrons_per_s, load_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The demo's monitor and collimator (configs/demo.toml).
FOCAL_LENGTH_MM, PITCH_UM, SIZE_PX = 350.0, 57.65, (1920, 1080)
ALIGNED = np.array([1.0, 0.0, 0.0, 0.0])
SIGMA_PX, REFRESH_HZ, PARTED_REFRESHES = 0.85, 60.0, 6.3
FAINT_MAG, COARSE_BITS = 6.0, 8
TOLERANCE_PX, TOLERANCE_MAG = RenderSettings().tolerance_px, RenderSettings().tolerance_mag
ARCSEC_PER_PX = PITCH_UM * 1e-3 / FOCAL_LENGTH_MM * ARCSEC_PER_RAD
TOLERANCE_ARCSEC = TOLERANCE_PX * ARCSEC_PER_PX
COLUMNS, PANEL_INCH, EDGE_INCH = 3, 1.75, 1.4
SPAN_S, SEED = 4.0, 1
EXACT = codes.Way("exact", "exact", BLUE)
NEAR_SAMPLES = 4
WINDOW_VI_MAG = 0.4  # half the width of a running median
# Decades of stars a magnitude: 0.6 where stars fill space evenly, less what dust hides.
STAR_SLOPE = 0.51
VIBRATION_ARCSEC, Z = 2.0, np.array([0.0, 0.0, 1.0])
SMALLEST = 1e-9  # as drawn
LOG_FROM = 20.0  # ratio of the ends of an axis from which on it is logarithmic
# The stresses of the title: what a bench meets first.
SIGMA, BITS, FAINT = (
    "sigma of a star [px]",
    f"bits, {FAINT_MAG:g} mag under white",
    f"mag under white, {COARSE_BITS} bits",
)
RED_STARS, CROWD, TILT = "V-I [mag]", "stars in view", "tilt of the screen [deg]"
TURN = f"turn [deg/s], {PARTED_REFRESHES:g} refreshes"
AGE, PACKETS, VIBRATION = (
    "age of a packet [ms]",
    "packets a second",
    f"vibration of {VIBRATION_ARCSEC:g} arcsec [Hz]",
)
MET_FIRST = (SIGMA, FAINT, TURN, AGE)
# What to do where a method leaves its tolerance, by its stress, in the words of
# docs/where-it-fails.md.
ADVICE = {
    SIGMA: "write a `sprite_sigma_px` of 0.5 or more",
    BITS: "[bit stealing, or a panel of more bits](accuracy-speed.md)",
    FAINT: "[bit stealing, `temporal`, or a panel of more bits](accuracy-speed.md)",
    RED_STARS: '`spectrum = "mk"`, or your own V-I for a star that matters',
    CROWD: "the brightest are drawn; write a smaller `faintest_v_mag`",
    TILT: "`hilstar calibrate geometric`",
    TURN: "an exposure of whole refreshes ([on time](on-time.md))",
    AGE: "a faster link; the swing here is shaken as the wheels of a small satellite shake it",
    PACKETS: "more packets, in the same swing",
    VIBRATION: '`prediction = "auto"` ([on time](on-time.md#prediction-and-jitter))',
}

Unit = Literal["px", "mag", "arcsec"]
TOLERANCES: dict[Unit, float] = {
    "px": TOLERANCE_PX,
    "mag": TOLERANCE_MAG,
    "arcsec": TOLERANCE_ARCSEC,
}


@dataclass(frozen=True, slots=True)
class LimitRow:
    """A method's error under one stress, its tolerance, and the stress at which they meet."""

    method: str
    stress: str
    at: float
    error: float
    unit: Unit
    tolerance: float
    meets: float


@dataclass(frozen=True, slots=True)
class StressLimit:
    """A method's error (n,) against a stress (n,), from easy to hard; `unit` is the error's.

    `says` describes the stress at which the method leaves its tolerance; its braces take the
    figure.
    """

    method: str
    stress: str
    says: str
    unit: Unit
    at: FloatArray
    error: FloatArray

    @property
    def at_unit(self) -> str:
        """The stress's unit: in brackets at its end, or what it counts."""
        bracketed = self.stress.partition("[")[2].partition("]")[0]
        quantity = self.stress.split()[0]
        return bracketed or quantity.rstrip(",")

    @property
    def tolerance(self) -> float:
        """The largest error that is allowed."""
        return TOLERANCES[self.unit]

    @property
    def fails(self) -> bool:
        """Whether the error exceeds the tolerance at any stress."""
        return bool((self.error > self.tolerance).any())

    @property
    def meets(self) -> float:
        """The first stress at which the error crosses the tolerance; NaN for none.

        Between two points the error's logarithm is a straight line.
        """
        over = self.error > self.tolerance
        crosses = over[1:] != over[:-1]
        crossing = np.flatnonzero(crosses)
        if not len(crossing):
            return math.nan
        k = int(crossing[0])
        around = np.maximum(self.error[k : k + 2], SMALLEST)
        low, high = np.log(around)
        share = (math.log(self.tolerance) - low) / (high - low)
        step = self.at[k + 1] - self.at[k]
        return float(self.at[k] + share * step)

    @property
    def words(self) -> str:
        """Where it fails, in words."""
        if math.isfinite(self.meets):
            return self.says.format(two_digits(self.meets))
        if (self.error > self.tolerance).all():
            return "everywhere"
        last = two_digits(float(self.at[-1]))
        return f"nowhere to {last} {self.at_unit}"

    def rows(self) -> list[LimitRow]:
        """Its rows of the table, from easy to hard."""
        ends = self.unit, self.tolerance, self.meets
        rows = []
        for at, error in zip(self.at.tolist(), self.error.tolist(), strict=True):
            row = LimitRow(self.method, self.stress, at, error, *ends)
            rows.append(row)
        return rows


def narrow_sprites() -> StressLimit:
    """The place of a star whose light is integrated over pixels, against its sigma."""
    sigmas_px = np.geomspace(0.9, 0.1, 33)
    phases = np.linspace(-0.5, 0.5, 21)
    pixels = np.arange(-8.0, 9.0)
    errors = []
    for sigma_px in sigmas_px.tolist():
        by_phase = []
        for phase in phases:
            by_phase.append(pixel_shares(pixels - phase, sigma_px))
        shares = np.stack(by_phase)
        places = shares @ pixels / shares.sum(axis=1)
        off_px = np.abs(places - phases)
        errors.append(float(off_px.max()))
    says = "stars under {} px wide"
    return StressLimit("Integral over pixels", SIGMA, says, "px", sigmas_px, np.array(errors))


def coarse_codes(quick: bool) -> StressLimit:
    """The light of a star with exact codes, against the monitor's bits."""
    bits = (10, 8, 6, 4) if quick else (12, 10, 9, 8, 7, 6, 5, 4)
    errors: list[float] = []
    for count in bits:
        (star,) = codes.code_errors(count, EXACT, 8, [FAINT_MAG])
        errors.append(star.flux_max_mag)
    at_bits = np.array(bits, dtype=float)
    return StressLimit(
        "Exact codes, light",
        BITS,
        "codes under {} bits",
        "mag",
        at_bits,
        np.array(errors),
    )


def faint_stars(quick: bool) -> StressLimit:
    """The place of a star with exact codes by the plain moment, against its magnitude."""
    count = 5 if quick else 13
    mags = np.linspace(0, 9, count)
    stars = codes.code_errors(COARSE_BITS, EXACT, 8, mags)
    errors = [star.max_px("moment") for star in stars]
    stress = FAINT
    return StressLimit(
        "Exact codes, place", stress, "{} mag under white", "px", mags, np.array(errors)
    )


def red_stars() -> StressLimit:
    """The light of held-out spectra by their V-I, median, against V-I."""
    library = load_library()
    optics = study_optics("ccd47-20")
    rates = library_electrons_per_s(library, optics, Photometry())
    errors = held_out_errors(rates)
    at = np.arange(-0.2, 3.9, 0.2)
    medians = []
    for centre in at:
        near = np.abs(library.vi_mag - centre) <= WINDOW_VI_MAG
        off_mag = np.abs(magnitude(1 + errors[near]))
        medians.append(float(np.median(off_mag)))
    says = "spectra over V-I {}"
    return StressLimit("Spectra by colour, median", RED_STARS, says, "mag", at, np.array(medians))


def crowds() -> StressLimit:
    """The light of stars that do not fit into a frame, against the stars in view."""
    counts = np.geomspace(3e3, 3e6, 19)
    psf = GaussianPsf((SIGMA_PX, SIGMA_PX))
    room = max_stars(psf.footprint_px)
    rng = np.random.default_rng(SEED)
    errors = []
    for count in counts.astype(int).tolist():
        brighter = np.log10(rng.uniform(size=count))
        light = flux_ratio(brighter / STAR_SLOPE)
        drawn = brightest(light, room)
        shown = light if drawn is None else light[drawn]
        share = float(shown.sum() / light.sum())
        errors.append(abs(magnitude(share)))
    return StressLimit(
        "A frame's room for stars", CROWD, "{} stars", "mag", counts, np.array(errors)
    )


def tilted_screen() -> StressLimit:
    """The places of a pinhole model on a tilted screen, rms after alignment, against the tilt."""
    camera = monitor_camera(SIZE_PX, PITCH_UM, FOCAL_LENGTH_MM, ALIGNED)
    x_px, y_px = camera.grid_px((13, 9))
    shown = normalise(camera.rays(x_px, y_px))
    tilts_deg = np.geomspace(0.0003, 3.0, 17)
    errors = []
    for tilt in np.radians(tilts_deg).tolist():
        across = x_px - camera.principal_point_px[0]
        down = y_px - camera.principal_point_px[1]
        depth = camera.focal_length_px + across * math.sin(tilt)
        turned = np.stack([across * math.cos(tilt), down, depth], axis=1)
        true = normalise(turned)
        weights = np.ones(len(true))
        turn = turn_between(true, shown, weights)
        turned_rad = np.cross(turn, true)
        residual = shown - true - turned_rad
        squares = (residual**2).sum(axis=1)
        rms_rad = float(np.sqrt(squares.mean()))
        errors.append(rms_rad * camera.focal_length_px)
    says = "a tilt over {} deg"
    return StressLimit("Pinhole, no geometry file", TILT, says, "px", tilts_deg, np.array(errors))


def wide_fields() -> StressLimit:
    """A direction onto the monitor's plane and back, against the angle from the axis."""
    camera = monitor_camera(SIZE_PX, PITCH_UM, FOCAL_LENGTH_MM, ALIGNED)
    from_90_deg = np.geomspace(60.0, 1e-7, 15)
    angle = np.radians(90.0 - from_90_deg)
    zeros = np.zeros(len(angle))
    true = np.stack([np.sin(angle), zeros, np.cos(angle)], axis=1)
    places_px = camera.project(true)
    rays = normalise(camera.rays(*places_px))
    off_rad = np.cross(rays, true)
    errors = np.linalg.norm(off_rad, axis=1) * ARCSEC_PER_RAD
    return StressLimit(
        "Perspective",
        "angle short of 90 deg [deg]",
        "{} deg short of 90",
        "arcsec",
        from_90_deg,
        errors,
    )


def poles() -> StressLimit:
    """An attitude to RA, Dec and roll and back, against its distance from the pole."""
    from_pole_deg = np.geomspace(10.0, 1e-7, 15)
    errors = []
    for distance in from_pole_deg.tolist():
        q = from_radec_roll_deg(123.4, 90.0 - distance, 56.7)
        angles_deg = to_radec_roll_deg(q)
        back = from_radec_roll_deg(*angles_deg)
        off_rad = angle_between_rad(q, back)
        errors.append(off_rad * ARCSEC_PER_RAD)
    return StressLimit(
        "RA, Dec and roll",
        "distance from the pole [deg]",
        "{} deg from the pole",
        "arcsec",
        from_pole_deg,
        np.array(errors),
    )


def parted_refreshes() -> StressLimit:
    """A star's place over an exposure of 6.3 refreshes, against the turn.

    `study timing` checks this law with the virtual tracker.
    """
    rates_deg_s = np.geomspace(0.03, 30.0, 13)
    exposures = Exposures(REFRESH_HZ, PARTED_REFRESHES / REFRESH_HZ)
    worst = beat(exposures).worst_arcsec_per_deg_s or 0.0
    stress = TURN
    off_arcsec = worst * rates_deg_s
    return StressLimit(
        "Refreshes in an exposure",
        stress,
        "turns over {} deg/s",
        "arcsec",
        rates_deg_s,
        off_arcsec,
    )


def predicted_rms_arcsec(
    attitude: Callable[[int], FloatArray],
    packet_hz: float,
    age_ms: float,
) -> float:
    """The rms error of the predicted attitude over the frames of a movement; packets arrive
    `age_ms` old.
    """
    way = next(predictor for predictor in predictors() if predictor.is_default)
    errors = []
    count = int(SPAN_S * REFRESH_HZ)
    for frame in range(count):
        t_ns = round((1 + frame / REFRESH_HZ) * NS_PER_S)
        newest_ns = t_ns - age_ms * NS_PER_MS
        newest = math.floor(newest_ns * packet_hz / NS_PER_S)
        numbers = range(newest + 1 - NEAR_SAMPLES, newest + 1)
        samples = []
        for number in numbers:
            at_ns = round(number * NS_PER_S / packet_hz)
            true = attitude(at_ns)
            rate = rate_of(attitude, at_ns)
            samples.append(AttitudeSample(at_ns, true, rate))
        predicted_q = way.load(samples)(t_ns)
        off_rad = angle_between_rad(predicted_q, attitude(t_ns))
        errors.append(off_rad * ARCSEC_PER_RAD)
    mean_square = np.mean(np.square(errors))
    return float(np.sqrt(mean_square))


def old_packets(quick: bool) -> StressLimit:
    """The predicted attitude of a shaken slew, against the age of the newest packet."""
    count = 6 if quick else 12
    ages_ms = np.geomspace(0.5, 100.0, count)
    errors = []
    for age in ages_ms.tolist():
        errors.append(predicted_rms_arcsec(slew_attitude, 1000.0, age))
    says = "packets over {} ms old"
    return StressLimit("Prediction by rates", AGE, says, "arcsec", ages_ms, np.array(errors))


def few_packets(quick: bool) -> StressLimit:
    """The predicted attitude of the same slew without delay, against the packet rate."""
    count = 6 if quick else 12
    rates_hz = np.geomspace(1000.0, 5.0, count)
    errors = []
    for rate in rates_hz.tolist():
        errors.append(predicted_rms_arcsec(slew_attitude, rate, 0.0))
    return StressLimit(
        "Prediction by rates",
        PACKETS,
        "under {} packets a second",
        "arcsec",
        rates_hz,
        np.array(errors),
    )


def vibrations(quick: bool) -> StressLimit:
    """The predicted attitude of a vibration, 20 ms ahead, against its frequency."""
    count = 6 if quick else 12
    frequencies_hz = np.geomspace(0.5, 45.0, count)
    errors = []
    for hz in frequencies_hz.tolist():

        def attitude(t_ns: int, hz: float = hz) -> FloatArray:
            wave = math.sin(math.tau * hz * t_ns / NS_PER_S)
            angle = VIBRATION_ARCSEC / ARCSEC_PER_RAD * wave
            return propagate(ORION, Z, angle)

        errors.append(predicted_rms_arcsec(attitude, 100.0, 20.0))
    return StressLimit(
        "Prediction over 20 ms",
        VIBRATION,
        "vibrations over {} Hz",
        "arcsec",
        frequencies_hz,
        np.array(errors),
    )


def every_limit(quick: bool) -> list[StressLimit]:
    """Every limit, in the order of the chain: light, places, time."""
    return [
        *(narrow_sprites(), coarse_codes(quick), faint_stars(quick)),
        *(red_stars(), crowds(), tilted_screen()),
        *(wide_fields(), poles(), parted_refreshes()),
        *(old_packets(quick), few_packets(quick), vibrations(quick)),
    ]


def run(directory: Path, quick: bool = False) -> list[str]:
    """Measure, and write `limits.csv` and its chart; a line for each limit. Raises InputError."""
    limits = every_limit(quick)
    rows: list[LimitRow] = []
    for limit in limits:
        rows += limit.rows()
    write_rows(directory / "limits.csv", rows)
    draw(directory / "limits", limits)
    lines = [limits_finding(limits)]
    for limit in limits:
        lines.append(f"{limit.method} ({limit.stress}): {limit.words}")
    return lines


def limits_finding(limits: Sequence[StressLimit]) -> str:
    """How many methods leave their tolerance, and where those do that a bench meets first."""
    failing = 0
    met = []
    for limit in limits:
        failing += limit.fails
        if limit.fails and limit.stress in MET_FIRST:
            met.append(limit.words)
    met_words = ", ".join(met)
    return f"{failing} of {len(limits)} methods of hilstar leave their tolerance: {met_words}"


def draw(path: Path, limits: Sequence[StressLimit]) -> None:
    """A panel for each method: its error, the tolerance, and where they meet."""
    rows = math.ceil(len(limits) / COLUMNS)
    arcsec = two_digits(TOLERANCE_ARCSEC)
    note = (
        f"Blue: the error as measured, largest or rms. Red: the tolerance, {TOLERANCE_MAG:g} mag,"
        f" {TOLERANCE_PX:g} px, or {arcsec} arcsec, which is {TOLERANCE_PX:g}"
        " px of the demo's monitor; the dot is where they meet. Each axis runs from easy to hard."
        " Places by the plain moment."
    )
    height_inch = EDGE_INCH + PANEL_INCH * rows
    layout: dict[str, Any] = {"share_x": False, "height_inch": height_inch}
    finding = limits_finding(limits)
    with chart(path, finding, rows, COLUMNS, note=note, **layout) as grid:
        for axes, limit in zip(grid, limits, strict=False):
            draw_limit(axes, limit)
        for axes in grid[len(limits) :]:
            axes.set_axis_off()


def draw_limit(axes: "Axes", limit: StressLimit) -> None:
    """One method: error against stress, from easy to hard, and where it meets its tolerance."""
    errors = np.maximum(limit.error, SMALLEST)
    axes.plot(limit.at, errors, color=BLUE, label="_error")
    axes.axhline(limit.tolerance, color=RED, ls="--", lw=1.2, label="_tolerance")
    axes.set(yscale="log", xlabel=limit.stress, ylabel=f"error [{limit.unit}]")
    axes.set_title(capital(limit.method), color=BLUE)  # the name of the line
    ends = (float(limit.at[0]), float(limit.at[-1]))
    low, high = sorted(ends)
    if high > LOG_FROM * abs(low) > 0:
        axes.set_xscale("log")
    if limit.at[0] > limit.at[-1]:
        axes.invert_xaxis()
    style: dict[str, Any] = {"color": RED, "fontsize": SMALL_PT}
    if not math.isfinite(limit.meets):
        axes.text(0.05, 0.5, limit.words, transform=axes.transAxes, **style)
        return
    place = limit.meets, limit.tolerance
    axes.plot(*place, "o", color=RED, ms=6, label="_meets", zorder=4)
    met = two_digits(limit.meets)
    label = f"{met} {limit.at_unit}".strip()
    axes.annotate(label, place, (-7, 5), textcoords="offset points", ha="right", **style)
