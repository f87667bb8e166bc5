"""How this process ends: signals, the end of its parent, and the last lines on stderr.

The first signal ends a command in order, and whatever the command is doing, the process has ended
within a second. Python's own handlers run in the main thread, between two steps of the interpreter:
a long draw or a call that waits in C delays them. So the number of a signal also goes to a socket,
from within C, and two watchers look at it: a thread, which ends the process with the usual exit
code, and a process, which does it where a call in C keeps Python's lock (as OpenGL's do) and no
thread can run.

Writing to stderr never waits: if nobody reads it, neither a frame nor the end of the process is
delayed.
"""

import _thread
import atexit
import contextlib
import io
import os
import select
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
THREAD_WAITS_S = 0.75  # for an end in order
GUARD_WAITS_S = 0.9
# a terminal and a wrapper both pass one Ctrl-C on: what comes so soon after a signal is no second
# one
ECHO_S = 0.1
POLL_S = 0.02  # between two looks for a second signal
PR_SET_PDEATHSIG = 1  # prctl(2)
SIGNALLED = 128  # and the signal's number: the exit code of a process that a signal ended
MAX_WAITING_BYTES = 1 << 20
PIECE_BYTES = 4096
DESCRIPTOR = 2
LAST_WORDS_S = 1.0  # for a traceback at the very end


class _Ending:
    """The state of this process's end: the signal, the events to set, the guard's number, and
    holds.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self.stops: list[threading.Event] = []
        self.guard: int | None = None
        self.holds = 0


_ending = _Ending()


def install() -> None:
    """Let SIGINT, SIGTERM and SIGHUP end this process. Call it in the main thread, before there are
    others; twice does nothing.

    SIGHUP stays ignored where it was (nohup); SIGINT does not, for a shell ignores it for whatever
    it runs with `&`.
    """
    if _ending.guard is not None:
        return
    # Open the standard streams that the parent process closed, so that no socket takes their
    # numbers. Python has None for one that was closed, and prints what is for None on stdout.
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(descriptor)
        except OSError:
            # The lowest number that is free; what a program of this one's writes has to go
            # somewhere, too.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            mode = "w" if descriptor else "r"
            stream = open(descriptor, mode, closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)
    watched, teller = socket.socketpair()
    teller.setblocking(False)
    parent = os.getpid()
    _ending.guard = os.fork()
    if _ending.guard == 0:
        teller.close()
        _guard(parent, watched)
    threading.Thread(target=_watch, args=(watched,), name="hilstar-signals", daemon=True).start()
    signal.set_wakeup_fd(teller.detach(), warn_on_full_buffer=False)
    for number in ENDING:
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _handle)


def _handle(number: int, frame: FrameType | None) -> None:
    if _ending.signal is not None:
        return  # the end is under way; a second signal is the watchers' matter
    _ending.signal = number
    if _ending.holds:
        return
    if not _ending.stops:
        if (
            _ending.guard
            and frame is not None
            and frame.f_code.co_filename.startswith("<frozen importlib")
        ):
            # Python's import calls itself back where an exception is lost, and so far nothing is
            # there to be put in order.
            _say_if_read("hilstar: stopped\n")
            _let_guard_go()
            os._exit(SIGNALLED + number)
        raise KeyboardInterrupt
    # The main thread may be in the middle of a wait for it and hold the event's lock, which a
    # handler in it cannot take.
    with contextlib.suppress(RuntimeError):  # no thread to be had: the watchers end it
        _thread.start_new_thread(lambda *stops: [stop.set() for stop in stops], (*_ending.stops,))


def is_command() -> bool:
    """Whether this process is one of hilstar's commands, and not a program that uses its parts."""
    return _ending.guard is not None


def caught() -> str | None:
    """The name of the signal that ends this process; None while none has come."""
    if _ending.signal is None:
        return None
    return signal.Signals(_ending.signal).name


