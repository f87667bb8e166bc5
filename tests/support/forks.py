"""hilstar's commands in processes of their own that begin where the imports are over: half of what
a start costs.

A fork server has imported hilstar and forks itself for each command, which is `python -m MODULE` or
`python -c CODE`. The fork is the caller's child, with its own number, streams, session, folder and
environment; it ends as any command does. What some commands import as they go, the server imports
before its first fork of one. Imports, and what a shell limits, are tested by `subprocess.Popen` of
`HILSTAR`.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import importlib
import io
import json
import os
import resource
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn
from unittest import mock

from hilstar.basics.process.interrupts import leave
from tests.support.benches import LIVE_BENCH, SCREEN_BENCH, SMALL_BENCH
from tests.support.undrawn import are_charts_left_out, charts_left_out

HILSTAR = [sys.executable, "-m", "hilstar"]
# What a bench imports before its first frame, and the commands that tests start most; no window, no
# browser, no thread.
MODULES = (
    "server.bench.build",
    "server.bench.effort_report",
    "server.bench.would_do",
    "server.console.publisher",
    "display.render.renderer",
    "server.loop",
    "server.open_link",
    "server.record.ledger",
    "server.serve",
)
COMMANDS = (
    ["serve", "none.toml"],
    ["replay", "none.toml", "none.csv"],
    ["frame", "none.toml"],
    ["--version"],
)
# What these commands import as they go; each takes 0.2 s to a second.
LATER = {
    "tests.support.sources.basilisk_run": (
        "Basilisk.architecture.messaging",
        "Basilisk.simulation.simSynch",
        "Basilisk.simulation.spacecraft",
        "Basilisk.utilities.SimulationBaseClass",
        "Basilisk.utilities.vizSupport",
    ),
    "campaign": (
        "hilstar.instruments.campaign.results",
        "hilstar.instruments.campaign.requirements_page",
        "hilstar.instruments.campaign.bench_run",
    ),
    "first-light": ("hilstar.instruments.calibrate.first_light.session", "scipy.optimize"),
    "frame": ("astropy.io.fits",),
    "pytest": ("pytest", "hilstar.instruments.compare", "astropy.io.fits"),
    "scheduler": ("distributed.cli.dask_scheduler",),
    "simulate": ("astropy.io.fits", "astropy.table", "hilstar.instruments.simulate.batch"),
    "tracker": (
        "hilstar.instruments.simulate.live_exposure",
        "hilstar.instruments.simulate.tracker_process",
    ),
    "worker": ("distributed.cli.dask_worker", "hilstar.instruments.campaign.pool"),
}
LIMITS = (resource.RLIMIT_AS, resource.RLIMIT_CPU, resource.RLIMIT_FSIZE, resource.RLIMIT_NOFILE)
MAX_REQUEST_BYTES = 1 << 20
ROOM = "a" * 2000  # room in the command line for those of its forks


class Started(subprocess.Popen):
    """A command of Python's, forked from the fork server, that finds the signals `ignored` as a
    shell or nohup leaves them.

    Any other command is started as `subprocess.Popen` does it.
    """

    def __init__(self, *arguments: Any, ignored: tuple[int, ...] = (), **more: Any) -> None:
        self._ignored = ignored
        super().__init__(*arguments, **more)

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        # A test that fails has not ended its commands, which would be waited for for ever.
        if kind is not None:
            self.kill()
        super().__exit__(kind, value, traceback)

    def _execute_child(self, args: Any, executable: Any, preexec_fn: Any, close_fds: Any, pass_fds: Any, cwd: Any, env: Any,
                       startupinfo: Any, creationflags: Any, shell: Any, *more: Any) -> None:  # fmt: skip
        (p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite), new_session = (
            more[:6],
            bool(more[11]),
        )
        environment = dict(os.environ if env is None else env)
        is_plain = not (preexec_fn or pass_fds or shell) and python_of(environment) == python_of(
            os.environ
        )
        if not is_plain or args[0] != sys.executable or args[1] not in {"-m", "-c"}:
            super()._execute_child(args, executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags,
                                   shell, *more)  # fmt: skip
            return
        request = {
            "words": list(map(str, args)),
            "folder": str(cwd or Path.cwd()),
            "new_session": new_session,
        }
        request |= {
            "environment": environment,
            "inherited": inherited_settings(),
            "ignored": self._ignored,
            "draws_no_charts": are_charts_left_out(),
        }
        streams = [
            own if own >= 0 else number for number, own in enumerate((p2cread, c2pwrite, errwrite))
        ]
        self.pid = fork_server().fork(request, streams)
        self._child_created = True
        self._close_pipe_fds(p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite)


def python_of(environment: Mapping[str, str]) -> dict[str, str]:
    """What an environment says to Python itself and to its loader of libraries, which hear it as
    they start.
    """
    return {
        name: value for name, value in environment.items() if name.startswith(("PYTHON", "LD_"))
    }


def inherited_settings() -> dict[str, Any]:
    """What else a child has of its parent: its priority, its cores and its limits."""
    return {
        "priority": (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority),
        "cores": sorted(os.sched_getaffinity(0)),
        "limits": [(kind, resource.getrlimit(kind)) for kind in LIMITS],
    }


class ForkServer:
    """The process that has imported hilstar; it ends with this one."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for kind in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            self._socket.setsockopt(socket.SOL_SOCKET, kind, MAX_REQUEST_BYTES)
        command = [sys.executable, "-m", "tests.support.forks", str(theirs.fileno()), ROOM]
        root = Path(__file__).resolve().parents[2]
        with theirs:
            self._process = subprocess.Popen(
                command, cwd=root, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.PIPE, start_new_session=True,
            )  # fmt: skip

    def fork(self, request: dict[str, Any], streams: list[int]) -> int:
        """Begin a command with these streams; its process' number."""
        socket.send_fds(self._socket, [json.dumps(request).encode()], streams)
        answer = self._socket.recv(100)
        assert answer, "the fork server has ended"
        return int(answer)


