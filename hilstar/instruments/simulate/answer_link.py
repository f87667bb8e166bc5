"""The answering end of a tracker's link: packets or JSON over ZeroMQ, UDP or a serial line, and
garbage on request.
"""

from typing import Any

import msgspec
import numpy as np

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import AnswerPacket, encode
from hilstar.basics.process.closing import Closing
from hilstar.instruments.simulate.live_exposure import BLINDED, LOST, TOO_FEW, TRACKING
from hilstar.server.answers.answer import Answer
from hilstar.server.sender import PATIENCE_S, SerialSender, open_sender

FORMATS = ("packet", "json")
MAX_BABBLE_BYTES = 300  # between two answers
STAR_DECIMALS = 4
SIGNAL_PLACE = 3  # of a star: what is after it is left out where it is not known
MODE_FLAGS = {
    TRACKING: protocol.ANSWER_TRACKING,
    LOST: protocol.ANSWER_LOST_IN_SPACE,
    TOO_FEW: protocol.ANSWER_TOO_FEW_STARS,
    BLINDED: protocol.ANSWER_BLINDED,
}


def json_answer(answer: Answer) -> bytes:
    """An answer as a JSON object in one line, without its end."""
    fields: dict[str, Any] = {
        "t_ns": answer.t_ns,
        "valid": answer.valid,
        "mode": answer.mode,
        "stars": answer.star_count,
    }
    for name, vector in (("q", answer.q_icrs_to_cam), ("rate", answer.rate_cam_rad_s)):
        if vector is not None:
            fields[name] = vector.tolist()
    if answer.rms_arcsec is not None:
        fields["rms_arcsec"] = answer.rms_arcsec
    fields["centroids"] = []
    for star in answer.centroids:
        numbers = [None if part is None else round(part, STAR_DECIMALS) for part in star]
        while len(numbers) > SIGNAL_PLACE and numbers[-1] is None:
            numbers.pop()
        fields["centroids"].append(numbers)
    return msgspec.json.encode(fields)


def answer_packet(answer: Answer, sequence: int) -> AnswerPacket:
    """An answer as a packet of the wire."""
    q = answer.q_icrs_to_cam
    rate = answer.rate_cam_rad_s
    known = protocol.ANSWER_VALID * (q is not None) + protocol.ANSWER_RATE_VALID * (
        rate is not None
    )
    q = np.array([1.0, 0.0, 0.0, 0.0]) if q is None else q
    rate = np.zeros(3) if rate is None else rate
    return AnswerPacket(
        sequence,
        MODE_FLAGS.get(answer.mode, 0) + known,
        answer.t_ns or 0,
        tuple(q.tolist()),
        tuple(rate.tolist()),
        answer.star_count or 0,
    )


class AnswerLink(Closing):
    """Sends answers in a format of FORMATS to a target (see `open_sender`); `babble` makes garbage
    before each.

    Raises InputError where the target cannot be opened.
    """

    def __init__(
        self, target: str, form: str, connect: bool, babble: np.random.Generator | None
    ) -> None:
        self._end = open_sender(target, connect=connect)
        self._form = form
        self._babble = babble
        self.endpoint = self._end.endpoint
        self.sent = self.babbled = 0

    def send(self, answer: Answer) -> None:
        """Send one answer. Only a full serial line is waited for, half a second at most."""
        if self._babble is not None:
            self._put_raw(self._babble.bytes(int(self._babble.integers(1, MAX_BABBLE_BYTES))))
            self.babbled += 1
        if self._form == "json":
            self._put_raw(
                json_answer(answer) + (b"\n" if isinstance(self._end, SerialSender) else b"")
            )
        else:
            self._end.put(encode(answer_packet(answer, self.sent)))
        self.sent += 1

    def _put_raw(self, message: bytes) -> None:
        if isinstance(self._end, SerialSender):
            self._end.send_bytes(message, PATIENCE_S)
        else:
            self._end.put(message)

    def close(self) -> None:
        """Close the link."""
        self._end.close()
