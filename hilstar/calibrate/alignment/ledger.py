"""The attitude that a run showed, at the moments of a tracker's telemetry."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.alignment.pairs import COMMANDED, Pairs, Telemetry
from hilstar.errors import InputError
from hilstar.rotation import conjugate, from_rotation_vectors, multiply, normalise, to_rotation_vector
from hilstar.run.record.ledger_reader import NO_FRAMES, frame_records
from hilstar.units import NS_PER_S

MAX_GAP_S = 0.5  # between two frames: beyond it nothing says what was shown, unless both show one attitude
MAX_STEP_RAD = np.radians(2.0)  # between two frames: more is a jump
SAME_RAD = 1e-9


def pair_with_ledger(telemetry_path: Path, telemetry: Telemetry, ledger: Path, offset_s: float) -> Pairs:
    """Pair each row of telemetry with what the run showed at its time plus `offset_s`, between the moments of light.

    A ledger's `light_ns` is on the sender's clock, when the middle row lights; the frames are drawn along the turn, so between
    two of them the attitude is the one in between. Rows before, after or within a gap or a jump of the frames are skipped.
    Raises InputError where no row is left.
    """
    light_ns, shown = _shown(ledger)
    at_ns = telemetry.t_ns + round(offset_s * NS_PER_S)
    before = np.clip(np.searchsorted(light_ns, at_ns, side="right") - 1, 0, len(light_ns) - 2)
    gap_s = (light_ns[before + 1] - light_ns[before]) / NS_PER_S
    step = to_rotation_vector(multiply(shown[before + 1], conjugate(shown[before])))
    turned = np.linalg.norm(step, axis=1)
    inside = (at_ns >= light_ns[before]) & (at_ns <= light_ns[before + 1]) & np.isfinite(turned)
    usable = inside & (((gap_s <= MAX_GAP_S) & (turned <= MAX_STEP_RAD)) | (turned <= SAME_RAD))
    if not usable.any():
        raise InputError(_no_overlap(telemetry_path, at_ns, ledger, light_ns))
    before, gap_s, step = before[usable], gap_s[usable], step[usable]
    share = (at_ns[usable] - light_ns[before]) / NS_PER_S / gap_s
    commanded = normalise(multiply(from_rotation_vectors(step * share[:, None]), shown[before]))
    rate = -step / gap_s[:, None]  # v_cam' = -omega x v_cam
    return Pairs(
        source=telemetry_path,
        line=telemetry.line[usable],
        commanded=commanded,
        reported=telemetry.reported[usable],
        skipped=telemetry.skipped + int((~usable).sum()),
        rate_rad_s=rate,
        names=COMMANDED,
    )


def _shown(ledger: Path) -> tuple[IntArray, FloatArray]:
    """Moments of light (n,), rising, and attitudes (n, 4), NaN where the sky was not shown as commanded."""
    found: dict[int, tuple[float, ...]] = {}
    nothing = (np.nan,) * 4
    for record in frame_records(ledger):
        bare = record.q is None or record.operator or record.hidden
        found[record.light_ns] = nothing if bare or record.q is None else record.q
    if len(found) < 2:
        raise InputError(f"{ledger}: {NO_FRAMES if not found else 'has one frame; give the ledger of a longer run'}")
    light_ns = np.array(sorted(found), dtype=np.int64)
    return light_ns, np.array([found[int(t)] for t in light_ns])


def _no_overlap(telemetry: Path, at_ns: IntArray, ledger: Path, light_ns: IntArray) -> str:
    if not len(at_ns):
        return f"{telemetry}: has no valid row; give telemetry of the time of the run"
    spans = [f"{t[0] / NS_PER_S:.3f} to {t[-1] / NS_PER_S:.3f} s" for t in (np.sort(at_ns), light_ns)]
    return (
        f"{telemetry}: its times, {spans[0]}, meet no frame of {ledger}, lit from {spans[1]} on the sender's clock; write t_s"
        " on that clock, or add --offset-s"
    )
