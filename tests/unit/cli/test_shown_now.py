"""The attitude that `hilstar answers --explain` takes as shown: by a run's page on this machine, or
by the sender of the bench file.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.attitude.wire.zmq_links import ZmqSender
from hilstar.cli import answers
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.console import listener
from tests.support.benches import bench_text
from tests.support.senders import free_port

Q = [0.6, 0.0, -0.8, 0.0]
SHOWN = {
    "q": Q, "ra_deg": 12.34567, "dec_deg": -5.0, "roll_deg": 1.0, "rate_deg_s": None, "age_ms": 2.0,
}  # fmt: skip


@pytest.fixture
def page(monkeypatch) -> Iterator[list[bytes]]:
    """The body that a program at the page's usual port answers /state with."""
    bodies = [b""]

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/state" else 404)
            self.end_headers()
            self.wfile.write(bodies[0])

        def log_message(self, *_: object) -> None:
            """Nothing."""

    with HTTPServer(("127.0.0.1", 0), Answer) as server:
        monkeypatch.setattr(listener, "PORT", server.server_port)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield bodies
        server.shutdown()
        thread.join()


def bench_file(folder, **attitude):
    """A small bench's file with an [attitude]."""
    path = folder / "bench.toml"
    path.write_text(bench_text({"attitude": attitude}))
    return read_bench_file(path)


def test_a_run_s_page_says_what_is_shown_and_another_program_nothing(
    tmp_path, page, monkeypatch, capsys
):
    file = bench_file(tmp_path, endpoint=f"ipc://{tmp_path}/none")
    monkeypatch.setattr(answers, "SHOWN_WITHIN_S", 0.0)
    page[0] = json.dumps({"state": {"attitude": SHOWN}}).encode()
    assert answers._shown_now(file).tolist() == Q
    place = f"by the page at 127.0.0.1:{listener.PORT}"
    assert capsys.readouterr().err == f"what is shown: RA 12.3457, Dec -5.0000, {place}\n"
    for body in (b"<html>", b"[]", b'{"state": {"attitude": null}}', b'{"state": {}}', b"{" * 99):
        page[0] = body
        assert answers._shown_now(file) is None
    line = f"ipc://{tmp_path}/none: no attitude comes; give what is shown by --radec RA,DEC,ROLL\n"
    assert capsys.readouterr().err == 5 * line


def test_without_a_page_the_sender_of_the_bench_file_is_heard_where_it_has_room(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(listener, "PORT", free_port())
    endpoint = f"ipc://{tmp_path}/sender"
    stop = threading.Event()
    sample = encode(AttitudeSample(5, np.array(Q)))

    def send() -> None:
        with ZmqSender(endpoint) as sender:
            while not stop.wait(0.01):
                sender.put(sample)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        assert answers._shown_now(bench_file(tmp_path, endpoint=endpoint)).tolist() == Q
    finally:
        stop.set()
        thread.join()
    # others have room for one listener alone, which is the run
    only = ({"endpoint": endpoint, "bind": True}, {"endpoint": endpoint, "lockstep": True})
    for attitude in (*only, {"source": "udp", "endpoint": "udp://127.0.0.1:5999"}):
        assert answers._shown_now(bench_file(tmp_path, **attitude)) is None
    assert capsys.readouterr().err == ""
