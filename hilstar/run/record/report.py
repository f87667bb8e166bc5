"""The figures of a run's report: timing, age, missed frames, packets and events, from its ledger."""

from __future__ import annotations

from pathlib import Path

import msgspec

from hilstar.errors import InputError
from hilstar.run.record.ledger_reader import NO_FRAMES, config_of, read_head, run_records
from hilstar.run.record.report_figures import Figures
from hilstar.running_statistics import Percentiles


def figures_of(path: Path) -> Figures:
    """Read a ledger. Raises InputError for a file that is no ledger, has no frame, or is damaged."""
    figures = Figures(read_head(path))
    for record in run_records(path):
        figures.add(record)
    if not figures.frames:
        raise InputError(f"{path}: {NO_FRAMES}")
    return figures


class RunReport(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a run: the JSON object of `hilstar report`. Times in ms, but for `duration_s`."""

    frames: int
    duration_s: float
    missed_frames: int
    stale_frames: int
    blank_frames: int
    operator_frames: int
    hidden_frames: int
    capped_frames: int
    timestamp_source: str
    refresh_hz: float | None
    pacing_jitter_ms: float | None
    interval_ms: Percentiles
    swap_late_ms: Percentiles
    draw_to_swap_ms: Percentiles
    attitude_age_ms: Percentiles
    attitude_age_frames: Percentiles | None
    prediction_ms: Percentiles
    packet_to_swap_ms: Percentiles
    packets: dict[str, int]
    events: dict[str, int]
    pulses: dict[str, int]
    right_frames: int = 0  # on the screen, with a fresh attitude, not changed by the operator
    clipped: int
    below_step: int
    stars_drawn: int
    memory_growth_mb: float | None
    bench_sha256: str | None
    calibration: str | None
    calibration_sha256: str | None
    gl_renderer: str | None
    gl_version: str | None
    render_path: str | None


def summarise(run: Figures) -> RunReport:
    """The figures of a run, from those of its frames."""
    config, last, spreads = config_of(run.head), run.last, run.spreads
    refresh_hz = None if config is None else config.monitor.refresh_hz
    age_ms = spreads["age"].percentiles()
    return RunReport(
        frames=run.frames,
        duration_s=run.duration_s,
        missed_frames=0 if last is None else last.missed,
        stale_frames=run.stale,
        right_frames=run.right,
        blank_frames=run.blank,
        operator_frames=run.operator,
        hidden_frames=run.hidden,
        capped_frames=run.capped,
        timestamp_source="" if last is None else last.timestamp_source,
        refresh_hz=refresh_hz,
        pacing_jitter_ms=spreads["interval"].deviation,
        interval_ms=spreads["interval"].percentiles(),
        swap_late_ms=spreads["late"].percentiles(),
        draw_to_swap_ms=spreads["draw"].percentiles(),
        attitude_age_ms=age_ms,
        attitude_age_frames=None if refresh_hz is None else age_ms.times(refresh_hz / 1e3),
        prediction_ms=spreads["prediction"].percentiles(),
        packet_to_swap_ms=spreads["packet"].percentiles(),
        packets=run.packets.counts,
        events=run.events,
        pulses=run.pulses,
        **run.most,
        memory_growth_mb=run.memory_growth_mb,
        bench_sha256=run.head.get("bench_sha256"),
        calibration=run.head.get("calibration"),
        calibration_sha256=run.head.get("calibration_sha256"),
        gl_renderer=run.head.get("gl_renderer"),
        gl_version=run.head.get("gl_version"),
        render_path=run.head.get("render_path"),
    )


def pulses_line(pulses: dict[str, int]) -> str:
    """The pulses of a run for a person."""
    if not pulses:
        return "none"
    lost = f", the line lost {pulses['lost']} times" if pulses["lost"] else ""
    return f"{pulses['sent']} at their frames, {pulses['skipped']} skipped{lost}"


def table_rows(found: RunReport) -> list[tuple[str, str]]:
    """The figures as rows of text: name and value."""
    refused = sum(count for reason, count in found.packets.items() if reason != "accepted")

    def three(figure: Percentiles | None, unit: str = "ms") -> str:
        values = (None, None, None) if figure is None else (figure.p50, figure.p99, figure.max)
        return " / ".join("-" if v is None else f"{v:.2f}" for v in values) + f" {unit} (p50 / p99 / max)"

    def number(value: float | None, unit: str) -> str:
        return "-" if value is None else f"{value:.2f} {unit}"

    frames = f"{found.frames} in {found.duration_s:.1f} s, {found.missed_frames} missed"
    return [
        ("frames", f"{frames}, {found.stale_frames} stale, {found.blank_frames} blank"),
        ("not the plain sky", f"{found.operator_frames} by an operator's keys, {found.hidden_frames} hidden"),
        ("coarser paths", f"{found.capped_frames} frames, because the turn was too fast"),
        ("time stamps", f"{found.timestamp_source}; the bench file's refresh rate is {number(found.refresh_hz, 'Hz')}"),
        ("pacing jitter", f"{number(found.pacing_jitter_ms, 'ms')} (standard deviation of the interval between swaps)"),
        ("interval", three(found.interval_ms)),
        ("swap later than predicted", three(found.swap_late_ms)),
        ("start of drawing to swap", three(found.draw_to_swap_ms)),
        ("age of the attitude at light", f"{three(found.attitude_age_ms)} = {three(found.attitude_age_frames, 'frames')}"),
        ("predicted past the last packet", three(found.prediction_ms)),
        ("packet to swap", three(found.packet_to_swap_ms)),
        ("packets", f"{found.packets.get('accepted', 0)} accepted, {refused} refused"),
        ("events", ", ".join(f"{kind} {count}" for kind, count in found.events.items()) or "none"),
        ("pulses", pulses_line(found.pulses)),
        ("stars", f"at most {found.stars_drawn} drawn, {found.clipped} clipped, {found.below_step} too faint"),
        ("memory after the first minute", number(found.memory_growth_mb, "MB more at the end")),
        ("bench file", f"SHA-256 {found.bench_sha256}"),
        ("calibration", f"{found.calibration}, SHA-256 {found.calibration_sha256}"),
        ("renderer", f"{found.gl_renderer}, OpenGL {found.gl_version or '-'}; levels by {found.render_path or '-'}"),
    ]
