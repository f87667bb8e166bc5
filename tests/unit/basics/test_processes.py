"""Processes and clocks: when a sign of life goes to systemd, which of several readings of two clocks
counts, when a reader is prompt, what nobody reads, and where users' modules come from.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib.util
import multiprocessing
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from importlib.machinery import PathFinder
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilstar.basics.process import interrupts, scheduling
from hilstar.basics.process.pool import ONE_THREAD, ProcessPool, WorkerProcess, _for_children
from hilstar.basics.process.programs import EACH_S, Service, sign_period_s
from hilstar.basics.process.scheduling import (
    HEAVY,
    LOOK_S,
    UNDISCIPLINED_NS,
    BackOff,
    HostClock,
    PromptWhileLight,
    steady_loop,
)
from hilstar.basics.process.user_code import UserCodeError, user_function
from tests.support.fake_clock import FakeClock

OWN, OTHER = 4711, 4712
PATIENCE_S = 60.0


@pytest.mark.parametrize(
    ("environment", "period_s"),
    [
        ({}, EACH_S),
        ({"WATCHDOG_USEC": "600000"}, 0.3),
        ({"WATCHDOG_USEC": "600000", "WATCHDOG_PID": str(OWN)}, 0.3),
        ({"WATCHDOG_USEC": "600000", "WATCHDOG_PID": str(OTHER)}, EACH_S),  # its parent's
        ({"WATCHDOG_USEC": "60000000"}, EACH_S),
        ({"WATCHDOG_USEC": "soon"}, EACH_S),
        ({"WATCHDOG_USEC": "600000", "WATCHDOG_PID": ""}, EACH_S),
    ],
)
def test_signs_go_to_systemd_twice_in_what_it_waits_for_this_process(environment, period_s):
    """sd_watchdog_enabled(3): microseconds, and for WATCHDOG_PID alone; half of it is advised."""
    assert sign_period_s(environment, OWN) == pytest.approx(period_s)


@pytest.mark.parametrize("is_abstract", [False, True])
def test_a_service_whose_work_hangs_gives_no_sign_until_it_goes_on(tmp_path, is_abstract):
    """sd_notify(3): @ stands for the zero that an abstract socket's name begins with."""
    address = f"@hilstar-{tmp_path}" if is_abstract else str(tmp_path / "notify")
    asked = 0

    def alive() -> bool:
        nonlocal asked
        asked += 1
        return asked > 3

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address.replace("@", "\0"))
        systemd.settimeout(PATIENCE_S)
        environment = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "20000"}
        with Service(lambda: True, alive, lambda: "two\nlines", environment):
            assert systemd.recv(999) == b"READY=1\nSTATUS=two lines"
            assert systemd.recv(999) == b"WATCHDOG=1\nSTATUS=two lines"
            assert asked > 3


class ScriptedClock(HostClock):
    """Gives its readings one after the other."""

    def __init__(self, now_ns: list[int], realtime_ns: list[int]) -> None:
        self._now_ns = iter(now_ns)
        self._realtime_ns = iter(realtime_ns)

    def now_ns(self) -> int:
        return next(self._now_ns)

    def realtime_ns(self) -> int:
        return next(self._realtime_ns)


@pytest.mark.parametrize(
    ("now_ns", "realtime_ns", "offset_ns"),
    [
        # read at once: the calendar's clock was read in the middle of the other's two readings
        ([1000, 1400], [10_000], 1200 - 10_000),
        # an interruption in the first two tries, the third is quick
        ([0, 90_000, 200_000, 350_000, 400_000, 400_200], [7, 8, 9], 400_100 - 9),
        # all three are slow: the quickest counts, whichever it is
        ([0, 90_000, 200_000, 230_000, 400_000, 490_000], [7, 8, 9], 215_000 - 8),
        ([0, 30_000, 200_000, 260_000, 400_000, 490_000], [7, 8, 9], 15_000 - 7),
    ],
)
def test_two_clocks_are_compared_by_the_quickest_of_three_readings(now_ns, realtime_ns, offset_ns):
    assert ScriptedClock(now_ns, realtime_ns).monotonic_minus_realtime_ns() == offset_ns


