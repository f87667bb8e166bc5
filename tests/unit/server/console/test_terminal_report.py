"""The lines that a run ends with, whole, from a summary of which no two figures are alike; the
sender's clock in a line; and how a status looks on a terminal.
"""

from __future__ import annotations

import io
import json
import os
from dataclasses import replace as other
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console

from hilstar.attitude.clock.sender_clock import ClockSummary
from hilstar.basics.running_statistics import Percentiles
from hilstar.basics.wrong_sky import ConditionTotal, WrongSkyTotal
from hilstar.server.console import run_status
from hilstar.server.console.run_status import StatusLine
from hilstar.server.console.terminal import clock_line, print_json, report
from hilstar.server.summary import (
    ClippedSummary,
    PacketSummary,
    RunSummary,
    RunVerdict,
    StarSummary,
)

NONE = Percentiles(None, None, None)
SUMMARY = RunSummary(
    frames=1201,
    duration_s=20.014,
    fps=59.96,
    frame_ms=Percentiles(1.104, 2.205, 3.306),
    attitude_age_ms=Percentiles(4.4, 5.5, 6.6),
    packets=PacketSummary(2000, 1990, 10, {"crc": 7, "nan": 0, "time": 3}, lost=4),
    stars_drawn=StarSummary(812.6, 930),
    clipped=ClippedSummary(8, [3, 1, 4, 15, 9], ["Moon", "Venus"]),
    missed_frames=5,
    stale_frames=6,
    capped=0,
    given_up=0,
    gl_renderer="llvmpipe",
    gl_version="4.5",
    render_path="GL",
    receive_latency_ms=Percentiles(0.11, 0.22, 0.33),
    clock=ClockSummary("one-way", 9.0, 12.34, 0.5678, 0, 2),
    link={"flooded": 17},
    screen={
        "operator": {"frames": 30, "s": 0.52},
        "hidden": {"frames": 0, "s": 0.0},
        "gamma": {"frames": 1, "s": 0.02},
    },
    wrong_sky=WrongSkyTotal(3.0, [ConditionTotal("stale", 2, 1.26, "no attitude for 100 ms")]),
    verdict=RunVerdict(False, False, 0.01, 3.0, "not right: 3.0 s of a wrong sky"),
)


def reported(capsys: pytest.CaptureFixture[str], summary: RunSummary) -> list[str]:
    report(summary, as_json=False)
    return capsys.readouterr().out.splitlines()


def test_a_run_ends_with_its_figures_in_their_order(capsys: pytest.CaptureFixture[str]) -> None:
    lines = reported(capsys, SUMMARY)
    assert {line[:20].endswith("  ") for line in lines} == {True}
    assert [(line[:20].strip(), line[20:]) for line in lines] == [
        ("frames", "1201 in 20.01 s (60.0 fps), 5 missed, 6 stale"),
        ("frame time", "1.10 / 2.21 / 3.31 ms (p50 / p99 / max), attitude in to codes ready"),
        ("attitude age", "4.40 / 5.50 / 6.60 ms (p50 / p99 / max) at render"),
        ("stars drawn", "813 mean, 930 max, 8 clipped Moon Venus HIP 3 HIP 1 HIP 4"),
        (
            "packets",
            "2000 received, 10 refused (crc 7, time 3); 17 more passed over unread, 4 lost",
        ),
        ("receive latency", "0.11 / 0.22 / 0.33 ms (p50 / p99 / max) above the minimum"),
        (
            "sender's clock",
            "from arrivals: drift 12.3 ppm, uncertainty 0.568 ms, excluding the minimum transport"
            " delay, jumps: 2",
        ),
        ("operator", "30 frames, 0.5 s, changed by an operator's keys"),
        ("gamma", "1 frames, 0.0 s, under another program's gamma ramp"),
        ("stale", "1.3 s: no attitude for 100 ms"),
        ("renderer", "llvmpipe"),
        ("verdict", "not right: 3.0 s of a wrong sky"),
    ]


