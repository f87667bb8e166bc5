"""What a command hands to the engine behind it is what its words say, each in its own place, and
what it says of the engine's result is that result: the engines are the test's.
"""

from __future__ import annotations

import json
import math
import socket
import sys
import threading
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from astropy.io import fits

from hilstar.attitude.wire.packet import Status, TimeRequest, encode
from hilstar.attitude.wire.shown_frames import FrameHead, ShownFrame
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.running_statistics import Percentiles
from hilstar.basics.units import NS_PER_S
from hilstar.cli import demo as demo_command
from hilstar.cli import serve as serve_command
from hilstar.cli import tracker as tracker_command
from hilstar.cli.accept import _time_text, costs_table
from hilstar.cli.campaign import CampaignOptions, CaseOptions, _scheduler, telling
from hilstar.cli.demo import (
    FOV_ARCSEC,
    PIXEL_ARCSEC,
    WRONG,
    TrackerBeside,
    loop_figures,
    print_loop,
    say_missed,
)
from hilstar.cli.running import ActingPageOptions, DisplayOptions, RunOptions
from hilstar.cli.send import heard
from hilstar.cli.send import tell as tell_sent
from hilstar.cli.serve import ServeOptions, heads_run
from hilstar.cli.study import (
    ROOMS,
    TIMED,
    WHOLE,
    FieldOptions,
    Study,
    StudyOptions,
    findings_of,
    refuse_unused,
    steps_of,
    thesis_lines,
)
from hilstar.cli.tracker import (
    TrackerOptions,
    checked_rate,
    counts_of,
    parse_silent,
    planted_errors,
    recorded,
)
from hilstar.instruments.assess import assessment
from hilstar.instruments.assess.budget import Axes
from hilstar.instruments.calibrate import camera_edges, effective_psf
from hilstar.instruments.calibrate import latency as by_diode
from hilstar.instruments.calibrate.geometric import geometry_fit
from hilstar.instruments.calibrate.latency import Edges
from hilstar.instruments.campaign import acceptance as acceptance_engine
from hilstar.instruments.campaign import acceptance_page, acceptance_plan, pool
from hilstar.instruments.campaign.acceptance_plan import CaseSet
from hilstar.instruments.campaign.acceptance_verdicts import CostOfSet
from hilstar.instruments.campaign.requirements import NOT_MET
from hilstar.instruments.simulate import batch, simulator
from hilstar.instruments.simulate import heads as twin_heads
from hilstar.instruments.simulate.answer_link import AnswerLink
from hilstar.instruments.simulate.heads import HeadsErrors
from hilstar.instruments.simulate.live_exposure import WatchedFrames
from hilstar.instruments.simulate.tracker_process import SILENT_AFTER_S, Planted
from hilstar.instruments.study import rapp
from hilstar.instruments.study.chain import run as chain
from hilstar.instruments.study.engine import ChartFinding
from hilstar.instruments.study.stability import CaseFigures, FailureCase
from hilstar.instruments.study.sweep import Judged
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.bench.bench_file import HeadsFile, read_bench_file, read_bench_or_heads
from hilstar.server.heads import HeadsRun
from hilstar.server.screen.screen import CODE, marker_light
from hilstar.server.send_log import SendTally
from hilstar.server.sender import UdpSender
from tests.support.acceptance import accepted
from tests.support.assessments import a_budget, an_assessment
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.heads import heads_file
from tests.support.planted_run import write_ledger
from tests.support.refusals import refusal
from tests.support.waiting import wait_for

NO_STATUS = Status(0, 0, 0, 0, 0, 0, 0)
PARTS = ("bias", "fov", "pixel")  # of a budget
Q = np.array([0.5, -0.5, 0.5, -0.5])


class Engine:
    """A function that keeps what it was given, and returns one thing."""

    def __init__(self, result: Any) -> None:
        self.result = result
        self.given: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def __call__(self, *given: Any, **named: Any) -> Any:
        self.given.append((given, named))
        return self.result


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, str, Any], Engine]:
    """Puts an engine in place of a module's function."""

    def put(module: Any, name: str, result: Any) -> Engine:
        made = Engine(result)
        monkeypatch.setattr(module, name, made)
        return made

    return put


def tracker_options(**words: Any) -> TrackerOptions:
    """The options of `hilstar tracker`, as typer gives them."""
    return TrackerOptions(bench_file=Path("bench.toml"), watch="tcp://127.0.0.1:1", **words)


