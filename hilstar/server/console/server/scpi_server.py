"""Serves SCPI over TCP, in the page's process: a test stand can read the state of a run, give it
orders, and set the attitude of the sky.

The run's state is read from shared memory, and orders are an operator's, both as for the page. With
`[attitude] source = "scpi"` this process sends an attitude packet to the run's UDP port on loopback
SENT_HZ times a second, like any other sender. No frame waits for it. Every connection has registers
and an error queue of its own. docs/scpi.md lists the commands.

A controller is a connection that gave the token, or that acted where none is needed; any other is a
stranger. Strangers cannot delay the attitudes: a connection has few commands in a turn, all
strangers together have one turn in STRANGERS_S, and a new stranger displaces strangers only
(`Turns`, `Peers`).
"""

import asyncio
import contextlib
import hmac
import math
import socket
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import NamedTuple

import numpy as np

from hilstar.attitude.wire.packet import Refusal, checked_sample, encode
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import propagate
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.version import __version__
from hilstar.server.console import scpi
from hilstar.server.console.messages import (
    FRAME,
    HAS_AGE,
    MISSING,
    STALE,
    FrameNumbers,
    Order,
    OrderAnswer,
    RunState,
    ScpiSetup,
    SharedMemory,
)
from hilstar.server.console.scpi import (
    NOT_A_NUMBER,
    OPERATION_COMPLETE,
    Headers,
    InstrumentStatus,
    LineBuffer,
    NotScpi,
    ScpiError,
    Unit,
)
from hilstar.server.console.server.reader import TICK_S, RunReader

SENT_HZ = 50.0
SETTLES_NS = 2 * NS_PER_S  # a command that waits for an attitude waits no longer (error -365)
MARGIN_NS = NS_PER_MS  # the frame in a state may have been read so long before the state's time
POLL_S = 0.01
ALIVE_NS = NS_PER_S  # an older state or step is a fault: the run writes ten states a second
MAX_CONTROLLERS, MAX_STRANGERS = 16, 16
# The commands without parameters; no query of QUERIES has any.
BARE = {
    "*CLS",
    "*RST",
    "*OPC",
    "*OPC?",
    "*WAI",
    "STATus:PRESet",
    "SKY:ATTitude?",
    "SKY:RATE?",
}
# Lines, commands and queries in a controller's turn, 0.2 ms of work. Before its next turn it waits
# TURN_S, so that a flood leaves time to the others.
UNITS_A_TURN, TURN_S = 8, 0.001
# All strangers together may send 800 a second, 3 % of a core.
STRANGER_UNITS_A_TURN, STRANGERS_S = 4, 0.005
MAX_READ_BYTES = 4096
MAX_UNSENT_BYTES = 65_536
UNREAD_S = 10.0
MAX_WRONG_TOKENS = 5
WRONG_TOKEN_S = 0.5
# The error number by the HTTP status of an order's answer; -310 for any other.
ORDER_ERRORS = {400: -224, 404: -224, 409: -221, 500: -250, 504: -365}
# Commands that need no token (docs/scpi.md, "Who may").
UNLOCKED = {
    "*IDN?",
    "*CLS",
    "SYSTem:AUTHenticate",
    "SYSTem:ERRor[:NEXT]?",
    "SYSTem:ERRor:COUNt?",
    "SYSTem:VERSion?",
}

# Bits of the operation and the questionable status; SCPI-1999 leaves bits 8 to 12 and 9 to 12 to a
# device.
SKY_SHOWN, LEDGER_ON, FAULT_ON, OPERATOR_ON = 1 << 8, 1 << 9, 1 << 10, 1 << 11
NO_ATTITUDE, LEDGER_FAILS, FRAMES_MISSED, NOT_WELL = 1 << 9, 1 << 10, 1 << 11, 1 << 12

Give = Callable[[Order], Awaitable[OrderAnswer]]


