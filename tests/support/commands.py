"""hilstar's commands: in a process of their own as a user runs them, or in this one where the
process is not what is tested.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import shlex
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from hilstar.cli import run_command
from hilstar.cli.entry import LOG_FORMAT
from tests.support.forks import HILSTAR, Started
from tests.support.waiting import PATIENCE_S


def run_hilstar(
    *arguments: str | Path,
    cwd: Path | None = None,
    timeout: float = PATIENCE_S,
    env: dict[str, str] | None = None,
) -> subprocess.CompletedProcess[str]:
    """The command as a user runs it, in a process of its own, without the half second of its
    imports (see `Started`). The words are those of `typed`.
    """
    return run_started([*HILSTAR, *typed(*arguments)], cwd, timeout, env)


def typed(line: str | Path = "", *others: str | Path) -> list[str]:
    """The words of a command: a line as a shell splits it, and others, which stay whole."""
    return [*shlex.split(str(line)), *map(str, others)]


def run_started(
    command: list[str],
    cwd: Path | None = None,
    timeout: float = PATIENCE_S,
    env: dict[str, str] | None = None,
) -> subprocess.CompletedProcess[str]:
    """Any command of Python's, the same way."""
    env = dict(os.environ) if env is None else env
    # A group of its own: what the command has started (`demo` a sender) ends with it, however it
    # ends.
    with Started(
        command,
        cwd=cwd,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            out, err = process.communicate(timeout=timeout)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def run_hilstar_here(
    *arguments: str | Path, cwd: Path | None = None, timeout: int = PATIENCE_S
) -> subprocess.CompletedProcess[str]:
    """The command line in this process: the same words, refusals and exit code, and milliseconds
    instead of a new process.

    The words are those of `typed`. For what is said, written and returned. The process itself
    (streams, signals, the workers it starts) is `run_hilstar`'s.
    """
    words = typed(*arguments)
    out, err = (
        io.TextIOWrapper(io.BytesIO(), "utf-8", "surrogateescape", write_through=True)
        for _ in range(2)
    )
    to_out, to_err = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    with bounded_by(timeout), contextlib.chdir(cwd or Path.cwd()), to_out, to_err, logging_to(err):
        code = run_command(words)
    texts = (stream.buffer.getvalue().decode("utf-8", "surrogateescape") for stream in (out, err))
    return subprocess.CompletedProcess(["hilstar", *words], code, *texts)


@contextlib.contextmanager
def logging_to(stream: TextIO) -> Iterator[None]:
    """What is logged goes to a stream, as a command's own process sends it to stderr."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logging.Formatter(LOG_FORMAT))
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)


@contextlib.contextmanager
def bounded_by(seconds: int) -> Iterator[None]:
    """An alarm: what waits for ever in this process fails (TimeoutError), and does not stop the
    suite.
    """

    def too_long(*_: object) -> None:
        raise TimeoutError(f"it takes over {seconds} s")

    before = signal.signal(signal.SIGALRM, too_long)
    outer_s = signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(outer_s)
        signal.signal(signal.SIGALRM, before)


def has_handlers(process: subprocess.Popen) -> bool:
    """True once a command catches signals itself: until then the system's own handlers do."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) & 1 << signal.SIGTERM - 1)


def assert_refused(result: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line on stderr that has every word; nothing on stdout; no traceback."""
    assert result.returncode == code, result.stderr
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1, result.stderr
    for word in words:
        assert word in result.stderr


def sent(to: str, *options: str) -> dict[str, Any]:
    """What `hilstar send` says of packets that it sent there."""
    result = run_hilstar_here("send", "--to", to, "--json", *options)
    assert result.returncode == 0, result.stderr
    return dict(json.loads(result.stdout))
