"""The attitude that a source's self-check names, written in the source's own form, looks at the
star that it names.
"""

from __future__ import annotations

import contextlib
import json
import re
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here
from tests.support.senders import free_port, publisher
from tests.support.sources import ros_bags
from tests.support.sources import spice_kernels as ck
from tests.support.sources.aem_messages import kvn, rows_of
from tests.support.sources.attitude_texts import cic_text, stk_text
from tests.support.sources.ros_bags import START_NS, Make, write_bag1, write_bag2, write_mcap
from tests.support.sources.viz_message import craft, viz_message
from tests.support.waiting import PATIENCE_S, repeating

MOUNTING = [0.6, 0.48, -0.64, 0.0]
ALNILAM = 26311
# The line has seven digits, of MRPs as of quaternions (4e-7 rad at most).
DIGITS_DEG = np.degrees(5e-7)
# Alnilam stands 15 arcsec from the place that the line names, and a pixel of the small bench's
# tracker has 38.
MIDDLE_PX = 0.5
STATED = ("--epoch-utc", "2026-11-22T10:00:00", "--place=48.1,11.6,500")
Numbers = list[float]


def csv(folder: Path, q: Numbers) -> Path:
    path = folder / "a.csv"
    path.write_text(
        "t_s,qw,qx,qy,qz\n" + "".join(f"{t_s},{','.join(map(repr, q))}\n" for t_s in (0, 1))
    )
    return path


def json_lines(folder: Path, q: Numbers) -> Path:
    path = folder / "a.jsonl"
    path.write_text("".join(json.dumps({"t_ns": t_ns, "q": q}) + "\n" for t_ns in (0, 10**9)))
    return path


def aem_writer(version: str = "1.0", **keywords: str) -> Callable[[Path, Numbers], Path]:
    def write(folder: Path, q: Numbers) -> Path:
        (folder / "a.aem").write_text(kvn(rows_of(q, q), version, **keywords))
        return folder / "a.aem"

    return write


def kernel(folder: Path, q: Numbers) -> Path:
    path = folder / "a.bc"
    path.unlink(missing_ok=True)
    ck.write_texts(folder)
    ticks = np.array([0.0, 1.0]) * ck.TICKS_PER_S
    with ck.new_ck(path) as handle:
        spiceypy.ckw01(
            handle,
            *ticks,
            ck.BODY,
            "J2000",
            False,
            "by a test",
            2,
            ticks,
            np.array([q, q]),
            np.zeros((2, 3)),
        )
    return path


def stk(folder: Path, q: Numbers) -> Path:
    x, y, z, w = q
    (folder / "a.a").write_text(stk_text([f"0 {x} {y} {z} {w}", f"1 {x} {y} {z} {w}"]))
    return folder / "a.a"


def cic(folder: Path, q: Numbers) -> Path:
    numbers = " ".join(map(repr, q))
    (folder / "a.cic").write_text(cic_text([f"60310 0 {numbers}", f"60310 1 {numbers}"]))
    return folder / "a.cic"


def bag_writer(
    kind: str, frame: str, release: str, write: Callable[..., Path], name: str
) -> Callable[[Path, Numbers], Path]:
    def written(folder: Path, q: Numbers) -> Path:
        x, y, z, w = q
        make = Make(release)
        times = [START_NS, START_NS + 10**9]
        sent = [
            ("/a", kind, t_ns, make.of(kind, t_ns, frame, "body", (w, x, y, z), (0, 0, 0)))
            for t_ns in times
        ]
        path = folder / f"{time.monotonic_ns()}{name}"
        return write(path, sent, **({} if release == "noetic" else {"release": release}))

    return written


B2A = {"ATTITUDE_DIR": "B2A", "QUATERNION_TYPE": "FIRST"}
LOGS = {
    "csv": (csv, "q", ()),
    "json": (json_lines, "q", ()),
    "aem-1": (aem_writer(), "Q1 Q2 Q3 QC", ()),
    "aem-1-back": (aem_writer(**B2A), "QC Q1 Q2 Q3", ()),
    "aem-1-from-body": (
        aem_writer(REF_FRAME_A="SC_BODY_1", REF_FRAME_B="EME2000", QUATERNION_TYPE="FIRST"),
        "QC Q1 Q2 Q3",
        (),
    ),
    "aem-2": (aem_writer("2.0"), "Q1 Q2 Q3 QC", ()),
    "aem-2-teme": (aem_writer("2.0", REF_FRAME_A="TEME"), "Q1 Q2 Q3 QC", ()),
    "aem-1-itrf": (aem_writer("1.0", REF_FRAME_A="ITRF-97", ATTITUDE_DIR="B2A"), "Q1 Q2 Q3 QC", ()),
    "aem-2-tracker": (
        aem_writer("2.0", REF_FRAME_A="STARTRACKER_1", REF_FRAME_B="ICRF"),
        "Q1 Q2 Q3 QC",
        (),
    ),
    "ck": (kernel, "m2q(C), C from J2000", ()),
    "ros1": (
        bag_writer(ros_bags.POSE_STAMPED, "map", "noetic", write_bag1, ".bag"),
        "x y z w",
        ("--reference", "enu", STATED[2]),
    ),
    "ros2": (
        bag_writer(ros_bags.IMU, "", "humble", write_bag2, ""),
        "x y z w",
        ("--reference", "icrs"),
    ),
    "ros2-mcap": (bag_writer(ros_bags.TF, "gcrf", "jazzy", write_mcap, ".mcap"), "x y z w", ()),
    "stk": (stk, "Q1 Q2 Q3 QC", ()),
    "cic": (cic, "QC Q1 Q2 Q3", ()),
}