def test_a_reader_is_prompt_but_while_it_takes_much_of_a_core(monkeypatch):
    """By what it took since the last look: one that has worked once is prompt again."""
    policies: list[int] = []

    def take(policy: int, priority: int) -> bool:
        policies.append(policy)
        return True

    limits: list[tuple[int, tuple[int, int]]] = []
    # this process keeps its own scheduling, and what it may ask for
    monkeypatch.setattr(scheduling, "SCHED_SETATTR", {})
    monkeypatch.setattr(scheduling.resource, "setrlimit", lambda *limit: limits.append(limit))
    monkeypatch.setattr(scheduling, "_set_all_threads", take)
    wall_s = cpu_s = 100.0
    prompt = PromptWhileLight(lambda: wall_s, lambda: cpu_s)
    looks = []
    for share in (0.0, 0.9, HEAVY + 0.05, HEAVY - 0.05, 0.0, 0.9):
        wall_s += 2 * LOOK_S
        cpu_s += 2 * LOOK_S * share
        prompt.tend()
        looks.append(policies[-1])
    assert looks == [os.SCHED_FIFO, *[os.SCHED_OTHER] * 2, *[os.SCHED_FIFO] * 2, os.SCHED_OTHER]
    assert len(policies) == 4  # it is asked for where it changes
    wall_s += LOOK_S / 2
    prompt.tend()  # too soon to look again
    prompt.give_up()
    wall_s += 10 * LOOK_S
    prompt.tend()
    assert policies[-1] == os.SCHED_OTHER
    assert len(policies) == 5
    assert limits == [(resource.RLIMIT_RTPRIO, (0, 0))]  # nor can what it starts take it


class Libc:
    """A C library whose adjtimex(2) tells an error, or fails."""

    def __init__(self, maxerror_us: int | None) -> None:
        self._maxerror_us = maxerror_us

    def adjtimex(self, pointer: object) -> int:
        timex = pointer._obj
        assert timex.modes == 0  # nothing is set
        if self._maxerror_us is None:
            return -1
        timex.maxerror = self._maxerror_us
        return 0


@pytest.mark.parametrize(
    ("maxerror_us", "error_ns"),
    [(250, 250_000), (16_000_000, UNDISCIPLINED_NS), (None, UNDISCIPLINED_NS)],
)
def test_the_error_of_unix_time_is_the_kernel_s_in_microseconds(monkeypatch, maxerror_us, error_ns):
    """adjtimex(2): maxerror is in microseconds, 16 s where nothing keeps the clock."""
    monkeypatch.setattr(scheduling.ctypes, "CDLL", lambda name: Libc(maxerror_us))
    found = HostClock().unix_offset()
    assert found.error_ns == error_ns
    assert abs(found.offset_ns - (time.monotonic_ns() - time.time_ns())) < 10**9


def test_the_time_asleep_is_what_one_clock_counts_and_the_other_does_not(monkeypatch):
    """clock_gettime(2): CLOCK_BOOTTIME goes on while the machine sleeps, CLOCK_MONOTONIC stands."""
    read_ns = {time.CLOCK_BOOTTIME: 90_000_000_007, time.CLOCK_MONOTONIC: 60_000_000_000}
    monkeypatch.setattr(time, "clock_gettime_ns", read_ns.__getitem__)
    assert HostClock().asleep_ns() == 30_000_000_007


@pytest.mark.parametrize("collecting", [True, False])
def test_a_loop_leaves_the_collector_and_the_threads_turns_as_they_were(monkeypatch, collecting):
    monkeypatch.setattr(scheduling, "raise_priority", lambda: "normal")
    monkeypatch.setattr(scheduling.gc, "collect", lambda: 0)  # of all that tests hold
    before_s = sys.getswitchinterval()
    was_collecting = gc.isenabled()
    try:
        (gc.enable if collecting else gc.disable)()
        with pytest.raises(KeyboardInterrupt), steady_loop() as priority:
            assert (priority, gc.isenabled()) == ("normal", False)
            assert sys.getswitchinterval() < before_s
            raise KeyboardInterrupt
        assert gc.isenabled() is collecting
        assert sys.getswitchinterval() == before_s
    finally:
        (gc.enable if was_collecting else gc.disable)()