@functools.cache
def fork_server() -> ForkServer:
    """This process' own."""
    return ForkServer()


def prepare() -> None:
    """Import and compute what every command would."""
    for module in MODULES:
        importlib.import_module(f"hilstar.{module}")
    from hilstar.attitude.logs.log_formats import log_formats
    from hilstar.cli import run_command
    from hilstar.server.bench.bench_file import bench_file_of
    from hilstar.server.bench.build import open_bench

    log_formats()  # each is a module
    # each fork makes its own
    with mock.patch("hilstar.server.bench.build.headless_context", return_value=None):
        # what a process computes once: stars, effort, paths
        for text in (SMALL_BENCH, LIVE_BENCH, SCREEN_BENCH):
            open_bench(bench_file_of(Path("none.toml"), text)).warm_up()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        for words in COMMANDS:
            run_command(words)  # refused: their options are built
    # and LLVM with it: 20 ms that each fork needs not spend
    for driver in Path("/usr/lib").glob("*/dri/swrast_dri.so"):
        with contextlib.suppress(OSError):
            ctypes.CDLL(str(driver))


def main(made: socket.socket) -> None:
    """Prepare, and make copies until nobody asks any more."""
    prepare()
    later = LATER.copy()
    settle()
    while True:
        data, streams, _, _ = socket.recv_fds(made, MAX_REQUEST_BYTES, 3)
        if not data:
            return
        request = json.loads(data)
        if modules := [module for word in request["words"][2:4] for module in later.pop(word, ())]:
            for module in modules:
                importlib.import_module(module)
            settle()
        read, write = os.pipe()
        between = os.fork()
        if not between:
            # Its parent ends at once, so that it becomes the child of the process that asked: that
            # one adopts orphans.
            if not os.fork():
                made.close()
                os.close(read)
                become_command(request, streams, write)
            os._exit(0)
        os.close(write)
        number = os.read(read, 100)
        os.waitpid(between, 0)
        for each in (read, *streams):
            os.close(each)
        made.send(number)


def settle() -> None:
    """Keep the collector from what is there: it would write to every page of it, which the forks
    share.
    """
    gc.collect()
    gc.freeze()


def become_command(request: dict[str, Any], streams: list[int], told: int) -> NoReturn:
    """Run the command in this forked process, with the streams and settings of the caller."""
    if request["new_session"]:
        os.setsid()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    inherited = request["inherited"]
    if inherited != json.loads(json.dumps(inherited_settings())):
        os.sched_setaffinity(0, inherited["cores"])
        for kind, limits in inherited["limits"]:
            resource.setrlimit(kind, tuple(limits))
        policy, priority = inherited["priority"]
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    tempfile.tempdir = None  # which the environment may say
    for number in (signal.SIGINT, signal.SIGHUP):
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number in request["ignored"] else usual)
    _, option, what, *words = request["words"]
    sys.path[0] = request["folder"] if option == "-m" else ""
    sys.argv = [what if option == "-m" else "-c", *words]
    if request["draws_no_charts"]:
        charts_left_out().start()
    show_command_line(request["words"])
    os.write(told, str(os.getpid()).encode())
    os.close(told)
    try:
        if option == "-m":
            runpy.run_module(what, run_name="__main__", alter_sys=True)
        else:
            sys.modules["__main__"] = main = types.ModuleType("__main__")
            exec(what, main.__dict__)
    except SystemExit as end:
        if isinstance(end.code, int):
            leave(end.code)
        raise
    leave(0)


def show_command_line(command: list[str]) -> None:
    """Make this the command line that /proc shows (its fields 48 and 49 are where the kernel
    reads it).
    """
    begin, end = map(int, Path("/proc/self/stat").read_text().rpartition(")")[2].split()[45:47])
    text = b"".join(word.encode(errors="surrogateescape") + b"\0" for word in command)[
        : end - begin - 1
    ]
    ctypes.memmove(begin, text.ljust(end - begin, b"\0"), end - begin)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with contextlib.suppress(ConnectionError), socket.socket(fileno=int(sys.argv[1])) as asked:
        main(asked)
