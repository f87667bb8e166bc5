"""The run's counts as OpenMetrics, for a lab's monitoring."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector

from hilstar.console.feed.messages import RunSeen
from hilstar.console.server.reader import Reader
from hilstar.units import NS_PER_S

CONTENT_TYPE = CONTENT_TYPE_LATEST


class RunCollector(Collector):
    """Makes the metrics of a run when they are asked for."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self.clients = 0

    def collect(self) -> Iterator[Metric]:
        """Each metric with its value now."""
        hello, seen = self._reader.hello(), self._reader.seen or RunSeen(host_ns=0)
        told = {key: str(hello[key]) for key in ("version", "command", "bench", "renderer")}
        yield InfoMetricFamily("hilstar_run", "What runs.", value=told)
        yield _gauge("hilstar_healthy", "1 while the sky is right, as GET /health has it.", float(self._reader.health.ok))
        yield _gauge("hilstar_health_since_timestamp_seconds", "Since when that is so.", self._reader.health.since_s)
        yield _counter("hilstar_frames", "Frames shown.", seen.frames)
        yield _counter("hilstar_frames_missed", "Refresh periods without a frame of their own.", seen.missed)
        yield _counter("hilstar_frames_stale", "Frames shown with a stale attitude.", seen.stale_frames)
        yield _counter("hilstar_frames_given_up", "Frames given up because their moment had passed.", seen.given_up)
        yield _counter("hilstar_packets_received", "Attitude packets received.", seen.received)
        refused = CounterMetricFamily("hilstar_packets_refused", "Attitude packets refused.", labels=["reason"])
        for reason, count in seen.refused.items():
            refused.add_metric([reason], count)
        yield refused
        yield from self._of_attitude(seen)
        yield from self._of_rest(seen)

    def _of_attitude(self, seen: RunSeen) -> Iterator[Metric]:
        yield _gauge("hilstar_attitude_missing", "1 until an attitude has come.", float(seen.missing))
        yield _gauge("hilstar_attitude_stale", "1 while the attitude is stale.", float(seen.stale))
        if seen.attitude is not None:
            yield _gauge(
                "hilstar_attitude_age_seconds", "Age of the attitude of the newest frame.", seen.attitude.age_ns / NS_PER_S
            )
        clock = seen.clock
        if clock is None:
            return
        for name, words, value, scale in (
            ("offset_seconds", "Host time minus the sender's.", clock.offset_ms, 1e-3),
            ("uncertainty_seconds", "Of the offset.", clock.uncertainty_ms, 1e-3),
            ("drift_ratio", "How much faster the sender's clock runs.", clock.drift_ppm, 1e-6),
        ):
            if value is not None:
                yield _gauge(f"hilstar_clock_{name}", words, value * scale)

    def _of_rest(self, seen: RunSeen) -> Iterator[Metric]:
        yield _gauge("hilstar_stars", "Stars in the newest frame.", seen.stars)
        yield _gauge("hilstar_stars_clipped", "Those brighter than the monitor's white.", len(seen.clipped))
        yield _gauge("hilstar_display_lost", "1 where the display has gone.", float(bool(seen.display_lost)))
        yield _gauge("hilstar_operator_override", "1 while an operator changes the sky.", float(bool(seen.operator_text)))
        if seen.ledger is not None:
            yield _gauge("hilstar_ledger_bytes", "Size of the ledger.", seen.ledger.bytes)
            yield _gauge("hilstar_ledger_failing", "1 while it cannot be written.", float(bool(seen.ledger.failing)))
        pacing = self._reader.pacing
        if pacing is not None:
            intervals = GaugeMetricFamily(
                "hilstar_frame_interval_seconds", "Between frames, over the last minute.", labels=["quantile"]
            )
            for quantile, key in (("0.5", "p50_ms"), ("0.99", "p99_ms")):
                intervals.add_metric([quantile], pacing[key] * 1e-3)
            yield intervals
            yield _gauge("hilstar_frame_interval_sd_seconds", "Standard deviation of it.", pacing["sd_ms"] * 1e-3)
        yield _gauge("hilstar_console_clients", "Pages that are open.", self.clients)


def _gauge(name: str, words: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, words, value=value)


def _counter(name: str, words: str, value: float) -> CounterMetricFamily:
    return CounterMetricFamily(name, words, value=value)


class Metrics:
    """The registry with a run in it."""

    def __init__(self, reader: Reader) -> None:
        self.collector = RunCollector(reader)
        self._registry = CollectorRegistry()
        self._registry.register(self.collector)

    def text(self) -> bytes:
        """The answer of `GET /metrics`."""
        return bytes(generate_latest(self._registry))  # type: ignore[no-untyped-call]
