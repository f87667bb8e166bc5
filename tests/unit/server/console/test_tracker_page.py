"""A tracker's answers on the operator's page: at once, over the picture, in /metrics and in the
terminal's status.
"""

from __future__ import annotations

import time

import msgspec
import numpy as np
import pytest

from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.answers.star_widths import FocusState
from hilstar.server.console.messages import NewAnswer, RunState, Setup, SharedMemory
from hilstar.server.console.overlay import overlay_of
from hilstar.server.console.protocol import AttitudeSource, Hello
from hilstar.server.console.run_status import RunSource, RunStatus
from hilstar.server.console.server.app import RunCollector
from hilstar.server.console.server.reader import RunReader
from hilstar.server.pacer import Shown
from hilstar.server.run_progress import Running
from tests.support.benches import ORION_Q
from tests.support.drawn import drawn
from tests.support.queued_answers import unasked_answers

FIGURES = TrackerFigures(
    answers=12, right=9, wrong=1, invalid=2, refused={"checksum": 3}, residual_arcsec=[1.0, -2.0, 30.0], verdict="right",
    mode="track", stars=9, rate_hz=10.0, availability=0.75, mean_arcsec=[1.0, 2.0, 3.0], rms_arcsec=[1.5, 2.5, 3.5],
    sigma3_arcsec=[4.0, 5.0, 6.0], latency_ms=150.0, latency_sigma_ms=2.0, age_s=0.1,
)  # fmt: skip


@pytest.fixture
def reader() -> RunReader:
    hello = Hello(version="0", command="hilstar serve", bench="bench.toml", started_utc="", resolution_px=(4, 3),
                  white_level=255, bits=8, refresh_hz=60.0, control=False)  # fmt: skip
    setup = Setup(hello=hello, source=AttitudeSource("zmq", ""), hosts=[], names=[], any_address=False, port=1, token="",
                  picture_bytes=12, pace="clock")  # fmt: skip
    return RunReader(SharedMemory.make(12), setup)


def put_answer(reader: RunReader, figures: TrackerFigures) -> None:
    reader._memory.answers.put(
        msgspec.json.encode(NewAnswer(figures, tuple(ORION_Q), [(1.0, 2.0)]))
    )


def put_focus(reader: RunReader, focus: FocusState) -> None:
    state = RunState(host_ns=time.monotonic_ns(), focus=focus)
    reader._memory.states.put(msgspec.json.encode(state))
    reader.look()


def test_a_figure_of_the_focus_is_one_point_of_its_chart(reader):
    put_focus(reader, FocusState(number=1, what="star sigma", sigma_px=1.25))
    assert reader.points[-1].focus_px == 1.25
    assert reader.state().focus.sigma_px == 1.25
    reader.look()
    assert reader.points[-1].focus_px is None  # the same figure makes no second point
    put_focus(reader, FocusState(number=2, what="star sigma", line="no star"))
    assert reader.points[-1].focus_px is None
    put_focus(reader, FocusState(number=3, what="star sigma", sigma_px=1.5))
    assert reader.points[-1].focus_px == 1.5


def test_a_session_that_measures_the_focus_says_so(reader):
    reader.setup.pace = "session"
    reader.look()
    assert reader.health_now().headline != "The focus is measured"
    put_focus(reader, FocusState(number=1, what="PSF sigma", sigma_px=1.25))
    assert reader.health_now().headline == "The focus is measured"


def test_an_answer_is_read_once_and_makes_a_point_of_the_chart(reader):
    assert reader.new_answer() is None
    put_answer(reader, FIGURES)
    put_answer(
        reader,
        msgspec.structs.replace(FIGURES, wrong=2, verdict="wrong", residual_arcsec=[9e4, 0.0, 0.0]),
    )
    assert reader.new_answer().wrong == 2
    assert reader.new_answer() is None and reader.answer.centroids == [(1.0, 2.0)]
    reader.look()
    point = reader.points[-1]
    assert (point.x_arcsec, point.z_arcsec, point.wrong) == (1.0, 30.0, 2)
    reader.look()
    assert (reader.points[-1].x_arcsec, reader.points[-1].wrong) == (None, 0)