def exit_code() -> int:
    """The exit code of a command that a signal ended."""
    return SIGNALLED + (_ending.signal or signal.SIGINT)


@contextlib.contextmanager
def stop_on_signal(stop: threading.Event) -> Iterator[None]:
    """A signal sets `stop` while this is open, and raises nothing (main thread only)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {}
    if _ending.guard is None:  # hilstar used as a library
        previous = {number: signal.signal(number, _handle) for number in ENDING}
        _ending.signal = None
    _ending.stops.append(stop)
    if _ending.signal is not None:
        stop.set()
    try:
        yield
    finally:
        _ending.stops.remove(stop)
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """A signal's KeyboardInterrupt comes when this is left (main thread; where hilstar's handlers
    are installed).

    It is for extensions in C that call Python back and do not look whether an exception came of it.
    """
    if (
        threading.current_thread() is not threading.main_thread()
        or _ending.stops
        or _ending.signal is not None
    ):
        yield
        return
    _ending.holds += 1
    try:
        yield
    finally:
        _ending.holds -= 1
    if caught() is not None and not _ending.holds:
        raise KeyboardInterrupt


def leave(code: int) -> NoReturn:
    """End the process without asking Python's own end, which takes every module apart (20 ms) and
    waits for threads.

    After a signal, or where a thread still waits for something, nothing else is asked either: a
    thread may be in the middle of writing. A profiler gets Python's own end.
    """
    for number in ENDING:
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(number, signal.SIG_DFL)
    _let_guard_go()
    own_names = {"hilstar-signals", "hilstar-stderr"}
    others = [thread for thread in threading.enumerate() if thread.name not in own_names]
    if _ending.signal is None and len(others) == 1:
        if sys.getprofile() is not None:
            sys.exit(code)
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        atexit._run_exitfuncs()
    os._exit(code)


def _let_guard_go() -> None:
    if _ending.guard:
        with contextlib.suppress(OSError):
            os.kill(_ending.guard, signal.SIGKILL)
            os.waitpid(_ending.guard, 0)


def _signals_in(watched: socket.socket) -> bytes:
    """The numbers of the signals so far; both watchers look at the same ones, and none takes
    them away.
    """
    with contextlib.suppress(BlockingIOError):
        return watched.recv(64, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    return b""


def _watch(watched: socket.socket) -> None:
    """The thread: waits for a signal, and then for the end, or for a second signal."""
    select.select([watched], [], [])
    numbers = _signals_in(watched)
    if not numbers:
        return
    begin_s = time.monotonic()
    heard_twice = False
    while not heard_twice and time.monotonic() - begin_s < THREAD_WAITS_S:
        time.sleep(POLL_S)
        if time.monotonic() - begin_s < ECHO_S:
            numbers = _signals_in(watched)
        heard_twice = len(_signals_in(watched)) > len(numbers)
    name = signal.Signals(numbers[0]).name
    if heard_twice:
        why = "at the second signal"
    else:
        why = f"{THREAD_WAITS_S:g} s after {name}, in the middle of {_whereabouts()}"
    _say_if_read(f"hilstar: ended {why}\n")
    end_children(os.getpid(), _ending.guard)
    _let_guard_go()
    os._exit(SIGNALLED + numbers[0])


def _whereabouts() -> str:
    """The innermost function of hilstar's own code in which the main thread is."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if "hilstar" in path.parts and path.name != Path(__file__).name:
            return f"{frame.f_code.co_name} ({path.name}, line {frame.f_lineno})"
        frame = frame.f_back
    return "its end"


def _say_if_read(line: str) -> None:
    """Write a line to stderr where there is room in its pipe: one that nobody reads holds nothing
    up.
    """
    with contextlib.suppress(OSError, ValueError):
        if select.select([], [2], [], 0)[1]:
            os.write(2, line.encode())


