"""Signals, from outside: every command is gone within a second, whatever it is at, and leaves no
process behind.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

from hilstar.attitude.logs.log_file import read_log
from hilstar.basics.process.interrupts import GUARD_WAITS_S, THREAD_WAITS_S
from tests.support.benches import LIVE_BENCH, attitude_table
from tests.support.commands import has_handlers
from tests.support.forks import Started
from tests.support.senders import free_port, packet, publisher
from tests.support.servers import workers_of
from tests.support.waiting import PATIENCE_S, CoreWaits, repeating, wait_for

WITHIN_S = 1.0
# A loaded machine wakes and reaps late.
LATE_S = 0.5
# A command is ended once more in the midst of its work: what works begins children and files as it
# goes, and what waits is where it stays by then.
WORKING_S = 1.2
LATER_S = {"send": 0.3, "replay": 0.3, "lockstep": 0.3}
NO_ATTITUDE = 4
STUCK = """
import sys, time
from hilstar.server.loop import FrameLoop
def drawn(self, *arguments):
    print("drawing", flush=True)
    {}
FrameLoop.draw = drawn
"""
WITHOUT_LOCK = STUCK.format("time.sleep(60)")
WITH_LOCK = STUCK.format("sum(range(10_000_000_000))")  # as a driver that draws for a minute


def program(*words: str | Path, before: str = "") -> list[str]:
    """The command, and Python that is run before it."""
    return [
        sys.executable,
        "-c",
        f"{before}\nfrom hilstar.__main__ import main\nmain()",
        *map(str, words),
    ]


@contextmanager
def started_command(
    command: list[str], begin: type[subprocess.Popen] = Started, **more
) -> Iterator[subprocess.Popen]:
    with begin(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, **more
    ) as process:
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def test_a_hang_up_ends_nothing_under_nohup(tmp_path):
    """SIGHUP stays ignored where it was on entry."""
    ledger = tmp_path / "run.mcap"
    with publisher() as (sender, port):
        command = program(
            "serve", serve_file(tmp_path, port), "--headless", "--json", "--ledger", ledger
        )
        with started_command(command, ignored=(signal.SIGHUP,)) as process:
            assert process.stderr is not None and process.stderr.readline()
            process.send_signal(signal.SIGHUP)
            wait_for(
                lambda: (
                    sender.send(packet(0, time.monotonic_ns()))
                    or (ledger.exists() and ledger.stat().st_size > 10_000)
                )
            )
            assert process.poll() is None
            code, out, err = ends(process, signal.SIGTERM)
    assert code == 0, err
    assert json.loads(out)["frames"] > 0


def ends(process: subprocess.Popen, number: int) -> tuple[int, str, str]:
    """Exit code and what was said, after a signal; within a second, and nothing of its session
    is left.
    """
    with CoreWaits(process.pid) as waited:
        begin_s = time.monotonic()
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE_S)
        took_s = time.monotonic() - begin_s
    assert took_s - waited.s < WITHIN_S + LATE_S, (took_s, waited.s, err)
    wait_for(lambda: not of_session(process.pid))
    return process.returncode, out.decode(), err.decode()


def of_session(session: int) -> list[str]:
    """The processes of a session, zombies apart."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] != "Z":
                found.append((folder / "cmdline").read_text())
    return found


def serve_file(folder: Path, port: int, more: str = "") -> Path:
    path = folder / "serve.toml"
    path.write_text(LIVE_BENCH + attitude_table(port, more))
    return path


@pytest.mark.timing
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_run_in_order(tmp_path, number):
    """Also where SIGINT is ignored on entry, as a shell does it for what it runs with `&`; not
    where SIGHUP is (nohup).
    """
    ledger = tmp_path / "run.mcap"
    with publisher() as (sender, port):
        command = program(
            "serve", serve_file(tmp_path, port), "--headless", "--json", "--ledger", ledger
        )
        with started_command(command, ignored=(signal.SIGINT,)) as process:
            assert process.stderr is not None and process.stderr.readline()
            wait_for(
                lambda: (
                    sender.send(packet(0, time.monotonic_ns()))
                    or (ledger.exists() and ledger.stat().st_size > 10_000)
                )
            )
            code, out, err = ends(process, number)
    assert code == 0, err
    assert "Traceback" not in err
    assert json.loads(out)["ledger"]["failure"] is None
    assert len(read_log(ledger)) > 0


