"""A simulator and a tracker in one process of their own: attitudes out over ZeroMQ, answers out
over a serial line.

`python -m tests.support.stub_tracker '{"port": 5560, "line": 5}'`: the keys are those of `Stub`.
The tracker reports what was commanded in the middle of each exposure, with errors that are planted
here, one JSON object a line. Its `mode` is the host's clock just before it writes, ns. It ends when
its standard input does, and then prints which answers were wild, and before which it was itself held
up for so long that the display had to guess.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
import zmq
from scipy.spatial.transform import Rotation

from tests.support.senders import ORION, packet

ARCSEC_PER_RAD = 180 * 3600 / np.pi
SENT_EACH_S = 0.02
# A display that is told nothing for longer predicts a swing, and shows another sky than this one.
STARVED_S, BEFORE_S = 2.5 * SENT_EACH_S, 0.3


@dataclass(frozen=True)
class Stub:
    """What is planted, the simulator's port, and the descriptor of the serial line.

    `swing_deg` is the size of a slow turn to and fro, `silent_s` a part of the run without answers.
    """

    port: int
    line: int
    answer_hz: float = 10.0
    latency_s: float = 0.12
    bias_arcsec: tuple[float, float, float] = (15.0, -9.0, 40.0)
    noise_arcsec: tuple[float, float, float] = (2.0, 2.0, 12.0)
    drift: float = 40e-6
    epoch_s: float = 500.0
    wild: float = 0.01
    swing_deg: float = 0.5
    silent_s: tuple[float, float] = (1e9, 1e9)
    seed: int = 1
    babble: bool = False

    def q(self, t_s: float) -> np.ndarray:
        """The commanded q_icrs_to_cam, scalar first, at a time of the host's clock."""
        turn = np.radians(self.swing_deg) * np.array(
            [np.sin(1.3 * t_s), np.sin(0.9 * t_s + 1.0), 0.0]
        )
        return np.roll(
            (Rotation.from_rotvec(turn) * Rotation.from_quat(np.roll(ORION, -1))).as_quat(), 1
        )

    def answer(
        self, k: int, middle_s: float, begun_s: float, rng: np.random.Generator
    ) -> tuple[str, bool]:
        """Answer k, of an exposure's middle, as a line; and whether it is wild."""
        error = Rotation.from_rotvec(
            (np.array(self.bias_arcsec) + self.noise_arcsec * rng.standard_normal(3))
            / ARCSEC_PER_RAD
        )
        is_wild = bool(rng.random() < self.wild)
        if is_wild:
            error = Rotation.random(random_state=rng)
        q = np.roll((error * Rotation.from_quat(np.roll(self.q(middle_s), -1))).as_quat(), 1)
        own_s = self.epoch_s + (middle_s - begun_s) * (1 + self.drift)
        told = {
            "t_ns": round(own_s * 1e9),
            "q": q.tolist(),
            "valid": True,
            "mode": str(time.monotonic_ns()),
            "stars": 9,
        }
        told["centroids"] = [[511.5, 511.5, 900.0, 26311], [300.0, 700.0, 400.0]] if k % 2 else []
        return json.dumps(told) + "\n", is_wild


def main() -> None:
    """Talk and answer until standard input ends."""
    stub = Stub(**json.loads(sys.argv[1]))
    rng = np.random.default_rng(stub.seed)
    sender = zmq.Context().socket(zmq.PUB)
    sender.setsockopt(zmq.LINGER, 0)
    sender.connect(f"tcp://127.0.0.1:{stub.port}")
    begun_s = time.monotonic()
    sent, answered, wild = 0, 0, []
    sent_s: deque[float] = deque([begun_s], maxlen=round(1 / SENT_EACH_S))
    starved = []
    while not select.select([sys.stdin], [], [], 0)[0]:
        now_s = time.monotonic()
        if now_s >= begun_s + sent * SENT_EACH_S:
            sender.send(packet(sent, round(now_s * 1e9), tuple(stub.q(now_s)), None))
            sent += 1
            sent_s.append(time.monotonic())
        middle_s = begun_s + 0.5 + answered / stub.answer_hz
        if now_s >= middle_s + stub.latency_s:
            text, is_wild = stub.answer(answered, middle_s, begun_s, rng)
            if not stub.silent_s[0] <= now_s - begun_s < stub.silent_s[1]:
                os.write(stub.line, text.encode())
                wild += [answered] if is_wild else []
                times_s = [at_s for at_s in sent_s if at_s > middle_s - BEFORE_S]
                if max(np.diff([middle_s - BEFORE_S, *times_s]), default=0.0) > STARVED_S:
                    starved.append(answered)
            answered += 1
        if stub.babble:
            os.write(stub.line, rng.bytes(64))
        time.sleep(0.001)
    print(json.dumps({"answered": answered, "wild": wild, "starved": starved}))


if __name__ == "__main__":
    main()
