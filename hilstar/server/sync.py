"""How a tracker's exposures beat with a screen's refresh, whether that costs more than the bench
tolerates, and what avoids it.

An exposure of n + f refreshes (f under 1) sees about n whole frames and a part of one at each end.
Each frame shows a star at the middle of its own light. A frame seen only in part still counts at
its own middle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S
from hilstar.server.bench.config import BenchConfig

ARCSEC_PER_DEG = 3600.0
# Closer to whole refreshes than this there is no beat: a screen's clock and a tracker's differ by
# more.
NO_BEAT = 1e-6
PHASES = 1024
EDGE = 1e-9  # refreshes: phases to either side of a jump
SHORTEST_LIT = 1e-6  # share of a refresh, for a panel that flashes
MIN_REFRESH_HZ, MAX_REFRESH_HZ = 0.01, 1000.0  # as [monitor] refresh_hz
MAX_CHANGE = 2.0  # a refresh rate farther off than this factor is no proposal
MM_PER_UM = 1e-3
FEW_ARCSEC = 99.5  # from there on, two digits would be written with an exponent


@dataclass(frozen=True, slots=True)
class Exposures:
    """A tracker before a screen: refresh rate, exposure, how often it exposes, and how long a row
    stays lit in a refresh.

    `frame_hz` None: one exposure follows the other without a gap. `lit_s` None: the whole refresh;
    no longer than that counts. `triggered` exposures begin with a frame. Raises InputError for a
    rate not above 0, and an exposure or light below 0.
    """

    refresh_hz: float
    exposure_s: float
    frame_hz: float | None = None
    lit_s: float | None = None
    triggered: bool = False

    def __post_init__(self) -> None:
        for name, value, zero_is_wrong in (
            ("refresh_hz", self.refresh_hz, True),
            ("frame_hz", 1.0 if self.frame_hz is None else self.frame_hz, True),
            ("exposure_s", self.exposure_s, False),
            ("lit_s", 0.0 if self.lit_s is None else self.lit_s, False),
        ):
            if not math.isfinite(value) or value < 0 or (zero_is_wrong and not value):
                raise InputError(
                    f"{name} = {value:g}: write a finite"
                    f" number{' above 0' if zero_is_wrong else ', 0 or more'}"
                )

    @property
    def refreshes(self) -> float:
        """Refreshes in an exposure."""
        return self.refresh_hz * self.exposure_s

    @property
    def every_hz(self) -> float:
        """How often the tracker exposes."""
        if self.frame_hz is None:
            return 1 / self.exposure_s
        return self.frame_hz

    @property
    def lit(self) -> float:
        """The part of a refresh for which a row stays lit."""
        if self.lit_s is None:
            return 1.0
        return min(max(self.lit_s * self.refresh_hz, SHORTEST_LIT), 1.0)


@dataclass(frozen=True, slots=True)
class Beat:
    """A beat: refreshes in an exposure, the period in which the errors repeat, and the largest
    errors.

    `period_s` is None where nothing beats, and where the tracker exposes at a whole part of the
    refresh rate: then its phase stands, until the clocks drift. `worst_arcsec_per_deg_s` is that of
    a star's place in a turn of 1 deg/s, None for an exposure of no length; `worst_mag` that of its
    light, infinite where an exposure may see none.
    """

    refreshes_per_exposure: float
    period_s: float | None
    worst_arcsec_per_deg_s: float | None
    worst_mag: float = 0.0


@dataclass(frozen=True, slots=True)
class SeenBeat:
    """What exposures see, by the phase at which each begins, (n,).

    `off_s`: the middle of the light seen after the middle of the exposure, NaN without any.
    `light`: relative to the mean.
    """

    off_s: FloatArray
    light: FloatArray


def seen_at(exposures: Exposures, phase: FloatArray) -> SeenBeat:
    """What is seen by an exposure that begins `phase` (n,) refreshes after a row lights, any
    number.

    The integrals of a row's light, and of its light times the middle of its frame, are closed forms
    of whole refreshes and a rest; an exposure is the difference of two. A star that turns at a rate
    is off by that rate times `off_s`.
    """
    begin = np.asarray(phase, dtype=np.float64) % 1.0
    length = exposures.refreshes
    lit = exposures.lit
    (light, moment), (light_0, moment_0) = _integrals(begin + length, lit), _integrals(begin, lit)
    light = light - light_0
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = np.where(light > EDGE * lit, (moment - moment_0) / light, np.nan)
        relative = light / (length * lit)
    return SeenBeat((middle - begin - length / 2) / exposures.refresh_hz, relative)


def _integrals(time: FloatArray, lit: float) -> tuple[FloatArray, FloatArray]:
    """Cumulative light of a row up to each time (n,), in refreshes, and its first moment."""
    whole = np.floor(time)
    part = np.minimum(time - whole, lit)
    return whole * lit + part, lit * whole * (whole - 1 + lit) / 2 + part * (whole + lit / 2)


def beat(exposures: Exposures) -> Beat:
    """The beat of a screen's refresh and a tracker's exposures.

    While rows stay lit for the whole refresh a star is off by at most f (1 - f) / 2 of one
    refresh's path, divided by n + f, and whole refreshes cure it. Where they flash it is off by up
    to half of the dark, however long the exposure is: no exposure cures that.
    """
    length = exposures.refreshes
    if length <= 0:
        return Beat(length, None, None)
    if exposures.triggered:
        return Beat(length, None, 0.0)
    # Phases all over a refresh, and to either side of those at which an exposure begins or ends
    # with a row's light.
    edges = np.array([0.0, exposures.lit, -length, exposures.lit - length])
    phases = np.concatenate(
        [np.arange(PHASES) / PHASES, *(edges + side for side in (-EDGE, 0.0, EDGE))]
    )
    sweep = seen_at(exposures, phases)
    arcsec = float(np.nanmax(np.abs(sweep.off_s))) * ARCSEC_PER_DEG
    dim = float(sweep.light.min())
    bright = float(sweep.light.max())
    if dim <= 0:
        mag = math.inf
    else:
        mag = 2.5 * max(math.log10(bright), -math.log10(dim))
    if abs(length - round(length)) < NO_BEAT and exposures.lit == 1.0:
        return Beat(length, None, 0.0)
    # The refresh as the tracker's frames sample it: the difference from the nearest multiple of
    # their rate.
    frame_hz = exposures.every_hz
    rest = exposures.refresh_hz / frame_hz
    rest -= round(rest)
    return Beat(length, None if abs(rest) < NO_BEAT else 1 / (abs(rest) * frame_hz), arcsec, mag)


class BeatProposal(msgspec.Struct, frozen=True, kw_only=True):
    """The nearest settings without a beat, each to be changed alone; None where there is none.

    `frame_hz`, for a panel that flashes, is the nearest rate of the tracker at which its phase
    stands.
    """

    refresh_hz: float | None = None
    exposure_s: float | None = None
    frame_hz: float | None = None


class BeatSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What a bench's beat costs, in JSON: the figures of `Beat`, and at the bench's own rate of
    turn.

    `matters` says whether that is over `[render] tolerance_px` or `tolerance_mag`; then there is a
    `proposal`.
    """

    refresh_hz: float
    exposure_s: float
    refreshes_per_exposure: float
    period_s: float | None
    worst_arcsec: float | None
    worst_mag: float | None
    turn_deg_s: float
    tolerance_arcsec: float
    tolerance_mag: float
    matters: bool
    proposal: BeatProposal | None


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What a beat may cost: in a turn at a rate, deg/s, of a star's place, arcsec, and of its
    light, mag.
    """

    turn_deg_s: float
    arcsec: float
    mag: float

    def is_broken_by(self, found: Beat) -> bool:
        """Whether a beat costs more."""
        arcsec = found.worst_arcsec_per_deg_s
        return (
            arcsec is not None and arcsec * self.turn_deg_s > self.arcsec
        ) or found.worst_mag > self.mag


def exposures_of(config: BenchConfig, refresh_hz: float | None = None) -> Exposures:
    """The exposures of a bench, with its screen's nominal refresh rate or a measured one. Raises
    InputError.
    """
    monitor = config.monitor
    tracker = config.tracker
    if monitor.hold_ms is None:
        lit_s = None
    else:
        lit_s = monitor.hold_ms * NS_PER_MS / NS_PER_S
    if refresh_hz is None:
        hz = monitor.refresh_hz
    else:
        hz = refresh_hz
    return Exposures(hz, tracker.exposure_s, tracker.frame_hz, lit_s, tracker.trigger == "external")


def beat_of(
    config: BenchConfig, refresh_hz: float | None = None, modes_hz: Sequence[float] = ()
) -> BeatSummary:
    """The beat of a bench, and what to write instead where it costs too much. Raises InputError.

    `refresh_hz` is that of the display where it was measured, `modes_hz` are those that the display
    has.
    """
    exposures = exposures_of(config, refresh_hz)
    render = config.render
    pixel_arcsec = (
        config.monitor.pixel_pitch_um
        * MM_PER_UM
        / config.collimator.focal_length_mm
        * ARCSEC_PER_RAD
    )
    tolerance = Tolerance(
        config.sync.turn_deg_s, render.tolerance_px * pixel_arcsec, render.tolerance_mag
    )
    frame_beat = beat(exposures)
    matters = tolerance.is_broken_by(frame_beat)
    arcsec = frame_beat.worst_arcsec_per_deg_s
    return BeatSummary(
        refresh_hz=exposures.refresh_hz,
        exposure_s=exposures.exposure_s,
        refreshes_per_exposure=frame_beat.refreshes_per_exposure,
        period_s=frame_beat.period_s,
        worst_arcsec=None if arcsec is None else arcsec * tolerance.turn_deg_s,
        worst_mag=frame_beat.worst_mag if math.isfinite(frame_beat.worst_mag) else None,
        turn_deg_s=tolerance.turn_deg_s,
        tolerance_arcsec=tolerance.arcsec,
        tolerance_mag=tolerance.mag,
        matters=matters,
        proposal=propose(exposures, tolerance, modes_hz) if matters else None,
    )


def propose(
    exposures: Exposures, tolerance: Tolerance, modes_hz: Sequence[float] = ()
) -> BeatProposal:
    """The nearest refresh rate, exposure and rate of the tracker that keep the beat within a
    tolerance, each alone.

    With `modes_hz` the refresh rate is the nearest of those.
    """
    whole = max(round(exposures.refreshes), 1)
    rates_hz = [hz for hz in modes_hz if hz > 0] or [whole / exposures.exposure_s]
    low_hz = max(MIN_REFRESH_HZ, exposures.refresh_hz / MAX_CHANGE)
    high_hz = min(MAX_REFRESH_HZ, exposures.refresh_hz * MAX_CHANGE)
    near_hz = sorted(
        (hz for hz in rates_hz if low_hz <= hz <= high_hz),
        key=lambda hz: abs(hz - exposures.refresh_hz),
    )
    refresh = [
        hz for hz in near_hz if not tolerance.is_broken_by(beat(replace(exposures, refresh_hz=hz)))
    ]
    # So many refreshes, or as many fewer as the tracker's frames have room for.
    if exposures.frame_hz is not None:
        whole = min(whole, math.floor(exposures.refresh_hz / exposures.frame_hz + NO_BEAT))
    if whole:
        exposure_s = whole / exposures.refresh_hz
    else:
        exposure_s = None
    cured = exposure_s is not None and not tolerance.is_broken_by(
        beat(replace(exposures, exposure_s=exposure_s))
    )
    # The nearest rate of exposures that begins each at one phase.
    parts = max(
        round(exposures.refresh_hz / exposures.every_hz),
        math.ceil(exposures.refreshes - NO_BEAT),
        1,
    )
    return BeatProposal(
        refresh_hz=refresh[0] if refresh else None,
        exposure_s=exposure_s if cured else None,
        frame_hz=None if cured else exposures.refresh_hz / parts,
    )


def beat_line(found: BeatSummary) -> str | None:
    """The beat for a person, with what to write instead; None where it does not matter."""
    if not found.matters:
        return None
    costs = []
    if found.worst_arcsec is not None:
        arcsec = (
            f"{found.worst_arcsec:.2g}"
            if found.worst_arcsec < FEW_ARCSEC
            else f"{found.worst_arcsec:.0f}"
        )
        costs.append(f"{arcsec} arcsec at {found.turn_deg_s:g} deg/s")
    if found.worst_mag is None:
        costs.append("all of its light")
    elif found.worst_mag > found.tolerance_mag:
        costs.append(f"{found.worst_mag:.2g} mag")
    how = (
        "in every exposure alike until the clocks drift"
        if found.period_s is None
        else f"in a beat of {found.period_s:.3g} s"
    )
    subject = (
        f"exposures of {found.exposure_s:g} s are {found.refreshes_per_exposure:.4g} refreshes of"
        f" {found.refresh_hz:.6g} Hz"
    )
    proposal, ways = found.proposal or BeatProposal(), []
    if proposal.refresh_hz is not None:
        ways.append(f"[monitor] refresh_hz = {proposal.refresh_hz:.6g}")
    if proposal.exposure_s is not None:
        ways.append(f"[tracker] exposure_s = {proposal.exposure_s:.6g}")
    if ways:
        cure = f"without a beat: {' or '.join(ways)}"
    else:
        cure = "no rate is without it: trigger the tracker ([sync] port, [tracker] trigger)"
        if proposal.frame_hz is not None:
            cure += f"; at [tracker] frame_hz = {proposal.frame_hz:.6g} its phase stands still"
    return f"{subject}: a star is off by up to {' and '.join(costs)}, {how}; {cure}"