@pytest.mark.timing
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("before", [WITHOUT_LOCK, WITH_LOCK])
def test_a_draw_without_end_is_ended(tmp_path, small_bench_file, number, before):
    """Once in a call that lets other threads run, and once in one that does not."""
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n60,1,0,0,0\n")
    with started_command(
        program("replay", small_bench_file, log, "--headless", before=before)
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == b"drawing\n"
        with CoreWaits(process.pid) as waited:
            code, _, err = ends(process, number)
    held_up = waited.s > GUARD_WAITS_S - THREAD_WAITS_S and code == -signal.SIGKILL
    if before == WITHOUT_LOCK and not held_up:
        assert code == 128 + number
        assert f"s after {signal.Signals(number).name}" in err.splitlines()[-1]
    else:
        assert code in {128 + number, -signal.SIGKILL}


def test_a_signal_while_a_shader_is_built_ends_it_in_order(tmp_path, small_bench_file):
    """There the GL library is called by Python and calls Python, and an exception of that is a
    crash.
    """
    before = (
        "import os, signal, _moderngl\nmake = _moderngl.make_uniform\ndef told(*arguments):\n   "
        " os.kill(os.getpid(), signal.SIGINT)\n    return make(*arguments)\n_moderngl.make_uniform"
        " = told"
    )
    with started_command(
        program(
            "frame",
            small_bench_file,
            "--radec",
            "84,-1,0",
            "--codes",
            tmp_path / "c.png",
            before=before,
        )
    ) as process:
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + signal.SIGINT, err
    assert err.decode().splitlines()[-1] == "hilstar: stopped"


def test_a_signal_while_a_peer_s_library_calls_python_ends_it_without_a_word_of_python_s(tmp_path):
    """numba's LLVM does: ctypes prints an exception that comes of a callback, and goes on. Here
    qsort does, with no numba.
    """
    before = (
        "import ctypes, os, signal\nfrom hilstar.instruments.study.speed import benchmark\nkind ="
        " ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)\ndef told(*pair):\n   "
        " os.kill(os.getpid(), signal.SIGINT)\n    return 0\ndef draw(*arguments):\n   "
        " ctypes.CDLL(None).qsort((ctypes.c_int * 2)(2, 1), 2, 4, kind(told))\n    print('drawn',"
        " flush=True)\nbenchmark.METHODS = (('callback', 'calls Python', lambda: draw),)"
    )
    with started_command(
        program("benchmark", "-o", tmp_path / "times", before=before), text=True
    ) as process:
        out, err = process.communicate(timeout=2 * PATIENCE_S)
    assert process.returncode == 128 + signal.SIGINT, err
    assert (out, err.splitlines()[-1]) == ("drawn\n", "hilstar: stopped")
    assert "Traceback" not in err


def test_a_signal_in_the_middle_of_a_wait_ends_a_run_in_order(tmp_path):
    """Python runs a handler between any two steps of the main thread, and there it may hold the
    lock of what it waits for.
    """
    before = (
        "import os, signal\nfrom hilstar.basics.process.scheduling import HostClock\nwait ="
        " HostClock.wait_until\ndef told(clock, due_ns, stop):\n    with stop._cond:\n       "
        " os.kill(os.getpid(), signal.SIGINT)\n    return wait(clock, due_ns,"
        " stop)\nHostClock.wait_until = told"
    )
    with started_command(
        program("serve", serve_file(tmp_path, free_port()), "--headless", "--json", before=before),
        text=True,
    ) as process:
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == NO_ATTITUDE, err
    assert json.loads(out)["frames"] < 10


def test_a_second_signal_ends_it_at_once(tmp_path, small_bench_file):
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n60,1,0,0,0\n")
    with started_command(
        program("replay", small_bench_file, log, "--headless", before=WITHOUT_LOCK)
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == b"drawing\n"
        process.send_signal(signal.SIGTERM)
        time.sleep(0.2)
        # a watcher that was held up takes two for one
        with repeating(lambda: process.send_signal(signal.SIGTERM), 0.15):
            _, _, err = ends(process, signal.SIGTERM)
    assert "second signal" in err


def test_a_disk_that_stands_still_holds_up_neither_the_frames_nor_the_end(tmp_path):
    """The ledger's writer never returns from a write: the summary comes all the same, says it,
    and the exit code is 1.
    """
    still = (
        "import time; from hilstar.attitude.logs import mcap_log as w; w.McapWriter.flush = lambda"
        " *a: time.sleep(100)"
    )
    command = [
        "serve",
        str(serve_file(tmp_path, free_port())),
        "--headless",
        "--json",
        "--ledger",
        str(tmp_path / "run.mcap"),
    ]
    with started_command(program(*command, before=still)) as process:
        assert process.stderr is not None
        # said after two seconds of frames
        while b"no attitude yet" not in (line := process.stderr.readline()):
            assert line
        code, out, err = ends(process, signal.SIGTERM)
    assert code == 1, err
    summary = json.loads(out)
    assert summary["frames"] > 10
    assert "did not take" in summary["ledger"]["failure"]


@contextmanager
def full_pipe() -> Iterator[int]:
    """The end of a pipe into which nothing more goes, and which nobody reads."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, bytes(4096))
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"\0")
    os.set_blocking(writing, True)
    try:
        yield writing
    finally:
        os.close(reading)
        os.close(writing)


@pytest.mark.timing
def test_a_log_that_nobody_reads_holds_up_neither_the_frames_nor_the_end(tmp_path):
    ledger = tmp_path / "run.mcap"
    with publisher() as (sender, port), full_pipe() as log:
        command = program(
            "serve", serve_file(tmp_path, port), "--headless", "--json", "--ledger", ledger
        )
        with Started(command, stdout=subprocess.PIPE, stderr=log) as process:
            try:
                grown = [5_000, 15_000]  # and on
                for size in grown:
                    wait_for(
                        lambda size=size: (
                            sender.send(b"refused, which is said")
                            or (ledger.exists() and ledger.stat().st_size > size)
                        )
                    )
                with CoreWaits(process.pid) as waited:
                    begin_s = time.monotonic()
                    process.send_signal(signal.SIGTERM)
                    out, _ = process.communicate(timeout=PATIENCE_S)
                    took_s = time.monotonic() - begin_s
                assert took_s - waited.s < WITHIN_S + LATE_S, (took_s, waited.s)
            finally:
                process.kill()
    assert process.returncode == NO_ATTITUDE
    assert json.loads(out)["frames"] > 10


@pytest.mark.timing
def test_a_summary_that_nobody_reads_does_not_hold_up_the_end(tmp_path):
    with full_pipe() as stdout:
        command = program("serve", serve_file(tmp_path, free_port()), "--headless")
        with Started(command, stdout=stdout, stderr=subprocess.PIPE) as process:
            try:
                assert process.stderr is not None and process.stderr.readline()
                with CoreWaits(process.pid) as waited:
                    begin_s = time.monotonic()
                    process.send_signal(signal.SIGTERM)
                    process.wait(timeout=PATIENCE_S)
                    took_s = time.monotonic() - begin_s
                assert took_s - waited.s < WITHIN_S + LATE_S, (took_s, waited.s)
            finally:
                process.kill()
    assert process.returncode == 128 + signal.SIGTERM


def test_a_lockstep_message_that_is_no_request_holds_up_nothing(tmp_path):
    """A DEALER that leaves out the empty part: libzmq's poll says that something is there, and
    nothing ever is.
    """
    port = free_port()
    context = zmq.Context()
    wrong, right = context.socket(zmq.DEALER), context.socket(zmq.REQ)
    with started_command(
        program("serve", serve_file(tmp_path, port, "lockstep = true"), "--headless", "--json")
    ) as process:
        try:
            assert process.stderr is not None and process.stderr.readline()
            for asker in (wrong, right):
                asker.setsockopt(zmq.LINGER, 0)
                asker.setsockopt(zmq.RCVTIMEO, round(PATIENCE_S * 1000))
                asker.connect(f"tcp://127.0.0.1:{port}")
            for _ in range(5):
                wrong.send(packet(1, 1))
                time.sleep(0.1)
            right.send(packet(2, 2))
            assert right.recv()
            for _ in range(5):
                wrong.send(packet(1, 1))
                time.sleep(0.1)
            code, out, _ = ends(process, signal.SIGTERM)
        finally:
            for asker in (wrong, right):
                asker.close()
            context.term()
    assert code == 0
    assert json.loads(out)["frames"] == 1


def test_a_sender_whose_listener_takes_nothing_ends_in_order(tmp_path):
    """Over ZeroMQ to a subscriber that never reads, and over a line that is full."""
    port = free_port()
    context = zmq.Context()
    deaf = context.socket(zmq.SUB)
    deaf.setsockopt(zmq.LINGER, 0)
    deaf.setsockopt(zmq.RCVHWM, 1)
    deaf.setsockopt(zmq.RCVBUF, 4096)
    deaf.setsockopt(zmq.SUBSCRIBE, b"")
    deaf.connect(f"tcp://127.0.0.1:{port}")
    far, near = os.openpty()
    try:
        for to, rate in (
            (f"tcp://127.0.0.1:{port}", "10000"),
            (f"serial:{os.ttyname(near)}@115200", "1000"),
        ):
            with started_command(
                program("send", "--spin", "z,1", "--rate", rate, "--to", to, "--json")
            ) as process:
                wait_for(lambda process=process: has_handlers(process))
                assert (
                    process.stderr is not None
                    and b"waiting for a listener" in process.stderr.readline()
                )
                time.sleep(0.4)  # up to four thousand packets: nothing more goes in
                code, out, err = ends(process, signal.SIGTERM)
            assert code == 0, err
            assert json.loads(out)["packets"] > 10
    finally:
        for descriptor in (far, near):
            os.close(descriptor)
        deaf.close()
        context.term()


def ctrl_c_is_blocked(worker: int) -> bool:
    (line,) = (
        line
        for line in Path(f"/proc/{worker}/status").read_text().splitlines()
        if line.startswith("SigBlk")
    )
    return bool(int(line.split()[1], 16) & 1 << signal.SIGINT - 1)


def test_a_pool_of_workers_ends_with_its_command(tmp_path, small_bench_file):
    """A terminal's Ctrl-C reaches all of them, and is for the command alone."""
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n" + "".join(f"{t},1,0,0,0\n" for t in range(5000)))
    out = tmp_path / "out"
    for number in (signal.SIGTERM, signal.SIGKILL):
        with started_command(
            program("simulate", small_bench_file, "--log", log, "-o", out / str(number))
        ) as process:
            wait_for(lambda number=number: list((out / str(number)).glob("*.fits")))
            assert workers_of(process) and all(map(ctrl_c_is_blocked, workers_of(process)))
            code, _, err = ends(process, number)
        assert code == (128 + number if number == signal.SIGTERM else -number)
        assert "Traceback" not in err


def other_commands(folder: Path, bench: Path) -> dict[str, list[str]]:
    log = folder / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n" + "".join(f"{0.1 * t},1,0,0,0\n" for t in range(2000)))
    port = free_port()
    return {
        "send": ["send", "--spin", "z,1", "--to", f"tcp://127.0.0.1:{port}"],
        "demo": ["demo", "-o", str(folder / "demo"), "--duration", "100"],
        "replay": ["replay", str(bench), str(log), "--headless"],
        "verify": ["verify", str(bench), "--fields", "10000"],
        "benchmark": ["benchmark", "-o", str(folder / "bench")],
        "study": ["study", "stability", "-o", str(folder / "study")],
        "lockstep": ["serve", str(serve_file(folder, port, "lockstep = true")), "--headless"],
    }


@pytest.mark.timing
@pytest.mark.parametrize(
    "name", ["send", "demo", "replay", "verify", "benchmark", "study", "lockstep"]
)
def test_every_command_that_takes_its_time_ends_within_a_second(tmp_path, small_bench_file, name):
    for number, later_s, begin in (
        (signal.SIGTERM, 0.0, subprocess.Popen),
        (signal.SIGINT, LATER_S.get(name, WORKING_S), Started),
    ):
        with started_command(
            program(*other_commands(tmp_path, small_bench_file)[name]), begin
        ) as process:
            wait_for(lambda process=process: has_handlers(process))
            time.sleep(later_s)
            code, _, err = ends(process, number)
        assert code in {0, NO_ATTITUDE, 128 + number}, err
        assert "Traceback" not in err


def test_closed_standard_streams_are_nobody_else_s(tmp_path, small_bench_file):
    """Else the first socket or file would be the standard error, and take its lines."""
    out = tmp_path / "frame.fits"
    command = program("frame", small_bench_file, "--radec", "84,-1,0", "-o", out)
    result = subprocess.run(
        ["bash", "-c", 'exec "$@" 0<&- 1>&- 2>&-', "bash", *command],
        timeout=PATIENCE_S,
        check=False,
    )
    assert result.returncode == 0
    assert out.read_bytes().startswith(b"SIMPLE")


def test_with_stderr_closed_stdout_holds_no_line_of_it(tmp_path):
    command = program("attitude", tmp_path / "no.csv", "--json")
    result = subprocess.run(
        ["bash", "-c", 'exec "$@" 2>&-', "bash", *command],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (result.returncode, result.stdout) == (2, "")


def test_a_run_with_all_standard_streams_closed_shows_its_frames(tmp_path):
    command = program(
        "serve",
        serve_file(tmp_path, free_port()),
        "--headless",
        "--frames",
        "2",
        "--ledger",
        tmp_path / "run.mcap",
    )
    result = subprocess.run(
        ["bash", "-c", 'exec "$@" 0<&- 1>&- 2>&-', "bash", *command],
        timeout=PATIENCE_S,
        check=False,
    )
    assert result.returncode == NO_ATTITUDE
    assert (tmp_path / "run.mcap").stat().st_size > 0