class SkySource:
    """The attitude that SCPI sets: constant, or turning at a rate since it was set. It is sent as
    packets to the UDP port `port` of this machine.
    """

    def __init__(self, port: int, max_rate_deg_s: float) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(("127.0.0.1", port))
        self._max_rate_deg_s = max_rate_deg_s
        self._q: FloatArray | None = None
        self._rate_rad_s: FloatArray = np.zeros(3)
        self._sequence = 0
        self.set_ns = 0  # host time of the newest setting

    def attitude(self, q: tuple[float, ...]) -> None:
        """Set q_icrs_to_cam (w, x, y, z) from now on; the rate stays. Raises ScpiError for numbers
        that are no unit quaternion.
        """
        sample = checked_sample(0, q, None)
        if isinstance(sample, Refusal):
            raise ScpiError(-222, sample.detail)
        self._q = sample.q_icrs_to_cam
        self.set_ns = time.monotonic_ns()
        self.send(jumps=True)

    @property
    def has_attitude(self) -> bool:
        """Whether an attitude was set: until then nothing is sent, whatever the rate."""
        return self._q is not None

    def rate(self, rate_deg_s: tuple[float, ...]) -> None:
        """Set the rate from now on, deg/s about the camera's axes, (3,). Raises ScpiError if it
        exceeds [attitude] max_rate_deg_s.
        """
        if math.hypot(*rate_deg_s) > self._max_rate_deg_s:
            raise ScpiError(
                -222, f"faster than [attitude] max_rate_deg_s = {self._max_rate_deg_s:g}"
            )
        now_ns = time.monotonic_ns()
        if self._q is not None:
            self._q = self._at(self._q, now_ns)
        self._rate_rad_s = np.radians(rate_deg_s)
        self.set_ns = now_ns
        self.send()

    def _at(self, q: FloatArray, t_ns: int) -> FloatArray:
        return propagate(q, self._rate_rad_s, (t_ns - self.set_ns) / NS_PER_S)

    def send(self, jumps: bool = False) -> None:
        """Send the present attitude; nothing before one is set. `jumps` marks an attitude that does
        not continue the previous motion: it is that of `set_ns`.
        """
        if self._q is None:
            return
        t_ns = self.set_ns if jumps else time.monotonic_ns()
        sample = checked_sample(
            t_ns, tuple(self._at(self._q, t_ns)), tuple(self._rate_rad_s), self._sequence, jumps
        )
        assert not isinstance(sample, Refusal)
        self._sequence += 1
        with contextlib.suppress(OSError):  # the run is ending
            self._socket.send(encode(sample))

    async def run(self) -> None:
        """Send the attitude SENT_HZ times a second until the task is cancelled."""
        while True:
            self.send()
            await asyncio.sleep(1 / SENT_HZ)


class Settled(NamedTuple):
    """The newest setting of the sky that the display has shown: the host time of the setting, and
    the host time from which a state is certain to include it, ns.
    """

    set_ns: int
    seen_ns: int


class Turns:
    """Gives connections their turns to run commands. Attitudes are sent between turns."""

    def __init__(self) -> None:
        self._strangers = asyncio.Lock()  # gives strangers their turns in order of arrival
        self._next_s = 0.0

    async def await_turn(self, stranger: bool) -> int:
        """Wait for a turn; returns the number of lines, commands and queries in it."""
        if not stranger:
            await asyncio.sleep(TURN_S)
            return UNITS_A_TURN
        clock_s = asyncio.get_running_loop().time
        async with self._strangers:
            await asyncio.sleep(self._next_s - clock_s())
            self._next_s = clock_s() + STRANGERS_S
        return STRANGER_UNITS_A_TURN


class Peers:
    """The open connections, controllers and strangers separately. In each the connection that has
    been silent longest comes first.
    """

    def __init__(self) -> None:
        self.controllers: dict[Connection, asyncio.StreamWriter] = {}
        self.strangers: dict[Connection, asyncio.StreamWriter] = {}

    def enter(self, client: "Connection", outgoing: asyncio.StreamWriter) -> None:
        """Add a new connection as a stranger. If there are MAX_STRANGERS, one is closed: of the
        address with the most strangers, the one that has been silent longest.
        """
        if len(self.strangers) >= MAX_STRANGERS:
            ((crowded, _),) = Counter(stranger.address for stranger in self.strangers).most_common(
                1
            )
            first = next(stranger for stranger in self.strangers if stranger.address == crowded)
            self.strangers.pop(first).transport.abort()
        self.strangers[client] = outgoing

    def heard(self, client: "Connection") -> None:
        """Note that a connection has sent something."""
        for peers in (self.controllers, self.strangers):
            if client in peers:
                peers[client] = peers.pop(client)

    def promote(self, client: "Connection") -> None:
        """Make a stranger a controller. If there are MAX_CONTROLLERS, the one that has been silent
        longest is closed.
        """
        outgoing = self.strangers.pop(client, None)
        if outgoing is None:
            return
        if len(self.controllers) >= MAX_CONTROLLERS:
            self.controllers.pop(next(iter(self.controllers))).transport.abort()
        self.controllers[client] = outgoing

    def leave(self, client: "Connection") -> None:
        """Remove a connection that has ended."""
        self.controllers.pop(client, None)
        self.strangers.pop(client, None)


