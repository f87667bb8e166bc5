"""Whether a bench's exposures beat with its screen by more than the bench tolerates, and the nearest rate that does not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec

from hilstar.bench.config import BenchConfig
from hilstar.run.sync.beat import NO_BEAT, Beat, Exposures, beat
from hilstar.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S

MIN_REFRESH_HZ, MAX_REFRESH_HZ = 0.01, 1000.0  # as [monitor] refresh_hz
MAX_CHANGE = 2.0  # a refresh rate farther off than this factor is no proposal
MM_PER_UM = 1e-3
FEW_ARCSEC = 99.5  # from there on, two digits would be written with an exponent


class Proposal(msgspec.Struct, frozen=True, kw_only=True):
    """The nearest settings without a beat, each to be changed alone; None where there is none.

    `frame_hz`, for a panel that flashes, is the nearest rate of the tracker at which its phase stands.
    """

    refresh_hz: float | None = None
    exposure_s: float | None = None
    frame_hz: float | None = None


class BeatSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What a bench's beat costs, in JSON: the figures of `Beat`, and at the bench's own rate of turn.

    `matters` says whether that is over `[render] tolerance_px` or `tolerance_mag`; then there is a `proposal`.
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
    proposal: Proposal | None


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What a beat may cost: in a turn at a rate, deg/s, of a star's place, arcsec, and of its light, mag."""

    turn_deg_s: float
    arcsec: float
    mag: float

    def is_broken_by(self, found: Beat) -> bool:
        """Whether a beat costs more."""
        arcsec = found.worst_arcsec_per_deg_s
        return (arcsec is not None and arcsec * self.turn_deg_s > self.arcsec) or found.worst_mag > self.mag


def exposures_of(config: BenchConfig, refresh_hz: float | None = None) -> Exposures:
    """The exposures of a bench, before a screen of its own refresh rate or of one that was measured. Raises InputError."""
    monitor, tracker = config.monitor, config.tracker
    lit_s = None if monitor.hold_ms is None else monitor.hold_ms * NS_PER_MS / NS_PER_S
    hz = monitor.refresh_hz if refresh_hz is None else refresh_hz
    return Exposures(hz, tracker.exposure_s, tracker.frame_hz, lit_s, tracker.trigger == "external")


def tolerance_of(config: BenchConfig) -> Tolerance:
    """What a bench tolerates, its pixels as angles."""
    pixel_arcsec = config.monitor.pixel_pitch_um * MM_PER_UM / config.collimator.focal_length_mm * ARCSEC_PER_RAD
    return Tolerance(config.sync.turn_deg_s, config.render.tolerance_px * pixel_arcsec, config.render.tolerance_mag)


def beat_of(config: BenchConfig, refresh_hz: float | None = None, modes_hz: Sequence[float] = ()) -> BeatSummary:
    """The beat of a bench, and what to write instead where it costs too much. Raises InputError.

    `refresh_hz` is that of the display where it was measured, `modes_hz` are those that the display has.
    """
    exposures, tolerance = exposures_of(config, refresh_hz), tolerance_of(config)
    found = beat(exposures)
    matters = tolerance.is_broken_by(found)
    arcsec = found.worst_arcsec_per_deg_s
    return BeatSummary(
        refresh_hz=exposures.refresh_hz,
        exposure_s=exposures.exposure_s,
        refreshes_per_exposure=found.refreshes_per_exposure,
        period_s=found.period_s,
        worst_arcsec=None if arcsec is None else arcsec * tolerance.turn_deg_s,
        worst_mag=found.worst_mag if math.isfinite(found.worst_mag) else None,
        turn_deg_s=tolerance.turn_deg_s,
        tolerance_arcsec=tolerance.arcsec,
        tolerance_mag=tolerance.mag,
        matters=matters,
        proposal=propose(exposures, tolerance, modes_hz) if matters else None,
    )


