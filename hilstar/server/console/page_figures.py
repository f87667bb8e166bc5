"""The table of the figures on the operator's page: name, unit, digits and source of each.

A new figure is a row of FIGURES. Its key is its path in the page's state, as `counts.missed`; a
key of `counts` is also a field of RunCounts, and its row has the function that reads it from the
run. The counts that a run publishes (`counts_of`), the metrics of `GET /metrics` (`metrics_of`) and
the lines of the page's panels (`page/protocol.js`, made by tools/make_page_protocol.py) follow from
the rows.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from hilstar.attitude.wire.packet import Reason

if TYPE_CHECKING:
    from hilstar.attitude.receiver import PacketCounts
    from hilstar.server.summary import RunTally

# The panels of the page; a HIDDEN figure is only in the state and the metrics, or drawn elsewhere.
Panel = Literal["pointing", "source", "run", "tracker", ""]
HIDDEN: Panel = ""
# How the page writes a value, by the function of that name in page/figures.js: a number with its
# unit, a share as percent, signed numbers, a text, or a text without the advice after its colon.
Form = Literal[
    "number", "share", "signed", "text", "clause", "clock", "clipped", "ledger", "reasons"
]
COUNTS = "counts."
DEGREE, DOUBLE_PRIME = "\N{DEGREE SIGN}", "\N{DOUBLE PRIME}"
PLUS_MINUS, NONE = "\N{PLUS-MINUS SIGN}", "\N{EN DASH}"


class RunCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of frames and packets since the run began. `refused` is by reason; `lost` counts
    packets that gaps in their `sequence` show.
    """

    frames: int = 0
    missed: int = 0
    stale: int = 0
    given_up: int = 0
    received: int = 0
    accepted: int = 0
    lost: int = 0
    refused: dict[str, int] = {}


class FigureMetric(NamedTuple):
    """A metric of `GET /metrics`; its name lacks `hilstar_`, and its value is `scale` times the
    figure's.
    """

    name: str
    help: str
    kind: Literal["counter", "gauge"] = "gauge"
    scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PageFigure:
    """A figure of the page. `text` is the format of its line: {} is its value, {KEY} and {KEY UNIT}
    the value of another key.

    `none` is the text where there is no value. A figure above zero, or not empty, is drawn in the
    colour of `shade`. `source` reads a figure of RunCounts from the run.
    """

    panel: Panel
    name: str
    key: str
    unit: str = ""
    digits: int = 0
    source: "Callable[[RunTally, PacketCounts], int | dict[str, int]] | None" = None
    form: Form = "number"
    text: str = "{}"
    none: str = NONE
    shade: Literal["", "warn", "bad"] = ""
    metric: FigureMetric | None = None


