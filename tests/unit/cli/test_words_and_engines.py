"""What a command hands to the engine behind it is what its words say, each in its own place, and
what it says of the engine's result is that result: the engines are the test's.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.running_statistics import Percentiles
from hilstar.cli import demo as demo_command
from hilstar.cli import serve as serve_command
from hilstar.cli import tracker as tracker_command
from hilstar.cli.accept import _print_costs, _time_text
from hilstar.cli.campaign import _scheduler, telling
from hilstar.cli.demo import FOV_ARCSEC, PIXEL_ARCSEC, WRONG, TrackerBeside
from hilstar.cli.running import ActingPageOptions, DisplayOptions, RunOptions
from hilstar.cli.send import heard
from hilstar.cli.send import tell as tell_sent
from hilstar.cli.serve import ServeOptions, heads_run
from hilstar.cli.study import refuse_unused, study_lines
from hilstar.cli.tracker import TrackerOptions, checked_rate, parse_silent, planted_errors, recorded
from hilstar.instruments.assess import assessment
from hilstar.instruments.calibrate import camera_edges, effective_psf
from hilstar.instruments.calibrate import latency as by_diode
from hilstar.instruments.campaign import acceptance as acceptance_engine
from hilstar.instruments.campaign import acceptance_page, acceptance_plan, pool
from hilstar.instruments.campaign.requirements import NOT_MET
from hilstar.instruments.simulate import heads as twin_heads
from hilstar.instruments.simulate import simulator
from hilstar.instruments.simulate.tracker_process import SILENT_AFTER_S, Planted
from hilstar.instruments.study.chain import run as chain
from hilstar.server.answers.answer import Answer
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.heads import HeadsRun
from tests.support.benches import bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.refusals import refusal

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
    known: dict[str, Any] = {
        "bias": "0,0,0", "fov_error": 0.0, "pixel_error": 0.0, "wrong": "0", "silent": None,
        "latency": 0.0, "clock_drift": 0.0, "clock_offset": 0.0,
    }  # fmt: skip
    return SimpleNamespace(**(known | words))  # type: ignore[return-value]


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
    live = SimpleNamespace(frames=SimpleNamespace(received=5, missing=2))
    link = SimpleNamespace(endpoint="here", sent=7, babbled=3)
    counts = tracker_command.counts_of(live, SimpleNamespace(refused=1), link, None)  # type: ignore[arg-type]
    assert counts == {
        "frames": {"received": 5, "missing": 2, "refused": 1},
        "link": {"endpoint": "here", "sent": 7, "babbled": 3},
    }
    without = tracker_command.counts_of(live, SimpleNamespace(refused=0), None, None)  # type: ignore[arg-type]
    assert "link" not in without and "camera" not in without


def test_what_was_sent_is_all_that_left_with_what_became_of_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tally = SimpleNamespace(total=20, sent=11, lost=4, corrupted=3, reordered=2)
    counts = SimpleNamespace(summary=lambda: {"lost": 9})
    link = SimpleNamespace(
        endpoint="udp://a:1", statuses=6, requests=5, unsent=1, link_counts=counts
    )
    tell_sent(tally, link, True)
    told = json.loads(capsys.readouterr().out)
    assert (told["packets"], told["sent"], told["lost"]) == (20, 16, 4)
    assert (told["corrupted"], told["reordered"]) == (3, 2)
    assert told["link"] == {"endpoint": "udp://a:1", "lost": 9}
    tell_sent(tally, link, False)
    words = " ".join(capsys.readouterr().err.split())
    assert "16 packets sent (4 lost, 3 corrupted, 2 reordered, 1 unsent)" in words
    assert "6 statuses heard, 5 time requests answered" in words


def test_a_listener_is_waited_for_in_slices_and_a_stop_ends_that() -> None:
    slices: list[float] = []

    def answers_third(seconds: float) -> bool:
        slices.append(seconds)
        return len(slices) == 3

    stop = threading.Event()
    sender = SimpleNamespace(wait_for_listener=answers_third)
    assert heard(sender, 1e6, stop, lambda seconds: None)
    assert len(slices) == 3
    silent = SimpleNamespace(wait_for_listener=lambda seconds: False)
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
    pairs = [
        {
            "heads": ["left", "right"], "fields": 4,
            "linear_arcsec": {"rms": 0.1, "max": 0.2}, "codes_arcsec": {"rms": 0.3, "max": 0.4},
        },
        {"heads": ["left", "up"], "fields": 0, "linear_arcsec": None, "codes_arcsec": None},
        {
            "heads": ["up", "left"], "fields": 1,
            "linear_arcsec": {"rms": 0.1, "max": 0.2}, "codes_arcsec": None,
        },
    ]  # fmt: skip
    twins = [SimpleNamespace(summary=lambda pair=pair: pair) for pair in pairs]
    asked = engine(twin_heads, "verify_heads", twins)
    words = ["verify", "heads.toml", "--fields", "4", "--seed", "9"]
    done = run_hilstar_here(*words, *["--json"] * as_json, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ((heads, fields, rng, _), _) = asked.given[0]
    assert (list(heads.names), fields) == (["left", "right"], 4)
    assert rng.random() == np.random.default_rng(9).random()
    if as_json:
        assert json.loads(done.stdout) == {"angles": pairs}
    else:
        assert [" ".join(line.split()) for line in done.stdout.splitlines()] == [
            "left to right 0.1000 / 0.2000 arcsec from linear light, 0.3000 / 0.4000 from codes"
            " (rms / max, 4 fields)",
            "left to up too few stars in both",
            "up to left too few stars in both",
        ]


def test_a_study_s_findings_are_right_where_all_of_its_cases_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = [
        SimpleNamespace(
            right=right, case="c", happens="h", why="w", method="m", fails="f"
        )
        for right in (True, False)
    ]  # fmt: skip
    finding = SimpleNamespace(figure="rapp", text="as the thesis")
    studies = {
        "stability": SimpleNamespace(run=lambda output: cases),
        "models": SimpleNamespace(run=lambda output: [finding]),
        "outputs": SimpleNamespace(run=lambda output: ["one"]),
        "timing": SimpleNamespace(run=lambda output, quick: (["timed"], None)),
        "limits": SimpleNamespace(run=lambda output, quick: [f"quick {quick}"]),
    }
    monkeypatch.setattr("hilstar.cli.study.import_module", lambda name: studies[name.split(".")[3]])
    output = tmp_path / "out"
    lines, right = study_lines("stability", output)
    assert lines == ["right  c: h (w); not m: f", "WRONG  c: h (w); not m: f"]
    assert right is False and output.is_dir()
    del cases[1]
    assert study_lines("stability", output)[1] is True
    assert study_lines("models", output) == (["rapp: as the thesis"], True)
    assert study_lines("outputs", output) == (["one"], True)
    assert study_lines("timing", output) == (["timed"], None)
    assert study_lines("limits", output, quick=True) == (["quick True"], True)


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


@pytest.mark.parametrize(("on_bench", "of_time"), [(False, "on 6 cores"), (True, "at most")])
def test_the_costs_of_a_plan_are_those_of_its_sets_and_of_all(
    capsys: pytest.CaptureFixture[str], on_bench: bool, of_time: str
) -> None:
    clauses = {"rates": ["angular rate", "lag"], "sky": ["availability"]}
    costs = [
        SimpleNamespace(case_set=SimpleNamespace(name="rates"), cases=40, seconds=100.0),
        SimpleNamespace(case_set=SimpleNamespace(name="sky"), cases=1000, seconds=8000.0),
    ]
    workers: list[int] = []
    acceptance = SimpleNamespace(
        costs=lambda count: workers.append(count) or costs,
        plan=SimpleNamespace(
            clauses_of=lambda name: [SimpleNamespace(capability=each) for each in clauses[name]]
        ),
        on_bench=on_bench,
    )
    _print_costs(acceptance, 6, False)  # type: ignore[arg-type]
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        "rates 40 cases 100 s angular rate",
        "lag",
        "sky 1000 cases 2.2 h availability",
        f"all 1040 cases 2.2 h {of_time}",
    ]
    _print_costs(acceptance, 6, True)  # type: ignore[arg-type]
    told = json.loads(capsys.readouterr().out)
    assert (told["s"], workers) == (8100.0, [6, 6])
    assert told["sets"][0] == {"set": "rates", "cases": 40, "s": 100.0, "clauses": clauses["rates"]}


def test_progress_without_a_terminal_is_a_line_each_ten_seconds_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 1000.0
    clock = SimpleNamespace(monotonic=lambda: now_s)
    monkeypatch.setattr("hilstar.cli.campaign.time", clock)
    with telling(100) as line:
        for passed_s, done in ((1.0, 20), (5.0, 30), (11.0, 40), (12.0, 41), (21.0, 60)):
            now_s = 1000.0 + passed_s
            line(done)
    # of those that were done since the first look: 20 in 10 s, and 40 in 20 s
    assert capsys.readouterr().err.splitlines() == [
        "hilstar: 40 of 100 cases, 2 a second, 30 s left",
        "hilstar: 60 of 100 cases, 2 a second, 20 s left",
    ]


def test_a_head_gets_the_options_of_its_run_and_none_of_another_kind() -> None:
    file = SimpleNamespace(names=["a"])
    run = heads_run(
        file,  # type: ignore[arg-type]
        SimpleNamespace(frames=30, duration=2.5, scpi=None, bench_file=Path("heads.toml")),  # type: ignore[arg-type]
        SimpleNamespace(headless=True, windowed=False, force=True, feed=None),  # type: ignore[arg-type]
        SimpleNamespace(
            ledger=Path("run.mcap"), ledger_split="1GB", scenario=Path("s.toml"), overwrite=False,
            strict=True, explain=False,
        ),  # type: ignore[arg-type]
        SimpleNamespace(control=True, token="secret"),  # type: ignore[arg-type]
    )  # fmt: skip
    words = ("--frames", "30", "--ledger-split", "1GB", "--scenario", "s.toml")
    switches = ("--headless", "--force", "--control", "--strict")
    wanted = HeadsRun(
        file,  # type: ignore[arg-type]
        (*words, *switches),
        2.5,
        Path("run.mcap"),
        token="secret",
    )
    assert run == wanted


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


def planted_demo(folder: Path) -> TrackerBeside:
    """The demo's tracker, which does not run."""
    return TrackerBeside(folder, folder / "loop.toml", "ipc://answers", 30.0, 5)