def test_a_run_without_a_frame_or_a_packet_has_dashes(capsys: pytest.CaptureFixture[str]) -> None:
    empty = RunSummary(
        frames=0,
        duration_s=0.0,
        fps=None,
        frame_ms=NONE,
        attitude_age_ms=NONE,
        packets=PacketSummary(0, 0, 0, {"crc": 0}),
        stars_drawn=StarSummary(None, None),
        clipped=ClippedSummary(0, []),
        missed_frames=0,
        stale_frames=0,
        capped=0,
        given_up=0,
        gl_renderer="none",
        gl_version="none",
        render_path="NumPy",
    )
    lines = [line[20:] for line in reported(capsys, empty)]
    assert lines[:3] == [
        "0 in 0.00 s (- fps), 0 missed, 0 stale",
        "- / - / - ms (p50 / p99 / max), attitude in to codes ready",
        "- / - / - ms (p50 / p99 / max) at render",
    ]
    assert lines[3:] == ["- mean, None max, 0 clipped", "0 received, 0 refused", "none"]


def test_a_latency_by_a_clock_that_is_known_is_absolute(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert SUMMARY.clock
    for mode, absolute in (
        ("exchange", True),
        ("shared", True),
        ("unix", True),
        ("one-way", False),
    ):
        summary = replace(SUMMARY, clock=other(SUMMARY.clock, mode=mode))
        (line,) = (line for line in reported(capsys, summary) if line.startswith("receive"))
        assert line.endswith("above the minimum") is not absolute


def test_as_json_it_is_the_summary(capsys: pytest.CaptureFixture[str]) -> None:
    report(SUMMARY, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["packets"]["lost"], told["clock"]["jumps"]) == (1201, 4, 2)
    assert "answers" not in told


def test_numbers_of_numpy_and_names_that_are_no_text_are_json(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_json({"a": np.float32(0.5), "b": np.arange(3), "c": np.True_})
    assert json.loads(capsys.readouterr().out) == {"a": 0.5, "b": [0, 1, 2], "c": True}
    with pytest.raises(TypeError, match="Path has no JSON"):
        print_json({"a": Path("x")})
    of_another_encoding = os.fsdecode(b"run-\xff.mcap")
    print_json({"path": of_another_encoding})
    told = capsys.readouterr().out
    assert json.loads(told)["path"] == of_another_encoding
    told.encode("ascii")


@pytest.mark.parametrize(
    ("clock", "line"),
    [
        (ClockSummary("none"), "no attitude has arrived"),
        (ClockSummary("shared"), "shared with the sender"),
        (
            ClockSummary("unix", uncertainty_ms=0.25),
            "Unix time, kept to 0.250 ms by this machine's kernel, and the sender's own error",
        ),
        (
            ClockSummary("exchange", exchanges=1),
            "from time exchanges: heard too briefly to state an uncertainty",
        ),
        (
            ClockSummary("exchange", 1.0, -3.26, 0.0125, 40, 0),
            "from time exchanges: drift -3.3 ppm, uncertainty 0.013 ms",
        ),
        (
            ClockSummary("one-way", 1.0, 2.0, 0.5, 0, 1),
            "from arrivals: drift 2.0 ppm, uncertainty 0.500 ms, excluding the minimum transport"
            " delay, jumps: 1",
        ),
    ],
)
def test_a_sender_s_clock_is_said_by_how_it_is_known(clock: ClockSummary, line: str) -> None:
    assert clock_line(clock) == line


def test_a_status_on_a_terminal_has_a_mark_a_label_and_a_text_a_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is drawn anew until the run ends, and then gone."""
    monkeypatch.setenv("TERM", "xterm")
    lines = [StatusLine("frames", "60 Hz"), StatusLine("attitude", "none for 3 s", well=False)]
    screen = io.StringIO()
    monkeypatch.setattr(
        "rich.console.Console",
        lambda **_: Console(file=screen, force_terminal=True, width=60, color_system=None),
    )
    looks = [False, False, True]
    stop = SimpleNamespace(is_set=lambda: looks.pop(0), wait=lambda _: None)
    status = SimpleNamespace(lines=lambda now_ns: lines)
    run_status._live(status, stop)  # what the thread runs
    drawn = screen.getvalue()
    assert drawn.count("ok  frames    60 Hz") >= 2
    assert drawn.count("!!  attitude  none for 3 s") >= 2