class ScpiServer:
    """The server of SCPI, and what all connections share: the run's state (`reader`), the function
    that sends an order (`give`), and the source of attitudes (`sky`, None if SCPI may not set
    them).
    """

    def __init__(
        self, setup: ScpiSetup, reader: RunReader, memory: SharedMemory, give: Give
    ) -> None:
        self.setup = setup
        self.reader = reader
        self.give = give
        self.sky = SkySource(setup.steer_port, setup.max_rate_deg_s) if setup.steer_port else None
        self._memory = memory
        self.peers = Peers()
        self.turns = Turns()
        self._missed = 0
        self._settled = Settled(0, 0)

    async def serve(self, listener: socket.socket) -> None:
        """Serve connections until the task is cancelled."""
        server = await asyncio.start_server(self._client, sock=listener, limit=MAX_READ_BYTES)
        async with server, asyncio.TaskGroup() as tasks:
            if self.sky is not None:
                tasks.create_task(self.sky.run())
            while True:
                await asyncio.sleep(TICK_S)
                self._look()

    def _look(self) -> None:
        self.pending()  # notes a setting that is shown while no command waits for it
        for client in (*self.peers.controllers, *self.peers.strangers):
            client.look()
        self._missed = 0 if self.reader.seen is None else self.reader.seen.counts.missed

    def conditions(self) -> tuple[int, int]:
        """The present conditions of the operation and the questionable status registers."""
        state = self.reader.seen
        if state is None:
            return 0, NO_ATTITUDE | NOT_WELL
        operation = SKY_SHOWN * (not state.frame.blank) | LEDGER_ON * (state.ledger is not None)
        operation |= FAULT_ON * bool(state.faults) | OPERATOR_ON * bool(state.operator_text)
        failing = state.ledger is not None and bool(state.ledger.failing)
        questionable = (
            NO_ATTITUDE * (state.frame.missing or state.frame.stale) | LEDGER_FAILS * failing
        )
        questionable |= FRAMES_MISSED * (state.counts.missed > self._missed)
        return operation, questionable | NOT_WELL * (not self.reader.health.ok)

    def pending(self) -> bool:
        """Whether the newest setting of the sky is not yet on the display, or not yet in the run's
        state. False at the latest SETTLES_NS after the setting.
        """
        sky = self.sky
        state = self.reader.seen
        now_ns = time.monotonic_ns()
        if sky is None or now_ns - sky.set_ns > SETTLES_NS:
            return False
        if self._settled.set_ns != sky.set_ns:
            newest_frame = self._memory.frames.last()
            if newest_frame is None or state is None:
                return True
            frame = FrameNumbers._make(FRAME.unpack(newest_frame[1]))
            # The run has not heard of the attitude yet, however late the frame was drawn.
            if sky.has_attitude and frame.flags & (MISSING | STALE):
                return True
            # The attitude of a blank or paused frame is not the present one: then the frame's
            # drawing has to be later than the setting.
            follows = frame.flags & HAS_AGE and not state.operator.get("pause")
            if (frame.swap_ns - frame.age_ns if follows else frame.draw_ns) < sky.set_ns:
                return True
            self._settled = Settled(sky.set_ns, now_ns + MARGIN_NS)
        return state is None or state.host_ns <= self._settled.seen_ns

    async def settled(self) -> None:
        """Wait until the newest setting of the sky is shown. Raises ScpiError (-365) if that takes
        over SETTLES_NS.
        """
        if not self.pending():
            return
        while self.pending():
            await asyncio.sleep(POLL_S)
        if self.sky is not None and self._settled.set_ns != self.sky.set_ns:
            raise ScpiError(-365, f"the attitude was not shown within {SETTLES_NS / NS_PER_S:g} s")

    async def _client(self, incoming: asyncio.StreamReader, outgoing: asyncio.StreamWriter) -> None:
        """Serve a connection until it ends. It is closed if it sends bytes that no test stand
        sends, does not read its answers, or has given MAX_WRONG_TOKENS wrong tokens.
        """
        peer = outgoing.get_extra_info("peername")
        client = Connection(self, "" if not peer else str(peer[0]))
        connected = outgoing.get_extra_info("socket")
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        outgoing.transport.set_write_buffer_limits(MAX_UNSENT_BYTES)
        self.peers.enter(client, outgoing)
        lines = LineBuffer()
        try:
            while data := await incoming.read(MAX_READ_BYTES):
                # Otherwise a controller's second write waits 40 ms for a delayed acknowledgement.
                connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
                self.peers.heard(client)
                await client.turn()
                for line in lines.feed(data):
                    answer = await client.answer(line)
                    # `Peers` closes a connection that is displaced by another.
                    if client.wrong_tokens >= MAX_WRONG_TOKENS or outgoing.is_closing():
                        return
                    if answer:
                        outgoing.write(answer.encode("ascii", "replace") + b"\n")
                        async with asyncio.timeout(UNREAD_S):
                            await outgoing.drain()
        except NotScpi:
            # Usually another site's page makes a browser send this: it must get no answer.
            outgoing.transport.abort()
        except (OSError, TimeoutError):
            outgoing.transport.abort()  # the peer has gone, or does not read its answers
        finally:
            self.peers.leave(client)
            outgoing.close()