@pytest.mark.parametrize("first_anew", [True, False])
def test_tries_come_at_once_and_then_twice_as_seldom_until_all_was_well(first_anew):
    clock = FakeClock()
    again = BackOff(0.05, 0.3, clock)
    assert again.over
    waits_s = []
    for anew in (first_anew, False, False, False, False, True, False):
        again.put_off(anew=anew)
        waits_s.append(again.left_s)
        clock.sleep(again.left_s)
        assert again.over
    assert waits_s == pytest.approx([0.05, 0.1, 0.2, 0.3, 0.3, 0.05, 0.1])


def test_workers_have_one_thread_and_no_ctrl_c_and_their_owner_keeps_its_own(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, set())
    with _for_children():
        assert {os.environ[name] for name in ONE_THREAD} == {"1"}
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, set())
    assert {name: os.environ.get(name) for name in ONE_THREAD} == before
    assert signal.pthread_sigmask(signal.SIG_BLOCK, set()) == mask


def test_an_answer_of_a_worker_that_has_died_since_is_still_heard():
    here, there = multiprocessing.Pipe()
    reading, writing = os.pipe()
    ended = SimpleNamespace(
        sentinel=reading, exitcode=-9, join=lambda seconds: None, is_alive=lambda: False
    )
    pool = ProcessPool(int, (), ())
    worker = WorkerProcess(ended, here)
    pool.workers.append(worker)
    there.send(("answer", 5))
    there.close()
    os.close(writing)
    news = [next(pool.heard()) for _ in range(2)]
    assert [(one.kind, one.said) for one in news] == [("answer", 5), ("died", -9)]
    assert worker.ready and pool.workers == []
    os.close(reading)


def test_what_nobody_reads_takes_so_much_memory_and_is_counted_when_it_is_read(monkeypatch):
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write_end, b"-" * 512)
    os.set_blocking(write_end, True)
    monkeypatch.setattr(interrupts, "DESCRIPTOR", write_end)
    monkeypatch.setattr(interrupts, "MAX_WAITING_BYTES", 1 << 18)
    queued = interrupts._QueuedStderr()
    line = b"x" * 999 + b"\n"
    for _ in range(1000):  # a megabyte
        assert queued.write(line) == len(line)
        assert queued._waiting_bytes <= 1 << 18
    came, dropped = 0, 0
    unread = b""
    while came + dropped < 1000:
        *lines, unread = (unread + os.read(read_end, 1 << 16)).split(b"\n")
        for one in lines:
            came += one.endswith(b"x")
            if one.startswith(b"hilstar: "):
                dropped += int(one.split()[1])
    assert came <= (1 << 18) // len(line)
    assert came + dropped == 1000
    os.close(read_end)
    os.close(write_end)


def test_a_user_s_module_is_the_one_beside_the_file_and_hides_no_installed_one(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "of_this_bench.py").write_text(
        "import its_neighbour\nlevel = its_neighbour.level\n"
    )
    (tmp_path / "its_neighbour.py").write_text("def level(): return 5\n")
    (tmp_path / "cobs").mkdir()
    (tmp_path / "cobs" / "__init__.py").write_text("")
    for name in ("os", "pyclbr"):  # Python's own, loaded and not
        (tmp_path / f"{name}.py").write_text("def system(): return 6\n")
    assert user_function("python:of_this_bench:level", tmp_path)() == 5
    installed = PathFinder.find_spec("cobs", sys.path)
    assert installed is not None
    assert not str(installed.origin).startswith(str(tmp_path))
    assert importlib.util.find_spec("its_neighbour") is not None  # a lazy import finds it later
    for function in ("os:system", "pyclbr:system", "subprocess:run", "of_this_bench", ""):
        with pytest.raises(UserCodeError):
            user_function(f"python:{function}", tmp_path)


