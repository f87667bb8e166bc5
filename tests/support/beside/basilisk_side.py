"""Basilisk (ISC, AVS Lab): attitudes, rates and times of its Vizard messages, and stars of frames,
beside its own record of a tumbling spacecraft.

Basilisk runs in real time and broadcasts at 50 Hz; `hilstar serve` listens, predicts to each
frame's moment of light, and writes a ledger.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation, Slerp

from hilstar.basics.charts import two_digits
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from tests.support.benches import bench_text
from tests.support.beside.steps import Beside, Step
from tests.support.senders import free_port
from tests.support.sources.basilisk import Truth, basilisk, rotation
from tests.support.waiting import is_connected_to, wait_for

# Two degrees a second, from just under |sigma| = 1: the switch to the shadow set comes within half
# a second.
CHASER = [[0.512, 0.613, 0.596], [0.02, 0.027, 0.012]]
MOUNTING = [0.6, 0.48, 0.64, 0.0]
SHOWN_S, RUN_S, QUICK_S = 0.02, 4.0, 1.2
FOCAL_PX = 60e3 / 57.65  # of the small bench's collimator and monitor
CORNERS = np.array([[x, y, FOCAL_PX] for x in (-160, 0, 160) for y in (-120, 0, 120)])
ENDED_WITHIN_S = 30.0
SUBSCRIBED_S = 0.3  # Basilisk does not tell whether a subscription has come over the connection
ATTITUDE, STARS = "attitude of a sample", "stars of a frame"


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Listen to a tumbling spacecraft for some seconds."""
    truth, topics = broadcast(folder, QUICK_S if quick else RUN_S)
    steps = (*sample_steps(truth, topics), *frame_steps(truth, topics))
    beside = Beside("Basilisk", version("bsk"), "", steps)
    attitude = two_digits(beside.size(ATTITUDE, "its shadow set"))
    stars = two_digits(beside.size(STARS, "with the predicted attitude"))
    finding = (
        f"hilstar reads Basilisk's attitudes to {attitude} arcsec, and has stars where its states"
        f" have them to {stars} px at 2 deg/s"
    )
    return Beside("Basilisk", version("bsk"), finding, steps)


def broadcast(folder: Path, seconds: float) -> tuple[Truth, dict[str, list[dict[str, Any]]]]:
    """A broadcast in real time: Basilisk's own record, and the ledger's topics."""
    port = free_port()
    attitude = {"source": "vizard", "endpoint": f"tcp://127.0.0.1:{port}", "spacecraft": "chaser"}
    tracker = {"q_body_to_cam": MOUNTING}
    bench, ledger = folder / "bench.toml", folder / "run.mcap"
    bench.write_text(bench_text({"tracker": tracker, "attitude": attitude}))
    ledger.unlink(missing_ok=True)
    scenario = {
        "mode": "broadcastStream",
        "port": port,
        "shown_s": SHOWN_S,
        "stops_s": [seconds],
        "spacecraft": {"chaser": CHASER},
    }
    command = [sys.executable, "-m", "hilstar", "serve", str(bench), "--headless"]
    command += ["--ledger", str(ledger)]
    with (
        basilisk(folder.resolve(), **scenario) as simulation,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as served,
    ):
        try:
            wait_for(lambda: is_connected_to(port), "its link to Basilisk")
            time.sleep(SUBSCRIBED_S)
            simulation.run()
            served.send_signal(signal.SIGTERM)
            served.wait(ENDED_WITHIN_S)
        finally:
            served.kill()
    topics: dict[str, list[dict[str, Any]]] = {}
    with ledger.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            topics.setdefault(channel.topic, []).append(json.loads(message.data))
    return Truth(folder), topics


def sample_steps(truth: Truth, topics: dict[str, list[dict[str, Any]]]) -> Iterator[Step]:
    """Every sample of the ledger beside the state of its time."""
    samples = topics["/attitude"]
    rows = [truth.row(sample["t_ns"]) for sample in samples]
    mounting = rotation(MOUNTING)
    as_vectors = Rotation.from_mrp(truth.sigma_bn)
    for step, body, pose in (
        ("sigma_BN taken to turn vectors", as_vectors, mounting),
        ("taken to turn frames, without the mounting", truth.body_from_n, Rotation.identity()),
        ("with the mounting", truth.body_from_n, mounting),
    ):
        off = [
            (rotation(sample["q"]) * (pose * body[row]).inv()).magnitude()
            for sample, row in zip(samples, rows, strict=True)
        ]
        yield Step(ATTITUDE, "arcsec, largest", step, max(off) * ARCSEC_PER_RAD)
    after = truth.t_ns[np.linalg.norm(np.diff(truth.sigma_bn, axis=0), axis=1).argmax() + 1]
    off = [
        (rotation(sample["q"]) * (mounting * truth.body_from_n[row]).inv()).magnitude()
        for sample, row in zip(samples, rows, strict=True)
        if sample["t_ns"] >= after
    ]
    yield Step(ATTITUDE, "arcsec, largest", "its shadow set alone", max(off) * ARCSEC_PER_RAD)
    sizes = []
    whole = []
    for sample, row in zip(samples, rows, strict=True):
        if sample["rate"] is not None:
            rate = mounting.apply(truth.omega_bn_b[row])
            whole.append(float(np.abs(rate).max()))
            sizes.append(float(np.abs(sample["rate"] - rate).max()))
    subject, unit = "rate of a sample", "rad/s, largest"
    yield Step(subject, unit, "not sent: a rate of none", max(whole))
    yield Step(subject, unit, "from three attitudes", max(sizes))


def frame_steps(truth: Truth, topics: dict[str, list[dict[str, Any]]]) -> Iterator[Step]:
    """Stars in the middle, the corners and the sides of each frame, at its moment of light."""
    mounting = rotation(MOUNTING)
    true_at = Slerp(truth.t_ns, mounting * truth.body_from_n)
    frames = []
    for frame in topics["/frame"]:
        is_known = frame["q"] is not None and not frame["stale"]
        if is_known and frame["light_ns"] <= truth.t_ns[-1]:
            frames.append(frame)
    held = [mounting * truth.body_from_n[truth.row(frame["attitude_t_ns"])] for frame in frames]
    drawn = [rotation(frame["q"]) for frame in frames]
    for step, attitudes in (
        ("with the newest attitude", held),
        ("with the predicted attitude", drawn),
    ):
        off = []
        for frame, attitude in zip(frames, attitudes, strict=True):
            off.append(star_error_px(attitude, true_at(frame["light_ns"])))
        yield Step(STARS, "px, largest", step, max(off))
    ages = [abs(frame["light_ns"] - frame["attitude_t_ns"]) / NS_PER_S for frame in frames]
    yield Step(
        "age of a frame's newest attitude", "s, largest", "at its moment of light", max(ages)
    )


def star_error_px(mine: Rotation, true: Rotation) -> float:
    """How far the farthest of CORNERS is from where the true attitude has it."""
    seen = (mine * true.inv()).apply(CORNERS)
    places = FOCAL_PX * seen[:, :2] / seen[:, 2:]
    return float(np.linalg.norm(places - CORNERS[:, :2], axis=1).max())
