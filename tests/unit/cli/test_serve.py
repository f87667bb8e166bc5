"""`hilstar serve` of several heads: what the process of the source hands to them, and what it says
of their ends.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.zmq_links import Feed, ZmqReceiver
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import multiply
from hilstar.cli import serve
from hilstar.server import heads, open_link
from hilstar.server.bench.bench_file import as_head
from tests.support.commands import run_hilstar_here
from tests.support.heads import MOUNTINGS, heads_file
from tests.support.waiting import wait_for

ENDS: dict[str, dict[str, Any]] = {
    "a": {"summary": {"frames": 7, "verdict": {"line": "in time"}}, "exit_code": 0, "restarts": 0},
    "b": {"summary": {"frames": 9}, "exit_code": 4, "restarts": 1},
    "c": {"summary": "killed", "exit_code": 3, "restarts": 0},
}


def test_heads_are_served_from_one_source_and_their_ends_are_told(tmp_path, monkeypatch):
    heads_file(tmp_path, 5561)
    sources: list[Any] = []
    runs: list[heads.HeadsRun] = []

    @contextmanager
    def opened(config, folder, notices, *, apart) -> Iterator[ZmqReceiver]:
        sources.append((tuple(config.tracker.q_body_to_cam), config.attitude.endpoint, apart))
        with ZmqReceiver("tcp://127.0.0.1:5561") as link:
            yield link

    def run_heads(asked, link, say):
        runs.append(asked)
        return ENDS

    monkeypatch.setattr(open_link, "open_link", opened)
    monkeypatch.setattr(heads, "run_heads", run_heads)
    words = ["serve", "heads.toml", "--headless", "--duration", "2", "--ledger", "run.mcap"]
    done = run_hilstar_here(*words, "--console", "127.0.0.1:0", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert sources == [((1.0, 0.0, 0.0, 0.0), "tcp://127.0.0.1:5561", True)]
    (asked,) = runs
    assert (asked.options, asked.duration_s, asked.ledger) == (
        ("--headless",),
        2.0,
        Path("run.mcap"),
    )
    assert asked.consoles == ("127.0.0.1:0",) * 3
    assert "waiting for a sender at tcp://127.0.0.1:5561, 3 heads: a, b, c" in done.stderr
    assert [" ".join(line.split()) for line in done.stdout.splitlines()] == [
        "a 7 frames, exit code 0",
        "b 9 frames, exit code 4, started again 1 times",
        "c no summary, exit code 3",
        "verdict a: in time",
    ]
    # the ledger of any head is kept
    (tmp_path / "run.b.mcap").touch()
    refused = run_hilstar_here(*words, cwd=tmp_path)
    assert refused.returncode == 2 and "run.b.mcap exists" in refused.stderr and len(runs) == 1
    done = run_hilstar_here(*words, "--overwrite", "--json", cwd=tmp_path)
    assert done.returncode == 3 and json.loads(done.stdout) == {"heads": ENDS}
    assert runs[1].consoles == ()
    # a token that no page takes is refused once, and not by each head's process
    paged = (*words, "--overwrite", "--console", "127.0.0.1:0", "--token", "short")
    refused = run_hilstar_here(*paged, cwd=tmp_path)
    assert (refused.returncode, "token" in refused.stderr, len(runs)) == (2, True, 2)


@pytest.mark.parametrize(("source", "of_packets"), [("", True), ('source = "42"\n', False)])
def test_a_head_takes_the_body_s_attitudes_as_its_own_camera_s_with_their_time(
    tmp_path, monkeypatch, source, of_packets
):
    parents: list[int] = []
    monkeypatch.setattr(serve, "end_with_parent", parents.append)
    path = heads_file(tmp_path, 5561)
    path.write_text(path.read_text() + source)
    file = as_head(tmp_path / "c.toml", path)
    endpoint = f"ipc://{tmp_path}/feed"
    q = np.array([0.6, 0.0, -0.8, 0.0])
    sample = wire.AttitudeSample(2_000, q, sequence=3)
    arrivals: list[Arrival[wire.Event]] = []
    with (
        Feed(endpoint) as feed,
        serve.fed_link(file, f"{endpoint},4711", Notices()) as link,
    ):

        def come() -> bool:
            feed.give(Arrival(123_456_789, sample, wire.encode(sample)))
            arrivals.extend(link.receive(10))
            return bool(arrivals)

        wait_for(come, "an attitude")
        assert link.conventions.of_packets is of_packets
    assert parents == [4711]
    assert arrivals[0].host_ns == 123_456_789
    event = arrivals[0].event
    assert isinstance(event, wire.AttitudeSample) and (event.sequence, event.t_ns) == (3, 2_000)
    wanted = multiply(np.array(MOUNTINGS["c"]), q)
    assert abs(event.q_icrs_to_cam @ wanted) == pytest.approx(1.0, abs=1e-12)