class Connection:
    """The instrument that one connection sees: its status, and a method for each command of
    COMMANDS and for some queries of QUERIES.

    `unlocked` says that the token was given or is not needed.
    """

    def __init__(self, server: ScpiServer, address: str) -> None:
        self.status = InstrumentStatus()
        self.unlocked = not server.setup.token
        self.is_controller = False
        self.wrong_tokens = 0
        self.address = address
        self._units_left = 0
        self._server = server
        self._reader = server.reader
        self._who = "SCPI" + ("" if address in {"127.0.0.1", "::1", ""} else f" ({address})")
        self._answers: list[str] = []

    async def turn(self) -> None:
        """Wait until this connection may continue: called before each line, command and query."""
        if not self._units_left:
            self._units_left = await self._server.turns.await_turn(not self.is_controller)
        self._units_left -= 1

    def _acts(self) -> None:
        """Make this connection a controller: it may act, and does."""
        self.is_controller = True
        self._server.peers.promote(self)

    def look(self) -> None:
        """Update the registers by the run's present conditions, and complete a waiting `*OPC`."""
        operation, questionable = self._server.conditions()
        self.status.operation.see(operation)
        self.status.questionable.see(questionable)
        if self.status.completes and not self._server.pending():
            self.status.completes = False
            self.status.standard.event |= OPERATION_COMPLETE

    async def answer(self, line: str | None) -> str:
        """Run the commands of a line (None: a line that was too long), and return its answers,
        separated by `;`, "" for none. Errors go into the queue.
        """
        self._answers = []
        await self.turn()
        try:
            if line is None:
                raise ScpiError(-363, f"a line has at most {scpi.MAX_LINE_BYTES} bytes")
            for unit in HEADERS.units(line):
                await self.turn()
                await self._do(unit)
        except ScpiError as error:  # after an error of syntax the rest of the line is ignored
            self.status.add(error)
        return ";".join(self._answers)

    async def _do(self, unit: Unit) -> None:
        """Run a command or query, and add its answer to the line's or its error to the queue."""
        try:
            if not self.unlocked and unit.pattern not in UNLOCKED:
                raise ScpiError(
                    -203,
                    'write SYST:AUTH "TOKEN" first, with the token that hilstar printed or was'
                    " given",
                )
            if unit.pattern not in UNLOCKED:
                self._acts()
            if unit.pattern in QUERIES or unit.pattern in BARE:
                scpi.count(unit, 0)
            self.look()
            query = QUERIES.get(unit.pattern)
            if query is None:
                response = await COMMANDS[unit.pattern](self, unit)
            else:
                response = query(self)
            if response is not None:
                self._answers.append(response)
        except ScpiError as error:
            self.status.add(error)

    async def _order(self, order: Order) -> None:
        answer = await self._server.give(order)
        if answer.status >= 400:
            raise ScpiError(ORDER_ERRORS.get(answer.status, -310), answer.line)
        done_ns = time.monotonic_ns()
        # Wait for a state after the order, so that the next query sees its effect.
        for _ in range(round(2 * TICK_S / POLL_S) + 1):
            if self._reader.seen is not None and self._reader.seen.host_ns > done_ns:
                break
            await asyncio.sleep(POLL_S)

    async def reset(self, unit: Unit) -> None:
        """`*RST`: switch off the operator's switches and the faults, and stop the motion; the
        attitude and the ledger stay.
        """
        self.status.completes = False
        state = self._reader.seen
        for name in () if state is None else [name for name, on in state.operator.items() if on]:
            await self._order(Order(id=0, name=name, who=self._who, on=False))
        for name in [] if state is None else state.faults:
            # A fault that came by the stream of faults cannot be ended by an operator.
            with contextlib.suppress(ScpiError):
                await self._order(Order(id=0, name="fault", who=self._who, on=False, fault=name))
        if self._server.sky is not None:
            self._server.sky.rate((0.0, 0.0, 0.0))

    async def complete_later(self, unit: Unit) -> None:
        """`*OPC`: set the bit "operation complete" once the sky is as it was set."""
        self.status.completes = True
        self.look()

    async def complete(self, unit: Unit) -> str:
        """`*OPC?`: answer 1 once the sky is as it was set."""
        await self.wait(unit)
        return "1"

    async def wait(self, unit: Unit) -> None:
        """`*WAI`: wait until the sky is as it was set; after SETTLES_NS that is an error."""
        try:
            await self._server.settled()
        except ScpiError as error:
            self.status.add(error)

    async def authenticate(self, unit: Unit) -> None:
        """`SYST:AUTH "TOKEN"`: check the token, in constant time. A wrong one is refused only
        after WRONG_TOKEN_S.
        """
        (given,) = scpi.count(unit, 1)
        if given.kind != "string":
            raise ScpiError(-104, 'write SYST:AUTH "TOKEN"')
        token = self._server.setup.token
        if token and not hmac.compare_digest(given.text.encode(), token.encode()):
            self.wrong_tokens += 1
            await asyncio.sleep(WRONG_TOKEN_S)
            raise ScpiError(-203, "that is not the token")
        self.unlocked = True
        self._acts()

    async def switch(self, unit: Unit) -> None:
        """`SKY:BLAN` (no light) and `LEDG:STAT` with ON or OFF: the switches of the page."""
        (on,) = scpi.count(unit, 1)
        if unit.pattern.startswith("SKY"):
            name = "blank"
        else:
            name = "ledger"
        await self._order(Order(id=0, name=name, who=self._who, on=scpi.boolean(on)))

    async def fault(self, unit: Unit) -> None:
        """`SKY:FAUL "NAME"[,ON|OFF]`: begin or end a fault of the scenario."""
        name, *on = scpi.count(unit, 1, 2)
        if name.kind != "string":
            raise ScpiError(-104, 'write SKY:FAUL "NAME",ON')
        wanted = scpi.boolean(on[0]) if on else True
        await self._order(Order(id=0, name="fault", who=self._who, on=wanted, fault=name.text))

    def _steered(self) -> SkySource:
        if self._server.sky is None:
            raise ScpiError(
                -221,
                f"the attitude comes by {self._server.setup.source}; write [attitude] source ="
                " 'scpi'",
            )
        return self._server.sky

    async def set_attitude(self, unit: Unit) -> None:
        """`SKY:ATT w,x,y,z`: set q_icrs_to_cam from now on."""
        sky = self._steered()
        given = scpi.count(unit, 4)
        sky.attitude(tuple(map(scpi.number, given)))

    async def set_rate(self, unit: Unit) -> None:
        """`SKY:RATE x,y,z`: set the rate from now on, deg/s about the camera's axes."""
        sky = self._steered()
        given = scpi.count(unit, 3)
        sky.rate(tuple(scpi.number(parameter, "DEG/S") for parameter in given))

    async def attitude(self, unit: Unit) -> str:
        """`SKY:ATT?` and `SKY:RATE?`: q_icrs_to_cam and rate, deg/s, of the newest frame, once the
        newest setting is shown.
        """
        await self.wait(unit)
        shown = self.seen.attitude
        if unit.pattern == "SKY:RATE?":
            return _numbers(None if shown is None else shown.rate_deg_s, 3)
        return _numbers(None if shown is None else shown.q, 4)

    @property
    def seen(self) -> RunState:
        """The run's newest state; an empty one before the first."""
        return self._reader.seen or RunState(host_ns=0)

    def status_byte(self) -> str:
        """`*STB?`: the status byte. A message waits if this line has had an answer before."""
        return str(self.status.byte(bool(self._answers)))

    def self_test(self) -> str:
        """`*TST?`: 0 while the run writes its state and its frame loop moves, else 1."""
        state = self.seen
        alive = (
            time.monotonic_ns() - state.host_ns < ALIVE_NS
            and state.host_ns - state.alive_ns < ALIVE_NS
        )
        return str(int(not alive))

    def faults(self) -> str:
        """`SKY:FAUL?`: the quoted names of the faults that are on, "" in quotes for none."""
        return ",".join('"' + name.replace('"', '""') + '"' for name in self.seen.faults) or '""'

    def residual(self) -> str:
        """`TRAC:RES?`: the residual of the tracker's newest answer, arcsec about x, y, z."""
        figures = self.seen.tracker
        return _numbers(None if figures is None else figures.residual_arcsec, 3)


