"""The main program of the page's process. `console.page_process` starts it with five file
descriptors as arguments: setup, shared memory, channel, and the listeners of the page and of SCPI,
of which one may be missing (-1).

It ends with the run: when the other end of the channel is closed, for whatever reason.
"""

import asyncio
import contextlib
import ctypes
import itertools
import logging
import os
import pickle
import signal
import socket
import sys
import time
from collections.abc import Coroutine, Iterator
from typing import Any

import msgspec
import uvicorn

from hilstar.basics.errors import one_line
from hilstar.basics.units import NS_PER_S
from hilstar.server.console.messages import Order, OrderAnswer, PictureRequest, Setup, SharedMemory
from hilstar.server.console.overlay import OverlayScene
from hilstar.server.console.protocol import PageText
from hilstar.server.console.server.app import ORDERED_S, Page
from hilstar.server.console.server.connections import (
    PING_S,
    PONG_S,
    BoundedHttp,
    OpenPages,
    ReadingWebSocket,
)
from hilstar.server.console.server.reader import TICK_S, PicturePacker, RunReader
from hilstar.server.console.server.scpi_server import ScpiServer

PR_SET_PDEATHSIG = 1
NICE = 5  # frames go first
MAX_ORDERS = 8
MAX_ANSWER_BYTES = 8_000
MAX_HEAD_BYTES = 16_000
MAX_MESSAGE_BYTES = 4_000
PICTURE_POLL_S = 0.02
GOING_AWAY = 1001


class Server(uvicorn.Server):
    """uvicorn's server without its signal handlers: this process ends with its channel."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handler."""
        yield


class OrderChannel:
    """Sends operators' orders to the run, and receives its answers, over the socket `channel`."""

    def __init__(self, channel: socket.socket) -> None:
        channel.setblocking(False)
        self._channel = channel
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[OrderAnswer]] = {}

    async def give(self, order: Order) -> OrderAnswer:
        """Send an order and wait for its answer. The answer has status 503 if MAX_ORDERS already
        wait, and 504 if the run does not answer within ORDERED_S.
        """
        if len(self._waiting) >= MAX_ORDERS:
            return OrderAnswer(id=0, status=503, line="too many orders at once; try again")
        order.id = next(self._numbers)
        answer: asyncio.Future[OrderAnswer] = asyncio.get_running_loop().create_future()
        self._waiting[order.id] = answer
        try:
            async with asyncio.timeout(ORDERED_S):
                await asyncio.get_running_loop().sock_sendall(
                    self._channel, msgspec.json.encode(order)
                )
                return await answer
        except TimeoutError:
            return OrderAnswer(
                id=0, status=504, line=f"no answer of the run within {ORDERED_S:g} s"
            )
        finally:
            self._waiting.pop(order.id, None)

    async def listen(self) -> None:
        """Receive answers until the run closes its end of the channel."""
        while True:
            try:
                data = await asyncio.get_running_loop().sock_recv(self._channel, MAX_ANSWER_BYTES)
            except OSError:
                return
            if not data:
                return
            answer = msgspec.json.decode(data, type=OrderAnswer)
            future = self._waiting.get(answer.id)
            if future is not None and not future.done():
                future.set_result(answer)


async def tick(reader: RunReader, memory: SharedMemory, pages: OpenPages) -> None:
    """Read the shared memory and send the state and new events to all pages, ten times a second;
    renew the request for pictures while a page needs them.
    """
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    while True:
        for event in reader.look():
            pages.tell(PageText(event=event))
        pages.tell(PageText(state=reader.state(), point=reader.points[-1]))
        hz = pages.picture_hz
        memory.want = (
            PictureRequest(round(NS_PER_S / hz), time.monotonic_ns() + NS_PER_S)
            if hz
            else PictureRequest()
        )
        due_s = max(due_s + TICK_S, loop.time())
        await asyncio.sleep(due_s - loop.time())


async def show(room: PicturePacker, reader: RunReader, pages: OpenPages) -> None:
    """Send new answers of the tracker to all pages, and each new picture, which is packed once, on
    another thread.
    """
    last = 0
    while True:
        await asyncio.sleep(PICTURE_POLL_S)
        answer = reader.new_answer()
        if answer is not None:
            pages.tell(PageText(answer=answer))
        if pages.picture_hz:
            packed = await asyncio.to_thread(room.newest, last, reader.seen, reader.answer)
            if packed is not None:
                last = packed.number
                pages.show(packed)


async def run(
    setup: Setup,
    memory: SharedMemory,
    channel: OrderChannel,
    page_listener: socket.socket | None,
    scpi_listener: socket.socket | None,
) -> None:
    """Serve the page and SCPI at their listeners (None for none) until the run ends. Raises what
    ends a server before.
    """
    scene: OverlayScene | None = pickle.loads(setup.scene) if setup.scene else None
    reader = RunReader(memory, setup)
    pages = OpenPages()
    page = Page(setup, reader, pages, None if scene is None else scene.sky, channel.give)
    config = uvicorn.Config(
        page.app(),
        http=BoundedHttp,
        ws=ReadingWebSocket,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PONG_S,
        lifespan="off",
        loop="asyncio",
        access_log=False,
        log_config=None,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=5,
        h11_max_incomplete_event_size=MAX_HEAD_BYTES,
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,
    )
    works: list[Coroutine[Any, Any, None]] = [tick(reader, memory, pages)]
    if page_listener is not None:
        works += [
            Server(config).serve([page_listener]),
            show(PicturePacker(memory, scene), reader, pages),
        ]
    if setup.scpi is not None and scpi_listener is not None:
        scpi = ScpiServer(setup.scpi, reader, memory, channel.give)
        works.append(scpi.serve(scpi_listener))
    tasks = [asyncio.create_task(work) for work in works]
    ended = asyncio.create_task(channel.listen())
    done, _ = await asyncio.wait([ended, *tasks], return_when=asyncio.FIRST_COMPLETED)
    if ended not in done:
        done.pop().result()  # raises the error that ended the task
    await pages.close_all(GOING_AWAY)


def listener_of(fd: int) -> socket.socket | None:
    """The listener of a file descriptor; None for -1."""
    if fd < 0:
        return None
    return socket.socket(fileno=fd)


def main() -> None:
    """Set up the process and serve. Exit code 1 where the servers fail, else 0."""
    setup_fd, board_fd, wire_fd, page_fd, scpi_fd = map(int, sys.argv[1:])
    # The kernel ends this process with the run, even if it hangs.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    # A terminal sends these signals to both processes, but the run ends this one.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(NICE)
    logging.disable(logging.CRITICAL)  # the run reports what the user needs to know
    setup = msgspec.msgpack.decode(os.pread(setup_fd, os.fstat(setup_fd).st_size, 0), type=Setup)
    memory = SharedMemory(board_fd, setup.picture_bytes)
    code = 0
    try:
        channel = OrderChannel(socket.socket(fileno=wire_fd))
        asyncio.run(run(setup, memory, channel, listener_of(page_fd), listener_of(scpi_fd)))
    except Exception as error:  # after any error the run starts the page again
        print(
            one_line(f"hilstar: the operator's page failed ({type(error).__name__}: {error})"),
            file=sys.stderr,
            flush=True,
        )
        code = 1
    os._exit(code)  # does not wait for threads, such as one that packs a picture


if __name__ == "__main__":
    main()