def test_modules_of_one_name_are_each_those_of_their_own_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    for folder, level in (("a", 5), ("b", 6)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "of_two_benches.py").write_text(f"def level(): return {level}\n")
    found = [user_function("python:of_two_benches:level", tmp_path / name)() for name in "abab"]
    assert found == [5, 6, 5, 6]
    assert sys.path[-1] == str(tmp_path / "b")  # last: it hides nothing that is installed
    assert sys.path.count(str(tmp_path / "b")) == 1


@pytest.fixture
def ending(monkeypatch):
    """The state of a command's end, as if its handlers were installed."""
    made = interrupts._Ending()
    made.guard = 0
    monkeypatch.setattr(interrupts, "_ending", made)
    return made


def test_a_stop_that_opens_after_a_signal_is_set_at_once(ending):
    ending.signal = signal.SIGTERM
    stop = threading.Event()
    with interrupts.stop_on_signal(stop):
        assert stop.is_set()
    assert ending.stops == []
    assert (interrupts.caught(), interrupts.exit_code()) == ("SIGTERM", 128 + 15)


def test_a_program_that_uses_a_stop_has_its_own_handlers_again(ending):
    ending.guard = None
    before = [signal.getsignal(number) for number in interrupts.ENDING]
    for _ in range(2):  # a signal of the first time is none of the second
        stop = threading.Event()
        with interrupts.stop_on_signal(stop):
            assert not stop.is_set()
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.wait(PATIENCE_S)
        assert [signal.getsignal(number) for number in interrupts.ENDING] == before
    assert interrupts.exit_code() == 128 + 15
    ending.signal = None
    assert (interrupts.caught(), interrupts.exit_code()) == (None, 128 + 2)


def test_a_signal_that_comes_while_it_is_held_raises_at_the_end(ending):
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts.held():
        with interrupts.held():
            interrupts._handle(signal.SIGINT, None)
            done.append("inner")
        done.append("outer")
    assert done == ["inner", "outer"] and ending.holds == 0
    with interrupts.held():  # the end is under way
        done.append("again")
    assert interrupts.caught() == "SIGINT"


def ended(work) -> tuple[int, str, str]:
    """The exit code of a fork of this process that does `work`, and what its stdout and stderr say;
    99 where the work comes to its end.
    """
    (out, to_out), (err, to_err) = os.pipe(), os.pipe()
    with warnings.catch_warnings():
        # Python 3.12 warns of threads that a fork has none of; what is done here needs none.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            os.setsid()
            os.dup2(to_out, 1)
            os.dup2(to_err, 2)
            sys.stdout, sys.stderr = (os.fdopen(fd, "w", closefd=False) for fd in (1, 2))
            for fd in (out, to_out, err, to_err):
                os.close(fd)
            work()
        os._exit(99)
    os.close(to_out)
    os.close(to_err)
    with os.fdopen(out) as stdout, os.fdopen(err) as stderr:
        said = stdout.read(), stderr.read()
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), *said


def watched_end(monkeypatch, wait_s: float, echo_s: float, second_s: float | None) -> tuple:
    """How the watching thread ends a process that a SIGTERM does not end, where a SIGINT comes so
    long after it.
    """
    monkeypatch.setattr(interrupts, "THREAD_WAITS_S", wait_s)
    monkeypatch.setattr(interrupts, "ECHO_S", echo_s)

    def hang() -> None:
        watched, teller = socket.socketpair()
        threading.Thread(target=interrupts._watch, args=(watched,), daemon=True).start()
        teller.send(bytes([signal.SIGTERM]))
        if second_s is not None:
            time.sleep(second_s)
            teller.send(bytes([signal.SIGINT]))
        time.sleep(PATIENCE_S)

    return ended(hang)


def test_a_process_that_a_signal_does_not_end_is_ended_with_a_line_and_the_first_signal_s_code(
    ending, monkeypatch
):
    code, _, line = watched_end(monkeypatch, 0.05, 0.0, None)
    assert code == 128 + 15
    assert line.startswith("hilstar: ended 0.05 s after SIGTERM, in the middle of ")
    assert line.count("\n") == 1