FIGURES = (
    PageFigure(
        panel="pointing",
        name="Rate x, y, z",
        key="attitude.rate_deg_s",
        unit=f"{DEGREE}/s",
        digits=3,
        form="signed",
    ),
    PageFigure(panel="pointing", name="Quaternion", key="attitude.q", digits=5, form="signed"),
    PageFigure(panel="source", name="First attitude", key="pointing", form="clause"),
    PageFigure(
        panel="source",
        name="Age at light",
        key="attitude.age_ms",
        unit="ms",
        digits=1,
        metric=FigureMetric(
            "attitude_age_seconds", "Age of the attitude of the newest frame.", scale=1e-3
        ),
    ),
    PageFigure(
        panel="source", name="Source", key="source.kind", form="text", text="{}  {source.endpoint}"
    ),
    PageFigure(
        panel="source",
        name="Clock offset",
        key="clock.offset_ms",
        unit="ms",
        digits=3,
        text=f"{{}} {PLUS_MINUS} {{clock.sigma_ms}}",
        metric=FigureMetric("clock_offset_seconds", "Host time minus the sender's.", scale=1e-3),
    ),
    PageFigure(
        panel=HIDDEN,
        name="Uncertainty of the clock",
        key="clock.sigma_ms",
        metric=FigureMetric("clock_uncertainty_seconds", "Of the offset.", scale=1e-3),
    ),
    PageFigure(
        panel="source",
        name="Clock drift",
        key="clock.drift_ppm",
        unit="ppm",
        digits=2,
        metric=FigureMetric(
            "clock_drift_ratio", "How much faster the sender's clock runs.", scale=1e-6
        ),
    ),
    PageFigure(panel="source", name="Clock from", key="clock.synchronised", form="clock"),
    PageFigure(
        panel="run",
        name="Frames",
        key="counts.frames",
        source=lambda tally, packets: tally.frames,
        metric=FigureMetric("frames", "Frames shown.", "counter"),
    ),
    PageFigure(
        panel="run",
        name="Missed",
        key="counts.missed",
        source=lambda tally, packets: tally.missed_frames,
        shade="warn",
        metric=FigureMetric(
            "frames_missed", "Refresh periods without a frame of their own.", "counter"
        ),
    ),
    PageFigure(
        panel="run",
        name="Stale",
        key="counts.stale",
        source=lambda tally, packets: tally.stale_frames,
        shade="warn",
        metric=FigureMetric("frames_stale", "Frames shown with a stale attitude.", "counter"),
    ),
    PageFigure(
        panel="run",
        name="Given up",
        key="counts.given_up",
        source=lambda tally, packets: tally.given_up_frames,
        shade="warn",
        metric=FigureMetric(
            "frames_given_up", "Frames given up because their moment had passed.", "counter"
        ),
    ),
    PageFigure(
        panel=HIDDEN,
        name="Packets received",
        key="counts.received",
        source=lambda tally, packets: packets.received,
        metric=FigureMetric("packets_received", "Attitude packets received.", "counter"),
    ),
    PageFigure(
        panel="run",
        name="Packets",
        key="counts.accepted",
        source=lambda tally, packets: packets.received - packets.refused,
        text="{} of {counts.received} accepted",
    ),
    PageFigure(
        panel="run",
        name="Lost",
        key="counts.lost",
        source=lambda tally, packets: packets.lost,
        shade="warn",
        metric=FigureMetric(
            "packets_lost",
            "Attitude packets that never came, by gaps of their sequence.",
            "counter",
        ),
    ),
    PageFigure(
        panel=HIDDEN,
        name="Packets refused",
        key="counts.refused",
        source=lambda tally, packets: _some(packets.refused_by),
        form="reasons",
    ),
    PageFigure(
        panel=HIDDEN,
        name="Wrong sky",
        key="wrong_sky_s",
        metric=FigureMetric(
            "wrong_sky_seconds", "Seconds in which the sky shown was wrong.", "counter"
        ),
    ),
    PageFigure(
        panel="run",
        name="Interval p50, p99",
        key="pacing.p50_ms",
        unit="ms",
        digits=2,
        text="{}, {pacing.p99_ms}",
    ),
    PageFigure(
        panel="run",
        name="Jitter (sd)",
        key="pacing.sd_ms",
        unit="ms",
        digits=3,
        metric=FigureMetric("frame_interval_sd_seconds", "Standard deviation of it.", scale=1e-3),
    ),
    PageFigure(
        panel="run",
        name="Stars drawn",
        key="frame.stars",
        metric=FigureMetric("stars", "Stars in the newest frame."),
    ),
    PageFigure(
        panel="run",
        name="Clipped",
        key="frame.clipped",
        form="clipped",
        none="none",
        shade="warn",
        metric=FigureMetric("stars_clipped", "Those brighter than the monitor's white."),
    ),
    PageFigure(panel="run", name="Ledger", key="ledger", form="ledger"),
    PageFigure(
        panel=HIDDEN,
        name="Size of the ledger",
        key="ledger.bytes",
        metric=FigureMetric("ledger_bytes", "Size of the ledger."),
    ),
    PageFigure(
        panel="tracker",
        name="Mean, last minute",
        key="tracker.mean_arcsec",
        unit=DOUBLE_PRIME,
        digits=1,
        form="signed",
    ),
    PageFigure(
        panel="tracker",
        name="Rms",
        key="tracker.rms_arcsec",
        unit=DOUBLE_PRIME,
        digits=1,
        form="signed",
    ),
    PageFigure(
        panel="tracker",
        name="3 sigma",
        key="tracker.sigma3_arcsec",
        unit=DOUBLE_PRIME,
        digits=1,
        form="signed",
    ),
    PageFigure(
        panel="tracker",
        name="Availability",
        key="tracker.availability",
        unit="%",
        digits=1,
        form="share",
        text="{} at {tracker.rate_hz Hz}",
        metric=FigureMetric(
            "tracker_availability_ratio", "Right answers of the last minute over those due."
        ),
    ),
    PageFigure(
        panel="tracker",
        name="Latency",
        key="tracker.latency_ms",
        unit="ms",
        digits=1,
        text=f"{{}} {PLUS_MINUS} {{tracker.latency_sigma_ms}}",
        metric=FigureMetric(
            "tracker_latency_seconds", "From the exposure's middle to the answer.", scale=1e-3
        ),
    ),
    PageFigure(
        panel=HIDDEN,
        name="Age of the newest answer",
        key="tracker.age_s",
        metric=FigureMetric("tracker_answer_age_seconds", "Since the newest answer."),
    ),
    PageFigure(panel="tracker", name="Mode", key="tracker.mode", form="text"),
    PageFigure(panel="tracker", name="Stars", key="tracker.stars"),
    PageFigure(
        panel="tracker",
        name="Answers",
        key="tracker.answers",
        text="{}, {tracker.invalid} without attitude",
    ),
    PageFigure(panel="tracker", name="Wrong", key="tracker.wrong", shade="bad"),
    PageFigure(
        panel="tracker",
        name="Refused",
        key="tracker.refused",
        form="reasons",
        none="none",
        shade="warn",
    ),
    PageFigure(
        panel="tracker",
        name="Out of order",
        key="tracker.out_of_order",
        shade="warn",
        metric=FigureMetric(
            "tracker_out_of_order", "Answers whose stamp is before an earlier answer's.", "counter"
        ),
    ),
    PageFigure(
        panel="tracker",
        name="Line",
        key="tracker.trouble",
        form="text",
        none="in order",
        shade="warn",
    ),
)


def _some(counts: Mapping[Reason, int]) -> dict[str, int]:
    return {reason: count for reason, count in counts.items() if count}


def counts_of(tally: "RunTally", packets: "PacketCounts") -> RunCounts:
    """The counts of a run's frames and packets, each read by the source of its row."""
    counts: dict[str, Any] = {}
    for figure in FIGURES:
        if figure.source is not None:
            counts[figure.key.removeprefix(COUNTS)] = figure.source(tally, packets)
    return RunCounts(**counts)


def value_of(state: object, key: str) -> Any:
    """The value at the path `key` (as "counts.missed") in the page's state; None if a part of the
    path is None.
    """
    value: Any = state
    for name in key.split("."):
        if value is None:
            return None
        value = getattr(value, name)
    return value


def metrics_of(state: object) -> Iterator[tuple[FigureMetric, float]]:
    """The metrics and their values, of all figures that have both; the value of a list is its
    length.
    """
    for figure in FIGURES:
        value = value_of(state, figure.key)
        if figure.metric is None or value is None:
            continue
        if isinstance(value, list):
            value = len(value)
        yield figure.metric, value * figure.metric.scale