def test_the_metrics_and_the_state_have_the_trackers_figures(reader):
    collector = RunCollector(reader)
    assert b"tracker" not in collector.text()
    silent = msgspec.structs.replace(FIGURES, silent="the tracker has not answered for 3.0 s")
    reader._memory.states.put(
        msgspec.json.encode(RunState(host_ns=2**62, alive_ns=2**62, tracker=silent))
    )
    reader.look()
    assert "the tracker has not answered for 3.0 s" in reader.health.reasons
    assert reader.state().tracker == silent
    text = collector.text().decode()
    for line in (
        'hilstar_tracker_answers_total{verdict="wrong"} 1.0',
        'hilstar_tracker_refused_total{reason="checksum"} 3.0',
        'hilstar_tracker_residual_rms_arcsec{axis="z"} 3.5',
        "hilstar_tracker_availability_ratio 0.75",
        "hilstar_tracker_latency_seconds 0.15",
        "hilstar_tracker_silent 1.0",
    ):
        assert line in text


def test_the_terminal_has_a_line_of_the_tracker(loop, small_bench):
    status = RunStatus(RunSource("zmq", "llvmpipe", 60.0))
    status.see(Shown(0, 0, None, drawn(np.zeros((3, 4), np.uint8)), missing=True))
    answers = unasked_answers(small_bench.config.monitor)
    status.follow(Running(loop, PacketCounts(), answers=answers))

    def line(figures: TrackerFigures) -> tuple[str, bool]:
        answers.figures = figures
        return next((line.text, line.well) for line in status.lines(1) if line.label == "tracker")

    text = (
        "1.0, -2.0, 30.0 arcsec off, rms 1.5, 2.5, 3.5, 75.0 % available, 150 ms late, track; 1 of"
        " 12 answers wrong"
    )
    assert line(FIGURES) == (text, True)
    assert line(msgspec.structs.replace(FIGURES, silent="gone")) == ("gone", False)
    assert not line(msgspec.structs.replace(FIGURES, trouble="unplugged"))[1]
    assert not line(msgspec.structs.replace(FIGURES, verdict="wrong"))[1]
    assert line(TrackerFigures())[0] == "- arcsec off, rms -, - available, - late; 0 answers"


@pytest.mark.gpu
def test_the_reported_field_and_centroids_lie_over_the_picture_where_the_tracker_says(bench_with):
    bench = bench_with()
    marks = overlay_of(bench).marks
    q = np.array(ORION_Q)
    outline = marks.truth(0, [], q).tracker_px
    star_px = np.array([[100.0, 900.0], [511.5, 511.5]])
    plain = marks.answer([0.0, 0.0, 0.0], q, q, star_px.tolist())
    assert np.array(plain.field_px) == pytest.approx(np.array(outline), abs=0.011)
    assert plain.centroids_px[1] == pytest.approx(marks.monitor.boresight_px, abs=0.011)
    # Turned by a about y, the tracker takes stars at +x for its middle: where it stands in the
    # shown sky, x + f a.
    turned = marks.answer([0.0, 3600.0, 0.0], q, q, [])
    focal_px = 60 / 0.05765
    shift = np.array(turned.field_px).mean(axis=0) - np.array(outline).mean(axis=0)
    assert np.abs(shift) == pytest.approx([focal_px * np.radians(1.0), 0.0], abs=0.6)
    # The same star, one degree on: its centroid moves with the sky.
    later = multiply(from_rotation_vector(np.radians([0.0, 1.0, 0.0])), q)
    moved = marks.answer(None, q, later, star_px[1:].tolist())
    assert moved.field_px == []
    star = marks.monitor.project(
        np.array([[np.sin(np.radians(1.0)), 0.0, np.cos(np.radians(1.0))]])
    )
    assert moved.centroids_px[0] == pytest.approx([star[0][0], star[1][0]], abs=0.011)