def test_each_planted_error_is_the_one_that_its_option_names() -> None:
    given = tracker_options(
        bias="1,-2,3.5", fov_error=4.0, pixel_error=5.0, wrong="6%", silent="7s@8s",
        latency=9.0, clock_drift=10.0, clock_offset=11.0,
    )  # fmt: skip
    assert planted_errors(given) == Planted(
        bias_arcsec=(1.0, -2.0, 3.5),
        fov_arcsec=4.0,
        pixel_arcsec=5.0,
        wrong=0.06,
        silent_s=7.0,
        after_s=8.0,
        latency_s=9.0,
        drift_ppm=10.0,
        offset_s=11.0,
    )
    assert planted_errors(tracker_options()) == Planted()
    assert parse_silent("2.5") == (2.5, SILENT_AFTER_S)


@pytest.mark.parametrize(
    ("rate_hz", "exposure_s", "found"), [(None, 0.02, 10.0), (None, 0.25, 4.0), (4.0, 0.25, 4.0)]
)
def test_a_tracker_answers_as_often_as_its_exposures_have_room(
    rate_hz: float | None, exposure_s: float, found: float
) -> None:
    assert checked_rate(rate_hz, exposure_s) == found


def test_an_answer_is_a_row_of_telemetry_with_its_own_time(tmp_path: Path) -> None:
    with recorded(tmp_path / "a.csv") as row:
        row(Answer(5, b"", 1_500_000_001, Q))
        row(Answer(6, b"", 2_250_000_000, None, valid=False))
        row(Answer(7, b"", None, Q))
    assert (tmp_path / "a.csv").read_text().splitlines() == [
        "t_s,qw,qx,qy,qz,valid",
        "1.500000001,0.5,-0.5,0.5,-0.5,1",
        "2.250000000,,,,,0",
        "0.000000000,0.5,-0.5,0.5,-0.5,1",
    ]


def test_a_tracker_says_what_it_answered(capsys: pytest.CaptureFixture[str]) -> None:
    told = {
        "answers": 30, "valid": 28, "passed_over": 3, "modes": {"track": 27, "lost": 3},
        "frames": {"received": 600, "missing": 4, "refused": 1},
        "cpu_ms": Percentiles(12.0, 13.0, 14.0), "latency_ms": Percentiles(150.0, 160.0, 170.0),
        "own_bias_arcsec": [1.0, -2.0, 3.0], "own_sigma_arcsec": [0.5, 0.25, 4.0],
    }  # fmt: skip
    tracker_command.tell(told, False)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        "answers 30, 28 valid (27 track, 3 lost), 3 exposures passed over",
        "frames 600 received, 4 missing",
        "an answer 12 ms of one core, 150 ms after mid-exposure (median)",
        "own bias 1.00, -2.00, 3.00 arcsec about x, y, z",
        "own sigma 0.50, 0.25, 4.00 arcsec about x, y, z",
    ]


def test_a_tracker_s_counts_are_those_of_its_parts() -> None:
    frames = WatchedFrames(lambda frame: np.ones((1, 1)))
    for number in (1, 2, 5):
        head = FrameHead(number, 1_000_000 * number, 4, 3, 8)
        frames.add(ShownFrame(head, np.zeros(1, np.uint32), np.ones(1, np.uint8)))
    received = {"received": 3, "missing": 2, "refused": 1}
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear,
        AnswerLink(heard_at(ear), "json", False, np.random.default_rng(1)) as link,
    ):
        link.send(Answer(5, b"", 1_500_000_001, Q))
        assert counts_of(frames, 1, link, None) == {
            "frames": received,
            "link": {"endpoint": link.endpoint, "sent": 1, "babbled": 1},
        }
    assert counts_of(frames, 1, None, None) == {"frames": received}


def heard_at(ear: socket.socket) -> str:
    """The target at which a socket listens."""
    ear.bind(("127.0.0.1", 0))
    return f"udp://127.0.0.1:{ear.getsockname()[1]}"


def test_what_was_sent_is_all_that_left_with_what_became_of_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tally = SendTally(sent=11, lost=4, corrupted=3, reordered=2)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear,
        UdpSender(heard_at(ear)) as link,
    ):
        link.put(b"a packet")
        _, sender = ear.recvfrom(100)
        for packet in (*[encode(NO_STATUS)] * 6, *[encode(TimeRequest(1, 2))] * 5):
            ear.sendto(packet, sender)
        wait_for(lambda: (link.statuses, link.requests) == (6, 5))
        tell_sent(tally, link, True)
        told = json.loads(capsys.readouterr().out)
        tell_sent(tally, link, False)
    counts = {"packets": 20, "sent": 16, "lost": 4, "corrupted": 3, "reordered": 2}
    assert told == counts | {
        "requests": 5,
        "statuses": 6,
        "link": {"endpoint": link.endpoint} | link.link_counts.summary(),
    }
    assert capsys.readouterr().err.splitlines() == [
        "16 packets sent (4 lost, 3 corrupted, 2 reordered)",
        "6 statuses heard, 5 time requests answered",
    ]


