"""The model inside a co-simulation FMU: it sends attitudes to `hilstar serve` over UDP, and takes
what comes back.

This file is copied into the FMU, and the generated table of the wire (attitude/wire/protocol.py)
beside it, as `hilstar_protocol`. There they have the standard library and PythonFMU alone, whatever
Python the simulation tool has: they import nothing of hilstar.
"""

import contextlib
import json
import math
import socket
import struct
import threading
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real, String
from pythonfmu.enums import Fmi2Status

if TYPE_CHECKING:
    from hilstar.attitude.wire import protocol
else:
    import hilstar_protocol as protocol

# what comes back to a sender of attitudes
BODIES = {
    protocol.KIND_TIME_REQUEST: protocol.TIME_REQUEST_BODY,
    protocol.KIND_STATUS: protocol.STATUS_BODY,
    protocol.KIND_ANSWER: protocol.ANSWER_BODY,
}
CRC = struct.Struct("<I")
NS_PER_S = 1_000_000_000
LISTEN_S = 0.2
# the start value of `t_s`: the attitude's time is the communication point's
COMMUNICATION_POINT = -1.0
Q = ("q_w", "q_x", "q_y", "q_z")
RATE = ("rate_x", "rate_y", "rate_z")
ANSWERED = ("answered_q_w", "answered_q_x", "answered_q_y", "answered_q_z")


def packed(body: bytes) -> bytes:
    """A packet: its body and the CRC-32 of that."""
    return body + CRC.pack(zlib.crc32(body))


def unpacked(packet: bytes) -> tuple[int, ...] | None:
    """The numbers of a packet that comes back; None for what is none."""
    if len(packet) < 2 or packet[0] != protocol.VERSION:
        return None
    body = BODIES.get(packet[1])
    if body is None or len(packet) != body.size + CRC.size or packet != packed(packet[: body.size]):
        return None
    return body.unpack(packet[: body.size])


