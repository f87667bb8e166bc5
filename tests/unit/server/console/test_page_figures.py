"""The table of the page's figures: every row leads to a value, to a line of the page and to a
metric.
"""

from __future__ import annotations

import re
import types
import typing

import msgspec
import pytest

from hilstar.attitude.receiver import PacketCounts
from hilstar.server.console.page_figures import (
    COUNTS,
    FIGURES,
    HIDDEN,
    PageFigure,
    RunCounts,
    counts_of,
    metrics_of,
    value_of,
)
from hilstar.server.console.protocol import (
    AttitudeSource,
    LedgerState,
    PageState,
    ShownClock,
    SkyHealth,
)
from hilstar.server.console.report import PAGE_DIR
from hilstar.server.summary import RunTally

SCRIPT = (PAGE_DIR / "figures.js").read_text(encoding="utf-8")
OTHER_KEYS = re.compile(r"\{([\w.]+)(?: [^}]+)?\}")


def run_counts() -> RunCounts:
    """The counts of a run of 600 frames and 90 packets."""
    tally, packets = RunTally(), PacketCounts(received=90, lost=2)
    for _ in range(600):
        tally.add(1, 1, 31, ())
    tally.missed_frames, tally.stale_frames, tally.given_up_frames = 5, 4, 3
    packets.refused_by["crc"] = 8
    return counts_of(tally, packets)


def leads_to_a_field(key: str) -> bool:
    """Whether a key is a field of the page's state, through all of its structs."""
    struct = PageState
    for name in key.split("."):
        types_of_fields = typing.get_type_hints(struct)
        if name not in types_of_fields:
            return False
        part = types_of_fields[name]
        members = typing.get_args(part) if isinstance(part, types.UnionType) else (part,)
        struct = next((each for each in members if hasattr(each, "__struct_fields__")), None)
    return True


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: figure.name)
def test_each_row_leads_to_values_of_the_state(figure: PageFigure) -> None:
    for key in (figure.key, *OTHER_KEYS.findall(figure.text)):
        assert leads_to_a_field(key), key


def test_a_key_that_is_no_field_is_found() -> None:
    assert leads_to_a_field("clock.offset_ms")
    assert not leads_to_a_field("clock.offset_s") and not leads_to_a_field("none")


@pytest.mark.parametrize("form", sorted({figure.form for figure in FIGURES}))
def test_the_page_knows_every_form(form: str) -> None:
    assert re.search(rf"^  {form}\b[:,]", SCRIPT, re.MULTILINE)


def test_names_stand_once_in_a_panel_and_keys_once_in_the_table() -> None:
    shown = [(figure.panel, figure.name) for figure in FIGURES if figure.panel != HIDDEN]
    keys = [figure.key for figure in FIGURES]
    metrics = [figure.metric.name for figure in FIGURES if figure.metric is not None]
    for each in (shown, keys, metrics):
        assert len(each) == len(set(each))


def test_every_count_of_a_run_has_a_row_that_says_where_it_comes_from() -> None:
    counted = {figure.key for figure in FIGURES if figure.source is not None}
    assert counted == {f"{COUNTS}{name}" for name in RunCounts.__struct_fields__}
    assert run_counts() == RunCounts(
        frames=600, missed=5, stale=4, given_up=3, received=90, accepted=82, lost=2,
        refused={"crc": 8},
    )  # fmt: skip


def test_metrics_are_the_figures_in_units_of_openmetrics() -> None:
    state = PageState(
        utc="",
        health=SkyHealth(True, "", []),
        source=AttitudeSource("udp", ""),
        pacing=None,
        counts=run_counts(),
        ledger=LedgerState("run.mcap", 4096),
    )
    found = {metric.name: (value, metric.kind) for metric, value in metrics_of(state)}
    counters = {name: value for name, (value, kind) in found.items() if kind == "counter"}
    assert counters == {
        "frames": 600, "frames_missed": 5, "frames_stale": 4, "frames_given_up": 3,
        "packets_received": 90, "packets_lost": 2, "wrong_sky_seconds": 0.0,
    }  # fmt: skip
    assert found["ledger_bytes"] == (4096, "gauge")
    assert found["stars_clipped"] == (0, "gauge")
    assert "attitude_age_seconds" not in found and "clock_drift_ratio" not in found
    assert value_of(state, "attitude.age_ms") is None
    clock = ShownClock(
        offset_ms=1.5, sigma_ms=None, drift_ppm=3.0, synchronised=True, mode="exchange"
    )
    timed = msgspec.structs.replace(state, clock=clock)
    found = {metric.name: value for metric, value in metrics_of(timed)}
    assert "clock_uncertainty_seconds" not in found
    assert found["clock_offset_seconds"] == pytest.approx(1.5e-3)
    assert found["clock_drift_ratio"] == pytest.approx(3e-6)