def test_a_second_signal_ends_it_at_once_and_the_echo_of_the_first_does_not(ending, monkeypatch):
    """A terminal and a wrapper both pass one Ctrl-C on."""
    code, _, line = watched_end(monkeypatch, PATIENCE_S, 0.0, 0.1)
    assert (code, line) == (128 + 15, "hilstar: ended at the second signal\n")
    code, _, line = watched_end(monkeypatch, 0.2, PATIENCE_S, 0.05)
    assert code == 128 + 15
    assert line.startswith("hilstar: ended 0.2 s after SIGTERM")


def test_what_ends_a_process_ends_its_children_but_its_guard(ending):
    """The guard ends by itself. What a child of these holds is the pipe of stdout, to its end."""

    def work() -> None:
        children = []
        for _ in range(3):
            children.append(os.fork())
            if children[-1] == 0:
                time.sleep(PATIENCE_S)
                os._exit(0)
        interrupts.end_children(os.getpid(), children[1], None)
        for child in (children[0], children[2]):
            _, status = os.waitpid(child, 0)
            assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL
        assert os.waitpid(children[1], os.WNOHANG) == (0, 0)
        interrupts._ending.guard = children[1]
        interrupts._let_guard_go()
        with contextlib.suppress(ChildProcessError):
            os.waitpid(children[1], 0)
            return
        os._exit(7)

    assert ended(work)[0] == 7


@pytest.mark.parametrize(("has_thread", "said"), [(False, "printed\nat exit\n"), (True, "")])
def test_a_process_that_is_left_says_what_it_had_to_unless_a_thread_still_waits(
    ending, has_thread, said
):
    def work() -> None:
        interrupts._ending.guard = None
        atexit._clear()
        for thread in threading.enumerate():  # of this process's tests: a fork has none of them
            assert thread is threading.main_thread()
        if has_thread:
            threading.Thread(target=time.sleep, args=(PATIENCE_S,), daemon=True).start()
        atexit.register(lambda: os.write(1, b"at exit\n"))
        sys.stdout.write("printed\n")
        interrupts.leave(5)

    assert ended(work) == (5, said, "")


def test_a_command_ends_by_its_first_signal_and_keeps_a_hang_up_that_was_ignored(ending):
    """Its guard is there, twice makes no second one, and stdin, closed before, is nobody else's."""

    def work() -> None:
        interrupts._ending.guard = None
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell has it for what runs with &
        os.close(0)
        sys.stdin = None
        assert not interrupts.is_command()
        interrupts.install()
        guard = interrupts._ending.guard
        interrupts.install()
        assert interrupts.is_command() and interrupts._ending.guard == guard
        assert Path("/proc/self/fd/0").readlink() == Path(os.devnull)
        assert sys.stdin.fileno() == 0 and not sys.stdin.writable()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(PATIENCE_S)
        except KeyboardInterrupt:
            assert interrupts.caught() == "SIGINT"
            os.kill(guard, 0)
            interrupts.leave(interrupts.exit_code())

    assert ended(work) == (128 + 2, "", "")


PARENT_OF_ONE = """
import os
import sys
import time
from hilstar.basics.process.interrupts import end_with_parent

pipe = int(sys.argv[1])
parent = os.getpid()
child = os.fork()
if child == 0:
    end_with_parent({parent})
    os.write(pipe, b"goes on")
    time.sleep(600)
os.waitpid(child, 0)
os.write(pipe, b"has ended")
"""


@pytest.mark.parametrize(("parent", "said"), [("parent", b"goes on"), ("1", b"has ended")])
def test_a_process_ends_with_the_one_that_began_it_also_where_that_was_another(parent, said):
    """The pipe's end is that of the last process that could write to it."""
    reading, writing = os.pipe()
    command = [sys.executable, "-c", PARENT_OF_ONE.format(parent=parent), str(writing)]
    with subprocess.Popen(command, pass_fds=[writing]) as process:
        os.close(writing)
        try:
            assert os.read(reading, 10) == said
        finally:
            process.kill()
    is_read, *_ = select.select([reading], [], [], PATIENCE_S)
    assert is_read, "the child goes on without its parent"
    assert os.read(reading, 10) == b""
    os.close(reading)
