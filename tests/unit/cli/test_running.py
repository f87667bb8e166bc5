"""What a run ends with, and who is let into its page and its SCPI: as the commands decide it, with
no run.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from msgspec.structs import replace as replaced

from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.notices import Notices
from hilstar.cli import first_light, image_source
from hilstar.cli.image_source import DotOptions, dot_images
from hilstar.cli.running import (
    ActingPageOptions,
    DisplayOptions,
    PageOptions,
    RunOptions,
    dated_ledger,
    end_of_run,
    followed,
    optional_answers,
    optional_frames,
    optional_scenario,
    page_listener,
    run_with_faults,
    say_beat,
    say_seen,
    scpi_listener,
    shown_bench,
)
from hilstar.cli.shown_run import run_files
from hilstar.cli.tracker import open_camera
from hilstar.instruments.calibrate import grabbed_dots
from hilstar.instruments.calibrate.grabbed_dots import DotImages
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.build import load
from hilstar.server.bench.scenario import NO_SCENARIO
from hilstar.server.faults import NO_RECORDING, Recording, ReplayedFaults, RunFaults
from hilstar.server.record.ledger import LedgerSwitch
from hilstar.server.replay import DrawnBy
from hilstar.server.summary import RunTally, RunVerdict
from hilstar.server.watchdog import GPU_LOST
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.closed_camera import ClosedCamera, power_of
from tests.support.commands import run_hilstar_here
from tests.support.model_display import model_screen
from tests.support.senders import free_port

RENDERER = DrawnBy("none", "none", "NumPy")
TOKEN = "0123456789abcdef-0123"


def ended(
    frames: int = 10,
    accepted: int = 5,
    is_strict: bool = True,
    failure: str | None = None,
    gone: str | None = None,
    gpu: str = "",
    strict: bool = False,
    blank: int | None = None,
) -> int:
    """The exit code of a run, 3 where it raises MachineError."""
    tally = RunTally()
    for _ in range(frames):
        tally.add(1_000_000, None if not accepted else 0, 3, ())
    tally.blank_frames = (0 if accepted else frames) if blank is None else blank
    summary = tally.summary(1.0, PacketCounts(received=accepted), RENDERER)
    summary = replaced(summary, verdict=RunVerdict(is_strict, is_strict, 0.0, 0.0, ""))
    notices = Notices()
    if gpu:
        notices.begin(GPU_LOST, gpu)
    try:
        end_of_run(summary, gone, failure, notices, as_json=False, strict=strict)
    except typer.Exit as exit_:
        return exit_.exit_code
    except MachineError as error:
        return error.exit_code
    return 0


@pytest.mark.parametrize(
    ("run", "exit_code"),
    [
        ({}, 0),
        ({"is_strict": False}, 0),  # nobody asked
        ({"strict": True}, 0),
        ({"strict": True, "is_strict": False}, 1),
        # a run without an attitude is code 4, the caller's
        ({"strict": True, "is_strict": False, "accepted": 0}, 0),
        # a replay has no packets, and all frames of a run may be blank before its attitude
        ({"strict": True, "is_strict": False, "accepted": 0, "blank": 0}, 1),
        ({"strict": True, "is_strict": False, "blank": 10}, 1),
        ({"failure": "No space left on device"}, 1),
        ({"gone": "its display was unplugged"}, 3),
        ({"gpu": "the GPU was reset: the run ends"}, 3),
        ({"gpu": "the GPU was reset: the run ends", "failure": "disk full"}, 3),
    ],
)
def test_a_run_ends_with_the_code_of_what_became_of_it(run, exit_code, capsys):
    assert ended(**run) == exit_code


@pytest.fixture
def listens(tmp_path):
    """What a page and SCPI listen with, by their options; all are closed."""
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    file = read_bench_file(path)
    with ExitStack() as stack:

        def opened(page: PageOptions, scpi: str | None = "127.0.0.1:0"):
            listener = stack.enter_context(page_listener(page))
            return listener, stack.enter_context(scpi_listener(file, scpi, listener, page.token))

        yield opened


def test_scpi_has_the_token_that_its_page_has_and_else_that_of_the_command_line(listens):
    page, scpi = listens(PageOptions(console="127.0.0.1:0", token=TOKEN))
    assert (page.token, scpi.token) == (TOKEN, TOKEN)
    alone, scpi = listens(PageOptions(token=TOKEN))
    assert (alone, scpi.token, scpi.made) == (None, TOKEN, False)
    page, scpi = listens(PageOptions(console="127.0.0.1:0"))
    assert (page.token, scpi.token) == ("", "")  # this machine's users alone


def test_beyond_this_machine_a_page_and_scpi_have_one_token_that_was_made(listens):
    page, scpi = listens(PageOptions(console="0.0.0.0:0"), "0.0.0.0:0")
    assert len(page.token) > 30
    assert scpi.token == page.token
    _, alone = listens(PageOptions(), "0.0.0.0:0")
    assert len(alone.token) > 30
    assert alone.made


@pytest.mark.parametrize(
    ("page", "words"),
    [
        (ActingPageOptions(control=True), "--control: is the page's"),
        (PageOptions(console_name=["bench.lab"]), "--console-name: is the page's"),
        (PageOptions(console="127.0.0.1:0", token="short"), "--token: write 16 to 200"),
    ],
)
def test_what_is_a_page_s_needs_one(listens, page, words):
    with pytest.raises(InputError, match=words):
        listens(page)


def test_a_bench_that_scpi_steers_needs_scpi(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"attitude": {"source": "scpi"}}))
    with (
        pytest.raises(InputError, match="needs SCPI; add --scpi"),
        scpi_listener(read_bench_file(path), None, None, None),
    ):
        raise AssertionError("a source that nothing feeds is refused")


@pytest.mark.parametrize(
    ("named", "dark"), [(Path("mine.fits"), Path("mine.fits")), (None, Path("taken.fits"))]
)
def test_a_dark_frame_that_is_named_counts_in_place_of_the_one_that_was_taken(
    tmp_path, monkeypatch, named, dark
):
    taken = DotImages([Path("0.fits")], Path("taken.fits"))
    source = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(grabbed_dots, "grab_dots", lambda *_, **__: taken)
    monkeypatch.setattr(image_source, "real_source", lambda *_: source)
    file = bench_file_of(tmp_path / "bench.toml", SMALL_BENCH)
    images = dot_images(file, [], tmp_path, DotOptions(grab="shoot {output}", dark=named))
    assert images == DotImages([Path("0.fits")], dark)


def test_dots_are_taken_with_the_exposure_that_is_asked_for_and_handed_on(tmp_path, monkeypatch):
    camera = ClosedCamera(power_of(2.2), 400_000.0)
    asked, opened, handed = [], [], []
    monkeypatch.setattr(camera, "hand_on", handed.append)
    monkeypatch.setattr(image_source, "real_source", lambda *all_: opened.append(all_) or camera)

    def grab_dots(file, source, plan, exposure_s, *, overwrite, tell):
        asked.append((exposure_s, overwrite))
        return DotImages([Path("0.fits")], Path("taken.fits"))

    monkeypatch.setattr(grabbed_dots, "grab_dots", grab_dots)
    file = bench_file_of(tmp_path / "bench.toml", SMALL_BENCH)
    feed = f"tcp://127.0.0.1:{free_port()}"
    options = DotOptions(grab="shoot {output}", exposure=0.02, feed=feed, overwrite=True)
    dot_images(file, [], tmp_path, options)
    assert asked == [(0.02, True)]
    assert opened == [(file, "shoot {output}")]
    assert len(handed) == 1


@pytest.mark.parametrize(
    ("given", "options", "words"),
    [
        ([], {"exposure": 0.1}, "--exposure: is for --grab"),
        ([], {"feed": "tcp://127.0.0.1:0"}, "--feed: is for --grab"),
        ([], {}, "no image of the dots"),
        ([Path("0.fits")], {"grab": "shoot {output}"}, "--grab takes the images"),
    ],
)
def test_images_of_dots_are_given_or_taken(tmp_path, given, options, words):
    with pytest.raises(InputError, match=words):
        dot_images(None, given, tmp_path, DotOptions(**options))


def test_a_beat_is_with_the_refresh_that_was_measured_where_the_screen_paces(tmp_path):
    screen, _ = model_screen(tmp_path)
    config = screen.bench.config
    for is_paced, refresh_hz in ((True, 62.5), (False, 60.0)):
        screen.keep_time(16.0, is_paced, 0)
        assert say_beat(config, screen).refresh_hz == refresh_hz
    assert say_beat(config, None).refresh_hz == 60.0


def test_a_tracker_s_camera_that_others_reach_needs_to_know_whom_to_let_in(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    with (
        pytest.raises(InputError, match="nothing says which may use it"),
        open_camera("192.0.2.1", [], read_bench_file(path), 2.0),
    ):
        pass


SCENARIO = (
    '[[fault]]\nkind = "blank"\nname = "cover"\nat_s = 0.5\nfor_s = 0.1\n'
    '[[fault]]\nkind = "freeze"\nname = "stuck"\n'
    '[[fault]]\nkind = "drop"\nname = "first"\nat_s = 0\n'
)


def test_a_run_has_the_faults_of_its_scenario_its_stream_or_its_recording(
    tmp_path, capsys, bench_with
):
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO)
    scenario = optional_scenario(path)
    assert optional_scenario(None) is None
    run = bench_with(), Notices(), LedgerSwitch()
    with run_with_faults(run[0], None, *run[1:]) as none:
        assert none is None
    with run_with_faults(run[0], scenario, *run[1:]) as faults:
        assert isinstance(faults, RunFaults) and faults.schedule.scenario is scenario
    assert capsys.readouterr().err == f"{path}: 3 faults, 2 of them at their time\n"
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    streamed = bench_with(f'[faults]\nendpoint = "{endpoint}"\n')
    with run_with_faults(streamed, None, *run[1:]) as faults:
        assert faults.schedule.scenario is NO_SCENARIO
    assert capsys.readouterr().err == f"faults: waiting for a sender at {endpoint}\n"


def test_a_replay_has_the_faults_of_its_run_and_no_other(tmp_path, bench_with):
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO)
    bench, notices, ledger = bench_with(), Notices(), LedgerSwitch()
    recording = Recording({1: optional_scenario(path).faults[0]}, 0, tmp_path)
    with run_with_faults(bench, None, notices, ledger, recording) as faults:
        assert isinstance(faults, ReplayedFaults)
    with (
        pytest.raises(InputError, match="faults of its own"),
        run_with_faults(bench, optional_scenario(path), notices, ledger, recording),
    ):
        pass
    with run_with_faults(bench, None, notices, ledger, NO_RECORDING) as faults:
        assert faults is None


def test_what_follows_a_run_has_each_frame_in_its_order():
    """The record first, as it is what a failure leaves; then the status, then who watches."""
    seen: list[str] = []

    def sink(name: str):
        return lambda shown: seen.append(f"{name} {shown}")

    status = SimpleNamespace(see=sink("status"), follow="follows", begun=0, alive=0, line=0)
    frames = SimpleNamespace(see=sink("frames"))
    description = SimpleNamespace(command="demo")
    with followed(None, False, description, None, status, sink("record"), frames) as what:
        what[0]("1st")
        what[0]("2nd")
        assert what[1:] == ("follows", None)
    assert seen == [
        f"{name} {k}" for k in ("1st", "2nd") for name in ("record", "status", "frames")
    ]
    with followed(None, False, description, None, status) as what:
        assert what[0] is status.see


@pytest.mark.parametrize("acts", [False, True])
def test_a_page_follows_a_run_after_its_status_and_hands_on_what_is_asked_there(monkeypatch, acts):
    seen: list[object] = []
    requests, listener, scpi, parts = object(), object(), object(), object()
    description = SimpleNamespace(command="demo")

    def opened_page(listeners, control, described, of):
        assert (listeners.page, listeners.scpi) == (listener, scpi)
        assert (control, described, of) == (acts, description, parts)
        page = SimpleNamespace(
            see=lambda shown: seen.append(("page", shown)),
            follow=lambda run: seen.append(("page follows", run)),
        )
        return nullcontext((page, requests))

    monkeypatch.setattr("hilstar.server.console.publisher.opened_page", opened_page)
    status = SimpleNamespace(
        see=lambda shown: seen.append(("status", shown)),
        follow=lambda run: seen.append(("status follows", run)),
        begun=0, alive=0, line=0,
    )  # fmt: skip
    with followed(listener, acts, description, parts, status, scpi=scpi) as (sink, follow, asked):
        follow("a run")
        sink("a frame")
        assert asked is requests
    assert seen == [
        ("status follows", "a run"),
        ("page follows", "a run"),
        ("status", "a frame"),
        ("page", "a frame"),
    ]


def test_a_session_s_lines_go_to_the_terminal_and_to_its_page(monkeypatch, capsys):
    told: list[object] = []
    file, listener = object(), object()

    def session_page(*given):
        assert given == (listener, True, file)
        return nullcontext(SimpleNamespace(say=told.append, show=told.append))

    monkeypatch.setattr("hilstar.server.console.publisher.session_page", session_page)
    for page, heard in ((None, []), (listener, ["step 2", "a pattern"])):
        with first_light._shown(page, True, file) as (tell, show):
            tell("step 2")
            show("a pattern")
        assert told == heard and capsys.readouterr().err == "step 2\n"


@pytest.mark.parametrize("is_asked", [False, True])
def test_a_screen_is_a_window_and_forced_only_where_it_is_asked_to_be(
    tmp_path, monkeypatch, is_asked
):
    screen, _ = model_screen(tmp_path)
    asked = []

    @contextmanager
    def open_screen(file, today, *, windowed, force, timed):
        asked.append((windowed, force, timed))
        yield screen

    monkeypatch.setattr("hilstar.server.screen.gate.open_screen", open_screen)
    file = bench_file_of(tmp_path / "bench.toml", SMALL_BENCH)
    display = DisplayOptions(windowed=is_asked, force=is_asked)
    with shown_bench(file, display, timed=True) as shown:
        assert shown == (screen.bench, screen)
    assert asked == [(is_asked, is_asked, True)]


@pytest.mark.parametrize("forced", [False, True])
def test_a_session_takes_any_monitor_and_orders_from_its_page_only_where_it_is_told_to(
    tmp_path, monkeypatch, forced
):
    camera = ClosedCamera(power_of(2.2), 400_000.0)
    asked = []

    def find_monitor(file, today, *, force):
        asked.append(force)
        raise MachineError("there is no monitor")

    def session_page(listener, control, file):
        asked.append(control)
        return nullcontext(SimpleNamespace(say=print, show=print))

    monkeypatch.setattr(camera, "find_monitor", find_monitor)
    monkeypatch.setattr(first_light, "image_source", lambda *_: camera)
    monkeypatch.setattr("hilstar.server.console.publisher.session_page", session_page)
    (tmp_path / "bench.toml").write_text(bench_text())
    words = ["first-light", "bench.toml", "-o", "s", "--grab", "take {output}"]
    words += ["--console", "127.0.0.1:0", *["--force", "--control"] * forced]
    done = run_hilstar_here(*words, cwd=tmp_path)
    assert done.returncode == 3 and "there is no monitor" in done.stderr
    assert asked == [forced, forced]


def test_answers_are_taken_and_frames_are_fed_while_a_run_lasts(tmp_path, monkeypatch, capsys):
    taken: list[str] = []
    source = SimpleNamespace(
        endpoint="udp://here", take=lambda: taken.append("look") or [], unread="",
        refusals=dict, trouble=lambda: "",
    )  # fmt: skip
    monkeypatch.setattr(
        "hilstar.server.answers.reader.open_answers", lambda *given: nullcontext(source)
    )
    answers = {"source": "udp", "bind": "127.0.0.1:5000", "format": "json"}
    for name, tables in (("plain", {}), ("answered", {"answers": answers})):
        (tmp_path / f"{name}.toml").write_text(
            bench_text({"render": {"quantisation": "round"}}, tables)
        )
    with load(tmp_path / "plain.toml") as bench:
        with optional_answers(bench, Notices(), LedgerSwitch(), None) as none:
            assert none is None
        with optional_frames(None, bench, None) as none:
            assert none is None
        with optional_frames(f"ipc://{tmp_path}/feed", bench, None) as feed:
            assert feed.endpoint == f"ipc://{tmp_path}/feed"
    assert capsys.readouterr().err == f"frames: ipc://{tmp_path}/feed\n"
    with (
        load(tmp_path / "answered.toml") as bench,
        optional_answers(bench, Notices(), LedgerSwitch(), None) as live,
    ):
        assert live is not None and live.figures.answers == 0
    assert taken  # once more at its end
    assert capsys.readouterr().err == "answers: udp://here\n"


def test_a_ledger_s_name_has_the_time_of_its_start_where_it_asks_for_it():
    assert dated_ledger(None) is None
    assert dated_ledger(Path("a/run.mcap")) == Path("a/run.mcap")
    before = datetime.now(UTC).replace(microsecond=0)
    name = dated_ledger(Path("a/run-{utc}.mcap")).name
    stamp = datetime.strptime(name, "run-%Y%m%dT%H%M%SZ.mcap").replace(tzinfo=UTC)
    assert before <= stamp <= datetime.now(UTC)


def test_the_files_of_a_run_are_read_or_written_and_never_both(tmp_path):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH)
    file = read_bench_file(tmp_path / "bench.toml")
    scenario, log = tmp_path / "scenario.toml", tmp_path / "log.csv"
    scenario.write_text(SCENARIO)
    ledger = tmp_path / "run.mcap"
    options = RunOptions(ledger=ledger, scenario=scenario)
    found = run_files(options, file, [log], [tmp_path / "out.csv"])
    assert found.ledger == ledger and len(found.scenario.faults) == 3
    for inputs, output in (([log], log), ([], scenario), ([], file.path), ([], ledger)):
        with pytest.raises(InputError):
            run_files(options, file, inputs, [output])
    ledger.write_bytes(b"a run")
    with pytest.raises(InputError, match=r"run\.mcap"):
        run_files(options, file)


@pytest.mark.parametrize(
    ("changes", "warning"),
    [
        ({}, "a star is 7.9 times as wide as the sky's"),
        ({"collimator": {"focal_length_mm": 6.0}}, "check the units: "),
    ],
)
def test_a_run_says_what_the_tracker_sees_and_where_that_is_implausible(
    tmp_path, capsys, changes, warning
):
    (tmp_path / "bench.toml").write_text(bench_text(changes))
    with load(tmp_path / "bench.toml") as bench:
        seen = say_seen(bench)
    fields, star, warned = capsys.readouterr().err.splitlines()
    assert fields.startswith("screen ") and star.startswith("star ")
    assert warned.startswith(warning)
    assert seen["fields_of_view"]["screen_deg"] and seen["star"]["sigma_px"]