def end_children(process: int, *spared: int | None) -> None:
    """Kill the children of a process, except `spared`."""
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{process}/task").iterdir():
            for child in map(int, (task / "children").read_text().split()):
                if child not in spared:
                    with contextlib.suppress(OSError):
                        os.kill(child, signal.SIGKILL)


def _guard(parent: int, watched: socket.socket) -> NoReturn:
    """The process: it ends with its parent, or ends it."""
    try:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)  # a terminal sends Ctrl-C to both
        # A reader of the parent's output waits until the last writer has closed.
        os.closerange(0, watched.fileno())
        os.closerange(watched.fileno() + 1, 1024)
        poll = select.poll()
        poll.register(watched, select.POLLIN)
        [(_, events)] = poll.poll()
        if not events & select.POLLHUP:
            poll.modify(watched, 0)  # POLLHUP is reported all the same
            if not poll.poll(GUARD_WAITS_S * 1000) and os.getppid() == parent:
                end_children(parent, os.getpid())
                os.kill(parent, signal.SIGKILL)
    finally:
        os._exit(0)


def end_with_parent(parent: int | None = None) -> None:
    """End this process when the process that began it ends, however that ends.

    With `parent`, the number of the process that began this one directly, the kernel kills this
    process, even where it hangs. Without, in a process of a pool, a thread waits for the pool's
    owner, which may not be the direct parent (forkserver).
    """
    if parent is not None:
        import ctypes  # 3 ms, and every command imports this module

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
        return
    import multiprocessing

    owner = multiprocessing.parent_process()
    if owner is not None:

        def end_after() -> NoReturn:
            owner.join()
            os._exit(1)

        threading.Thread(target=end_after, name="hilstar-parent", daemon=True).start()


class _QueuedStderr(io.RawIOBase):
    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._dropped = 0
        self._changed = threading.Condition()
        threading.Thread(target=self._run, name="hilstar-stderr", daemon=True).start()

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return DESCRIPTOR

    def isatty(self) -> bool:
        return os.isatty(DESCRIPTOR)

    def write(self, data: Any) -> int:
        piece = bytes(data)
        with self._changed:
            if self._waiting_bytes + len(piece) > MAX_WAITING_BYTES:
                self._dropped += 1
            else:
                self._waiting.append(piece)
                self._waiting_bytes += len(piece)
                self._changed.notify_all()
        return len(piece)

    def finish(self, patience_s: float) -> None:
        end_s = time.monotonic() + patience_s
        with self._changed:
            while self._waiting_bytes and (rest_s := end_s - time.monotonic()) > 0:
                self._changed.wait(rest_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting:
                    self._changed.wait()
                piece = self._waiting.popleft()
                dropped = self._dropped
                self._dropped = 0
            data = piece
            if dropped:
                data += f"hilstar: {dropped} lines were dropped: nothing read them\n".encode()
            with contextlib.suppress(OSError):  # there is no reader to tell
                while data:
                    try:
                        data = data[os.write(DESCRIPTOR, data[:PIECE_BYTES]) :]
                    except BlockingIOError:
                        # another process that shares it has made it non-blocking
                        time.sleep(0.01)
            with self._changed:
                self._waiting_bytes -= len(piece)
                self._changed.notify_all()


_queued: _QueuedStderr | None = None


def queue_stderr() -> None:
    """Queue writes to `sys.stderr`, so that none waits."""
    global _queued  # noqa: PLW0603 - a process has one stderr
    if _queued is None and sys.stderr is not None:
        _queued = _QueuedStderr()
        encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
        sys.stderr = io.TextIOWrapper(
            io.BufferedWriter(_queued), encoding, "backslashreplace", line_buffering=True
        )
        atexit.register(finish_stderr, LAST_WORDS_S)


def finish_stderr(patience_s: float) -> None:
    """Wait until everything queued has been written, for at most `patience_s`."""
    if _queued is not None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        _queued.finish(patience_s)
