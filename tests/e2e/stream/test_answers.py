"""Answers over real roads: a pty, UDP, TCP both ways, ZeroMQ and a growing file, read by a
process of its own.
"""

from __future__ import annotations

import contextlib
import http.server
import json
import os
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq

from hilstar.attitude.wire import apart
from hilstar.attitude.wire.packet import AnswerPacket, encode, framed
from hilstar.basics.errors import HilstarError
from hilstar.basics.notices import Notices
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.reader import AnswersApart, open_answers
from hilstar.server.bench.config import parse_config
from tests.support.benches import SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.wire.ptys import serial_line

Q = (0.6, 0.0, 0.8, 0.0)
PACKETS = [encode(AnswerPacket(k, 2, 10 + k, Q, stars=3)) for k in range(3)]
STREAM = b"\0" + b"".join(map(framed, PACKETS))


@contextlib.contextmanager
def reading(folder: Path, keys: str, notices: Notices | None = None) -> Iterator[AnswersApart]:
    config = parse_config(folder / "bench.toml", f"{SMALL_BENCH}\n[answers]\n{keys}\n")
    with open_answers(config, folder, notices or Notices()) as source:
        source.await_ready()
        yield source


def gathered(
    source: AnswersApart, count: int, again: Callable[[], object] | None = None
) -> list[Answer]:
    """So many answers; `again` sends them all, while some are missing: what was sent before the
    road stood is lost, which may be only the first of them. Then each counts once, by its time.
    """
    found: list[Answer] = []

    def enough() -> bool:
        if again is not None:
            again()
        known_ns = {answer.t_ns for answer in found}
        for answer in source.take(50):
            if again is None or answer.t_ns not in known_ns:
                known_ns.add(answer.t_ns)
                found.append(answer)
        return len(found) >= count

    wait_for(enough, "answers")
    if again is not None:
        found.sort(key=lambda answer: answer.t_ns or 0)
    return found


def free_port() -> int:
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


def assert_answers(found: list[Answer]) -> None:
    assert [answer.t_ns for answer in found[:3]] == [10, 11, 12]
    for answer in found:
        assert np.array_equal(answer.q_icrs_to_cam, Q)
        assert (answer.star_count, answer.valid) == (3, True)


def test_a_serial_line_is_read_asked_and_comes_back(tmp_path):
    port = tmp_path / "port"
    keys = f'source = "serial"\nport = "{port}"\npoll_hex = "55 AA"\npoll_hz = 50'
    with contextlib.ExitStack() as opened:
        with serial_line() as (device, name):
            port.symlink_to(name)
            source = opened.enter_context(reading(tmp_path, keys))
            # What is written before the process has opened the port is flushed.
            assert_answers(gathered(source, 3, lambda: os.write(device, STREAM)))
            os.write(device, b"\x05nonsense\0")
            wait_for(
                lambda: source.take(20) == [] and source.refusals() == {"framing": 1}, "the refusal"
            )
            assert os.read(device, 2) == b"\x55\xaa"
        device, name = opened.enter_context(serial_line())
        port.unlink()
        port.symlink_to(name)
        assert_answers(gathered(source, 3, lambda: os.write(device, STREAM)))