@pytest.fixture
def self_check_bench(tmp_path: Path) -> Path:
    path = tmp_path / "mounted.toml"
    path.write_text(bench_text({"tracker": {"q_body_to_cam": MOUNTING}}))
    return path


def looked_at(*arguments: object) -> tuple[dict, str, Numbers]:
    """What `hilstar attitude` says, and of its self-check the words before the numbers, and the
    numbers.
    """
    result = run_hilstar_here("attitude", *arguments, "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    words, numbers = re.search(
        r"^self-check: at (.*?) = \((.*?)\)", told["conventions"][-1]
    ).groups()
    return told, words, [float(number) for number in numbers.split(",")]


def assert_alnilam_is_in_the_middle(told: dict) -> None:
    assert (told["ra_deg"], told["dec_deg"]) == pytest.approx((84.057, -1.2), abs=DIGITS_DEG)
    assert (told["roll_deg"] + 180) % 360 - 180 == pytest.approx(0, abs=DIGITS_DEG)
    star = told["stars"][0]
    assert star["hip"] == ALNILAM
    assert (star["x_px"], star["y_px"]) == pytest.approx((511.5, 511.5), abs=MIDDLE_PX)


@pytest.mark.parametrize("form", LOGS)
def test_a_log_of_the_self_check_s_attitude_looks_at_the_star_that_it_names(
    tmp_path, self_check_bench, form
):
    write, label, stated = LOGS[form]
    _, words, numbers = looked_at(
        write(tmp_path, [0.5, -0.5, 0.5, 0.5]), *stated, "--bench", self_check_bench
    )
    assert words == label
    told, _, _ = looked_at(write(tmp_path, numbers), *stated, "--bench", self_check_bench)
    assert_alnilam_is_in_the_middle(told)


# Live


@contextlib.contextmanager
def timed(send: Callable[[int], object], pause_s: float = 0.01) -> Iterator[None]:
    """`send` called with the time, ns, in a thread of its own."""
    begun_ns = time.monotonic_ns()
    with repeating(lambda: send(time.monotonic_ns() - begun_ns), pause_s):
        yield


@contextlib.contextmanager
def vizard(numbers: Numbers) -> Iterator[dict[str, object]]:
    with publisher() as (sender, port):

        def send(t_ns: int) -> None:
            sender.send_multipart([b"SIM_UPDATE", viz_message(t_ns, [craft(sigma=numbers)])])

        with timed(send):
            yield {"source": "vizard", "endpoint": f"tcp://127.0.0.1:{port}"}


def packet_of(t_ns: int, numbers: Numbers) -> bytes:
    body = struct.pack("<BBHIq4d3f", 1, 1, 0, 0, t_ns, *numbers, 0, 0, 0)
    return body + struct.pack("<I", zlib.crc32(body))


def json_of(t_ns: int, numbers: Numbers) -> bytes:
    return json.dumps({"t_ns": t_ns, "q": numbers}).encode()


def zmq_of(
    content: Callable[[int, Numbers], bytes],
) -> Callable[[Numbers], contextlib.AbstractContextManager]:
    @contextlib.contextmanager
    def sending(numbers: Numbers) -> Iterator[dict[str, object]]:
        with publisher() as (sender, port), timed(lambda t_ns: sender.send(content(t_ns, numbers))):
            yield {"source": "zmq", "endpoint": f"tcp://127.0.0.1:{port}"}

    return sending


@contextlib.contextmanager
def udp(numbers: Numbers) -> Iterator[dict[str, object]]:
    place = ("127.0.0.1", free_port())
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        timed(lambda t_ns: sender.sendto(packet_of(t_ns, numbers), place)),
    ):
        yield {"source": "udp", "bind": f"{place[0]}:{place[1]}"}


@contextlib.contextmanager
def nasa42(numbers: Numbers) -> Iterator[dict[str, object]]:
    """One message to whoever connects, as 42 sends it first."""
    qn = " ".join(f"{c:18.12e}" for c in numbers)
    text = f"TIME 2024-099-00:00:00.000000000\nSC[0].B[0].qn = [{qn}]\n[ENDMSG]\n".encode()

    def serve(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            connection.sendall(text)
            connection.recv(4)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        yield {"source": "42", "endpoint": f"tcp://127.0.0.1:{listener.getsockname()[1]}"}
        thread.join()


STREAMS = {
    "vizard": (vizard, "sigma_BN", [0.1, 0.2, 0.3]),
    "42": (nasa42, "qn", [0.5, -0.5, 0.5, 0.5]),
    "zmq": (zmq_of(packet_of), "q", [0.5, -0.5, 0.5, 0.5]),
    "zmq-json": (zmq_of(json_of), "q", [0.5, -0.5, 0.5, 0.5]),
    "udp": (udp, "q", [0.5, -0.5, 0.5, 0.5]),
}


@pytest.mark.parametrize("form", STREAMS)
def test_a_stream_of_the_self_check_s_attitude_looks_at_the_star_that_it_names(tmp_path, form):
    sending, label, start = STREAMS[form]

    def seen(numbers: Numbers) -> tuple[dict, str, Numbers]:
        with sending(numbers) as attitude:
            (tmp_path / "live.toml").write_text(
                bench_text({"tracker": {"q_body_to_cam": MOUNTING}, "attitude": attitude})
            )
            return looked_at(tmp_path / "live.toml")

    _, words, numbers = seen(start)
    assert words == label
    assert_alnilam_is_in_the_middle(seen(numbers)[0])