def _numbers(values: tuple[float, ...] | list[float] | None, places: int) -> str:
    return ",".join(
        [NOT_A_NUMBER] * places if values is None else [f"{value:.12E}" for value in values]
    )


def _setting(what: Callable[[InstrumentStatus, int], None], maximum: int) -> "Command":
    async def command(connection: Connection, unit: Unit) -> None:
        what(connection.status, scpi.integer(scpi.count(unit, 1)[0], maximum))

    return command


def _bare(what: Callable[[InstrumentStatus], None]) -> "Command":
    async def command(connection: Connection, unit: Unit) -> None:
        what(connection.status)

    return command


Command = Callable[[Connection, Unit], Awaitable[str | None]]
# Queries that answer at once. No query has parameters.
QUERIES: dict[str, Callable[[Connection], str]] = {
    "*IDN?": lambda at: f"hilstar,star display,0,{__version__}",
    "*ESE?": lambda at: str(at.status.standard.enable),
    "*ESR?": lambda at: str(at.status.standard.read()),
    "*SRE?": lambda at: str(at.status.service_enable),
    "*STB?": Connection.status_byte,
    "*TST?": Connection.self_test,
    "SYSTem:ERRor[:NEXT]?": lambda at: at.status.next_error(),
    "SYSTem:ERRor:COUNt?": lambda at: str(len(at.status.errors)),
    "SYSTem:VERSion?": lambda at: "1999.0",
    "STATus:OPERation[:EVENt]?": lambda at: str(at.status.operation.read()),
    "STATus:OPERation:CONDition?": lambda at: str(at.status.operation.condition),
    "STATus:OPERation:ENABle?": lambda at: str(at.status.operation.enable),
    "STATus:QUEStionable[:EVENt]?": lambda at: str(at.status.questionable.read()),
    "STATus:QUEStionable:CONDition?": lambda at: str(at.status.questionable.condition),
    "STATus:QUEStionable:ENABle?": lambda at: str(at.status.questionable.enable),
    "SKY:BLANk?": lambda at: str(int(bool(at.seen.operator.get("blank")))),
    "SKY:FAULt?": Connection.faults,
    "LEDGer:STATe?": lambda at: str(int(at.seen.ledger is not None)),
    "TRACker:RESidual?": Connection.residual,
    "FRAMe:MISSed?": lambda at: str(at.seen.counts.missed),
}
COMMANDS: dict[str, Command] = {
    "*CLS": _bare(InstrumentStatus.clear),
    "*RST": Connection.reset,
    "*OPC": Connection.complete_later,
    "*OPC?": Connection.complete,
    "*WAI": Connection.wait,
    "*ESE": _setting(lambda status, mask: setattr(status.standard, "enable", mask), 255),
    "*SRE": _setting(
        lambda status, mask: setattr(status, "service_enable", mask & ~scpi.MASTER), 255
    ),
    "SYSTem:AUTHenticate": Connection.authenticate,
    "STATus:PRESet": _bare(InstrumentStatus.preset),
    "STATus:OPERation:ENABle": _setting(
        lambda status, mask: setattr(status.operation, "enable", mask), 0x7FFF
    ),
    "STATus:QUEStionable:ENABle": _setting(
        lambda status, mask: setattr(status.questionable, "enable", mask), 0x7FFF
    ),
    "SKY:BLANk": Connection.switch,
    "SKY:ATTitude": Connection.set_attitude,
    "SKY:ATTitude?": Connection.attitude,
    "SKY:RATE": Connection.set_rate,
    "SKY:RATE?": Connection.attitude,
    "SKY:FAULt": Connection.fault,
    "LEDGer:STATe": Connection.switch,
}
HEADERS = Headers([*QUERIES, *COMMANDS])