def test_a_listener_is_waited_for_in_slices_and_a_stop_ends_that() -> None:
    slices: list[float] = []

    def answers_third(seconds: float) -> bool:
        slices.append(seconds)
        return len(slices) == 3

    def silent(seconds: float) -> bool:
        return False

    stop = threading.Event()
    assert heard(answers_third, 1e6, stop, lambda seconds: None)
    assert len(slices) == 3
    assert not heard(silent, 0.0, stop, lambda seconds: None)
    stop.set()
    assert heard(silent, 1e6, stop, lambda seconds: None)


@pytest.mark.parametrize("as_json", [False, True])
def test_the_angles_of_heads_are_said_pair_by_pair(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], as_json: bool
) -> None:
    for name in ("left", "right"):
        mounted = {"tracker": {"q_body_to_cam": [1.0, 0.0, 0.0, 0.0]}}
        (tmp_path / f"{name}.toml").write_text(bench_text(mounted))
    (tmp_path / "heads.toml").write_text('heads = ["left.toml", "right.toml"]\n')
    errors = [
        HeadsErrors("left", "right", [0.1, 0.1], [0.3, 0.4]),
        HeadsErrors("left", "up"),
        HeadsErrors("up", "left", [0.1], []),
    ]
    asked = engine(twin_heads, "verify_heads", errors)
    words = ["verify", "heads.toml", "--fields", "4", "--seed", "9"]
    done = run_hilstar_here(*words, *["--json"] * as_json, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ((heads, fields, rng, _), _) = asked.given[0]
    assert (list(heads.names), fields) == (["left", "right"], 4)
    assert rng.random() == np.random.default_rng(9).random()
    if as_json:
        assert json.loads(done.stdout) == {"angles": [pair.summary() for pair in errors]}
    else:
        assert [" ".join(line.split()) for line in done.stdout.splitlines()] == [
            "left to right 0.1000 / 0.1000 arcsec from linear light, 0.3536 / 0.4000 from codes"
            " (rms / max, 2 fields)",
            "left to up too few stars in both",
            "up to left too few stars in both",
        ]


def test_a_study_s_findings_are_right_where_all_of_its_cases_are() -> None:
    right, wrong = (
        FailureCase("c", "m", "f", "h", "w", CaseFigures(error, 2.0, tolerance=1.0))
        for error in (1.0, 1.1)
    )
    lines = ["right  c: h (w); not m: f", "WRONG  c: h (w); not m: f"]
    assert findings_of("stability", [right, wrong]) == (lines, False)
    assert findings_of("stability", [right]) == (lines[:1], True)
    finding = ChartFinding("rapp", "as the thesis")
    assert findings_of("models", [finding]) == (["rapp: as the thesis"], True)
    assert findings_of("outputs", ["one"]) == (["one"], True)
    assert findings_of("timing", (["timed"], None)) == (["timed"], None)
    assert findings_of("limits", ["a limit"]) == (["a limit"], True)


@pytest.mark.parametrize("what", sorted(set(get_args(Study)) - {"chain", "confront"}))
def test_a_study_takes_quick_where_a_part_of_it_is(what: str) -> None:
    """`chain` and `confront` are called by their own functions."""
    module = f"{what}.run" if what in ROOMS else what
    run = import_module(f"hilstar.instruments.study.{module}").run
    assert ("quick" in signature(run).parameters) is (what not in WHOLE)
    assert (get_type_hints(run)["return"] == Judged) is (what in TIMED)


def test_the_bar_of_a_study_counts_the_five_scenes_of_a_chain_and_nothing_else() -> None:
    assert [steps_of(what) for what in ("chain", "models", "timing")] == [5, math.inf, math.inf]


@pytest.mark.parametrize("right", [True, False, None])
def test_a_study_of_a_chain_tells_its_scenes_what_to_do_and_whether_all_was_right(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], right: bool | None
) -> None:
    (tmp_path / "bench.toml").write_text(bench_text())
    asked = engine(chain, "run", chain.ChainStudy(["a scene"], right, ["write auto"]))
    words = ("study", "chain", "bench.toml", "-o", "out", "--quick")
    done = run_hilstar_here(*words, "--json", cwd=tmp_path)
    assert json.loads(done.stdout) == {
        "study": "chain",
        "right": right,
        "findings": ["a scene"],
        "answers": ["write auto"],
        "directory": "out",
    }
    ((file, output, quick, _), _) = asked.given[0]
    assert (file.path, output, quick) == (Path("bench.toml"), Path("out"), True)
    lines = run_hilstar_here(*words, cwd=tmp_path).stdout.splitlines()
    assert lines == ["a scene", "figures and tables in out", "write auto"]