def test_the_demo_s_budget_stands_beside_what_was_planted(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    from hilstar.server.answers.judge import TrackerFigures

    axes = SimpleNamespace(cross=2.25, roll=8.5)
    parts = SimpleNamespace(
        bias_arcsec=np.array([19.5, -10.5, 41.0]),
        fov_arcsec=axes,
        pixel_arcsec=SimpleNamespace(cross=0.5, roll=None),
    )
    asked = engine(assessment, "assess_files", SimpleNamespace(found=parts))
    monkeypatch.setattr("hilstar.instruments.assess.page.write_page", lambda page, found: None)
    planted_demo(tmp_path).report(TrackerFigures(answers=200, wrong=3), True)
    told = json.loads(capsys.readouterr().err)["loop"]
    assert asked.given[0][0][:2] == (tmp_path / "loop.mcap", None)
    rows = {row["quantity"]: (row["planted"], row["found"], row["unit"]) for row in told}
    assert rows == {
        "bias x": (20.0, 19.5, "arcsec"),
        "bias y": (-10.0, -10.5, "arcsec"),
        "bias z": (40.0, 41.0, "arcsec"),
        "field-of-view error across": (FOV_ARCSEC, 2.25, "arcsec"),
        "field-of-view error about": (4 * FOV_ARCSEC, 8.5, "arcsec"),
        "pixel error across": (PIXEL_ARCSEC, 0.5, "arcsec"),
        "pixel error about": (4 * PIXEL_ARCSEC, None, "arcsec"),
        "wrong answers": (100 * WRONG, 1.5, "%"),
    }
    monkeypatch.setattr(
        "hilstar.instruments.assess.report.lines_of", lambda found: [("bias", "20 arcsec")]
    )
    planted_demo(tmp_path).report(None, False)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "bias 20 arcsec" and "bias x 20.00 19.50 arcsec" in lines
    assert lines[-1] == "pixel error about 2.40 unknown arcsec"  # no answers, no share of them


@pytest.mark.parametrize(("missed", "words"), [(10, ""), (11, "missed 11 frames")])
def test_the_demo_says_where_its_budget_is_the_machine_s_too(
    capsys: pytest.CaptureFixture[str], missed: int, words: str
) -> None:
    demo_command._say_missed(SimpleNamespace(frames=1000, missed_frames=missed))  # type: ignore[arg-type]
    told = capsys.readouterr().err
    assert words in told and bool(told) is bool(words)


EDGES = 20  # of which a delay is found, at least


def edges_file(folder: Path) -> Path:
    """Edges of light, 100 ns apart."""
    path = folder / "edges.csv"
    rows = [f"{100 * k},{k % 2}" for k in range(1, EDGES + 1)]
    path.write_text("\n".join(["host_ns,level", *rows]) + "\n")
    return path


def test_a_delay_that_is_measured_is_written_with_its_own_error(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine]
) -> None:
    summary = {"panel_delay_ms": 8.25, "panel_delay_u_ms": 0.5}
    measured = engine(by_diode, "measure_latency", summary)
    engine(by_diode, "latency_lines", ["eight"])
    written = engine(by_diode, "write_panel_delay", None)
    (tmp_path / "run.mcap").write_bytes(b"")
    words = ["latency", "run.mcap", "--edges", str(edges_file(tmp_path)), "--write", "b.toml"]
    done = run_hilstar_here(*words, "--save", "kept.csv", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (ledger, edges, output), _ = measured.given[0]
    assert (ledger, output) == (Path("run.mcap"), Path("out"))
    wanted_ns = [100 * k for k in range(1, EDGES + 1)]
    assert edges.host_ns.tolist() == wanted_ns
    assert written.given == [((Path("b.toml"), 8.25, 0.5), {})]
    assert by_diode.read_edges(tmp_path / "kept.csv").host_ns.tolist() == wanted_ns
    assert done.stdout == "eight\n"


def test_a_camera_films_the_square_as_the_run_s_bench_file_says(
    tmp_path: Path, engine: Callable[[Any, str, Any], Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hilstar.server.genicam import camera as genicam
    from tests.support.planted_run import write_ledger

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


def test_what_is_given_as_an_option_of_a_run_is_an_option_of_the_real_command() -> None:
    """The stand-ins above have the fields of the options themselves."""
    for options, names in (
        (ServeOptions, {"frames", "duration", "scpi", "bench_file"}),
        (DisplayOptions, {"headless", "windowed", "force", "feed"}),
        (RunOptions, {"ledger", "ledger_split", "scenario", "overwrite", "strict", "explain"}),
        (ActingPageOptions, {"control", "token"}),
        (TrackerOptions, set(vars(tracker_options()))),
    ):
        assert names <= set(options.__dataclass_fields__), options
    assert math.isfinite(WRONG)


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
    options = SimpleNamespace(what=what, bench=known["bench"], images=known["images"])
    pointing = SimpleNamespace(radec=known["radec"], star=known["star"])
    if words is None:
        refuse_unused(options, pointing)  # type: ignore[arg-type]
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
    options = SimpleNamespace(
        scheduler=scheduler, memory=memory, tls_ca_file=None, tls_cert=None, tls_key=key
    )
    cases = SimpleNamespace(workers=workers)
    if words is None:
        assert _scheduler(options, cases) is None  # type: ignore[arg-type]
    else:
        assert words in refusal(_scheduler, options, cases)


@pytest.mark.parametrize(
    ("verdict", "words", "code"),
    [
        (NOT_MET, [], 0),
        (NOT_MET, ["--strict"], 1),
        ("met", ["--strict"], 0),
        ("not shown", ["--strict"], 0),
    ],
)
def test_an_acceptance_that_is_not_met_is_an_error_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: str, words: list[str], code: int
) -> None:
    accepted = SimpleNamespace(
        on_bench=False,
        check=lambda: None,
        run=lambda missing: [],
        verdicts=lambda results: [verdict],
    )
    monkeypatch.setattr(acceptance_plan, "read_acceptance_plan", lambda *_: None)
    monkeypatch.setattr(acceptance_engine, "Acceptance", lambda *_: accepted)
    monkeypatch.setattr(acceptance_engine, "write_ledger", lambda path, results: 0)
    monkeypatch.setattr(acceptance_page, "write_acceptance", lambda *_: {})
    monkeypatch.setattr(acceptance_page, "lines_of", lambda *_: ["a line"])
    monkeypatch.setattr(acceptance_page, "verdict_of", lambda verdicts: verdicts[0])
    done = run_hilstar_here("accept", "bench.toml", "-o", "out", *words, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (code, "")
    assert done.stdout.splitlines()[0] == "a line"


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