class StarDisplay(Fmi2Slave):  # type: ignore[misc]
    """A star display as a block of a simulation: attitude in; frame, health and the tracker's
    answered attitude out.
    """

    description = "A star tracker's display on a bench (hilstar serve), driven over UDP"
    license = "MIT"

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        made = json.loads(Path(__file__).with_name("bench.json").read_text())
        self.address: str = made["address"]
        self.real_time = self.use_rate = True
        self.q_w = 1.0
        self.q_x = 0.0
        self.q_y = 0.0
        self.q_z = 0.0
        self.rate_x = self.rate_y = self.rate_z = 0.0
        self.t_s = COMMUNICATION_POINT
        self.frame = self.health = self.statuses = self.answers = 0
        self.answered_q_w = self.answered_q_x = self.answered_q_y = self.answered_q_z = 0.0
        self.answered_t_s = 0.0
        self._register()
        self._socket: socket.socket | None = None
        self._sequence = 0
        # a time of the model, ns, and of the host's monotonic clock
        self._zero: tuple[int, int] | None = None
        # a communication point, s, and when it was there
        self._begun: tuple[float, float] | None = None

    def _register(self) -> None:
        parameter = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(
            String("address", description="HOST:PORT of hilstar's [attitude] bind", **parameter)
        )
        pace = "a step takes as long as it simulates; false: the tool itself is in real time"
        self.register_variable(Boolean("real_time", description=pace, **parameter))
        self.register_variable(
            Boolean("use_rate", description="the rate inputs are connected", **parameter)
        )
        for name in (*Q, *RATE, "t_s"):
            description = "s: time of the attitude, -1 for that of the communication point"
            if name != "t_s":
                if name in Q:
                    description = "q_icrs_to_cam, scalar first, Hamilton"
                else:
                    description = "rad/s: rate of cam, its own components"
            self.register_variable(
                Real(name, causality=Fmi2Causality.input, description=description)
            )
        for name, description in (
            ("frame", "number of the newest frame that was shown, mod 2^31"),
            ("health", "sum of hilstar's health bits"),
            ("statuses", "status packets so far: 0 while no display answers"),
            ("answers", "valid answers of the tracker so far"),
        ):
            discrete = Fmi2Variability.discrete
            self.register_variable(
                Integer(
                    name,
                    causality=Fmi2Causality.output,
                    variability=discrete,
                    description=description,
                )
            )
        for name in ANSWERED:
            description = (
                "attitude of the tracker's newest valid answer, q_icrs_to_cam; zeros before one"
            )
            self.register_variable(
                Real(name, causality=Fmi2Causality.output, description=description)
            )
        self.register_variable(
            Real(
                "answered_t_s",
                causality=Fmi2Causality.output,
                description="s: when that answer's exposure had its middle",
            )
        )

    def to_xml(self, *options: object) -> Element:
        """The model's description; outputs are also its initial unknowns (FMI 2.0, 2.2.8), which
        PythonFMU leaves out.
        """
        root: Element = super().to_xml(*options)
        structure = root.find("ModelStructure")
        if structure is not None and (outputs := structure.find("Outputs")) is not None:
            SubElement(structure, "InitialUnknowns").extend(outputs)
        return root

    def exit_initialization_mode(self) -> None:
        """Open the socket, and listen."""
        host, _, port = self.address.rpartition(":")
        addresses = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
        self._socket = socket.socket(addresses[0][0], socket.SOCK_DGRAM)
        self._socket.connect(addresses[0][4])
        self._socket.settimeout(LISTEN_S)
        threading.Thread(
            target=self._listen, args=(self._socket,), name="hilstar-fmu", daemon=True
        ).start()

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Send the attitude of this communication point; in real time, wait for the next."""
        q = tuple(getattr(self, name) for name in Q)
        rate = tuple(getattr(self, name) for name in RATE)
        if not abs(math.hypot(*q) - 1.0) <= protocol.NORM_TOLERANCE or not all(
            map(math.isfinite, rate)
        ):
            line = (
                f"q has the norm {math.hypot(*q):.6g}, rate is {rate}; connect a unit quaternion, w"
                " first"
            )
            self.log(line, Fmi2Status.error)
            return False
        if self.t_s == COMMUNICATION_POINT:
            t_s = current_time
        else:
            t_s = self.t_s
        t_ns = round(t_s * NS_PER_S)
        if self._zero is None:
            self._zero = t_ns, time.monotonic_ns()
            self._begun = current_time, time.monotonic()
        flags = protocol.FLAG_RATE_VALID if self.use_rate else 0
        head = (protocol.VERSION, protocol.KIND_ATTITUDE, flags, self._sequence % 2**32, t_ns)
        body = protocol.ATTITUDE_BODY.pack(*head, *q, *rate)
        self._sequence += 1
        with contextlib.suppress(OSError):  # no display is there now; one may come
            if self._socket is not None:
                self._socket.send(packed(body))
        if self.real_time and self._begun is not None:
            begun_s, begun_at_s = self._begun
            time.sleep(max(0.0, begun_at_s + current_time + step_size - begun_s - time.monotonic()))
        return True

    def terminate(self) -> None:
        """Close the socket."""
        opened = self._socket
        self._socket = None
        if opened is not None:
            opened.close()

    def _now_ns(self) -> int:
        if self._zero is None:
            return 0
        model_ns, host_ns = self._zero
        return model_ns + time.monotonic_ns() - host_ns

    def _listen(self, opened: socket.socket) -> None:
        while self._socket is opened:
            try:
                numbers = unpacked(opened.recv(256))
            except TimeoutError:
                continue
            except OSError:  # refused, where no display is there; or closed
                time.sleep(LISTEN_S / 10)
                continue
            if numbers is not None:
                self._take(opened, numbers)

    def _take(self, opened: socket.socket, numbers: tuple[int, ...]) -> None:
        _, kind, flags, sequence, t_ns, *rest = numbers
        if kind == protocol.KIND_TIME_REQUEST and self._zero is not None:
            head = (protocol.VERSION, protocol.KIND_TIME_REPLY, 0, sequence, t_ns)
            reply = protocol.TIME_REPLY_BODY.pack(*head, self._now_ns(), self._now_ns())
            with contextlib.suppress(OSError):
                opened.send(packed(reply))
        elif kind == protocol.KIND_STATUS:
            self.health, self.frame, self.statuses = flags, sequence % 2**31, self.statuses + 1
        elif kind == protocol.KIND_ANSWER and flags & protocol.ANSWER_VALID:
            self.answered_q_w, self.answered_q_x, self.answered_q_y, self.answered_q_z = map(
                float, rest[:4]
            )
            self.answered_t_s, self.answers = t_ns / NS_PER_S, self.answers + 1