def propose(exposures: Exposures, tolerance: Tolerance, modes_hz: Sequence[float] = ()) -> Proposal:
    """The nearest refresh rate, exposure and rate of the tracker that keep the beat within a tolerance, each alone.

    With `modes_hz` the refresh rate is the nearest of those.
    """
    whole = max(round(exposures.refreshes), 1)
    rates_hz = [hz for hz in modes_hz if hz > 0] or [whole / exposures.exposure_s]
    refresh = [hz for hz in sorted(rates_hz, key=lambda hz: abs(hz - exposures.refresh_hz)) if _is_near(hz, exposures)]
    refresh = [hz for hz in refresh if not tolerance.is_broken_by(beat(replace(exposures, refresh_hz=hz)))]
    exposure_s = _longest_whole(exposures, whole)
    cured = exposure_s is not None and not tolerance.is_broken_by(beat(replace(exposures, exposure_s=exposure_s)))
    return Proposal(
        refresh_hz=refresh[0] if refresh else None,
        exposure_s=exposure_s if cured else None,
        frame_hz=None if cured else _standing_hz(exposures),
    )


def _is_near(hz: float, exposures: Exposures) -> bool:
    ratio = hz / exposures.refresh_hz
    return MIN_REFRESH_HZ <= hz <= MAX_REFRESH_HZ and 1 / MAX_CHANGE <= ratio <= MAX_CHANGE


def _longest_whole(exposures: Exposures, whole: int) -> float | None:
    """So many refreshes, or as many fewer as the tracker's frames have room for; None where they have not room for one."""
    if exposures.frame_hz is not None:
        whole = min(whole, math.floor(exposures.refresh_hz / exposures.frame_hz + NO_BEAT))
    return whole / exposures.refresh_hz if whole else None


def _standing_hz(exposures: Exposures) -> float | None:
    """The nearest rate of exposures that begins each at one phase; None where the exposures are longer."""
    frame_hz = 1 / exposures.exposure_s if exposures.frame_hz is None else exposures.frame_hz
    parts = max(round(exposures.refresh_hz / frame_hz), math.ceil(exposures.refreshes - NO_BEAT), 1)
    return exposures.refresh_hz / parts


def beat_line(found: BeatSummary) -> str | None:
    """The beat for a person, with what to write instead; None where it does not matter."""
    if not found.matters:
        return None
    costs = []
    if found.worst_arcsec is not None:
        arcsec = f"{found.worst_arcsec:.2g}" if found.worst_arcsec < FEW_ARCSEC else f"{found.worst_arcsec:.0f}"
        costs.append(f"{arcsec} arcsec at {found.turn_deg_s:g} deg/s")
    if found.worst_mag is None:
        costs.append("all of its light")
    elif found.worst_mag > found.tolerance_mag:
        costs.append(f"{found.worst_mag:.2g} mag")
    how = "in every exposure alike until the clocks drift" if found.period_s is None else f"in a beat of {found.period_s:.3g} s"
    subject = (
        f"exposures of {found.exposure_s:g} s are {found.refreshes_per_exposure:.4g} refreshes of {found.refresh_hz:.6g} Hz"
    )
    return f"{subject}: a star is off by up to {' and '.join(costs)}, {how}; {_cure(found.proposal or Proposal())}"


def _cure(proposal: Proposal) -> str:
    ways = []
    if proposal.refresh_hz is not None:
        ways.append(f"[monitor] refresh_hz = {proposal.refresh_hz:.6g}")
    if proposal.exposure_s is not None:
        ways.append(f"[tracker] exposure_s = {proposal.exposure_s:.6g}")
    if ways:
        return f"without a beat: {' or '.join(ways)}"
    stands = "" if proposal.frame_hz is None else f"; at [tracker] frame_hz = {proposal.frame_hz:.6g} its phase stands still"
    return f"no rate is without it: trigger the tracker ([sync] port, [tracker] trigger){stands}"
