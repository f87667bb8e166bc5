"""Runs the process of the page and of SCPI beside a run: starts it, restarts it if it ends,
publishes the run's state to it, and carries out its orders.

A thread of its own does this ten times a second; the frame loop takes no part in it.
"""

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from hilstar.basics.errors import one_line
from hilstar.basics.notices import Notice, Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff
from hilstar.server.console.listener import PageListener
from hilstar.server.console.messages import (
    Order,
    OrderAnswer,
    RunEvent,
    RunState,
    Setup,
    SharedMemory,
)

TICK_S = 0.1
FIRST_WAIT_S, MAX_WAIT_S = 0.1, 5.0  # shortest and longest pause before a restart
STEADY_S = 10.0  # a process that ran for longer is restarted after the shortest pause
END_WAITS_S = 1.0
MAX_ORDERS = 8  # at once
MAX_ORDER_BYTES = 8_000
# Environment variables for the run alone: those by which it reports to systemd, and the token,
# which the page's process gets in its Setup.
OF_THE_RUN = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC", "HILSTAR_TOKEN"}
# -P: no module is imported from the working directory.
PAGE = (sys.executable, "-P", "-m", "hilstar.server.console.server")


class Listeners(NamedTuple):
    """The listeners of the page and of SCPI; None for one that is not served."""

    page: PageListener | None
    scpi: PageListener | None = None


Do = Callable[[Order], OrderAnswer]  # on a thread of its own


@dataclass(slots=True)
class _Page:
    process: "subprocess.Popen[bytes]"
    channel: socket.socket
    begun_s: float


class PageProcess(Closing):
    """Serves the page of a run or session from a separate process until it is closed.

    `now` returns the current state, `notices` give the events, and `do` carries out an order, on a
    thread of its own. `memory` is shared with the process.
    """

    def __init__(
        self,
        setup: Setup,
        memory: SharedMemory,
        listeners: Listeners,
        now: Callable[[], RunState],
        notices: Notices,
        do: Do,
    ) -> None:
        self._memory = memory
        self._now = now
        self._notices = notices
        self._do = do
        self._listener_fds = [
            -1 if listener is None else listener.socket.fileno() for listener in listeners
        ]
        self._setup_fd = os.memfd_create("hilstar-console-setup")
        with os.fdopen(os.dup(self._setup_fd), "wb") as file:
            file.write(msgspec.msgpack.encode(setup))
        self._events: deque[Notice] = deque(maxlen=1000)
        notices.listen(self._events.append)
        self._stop = threading.Event()
        self._page: _Page | None = None
        self._again = BackOff(FIRST_WAIT_S, MAX_WAIT_S, HOST_CLOCK)
        self._workers = ThreadPoolExecutor(MAX_ORDERS, thread_name_prefix="hilstar-order")
        self._thread = threading.Thread(target=self._run, name="hilstar-console", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the page's process, at the latest END_WAITS_S after it was asked to."""
        self._stop.set()
        self._thread.join()
        self._workers.shutdown(wait=False, cancel_futures=True)
        os.close(self._setup_fd)

    @property
    def pid(self) -> int | None:
        """The ID of the page's process, None while there is none."""
        if self._page is None:
            return None
        return self._page.process.pid

    def _run(self) -> None:
        """The thread: ticks and orders until `close`, then the end of the page's process."""
        next_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            if now_s >= next_s:
                next_s = now_s + TICK_S
                self._tick(now_s)
            self._listen(max(next_s - time.monotonic(), 0.0))
        page = self._page
        self._page = None
        if page is None:
            return
        page.channel.close()  # the page's process ends when its channel is closed
        try:
            page.process.wait(END_WAITS_S)
        except subprocess.TimeoutExpired:
            page.process.kill()
            page.process.wait()

    def _tick(self, now_s: float) -> None:
        """Publish the state and new events; start the page's process, or note that it has ended."""
        try:
            self._memory.states.put(msgspec.json.encode(self._now()))
            ahead_s = time.time() - time.monotonic_ns() * 1e-9
            while self._events:
                notice = self._events.popleft()
                event = RunEvent(
                    round(notice.host_ns * 1e-9 + ahead_s, 3), notice.kind, notice.detail
                )
                self._memory.events.put(msgspec.json.encode(event))
        except Exception as error:
            # E.g. the frame loop changed a container that was being read: the next tick reads it
            # again.
            self._memory.states.put(
                msgspec.json.encode(
                    RunState(host_ns=time.monotonic_ns(), note=one_line(repr(error)))
                )
            )
        page = self._page
        if page is None:
            if self._again.over:
                self._start_page(now_s)
        elif (code := page.process.poll()) is not None:
            page.channel.close()
            self._page = None
            if code < 0:
                how = f"signal {-code}"
            else:
                how = f"exit code {code}"
            self._lose(f"the operator's page ended ({how})", anew=now_s - page.begun_s > STEADY_S)

    def _start_page(self, now_s: float) -> None:
        # Packets of a sequence: each message arrives whole.
        channel, its_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        environment = {name: value for name, value in os.environ.items() if name not in OF_THE_RUN}
        given = (self._setup_fd, self._memory.fd, its_end.fileno(), *self._listener_fds)
        try:
            process = subprocess.Popen(
                [*PAGE, *map(str, given)],
                pass_fds=[fd for fd in given if fd >= 0],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=environment
                | {"PYTHONPATH": os.pathsep.join(place for place in sys.path if place)},
            )
        except OSError as error:
            channel.close()
            self._lose(f"the operator's page cannot be started ({error.strerror})")
            return
        finally:
            its_end.close()
        channel.setblocking(False)
        self._page = _Page(process, channel, now_s)

    def _lose(self, what: str, *, anew: bool = False) -> None:
        self._notices.tell("console-lost", f"{what}; it is started again")
        self._again.put_off(anew=anew)

    def _listen(self, seconds: float) -> None:
        """Wait for an order for at most `seconds`, and have a worker carry it out."""
        page = self._page
        if page is None:
            self._stop.wait(seconds)
            return
        ready, _, _ = select.select([page.channel], [], [], seconds)
        if not ready:
            return
        with contextlib.suppress(OSError, msgspec.MsgspecError, UnicodeDecodeError):
            data = page.channel.recv(MAX_ORDER_BYTES)
            if data:
                order = msgspec.json.decode(data, type=Order)
                self._workers.submit(self._do, order).add_done_callback(self._answer)
            # No data: the page has ended, which the next tick reports.
            else:
                self._stop.wait(seconds)

    def _answer(self, done: Future[OrderAnswer]) -> None:
        page = self._page
        if page is None or done.cancelled() or done.exception() is not None:
            return
        with contextlib.suppress(OSError):  # the page may have ended meanwhile
            page.channel.send(msgspec.json.encode(done.result()))