def test_udp_takes_each_datagram_from_who_may_send(tmp_path):
    port = free_port()
    with (
        reading(tmp_path, f'source = "udp"\nbind = "127.0.0.1:{port}"') as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        found = gathered(
            source, 3, lambda: [sender.sendto(packet, ("127.0.0.1", port)) for packet in PACKETS]
        )
        assert_answers(found)


def test_tcp_listens_and_takes_a_connection_after_the_former_one_closed(tmp_path):
    port = free_port()
    with reading(tmp_path, f'source = "tcp"\nlisten = "127.0.0.1:{port}"') as source:
        for _ in range(2):
            made: list[socket.socket] = []

            def connected(made=made) -> bool:
                with contextlib.suppress(OSError):
                    made.append(socket.create_connection(("127.0.0.1", port)))
                return bool(made)

            wait_for(connected, "the listener")
            made[0].sendall(STREAM)
            assert_answers(gathered(source, 3))
            made[0].close()


def test_tcp_connects_to_a_tracker_that_starts_later_and_asks_it(tmp_path):
    port = free_port()
    with (
        reading(
            tmp_path,
            f'source = "tcp"\nconnect = "127.0.0.1:{port}"\npoll_hex = "3f"\nformat = "json"',
        ) as source,
        socket.create_server(("127.0.0.1", port)) as server,
    ):
        server.settimeout(PATIENCE_S)
        tracker, _ = server.accept()
        tracker.settimeout(PATIENCE_S)
        assert tracker.recv(1) == b"?"
        tracker.sendall(
            json.dumps({"t_ns": 10, "q": Q, "stars": 3, "centroids": [[1, 2, 3, 4]]}).encode()
            + b"\n"
        )
        (answer,) = gathered(source, 1)
        assert tuple(answer.centroids[0]) == (1.0, 2.0, 3.0, 4, None)
        tracker.close()


def test_zeromq_takes_the_last_part(tmp_path):
    with zmq.Context() as context, context.socket(zmq.PUB) as sender:
        port = sender.bind_to_random_port("tcp://127.0.0.1")
        with reading(tmp_path, f'source = "zmq"\nendpoint = "tcp://127.0.0.1:{port}"') as source:
            assert_answers(
                gathered(
                    source,
                    3,
                    lambda: [sender.send_multipart([b"topic", packet]) for packet in PACKETS],
                )
            )


def test_a_growing_file_counts_from_the_start_on_and_again_when_it_is_made_anew(tmp_path):
    path = tmp_path / "tracker.bin"
    path.write_bytes(STREAM)
    with reading(tmp_path, 'source = "file"\npath = "tracker.bin"') as source:

        def append() -> None:
            with path.open("ab") as file:
                file.write(STREAM)

        first = gathered(source, 3, append)
        assert_answers(first)
        path.unlink()
        path.write_bytes(STREAM)
        assert_answers(gathered(source, 3))


@pytest.mark.timing
@pytest.mark.parametrize("kind", ["device", "endless file"])
def test_a_file_that_never_ends_takes_no_core_and_is_told(tmp_path, kind):
    """A link to /dev/zero is let go; a file of zeros to 64 GB is read and dropped, no faster
    than a chunk each 10 ms.
    """
    path, notices = tmp_path / "tracker.bin", Notices()
    path.touch()
    with reading(tmp_path, 'source = "file"\npath = "tracker.bin"', notices) as source:
        gathered(source, 3, lambda: path.write_bytes(STREAM))  # the reader has opened it
        path.unlink()
        if kind == "device":
            path.symlink_to("/dev/zero")
            wait_for(lambda: source.take(20) == [] and source.trouble(), "the trouble")
            assert source.trouble() == "it is a device now, and no regular file"
            assert notices.counts() == {"answers-lost": 1}
        else:
            with path.open("wb") as file:
                file.truncate(64 * 10**9)
            wait_for(
                lambda: source.take(20) == [] and source.refusals().get("flood", 0) > 100,
                "what is dropped",
            )
        before_s, begun_ns = reader_cpu_s(source), time.monotonic_ns()
        wait_for(
            lambda: source.take(20) == [] and time.monotonic_ns() - begun_ns > 10**9, "a second"
        )
        # Without a rest the reader takes the whole of a core.
        assert reader_cpu_s(source) - before_s < 0.3 * (time.monotonic_ns() - begun_ns) / 1e9
        path.unlink()
        path.write_bytes(STREAM)
        assert_answers(gathered(source, 3))
        assert source.trouble() == ""


def reader_cpu_s(source: AnswersApart) -> float:
    """The CPU time of the process that reads."""
    fields = (
        Path(f"/proc/{source._process._process.pid}/stat").read_text().rpartition(")")[2].split()
    )
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_babbling_tracker_is_bounded_and_its_good_answers_still_come(tmp_path, rng):
    with (
        serial_line() as (device, name),
        reading(tmp_path, f'source = "serial"\nport = "{name}"') as source,
    ):
        for _ in range(40):
            os.write(device, rng.bytes(3000) + STREAM)
        found = gathered(source, 100)
        assert all(np.array_equal(answer.q_icrs_to_cam, Q) for answer in found)
        wait_for(
            lambda: source.take(20) == [] and sum(source.refusals().values()) > 100, "refusals"
        )
        assert set(source.refusals()) <= {"framing", "crc", "format"}


def test_noise_in_which_a_frame_may_begin_at_every_byte_does_not_end_the_reader(tmp_path, rng):
    """Half a second's worth of the bound, which would take a core for seconds: most of it is
    dropped, and answers go on.
    """
    path, notices = tmp_path / "tracker.bin", Notices()
    fields = ", ".join(
        f'{{ name = "{name}", at = {4 * k}, type = "f32" }}'
        for k, name in enumerate(("qw", "qx", "qy", "qz"))
    )
    keys = (
        'source = "file"\npath = "tracker.bin"\nformat = "frame"\nframing = "fixed"\nlength ='
        ' 20\nchecksum = "crc32"\n'
    )
    body = struct.pack("<4f", *Q)
    frame = body + zlib.crc32(body).to_bytes(4, "big")
    path.touch()
    with reading(tmp_path, keys + f"fields = [{fields}]", notices) as source:

        def append(data: bytes) -> None:
            with path.open("ab") as file:
                file.write(data)

        gathered(source, 1, lambda: append(frame))
        append(rng.bytes(250_000))
        wait_for(
            lambda: source.take(20) == [] and source.refusals().get("flood", 0) > 10,
            "what is dropped",
        )
        answer, *_ = gathered(source, 1, lambda: append(2 * frame))
        assert np.allclose(answer.q_icrs_to_cam, Q, atol=1e-7)
        assert notices.counts().get("receiver-failed", 0) == 0


def test_a_road_that_is_not_there_is_refused_before_the_run(tmp_path):
    for keys in (
        'source = "serial"\nport = "/dev/no-such-port"',
        f'source = "file"\npath = "{tmp_path}"',
    ):
        with pytest.raises(HilstarError, match=r"\[answers\]"), reading(tmp_path, keys):
            pass
    (tmp_path / "bench.toml").write_text(SMALL_BENCH)
    assert_refused(
        run_hilstar_here("answers", tmp_path / "bench.toml"), 2, "has no [answers]", "bench.toml"
    )


def test_a_recorded_file_is_decoded_and_explained(tmp_path):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH + '\n[answers]\nsource = "udp"\n')
    (tmp_path / "line.bin").write_bytes(STREAM + b"\x05nonsense\0")
    given = ("answers", tmp_path / "bench.toml", "--from", tmp_path / "line.bin")
    said = json.loads(run_hilstar_here(*given, "--json").stdout)
    assert said["counts"] == {"answers": 3, "valid": 3, "framing": 1}
    assert [row["t_ns"] for row in said["answers"][:3]] == [10, 11, 12]
    explained = run_hilstar_here(*given, "--explain", "--quaternion", "0.6,0,-0.8,0").stdout
    assert (
        'write [answers] convention = { scalar = "first", direction = "cam_to_icrs", frame ='
        ' "cam" }' in explained
    )
    assert_refused(run_hilstar_here(*given[:3], tmp_path / "none.bin"), 2, "none.bin")


