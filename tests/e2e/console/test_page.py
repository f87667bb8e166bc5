"""The operator's page of a run: what it is told, what it may do, and that it comes back and goes
with the run.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from hilstar.server.record.ledger_records import frame_records
from tests.support.commands import run_hilstar_here
from tests.support.ledgers import read_events
from tests.support.pages import PageAddress, children, gone, live, page_of, picture_of
from tests.support.run_page import run_data_of
from tests.support.senders import LYRA, ORION, connected, talking
from tests.support.servers import bound
from tests.support.waiting import CHANCES, wait_for

pytestmark = pytest.mark.e2e
PAGE = "hilstar.server.console.server"
# `stale_after_ms` is 250; then the next frame, a tick of the run's and one of the page's. What is
# left is for a busy machine.
STALE_S, SEEN_S = 0.25, 0.5


@pytest.fixture(scope="module")
def page_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    with bound(
        folder, "--console", "127.0.0.1:0", "--control", "--ledger", str(folder / "run.mcap")
    ) as served:
        yield served, page_of(served), folder


@pytest.fixture
def page(page_run) -> PageAddress:
    return page_run[1]


def test_health_says_what_is_wrong_and_turns_within_half_a_second(page_run):
    served, page, _ = page_run
    wait_for(lambda: page.json("/health")["reasons"] == ["no attitude has come yet"], served.lines)
    with connected(served.port) as sender:
        for attempt in range(CHANCES):
            with talking(sender, first=1 + 10_000 * attempt):
                wait_for(lambda: page.health_is(True))
                with live(page) as link:
                    link.await_message(
                        lambda said: said.get("state", {}).get("health", {}).get("ok")
                    )
            stopped_s = time.monotonic()
            with live(page) as link:
                said = link.await_message(
                    lambda said: "state" in said and not said["state"]["health"]["ok"]
                )
            if (took_s := time.monotonic() - stopped_s) < STALE_S + SEEN_S:
                break
        assert took_s < STALE_S + SEEN_S
        assert said["state"]["health"]["reasons"][0].startswith("the attitude is stale")
        assert page.health_is(False)


def test_a_picture_has_the_stars_of_its_frame_where_the_truth_says(page_run):
    served, page, _ = page_run
    with connected(served.port) as sender, talking(sender, q=ORION), live(page) as link:
        wait_for(lambda: page.health_is(True))
        link.want(picture=True, hz=10, grid=True)
        truth = link.await_message(
            lambda said: isinstance(said, dict) and said.get("truth", {}).get("stars")
        )["truth"]
        head, levels = picture_of(link.await_message(lambda said: isinstance(said, bytes)))
    assert (head["w"], head["h"]) == (320, 240) and levels.dtype == np.uint8
    assert truth["frame"] == head["frame"]
    shown = [star for star in truth["stars"] if 2 < star[0] < 317 and 2 < star[1] < 237][:5]
    assert len(shown) == 5
    for x, y, *_ in shown:
        near = levels[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3]
        brightest = np.unravel_index(np.argmax(near), near.shape)
        assert (
            abs(brightest[0] - 2 + round(y) - y) <= 1 and abs(brightest[1] - 2 + round(x) - x) <= 1
        )
    assert {"\u03b6 Ori", "\u03b5 Ori"} & {star[4] for star in truth["stars"][:8]}
    assert len(truth["grid"]) > 4 and all(len(line["px"]) > 1 for line in truth["grid"])


def test_a_picture_is_the_run_s_own_and_moves_with_the_attitude(page_run):
    served, page, _ = page_run
    with connected(served.port) as sender, live(page) as link:
        link.want(picture=True, hz=10)
        seen = []
        for q in (ORION, LYRA):
            with talking(sender, q=q, first=10_000 * (1 + len(seen))):
                wait_for(lambda: page.health_is(True))
                head, levels = picture_of(
                    link.await_message(lambda said: isinstance(said, bytes) and len(said) > 300)
                )
                for _ in range(5):  # those that were on their way
                    head, levels = picture_of(
                        link.await_message(lambda said: isinstance(said, bytes))
                    )
                seen.append((head["frame"], levels))
    assert seen[1][0] > seen[0][0]
    assert (
        not np.array_equal(seen[0][1], seen[1][1]) and seen[0][1].max() > 0 and seen[1][1].max() > 0
    )


def test_each_control_acts_on_the_next_frames_and_is_in_the_ledger_with_who(page_run):
    served, page, folder = page_run
    with connected(served.port) as sender, talking(sender):
        wait_for(lambda: page.health_is(True))
        for name in ("blank", "pause", "patch", "crosshair", "grid"):
            assert page.control(name, "Ada", on=True) == (200, {"line": f"{name} on"})
            wait_for(lambda name=name: page.json("/state")["state"]["operator"][name], name)
            assert page.control(name, "Ada", on=False) == (200, {"line": f"{name} off"})
        assert page.control("mark", "J%C3%B6rg", text="lamp\x1b[2J on") == (
            200,
            {"line": "mark written"},
        )
        wait_for(lambda: page.health_is(True))
    wait_for(lambda: any(event.kind == "mark" for event in read_events(folder / "run.mcap")))
    told = [(event.detail, event.who) for event in read_events(folder / "run.mcap") if event.who]
    assert told[:2] == [
        ("blank on, by Ada: blank", "Ada"),
        ("blank off, by Ada: the sky of the attitude again", "Ada"),
    ]
    assert told[-1] == ("mark, by J\u00f6rg: lamp\\x1b[2J on", "J\u00f6rg")
    assert len(told) == 11
    operators = {frame.operator for frame in frame_records(folder / "run.mcap")}
    assert {"blank", "pause", "patch 50%", "crosshair", "grid"} <= operators


def test_a_blank_or_a_patch_is_what_the_picture_shows(page_run):
    served, page, _ = page_run
    with connected(served.port) as sender, talking(sender), live(page) as link:
        wait_for(lambda: page.health_is(True))
        link.want(picture=True, hz=10)
        for name, value in (("blank", 0), ("patch", 128)):
            assert page.control(name, on=True)[0] == 200
            for _ in range(200):
                _, levels = picture_of(link.await_message(lambda said: isinstance(said, bytes)))
                if (levels == value).all():
                    break
            assert (levels == value).all()
            # beside it the attitude may be stale: a busy machine's sender is late
            reasons = page.json("/health")["reasons"]
            assert any(f"changed by the operator: {name}" in reason for reason in reasons)
            assert page.control(name, on=False)[0] == 200


def test_a_ledger_is_ended_and_begun_while_the_run_goes_on(page_run):
    _, page, folder = page_run
    status, answer = page.control("ledger", on=False)
    assert status == 200 and "is whole" in answer["line"]
    assert page.json("/state")["state"]["ledger"] is None
    before = len(list(frame_records(folder / "run.mcap")))
    assert page.control("ledger", on=True)[0] == 200
    path = Path(page.json("/state")["state"]["ledger"]["path"])
    assert path.parent == folder and path.name != "run.mcap"
    wait_for(lambda: path.stat().st_size and len(list(frame_records(path))) > 5)
    assert len(list(frame_records(folder / "run.mcap"))) == before


def test_a_ledger_may_be_called_anything(tmp_path):
    folder = tmp_path / os.fsdecode(b"r\xffun")
    folder.mkdir()
    ledger = folder / os.fsdecode(b"l\xfe.mcap")
    with bound(
        tmp_path, "--console", "127.0.0.1:0", "--control", "--ledger", str(ledger)
    ) as served:
        page = page_of(served)
        with connected(served.port) as sender, talking(sender):
            wait_for(lambda: page.health_is(True))
            assert page.json("/state")["state"]["ledger"]["path"].endswith("/r\\xffun/l\\xfe.mcap")
            status, said = page.control("ledger", on=False)
            assert (status, said["line"].endswith("/r\\xffun/l\\xfe.mcap is whole")) == (200, True)
            status, said = page.control("ledger", on=True)
            assert (status, "/r\\xffun/hilstar-" in said["line"]) == (200, True)
            assert page.control("mark", text="still here")[0] == 200
            # a busy machine may miss most frames of one second
            wait_for(lambda: page.health_is(True))
        told = served.summary()["ledger"]
    assert told["failure"] is None
    found = run_hilstar_here("report", ledger, "-o", tmp_path / "report")
    assert found.returncode == 0, found.stderr
    assert (
        run_data_of((tmp_path / "report" / "report.html").read_text())["about"]["run"]
        == "l\\xfe.mcap"
    )


def test_a_page_killed_comes_back_by_itself_while_frames_go_on(page_run):
    served, page, _ = page_run
    (first,) = children(served.process.pid, PAGE)
    wait_for(lambda: page.health_is(False))  # nobody sends
    wrong_since = page.json("/health")["since"]
    frames = page.json("/state")["state"]["counts"]["frames"]
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: [pid for pid in children(served.process.pid, PAGE) if pid != first])
    # the request waits at the door until there is a page
    assert page.json("/state")["state"]["counts"]["frames"] > frames
    assert page.json("/health")["since"] == wrong_since
    said = "the operator's page ended (signal 9); it is started again"
    served.await_line(said)
    assert served.count(said) == 1


def test_metrics_are_openmetrics_with_the_run_s_counts(page):
    from prometheus_client.openmetrics.parser import text_string_to_metric_families

    status, headers, data = page.ask("/metrics")
    assert status == 200 and headers["content-type"].startswith("application/openmetrics-text")
    samples = {
        sample.name: sample.value
        for family in text_string_to_metric_families(data.decode())
        for sample in family.samples
    }
    counts = page.json("/state")["state"]["counts"]
    assert 0 < samples["hilstar_frames_total"] <= counts["frames"]
    assert samples["hilstar_packets_received_total"] <= counts["received"]
    assert samples["hilstar_healthy"] in {0.0, 1.0}


@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGINT])
def test_the_page_ends_with_its_run(tmp_path, sign):
    with bound(tmp_path, "--console", "127.0.0.1:0") as served:
        page_of(served)
        (pid,) = children(served.process.pid, PAGE)
        served.process.send_signal(sign)
        wait_for(lambda: served.process.poll() is not None)
        wait_for(lambda: gone(pid))
