"""The page's process, as `console.feed.host` starts it: its arguments are descriptors, of setup, board, wire and listener.

It ends with the run: when the other end of the wire is closed, however that comes.
"""

from __future__ import annotations

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
from collections.abc import Iterator

import msgspec
import uvicorn

from hilstar.console.feed.board import Board, Want
from hilstar.console.feed.messages import Answer, Order, Setup
from hilstar.console.feed.scene import Scene
from hilstar.console.server.app import ORDERED_S, Page
from hilstar.console.server.live import Crowd
from hilstar.console.server.pictures import PictureRoom
from hilstar.console.server.protocol import PING_S, PONG_S, BoundedHttp, ReadingWebSocket
from hilstar.console.server.reader import TICK_S, Reader
from hilstar.errors import one_line
from hilstar.units import NS_PER_S

PR_SET_PDEATHSIG = 1
NICE = 5  # frames go first
MAX_ORDERS = 8
MAX_ANSWER_BYTES = 8_000
MAX_HEAD_BYTES = 16_000
MAX_MESSAGE_BYTES = 4_000
PICTURE_POLL_S = 0.02
GOING_AWAY = 1001


class Server(uvicorn.Server):
    """uvicorn's, whose end is this process's own matter."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals as they are."""
        yield


class Wire:
    """Orders to the run, and its answers to them."""

    def __init__(self, wire: socket.socket) -> None:
        wire.setblocking(False)
        self._wire = wire
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}

    async def give(self, order: Order) -> Answer:
        """Give an order, and wait for what becomes of it."""
        if len(self._waiting) >= MAX_ORDERS:
            return Answer(id=0, status=503, line="too many orders at once; try again")
        order.id = next(self._numbers)
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[order.id] = answer
        try:
            async with asyncio.timeout(ORDERED_S):
                await asyncio.get_running_loop().sock_sendall(self._wire, msgspec.json.encode(order))
                return await answer
        except TimeoutError:
            return Answer(id=0, status=504, line=f"no answer of the run within {ORDERED_S:g} s")
        finally:
            self._waiting.pop(order.id, None)

    async def listen(self) -> None:
        """Take answers until the run closes its end."""
        while True:
            try:
                data = await asyncio.get_running_loop().sock_recv(self._wire, MAX_ANSWER_BYTES)
            except OSError:
                return
            if not data:
                return
            answer = msgspec.json.decode(data, type=Answer)
            future = self._waiting.get(answer.id)
            if future is not None and not future.done():
                future.set_result(answer)


async def tick(reader: Reader, board: Board, crowd: Crowd) -> None:
    """Ten times a second: look at the board, and tell all pages."""
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    while True:
        for event in reader.look():
            crowd.tell({"event": event})
        crowd.tell({"state": reader.state(), "point": reader.points[-1]})
        hz = crowd.picture_hz
        board.want = Want(round(NS_PER_S / hz), time.monotonic_ns() + NS_PER_S) if hz else Want()
        due_s = max(due_s + TICK_S, loop.time())
        await asyncio.sleep(due_s - loop.time())


async def show(room: PictureRoom, reader: Reader, crowd: Crowd) -> None:
    """Pack each new picture once, on another thread, and offer it to all pages."""
    last = 0
    while True:
        await asyncio.sleep(PICTURE_POLL_S)
        if crowd.picture_hz:
            packed = await asyncio.to_thread(room.newest, last, reader.seen)
            if packed is not None:
                last = packed.number
                crowd.show(packed)


async def run(setup: Setup, board: Board, wire: Wire, listener: socket.socket) -> None:
    """Serve until the run has ended."""
    scene: Scene | None = pickle.loads(setup.scene) if setup.scene else None
    reader, crowd = Reader(board, setup), Crowd()
    page = Page(setup, reader, crowd, {} if scene is None else scene.sky, wire.give)
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
    server = Server(config)
    tasks = [
        asyncio.create_task(work)
        for work in (server.serve([listener]), tick(reader, board, crowd), show(PictureRoom(board, scene), reader, crowd))
    ]
    ended = asyncio.create_task(wire.listen())
    done, _ = await asyncio.wait([ended, *tasks], return_when=asyncio.FIRST_COMPLETED)
    if ended not in done:
        done.pop().result()  # what went wrong
    await crowd.close_all(GOING_AWAY)


def main() -> None:
    """Set the process up, and serve."""
    setup_fd, board_fd, wire_fd, listener_fd = map(int, sys.argv[1:])
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # even where this process hangs
    for number in (signal.SIGINT, signal.SIGHUP):  # a terminal sends them to all; the run ends this process
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(NICE)
    logging.disable(logging.CRITICAL)  # the run says what there is to say
    setup = msgspec.msgpack.decode(os.pread(setup_fd, os.fstat(setup_fd).st_size, 0), type=Setup)
    board = Board(board_fd, setup.picture_bytes)
    listener = socket.socket(fileno=listener_fd)
    code = 0
    try:
        asyncio.run(run(setup, board, Wire(socket.socket(fileno=wire_fd)), listener))
    except Exception as error:  # whatever it is: the run starts the page again
        print(one_line(f"hilstar: the operator's page failed ({type(error).__name__}: {error})"), file=sys.stderr, flush=True)
        code = 1
    os._exit(code)  # without waiting for threads


if __name__ == "__main__":
    main()