def test_the_costs_of_a_plan_are_those_of_its_sets_and_of_all() -> None:
    costs = [
        (CostOfSet(CaseSet("rates", "", {}, None), 40, 100.0), ["angular rate", "lag"]),
        (CostOfSet(CaseSet("sky", "", {}, None), 1000, 8000.0), ["availability"]),
    ]
    told, lines = costs_table(costs, "on 6 cores")
    assert [" ".join(line.split()) for line in lines] == [
        "rates 40 cases 100 s angular rate",
        "lag",
        "sky 1000 cases 2.2 h availability",
        "all 1040 cases 2.2 h on 6 cores",
    ]
    rates = {"set": "rates", "cases": 40, "s": 100.0, "clauses": ["angular rate", "lag"]}
    assert (told["s"], told["sets"][0]) == (8100.0, rates)


@pytest.mark.parametrize("is_terminal", [False, True])
def test_progress_where_no_line_is_erased_is_a_line_each_ten_seconds_with_the_time_left(
    is_terminal: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    now_s = 1000.0
    with telling(100, lambda: now_s) as line:
        for passed_s, done in ((1.0, 20), (5.0, 30), (11.0, 40), (12.0, 41), (21.0, 60)):
            now_s = 1000.0 + passed_s
            line(done)
    # of those that were done since the first look: 20 in 10 s, and 40 in 20 s
    assert capsys.readouterr().err.splitlines() == [
        "hilstar: 40 of 100 cases, 2 a second, 30 s left",
        "hilstar: 60 of 100 cases, 2 a second, 20 s left",
    ]


def test_a_head_gets_the_options_of_its_run_and_none_of_another_kind(tmp_path: Path) -> None:
    file = read_bench_or_heads(heads_file(tmp_path, 5560))
    assert isinstance(file, HeadsFile)
    run = heads_run(
        file,
        ServeOptions(bench_file=file.path, frames=30, duration=2.5),
        DisplayOptions(headless=True, force=True),
        RunOptions(
            ledger=Path("run.mcap"), ledger_split="1GB", scenario=Path("s.toml"), strict=True
        ),
        ActingPageOptions(control=True, token="secret"),
    )
    words = ("--frames", "30", "--ledger-split", "1GB", "--scenario", "s.toml")
    switches = ("--headless", "--force", "--control", "--strict")
    assert run == HeadsRun(file, (*words, *switches), 2.5, Path("run.mcap"), token="secret")


@pytest.mark.parametrize(
    ("summary", "restarts", "line"),
    [
        ({"frames": 90}, 0, "left 90 frames, exit code 0"),
        ({"frames": 90}, 1, "left 90 frames, exit code 0, started again 1 times"),
        ("no JSON", 0, "left no summary, exit code 0"),
    ],
)
def test_a_head_s_end_is_said_in_a_line(summary: Any, restarts: int, line: str) -> None:
    head = {"summary": summary, "exit_code": 0, "restarts": restarts}
    assert " ".join(serve_command._head_line("left", head).split()) == line


def test_the_demo_s_tracker_answers_on_this_machine_s_clock(tmp_path: Path) -> None:
    """Its process reads the same one as the display's."""
    (tmp_path / "demo.toml").write_text(bench_text())
    with demo_command.tracker_beside(tmp_path / "loop", tmp_path / "demo.toml", 1.0, 5):
        config = read_bench_file(tmp_path / "loop" / "loop.toml").config
    assert config.answers is not None
    assert (config.answers.source, config.answers.clock) == ("zmq", "host")
    assert str(config.answers.endpoint).startswith("ipc://")


def test_the_demo_s_budget_stands_beside_what_was_planted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bias_arcsec = np.array([19.5, -10.5, 41.0])
    axes = Axes(2.25, 8.5), Axes(0.5, None)
    rows = loop_figures(bias_arcsec, *axes, TrackerFigures(answers=200, wrong=3))
    assert {row.quantity: (row.planted, row.found, row.unit) for row in rows} == {
        "bias x": (20.0, 19.5, "arcsec"),
        "bias y": (-10.0, -10.5, "arcsec"),
        "bias z": (40.0, 41.0, "arcsec"),
        "field-of-view error across": (FOV_ARCSEC, 2.25, "arcsec"),
        "field-of-view error about": (4 * FOV_ARCSEC, 8.5, "arcsec"),
        "pixel error across": (PIXEL_ARCSEC, 0.5, "arcsec"),
        "pixel error about": (4 * PIXEL_ARCSEC, None, "arcsec"),
        "wrong answers": (100 * WRONG, 1.5, "%"),
    }
    # without answers there is no share of them
    assert loop_figures(bias_arcsec, *axes, None) == rows[:-1]
    print_loop([("bias", "20 arcsec")], rows[5:7])
    assert [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()] == [
        "bias 20 arcsec",
        "planted found",
        "pixel error across 0.60 0.50 arcsec",
        "pixel error about 2.40 unknown arcsec",
    ]


@pytest.mark.usefixtures("without_charts")
def test_the_demo_reports_the_budget_of_its_own_ledger(
    tmp_path: Path,
    engine: Callable[[Any, str, Any], Engine],
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = engine(assessment, "assess_files", an_assessment())
    beside = TrackerBeside(tmp_path, tmp_path / "loop.toml", "ipc://answers", 30.0, 5)
    beside.report(None, True)
    assert asked.given[0][0][:2] == (tmp_path / "loop.mcap", None)
    assert (tmp_path / "budget.html").stat().st_size
    rows = loop_figures(*[getattr(a_budget(), f"{name}_arcsec") for name in PARTS], None)
    assert json.loads(capsys.readouterr().err) == {"loop": [row._asdict() for row in rows]}


@pytest.mark.parametrize(("missed", "words"), [(10, ""), (11, "missed 11 frames")])
def test_the_demo_says_where_its_budget_is_the_machine_s_too(
    capsys: pytest.CaptureFixture[str], missed: int, words: str
) -> None:
    say_missed(missed, 1000)
    told = capsys.readouterr().err
    assert words in told and bool(told) is bool(words)


EDGES = 20  # of which a delay is found, at least


def edges_file(folder: Path) -> Path:
    """Edges of light, 100 ns apart."""
    path = folder / "edges.csv"
    rows = [f"{100 * k},{k % 2}" for k in range(1, EDGES + 1)]
    path.write_text("\n".join(["host_ns,level", *rows]) + "\n")
    return path


def test_a_delay_that_is_measured_is_written_with_its_own_error(tmp_path: Path) -> None:
    """Edges of light 8.25 ms after the swaps that caused them."""
    square = 'photodiode_px = 40\nphotodiode = "code"\nscanout_ms = 0\n'
    bench = SMALL_BENCH.replace("[collimator]", f"{square}[collimator]")
    levels = np.array([marker_light(number, CODE) for number in range(120)])
    frames_s = np.arange(120) / 60
    write_ledger(tmp_path / "run.mcap", frames_s, None, bench=bench, markers=levels.tolist())
    changed = np.flatnonzero(np.diff(levels)) + 1
    seen_ns = [5 * NS_PER_S + round(t_s * NS_PER_S) + 8_250_000 for t_s in frames_s[changed]]
    by_diode.save_edges(tmp_path / "edges.csv", Edges(np.array(seen_ns), levels[changed]))
    (tmp_path / "b.toml").write_text(bench)
    words = ["latency", "run.mcap", "--edges", "edges.csv", "--write", "b.toml"]
    done = run_hilstar_here(*words, "--save", "kept.csv", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    config = read_bench_file(tmp_path / "b.toml").config
    assert config.monitor.panel_delay_ms == 8.25
    assert config.certify.panel_delay_u_ms == 0.0
    assert by_diode.read_edges(tmp_path / "kept.csv").host_ns.tolist() == seen_ns
    assert (tmp_path / "out/latency.png").exists()
    summary = json.loads(run_hilstar_here(*words[:4], "--json", cwd=tmp_path).stdout)
    assert summary["panel_delay_ms"] == 8.25
    assert done.stdout.splitlines() == by_diode.latency_lines(summary)


def test_a_camera_films_the_square_as_the_run_s_bench_file_says(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hilstar.server.genicam import camera as genicam

    ledger = write_ledger(tmp_path / "run.mcap", np.array([0.0, 1.0]), None)
    engine(by_diode, "measure_latency", {})
    engine(by_diode, "latency_lines", ["filmed"])
    edges = by_diode.read_edges(edges_file(tmp_path))
    filmed = engine(camera_edges, "film_edges", edges)
    monkeypatch.setattr("hilstar.cli.latency.LEDGER_BEHIND_S", 0.0)
    opened: list[Any] = []

    class Camera:
        def __init__(self, name: str) -> None:
            opened.append(name)

        def set(self, settings: Any) -> None:
            opened.append(settings)

        def __enter__(self) -> Camera:
            return self

        def __exit__(self, *_: object) -> None:
            opened.append("closed")

    monkeypatch.setattr(genicam, "GenicamCamera", Camera)
    words = ["latency", str(ledger), "--grab", "genicam:SN7", "--exposure", "0.002"]
    done = run_hilstar_here(*words, "--duration", "1.5", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (_, seconds, exposure_s, refresh_hz), _ = filmed.given[0]
    assert (seconds, exposure_s, refresh_hz) == (1.5, 0.002, 60.0)
    assert (opened[0], opened[-1]) == ("SN7", "closed")
    refused = run_hilstar_here("latency", str(ledger), "--grab", "take {output}", cwd=tmp_path)
    assert refused.returncode == 2 and "a command takes one image at a time" in refused.stderr


def test_the_geometry_of_dots_is_found_with_what_the_words_name(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bench.toml").write_text(bench_text())
    (tmp_path / "plan").mkdir()
    for name in ("plan/plan.csv", "seen.csv", "dark.fits"):
        (tmp_path / name).write_bytes(b"")
    asked = engine(geometry_fit, "calibrate_files", "the fit")
    written = engine(geometry_fit, "write_calibrated", ["g.toml", "p.png"])
    monkeypatch.setattr(geometry_fit, "summary_of", lambda found, names: {"written": names})
    monkeypatch.setattr(geometry_fit, "lines_of", lambda found: ["fitted"])
    words = "calibrate geometric bench.toml seen.csv --plan plan -o g.toml --dark dark.fits"
    done = run_hilstar_here(
        *words.split(), "--plot", "p.png", "--tracker-is-ideal", "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    (file, seen, plan, dark), named = asked.given[0]
    assert file.path.name == "bench.toml"
    assert (seen, plan, dark) == ([Path("seen.csv")], Path("plan/plan.csv"), Path("dark.fits"))
    assert named == {"tracker_is_ideal": True}
    assert written.given[0][0][:3] == (Path("g.toml"), "the fit", Path("p.png"))
    assert json.loads(done.stdout) == {"written": ["g.toml", "p.png"]}


def test_the_psf_of_dots_is_found_with_what_the_words_name(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bench.toml").write_text(bench_text())
    (tmp_path / "plan").mkdir()
    for name in ("plan/plan.csv", "a.fits", "b.fits", "dark.fits"):
        (tmp_path / name).write_bytes(b"")
    asked = engine(effective_psf, "effective_psf", SimpleNamespace(glass="the glass"))
    drawn = engine(effective_psf, "draw_effective", None)
    monkeypatch.setattr(effective_psf, "summary_of", lambda found: {"dots": 9})
    monkeypatch.setattr(effective_psf, "lines_of", lambda found: ["nine dots"])
    written = Engine(None)
    monkeypatch.setattr("hilstar.optics.glass.psf_file.write_glass", written)
    words = "calibrate psf bench.toml a.fits b.fits --plan plan -o psf.fits --dark dark.fits"
    done = run_hilstar_here(
        *words.split(), "--oversampling", "6", "--plot", "p.png", "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    (file, images, plan, dark, oversampling), _ = asked.given[0]
    assert file.path.name == "bench.toml"
    assert [path.name for path in images] == ["a.fits", "b.fits"]
    assert (plan, dark, oversampling) == (Path("plan/plan.csv"), Path("dark.fits"), 6)
    assert written.given == [((Path("psf.fits"), "the glass"), {})]
    assert drawn.given[0][0][0] == Path("p.png")
    assert json.loads(done.stdout) == {"dots": 9, "written": ["psf.fits", "p.png"]}
    plain = run_hilstar_here(*words.split(), cwd=tmp_path)
    assert plain.stdout.splitlines() == [
        "nine dots",
        "in the bench file, under [tracker.optics]: psf = 'psf.fits'",
    ]


@pytest.mark.parametrize(
    ("what", "given", "words"),
    [
        ("chain", {}, "is of a bench"),
        ("chain", {"bench": Path("b.toml")}, None),
        ("models", {"bench": Path("b.toml"), "radec": "1,2,3"}, None),
        ("timing", {"bench": Path("b.toml")}, "has benches of its own; leave out b.toml"),
        ("timing", {"star": "Vega"}, "has fields of its own; leave out --star"),
        ("chain", {"bench": Path("b.toml"), "radec": "1,2,3"}, "leave out --radec"),
        ("outputs", {"radec": "1,2,3"}, "a field is seen by a bench"),
        ("confront", {}, "is of photographs; add --images DIR"),
        ("confront", {"images": Path("d")}, None),
        ("timing", {"images": Path("d")}, "has no photographs; leave out --images"),
        ("chain", {"bench": Path("b.toml"), "images": Path("d")}, "leave out --images"),
        ("geometry", {}, None),
    ],
)
def test_a_study_takes_what_it_uses_and_nothing_else(
    what: str, given: dict[str, Any], words: str | None
) -> None:
    known = dict.fromkeys(("bench", "images", "radec", "star")) | given
    options = StudyOptions(what=what, output=Path(), bench=known["bench"], images=known["images"])
    pointing = FieldOptions(radec=known["radec"], star=known["star"])
    if words is None:
        refuse_unused(options, pointing)
    else:
        assert words in refusal(refuse_unused, options, pointing)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], "give the edges with one of --edges"),
        (["--edges", "e.csv", "--diode", "serial:/dev/x@9600"], "give the edges with one of"),
        (["--edges", "e.csv", "--grab", "genicam:S"], "give the edges with one of --edges"),
        (["--edges", "e.csv", "--exposure", "0.01"], "--exposure: is for --grab; leave it out"),
        (["--edges", "out/latency.png", "-o", "out"], "out/latency.png"),
    ],
)
def test_a_latency_has_one_source_of_edges_and_overwrites_none(
    tmp_path: Path, words: list[str], line: str
) -> None:
    (tmp_path / "out").mkdir()
    for name in ("run.mcap", "e.csv", "out/latency.png"):
        (tmp_path / name).write_bytes(b"")
    refused = run_hilstar_here("latency", "run.mcap", *words, cwd=tmp_path)
    assert refused.returncode == 2 and line in refused.stderr


@pytest.mark.parametrize(
    ("scheduler", "workers", "memory", "key", "words"),
    [
        ("tcp://127.0.0.1:1", 4, None, None, "leave out --workers and --memory"),
        ("tcp://127.0.0.1:1", None, "4GB", None, "leave out --workers and --memory"),
        (None, 4, "4GB", Path("k.pem"), "is for a cluster"),
        (None, 4, "4GB", None, None),
    ],
)
def test_a_cluster_has_its_own_workers(
    scheduler: str | None,
    workers: int | None,
    memory: str | None,
    key: Path | None,
    words: str | None,
) -> None:
    options = CampaignOptions(
        plan=Path(), output=Path(), scheduler=scheduler, memory=memory, tls_key=key
    )
    cases = CaseOptions(workers=workers)
    if words is None:
        assert _scheduler(options, cases) is None
    else:
        assert words in refusal(_scheduler, options, cases)


ACCEPTED = """
[[clause]]
capability = "noise"
quantity = "nea"
axis = "cross"
of = "lost"
maximum = {maximum_arcsec}
[cases.lost]
cases = 4
frames = 4
"""


def test_an_acceptance_that_is_not_met_is_an_error_where_that_is_asked_for(tmp_path: Path) -> None:
    """Of cases that stand in its directory."""
    accepted(tmp_path, ACCEPTED.format(maximum_arcsec=1e6))
    for maximum_arcsec, words, verdict, code in (
        (1e6, ["--strict"], "met", 0),
        (1e-6, [], NOT_MET, 0),
        (1e-6, ["--strict"], NOT_MET, 1),
        (0.3, ["--strict"], "not shown", 0),
    ):
        (tmp_path / "plan.toml").write_text(ACCEPTED.format(maximum_arcsec=maximum_arcsec))
        asked = ("accept", "bench.toml", "--plan", "plan.toml", "-o", "out")
        done = run_hilstar_here(*asked, *words, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (code, "")
        line, page = done.stdout.splitlines()
        assert line.startswith(f"noise  {verdict:12}at most")
        assert page == "page  out/accept.html"


def test_an_acceptance_s_sets_are_run_by_one_pool_that_turns_to_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: Callable[[Any, str, Any], Engine]
) -> None:
    made: list[Any] = []
    turned: list[Any] = []
    ran: list[Any] = []

    class Workers:
        def __init__(self, *given: Any) -> None:
            made.append(given)

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None:
            made.append("closed")

        def turn_to(self, *given: Any) -> None:
            turned.append(given)

    class Cases:
        cases = 7

        def __init__(self, name: str) -> None:
            self.job, self.identity = f"job {name}", f"identity {name}"

        def run(self, directory: Any, workers: Any, on_done: Any) -> None:
            ran.append((self.job, directory, isinstance(workers, Workers)))

    def run(missing: Callable[..., None]) -> list[Any]:
        for name in ("rates", "sky"):
            missing(Cases(name), f"folder {name}", name)
        return []

    accepted = SimpleNamespace(
        on_bench=False, check=lambda: None, run=run, verdicts=lambda results: ["met"]
    )
    read = engine(acceptance_plan, "read_acceptance_plan", "the plan")
    opened = engine(acceptance_engine, "Acceptance", accepted)
    monkeypatch.setattr(pool, "Pool", Workers)
    monkeypatch.setattr(acceptance_engine, "write_ledger", lambda path, results: 0)
    monkeypatch.setattr(acceptance_page, "write_acceptance", lambda *_: {})
    monkeypatch.setattr(acceptance_page, "lines_of", lambda *_: [])
    words = "--quick --through display --workers 3 --solver-timeout 2.5 --plan own.toml"
    done = run_hilstar_here("accept", "bench.toml", "-o", "out", *words.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert read.given[0][0] == (Path("own.toml"), Path("bench.toml"), True, "display")
    assert opened.given[0][0] == ("the plan", Path("bench.toml"), Path("out"), "centroids", 2.5)
    jobs = [("job rates", "identity rates"), ("job sky", "identity sky")]
    assert made == [(*jobs[0], 3), "closed"] and turned == jobs
    assert ran == [(job, f"folder {job[4:]}", True) for job, _ in jobs]
    assert [line for line in done.stderr.splitlines() if line.endswith("7 cases")] == [
        "hilstar: rates: 7 cases",
        "hilstar: sky: 7 cases",
    ]


def test_a_duration_has_the_unit_that_gives_it_two_or_three_digits() -> None:
    times = [_time_text(seconds) for seconds in (9.0, 119.0, 120.0, 7199.0, 7200.0, 36e3)]
    assert times == ["9 s", "119 s", "2 min", "120 min", "2.0 h", "10.0 h"]


def test_an_exposure_is_summed_up_by_its_numbers(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(bench_text({"tracker": {"resolution_px": [128, 96]}}))
    words = ("simulate", "bench.toml", "--radec", "84,-1,0", "-o", "o.fits", "--json")
    told = json.loads(run_hilstar_here(*words, cwd=tmp_path).stdout)
    dn = fits.getdata(tmp_path / "o.fits")
    assert told["dn"] == {"min": dn.min(), "mean": pytest.approx(dn.mean()), "max": dn.max()}
    assert told["written"] == ["o.fits"] and told["faults"] == []


def test_an_exposure_at_a_moment_has_the_faults_that_are_on_then(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(bench_text({"tracker": {"resolution_px": [128, 96]}}))
    ghost = 'kind = "false-star"\nname = "ghost"\ntracker_px = [40, 50]\nelectrons = 1e5\n'
    (tmp_path / "ghost.toml").write_text(f"[[fault]]\n{ghost}at_s = 1.0\nfor_s = 1.0\n")
    words = "simulate bench.toml --radec 84,-1,0 -o o.fits --scenario ghost.toml --json --at"
    for at_s, faults in (("1.5", ["ghost"]), ("0.5", [])):
        told = json.loads(run_hilstar_here(words, at_s, cwd=tmp_path).stdout)
        assert told["faults"] == faults


def test_a_log_s_exposures_have_the_faults_of_a_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []
    monkeypatch.setattr(batch, "simulate_views", lambda *parts: given.append(parts[-1]))
    (tmp_path / "bench.toml").write_text(bench_text())
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n")
    (tmp_path / "cover.toml").write_text('[[fault]]\nkind = "blank"\nname = "b"\nat_s = 0.5\n')
    words = ("simulate", "bench.toml", "--log", "log.csv", "-o", "out")
    for more in ((), ("--scenario", "cover.toml")):
        assert run_hilstar_here(*words, *more, cwd=tmp_path).returncode == 0
    without, faults = given
    assert without is None and faults is not None


def test_an_attitude_is_told_with_its_rate_in_degrees_and_its_stars_places(tmp_path: Path) -> None:
    tables = {"tracker": {"resolution_px": [300, 200]}, "sky": {"faintest_v_mag": 4.0}}
    (tmp_path / "bench.toml").write_text(bench_text(tables))
    q = ",".join(map(repr, from_radec_roll_deg(84.057, -1.2, 0.0).tolist()))
    (tmp_path / "log.csv").write_text(f"t_s,qw,qx,qy,qz,rx,ry,rz\n0,{q},0.01,-0.02,0.04\n")
    words = ("attitude", "log.csv", "--bench", "bench.toml")
    told = json.loads(run_hilstar_here(*words, "--json", cwd=tmp_path).stdout)
    assert told["rate_deg_s"] == pytest.approx(np.degrees([0.01, -0.02, 0.04]))
    said = run_hilstar_here(*words, cwd=tmp_path).stdout.splitlines()
    assert said[1] == "RA 84.0570, Dec -1.2000, roll 0.0000 deg"
    assert said[2] == "rate 0.572958, -1.145916, 2.291831 deg/s about x, y, z of the camera"
    assert "of 300 x 200 px" in said[3]


def test_a_study_s_figures_are_not_written_over_its_bench(tmp_path: Path) -> None:
    bench = tmp_path / rapp.BENCH_FILES[0]
    bench.write_text(bench_text())
    assert "is read or written by this command already" in refusal(
        thesis_lines, "models", bench, tmp_path, None
    )


def test_a_scenario_gives_an_exposure_its_moments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without one nothing changes in a sky of stars alone."""

    def opened(file: Any) -> Any:
        raise InputError("enough")

    monkeypatch.setattr(simulator, "Simulator", opened)
    (tmp_path / "bench.toml").write_text(bench_text())
    fault = 'kind = "false-star"\nname = "ghost"\nscreen_px = [40, 50]\nelectrons_per_s = 1e5\n'
    (tmp_path / "ghost.toml").write_text(f"[[fault]]\n{fault}at_s = 1.0\n")
    words = ["simulate", "bench.toml", "--radec", "84,-1,0", "-o", "o.fits", "--at", "1.5"]
    still = run_hilstar_here(*words, cwd=tmp_path)
    assert_refused(still, 2, "simulate --at 1.5: nothing moves in this sky")
    timed = run_hilstar_here(*words, "--scenario", "ghost.toml", cwd=tmp_path)
    assert_refused(timed, 2, "enough")