def test_what_is_shown_now_is_asked_of_a_run_s_page(tmp_path, monkeypatch):
    """A page, another program, and nobody: each at the address where a run's page usually is."""
    shown = {
        "q": [0.6, 0, -0.8, 0],
        "ra_deg": 1,
        "dec_deg": 2,
        "roll_deg": 3,
        "rate_deg_s": None,
        "age_ms": 4,
    }
    for body, marked in (
        (json.dumps({"state": {"attitude": shown}}), True),
        ('{"state": {"attitude": null}}', False),
        ("<a>", False),
    ):

        class Page(http.server.BaseHTTPRequestHandler):
            said = body.encode()

            def do_GET(self) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(self.said)

        tracker = tmp_path / "tracker.jsonl"
        tracker.touch()
        (tmp_path / "bench.toml").write_text(
            SMALL_BENCH + '\n[attitude]\nsource = "udp"\n[answers]\nsource = "file"\npath ='
            ' "tracker.jsonl"\nformat = "json"\n'
        )
        over = threading.Event()

        def answer_until_over(tracker=tracker, over=over) -> None:
            while not over.wait(0.1):
                with tracker.open("ab") as file:
                    file.write(b'{"q":[0.6,0,0.8,0]}\n')

        with http.server.HTTPServer(("127.0.0.1", 0), Page) as server:
            monkeypatch.setattr("hilstar.server.console.listener.PORT", server.server_port)
            threads = [
                threading.Thread(target=each) for each in (server.handle_request, answer_until_over)
            ]
            for thread in threads:
                thread.start()
            found = run_hilstar_here(
                "answers", tmp_path / "bench.toml", "--explain", "--duration", "1"
            ).stdout
            over.set()
            for thread in threads:
                thread.join()
        assert "scalar first cam_to_icrs" in found
        assert ("> scalar first cam_to_icrs" in found) == marked


LOOPING = """
import os, pathlib, time
pathlib.Path(__file__).with_name("class").write_text(str(os.sched_getscheduler(0)))
def decode(data):
    while data == b"loop": pass
    while data == b"sleep": time.sleep(1)
    if data == b"exit": os._exit(3)
    return [{"t_ns": int(data), "q": [0.6, 0, 0.8, 0]}]
"""


@pytest.mark.parametrize("poison", [b"loop", b"sleep", b"exit"])
def test_a_function_that_does_not_return_is_ended_and_named_and_the_next_answers_come(
    tmp_path, caplog, monkeypatch, poison
):
    monkeypatch.setattr(apart, "LOOPS_S", 0.3)
    (tmp_path / "looping_tracker.py").write_text(LOOPING)
    keys = (
        f'source = "udp"\nbind = "127.0.0.1:{(port := free_port())}"\nformat ='
        ' "python:looping_tracker:decode"'
    )
    to = ("127.0.0.1", port)
    with (
        reading(tmp_path, keys) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        gathered(source, 1, lambda: sender.sendto(b"1", to))
        reader = source._process._process
        assert (tmp_path / "class").read_text() == str(os.SCHED_OTHER)
        assert os.sched_getscheduler(reader.pid) == os.SCHED_OTHER
        sender.sendto(poison, to)

        def told() -> bool:  # as a run looks at it: fifty times a second, without waiting
            source.take()
            return (
                "receiver-failed" in caplog.text
                or "python:looping_tracker:decode) stopped" in caplog.text
            )

        wait_for(told, "the reader is ended", poll_s=0.02)
        assert source.unread and reader.poll() is not None
        gathered(source, 1, lambda: sender.sendto(b"2", to))
        assert not source.unread
