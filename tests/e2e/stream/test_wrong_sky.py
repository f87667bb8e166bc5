"""A sky that is wrong though its attitudes are fresh: where it is said while it lasts, and what
is said of the run after it.
"""

from __future__ import annotations

import itertools
import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq

from hilstar.basics.rotation import conjugate, propagate
from hilstar.server.console.report import report
from tests.support.commands import run_hilstar_here
from tests.support.pages import page_of
from tests.support.senders import ORION, connected
from tests.support.servers import Served, bound
from tests.support.waiting import PATIENCE_S, repeating, wait_for

pytestmark = pytest.mark.e2e
TURN_RAD_S = np.radians([0.0, 0.0, 0.5])
AHEAD_NS = 100_000_000
UNPACED = ("--headless", "--speed", "max")
CLOCK_UNIX = 'bind = true\nclock = "unix"'
Sent = Callable[[int, np.ndarray, tuple[float, ...]], dict[str, object]]


@contextmanager
def wrong_sender(sender: zmq.Socket, sent: Sent) -> Iterator[None]:
    """A sender that turns by TURN_RAD_S at 100 Hz, and says what `sent` makes of time, attitude
    and rate.
    """
    from_ns, sequences = time.time_ns(), itertools.count(1)

    def say() -> None:
        t_ns = time.time_ns()
        q = propagate(np.array(ORION), TURN_RAD_S, (t_ns - from_ns) / 1e9)
        sender.send(
            json.dumps(sent(t_ns, q, tuple(TURN_RAD_S)) | {"sequence": next(sequences)}).encode()
        )

    with repeating(say, 0.01):
        yield


def ended(served: Served) -> tuple[int, dict]:
    """Exit code and summary after Ctrl-C."""
    served.process.send_signal(signal.SIGINT)
    assert served.process.stdout is not None
    out = served.process.stdout.read()
    return served.process.wait(PATIENCE_S), json.loads(out)


def reasons_say(page, words: str) -> bool:
    status, _, data = page.ask("/health")
    return status == 503 and any(words in reason for reason in json.loads(data)["reasons"])


def test_a_clock_ahead_is_said_while_it_lasts_and_counts_as_wrong_after_it(tmp_path):
    ledger, ahead_ns = tmp_path / "run.mcap", [AHEAD_NS]
    with bound(
        tmp_path,
        "--console",
        "127.0.0.1:0",
        "--ledger",
        str(ledger),
        "--strict",
        attitude=CLOCK_UNIX,
    ) as served:
        page = page_of(served)
        with (
            connected(served.port) as sender,
            wrong_sender(
                sender,
                lambda t_ns, q, rate: {"t_ns": t_ns + ahead_ns[0], "q": q.tolist(), "rate": rate},
            ),
        ):
            wait_for(lambda: reasons_say(page, "0.100 s ahead of CLOCK_REALTIME"))
            assert (
                'hilstar_wrong_sky{kind="clock-not-shared"} 1.0' in page.ask("/metrics")[2].decode()
            )
            assert [each["kind"] for each in page.json("/state")["state"]["wrong_sky"]] == [
                "clock-not-shared"
            ]
            ahead_ns[0] = 0
            served.await_line("agrees with CLOCK_REALTIME (Unix time) of this machine again")
            wait_for(lambda: page.health_is(True))
            wait_for(lambda: page.json("/state")["state"]["frame"]["number"] > 60)
            code, summary = ended(served)
    assert code == 1 and not summary["verdict"]["strict"]
    assert [one["kind"] for one in summary["wrong_sky"]["conditions"]] == ["clock-not-shared"]
    assert (
        0
        < summary["wrong_sky"]["seconds"]
        == summary["verdict"]["wrong_sky_s"]
        < summary["duration_s"]
    )
    found = report(ledger, tmp_path / "report")
    assert found.wrong_sky.seconds == pytest.approx(summary["wrong_sky"]["seconds"], abs=0.2)
    assert 0 < found.wrong_frames <= found.frames - found.right_frames
    again = run_hilstar_here(
        "replay",
        str(tmp_path / "serve.toml"),
        str(ledger),
        "--headless",
        "--speed",
        "max",
        "--json",
        "--strict",
    )
    told = json.loads(again.stdout)
    assert (
        again.returncode == 1
        and told["events"]["clock-not-shared"] == told["events"]["clock-shared"] == 1
    )


def test_a_conjugate_is_said_with_the_line_to_write(tmp_path):
    with bound(tmp_path, "--console", "127.0.0.1:0") as served:
        page = page_of(served)
        with (
            connected(served.port) as sender,
            wrong_sender(
                sender,
                lambda t_ns, q, rate: {"t_ns": t_ns, "q": conjugate(q).tolist(), "rate": rate},
            ),
        ):
            wait_for(
                lambda: reasons_say(page, '[attitude] convention = { direction = "cam_to_icrs" }')
            )


def test_what_only_a_person_can_judge_is_said_at_the_first_attitude(tmp_path):
    """A conjugate without rates is as good a quaternion: where it points is said, and the page
    has the same.
    """
    with bound(tmp_path, "--console", "127.0.0.1:0") as served:
        page = page_of(served)
        with (
            connected(served.port) as sender,
            wrong_sender(sender, lambda t_ns, q, rate: {"t_ns": t_ns, "q": list(ORION)}),
        ):
            served.await_line(
                "the first attitude points at RA 84.000, Dec -1.000, roll 0.000 deg; the brightest"
                " star in view is"
            )
            wait_for(
                lambda: (
                    "Alnilam, ε Ori, V 1.69, in Orion" in page.json("/state")["state"]["pointing"]
                )
            )


def test_units_lost_packets_and_three_decimals_are_notices(tmp_path):
    lost = itertools.count()
    with bound(tmp_path, "--console", "127.0.0.1:0") as served:
        page = page_of(served)
        with connected(served.port) as sender:
            from_ns = time.time_ns()

            def say() -> None:
                k = next(lost)
                t_ns = time.time_ns()
                q = np.round(propagate(np.array(ORION), TURN_RAD_S, (t_ns - from_ns) / 1e9), 3)
                if k % 10:
                    sender.send(
                        json.dumps({"t_ns": t_ns // 1000, "q": q.tolist(), "sequence": k}).encode()
                    )

            with repeating(say, 0.01):
                served.await_line(
                    "it is in microseconds, not in nanoseconds; send nanoseconds: multiply by 1000"
                )
                served.await_line(
                    "the quaternions come in steps of 0.001: each attitude is off by 206 arcsec rms"
                )
                wait_for(lambda: page.json("/state")["state"]["counts"]["lost"] > 3)
        _, summary = ended(served)
    assert summary["packets"]["lost"] > 3 and summary["wrong_sky"] == {
        "seconds": 0.0,
        "conditions": [],
    }


def frames_of_log(path: Path, count: int) -> Path:
    path.write_text(
        "t_s,qw,qx,qy,qz\n" + "".join(f"{k / 10},0.5,0.5,-0.5,0.5\n" for k in range(count))
    )
    return path


def test_the_last_line_of_a_run_is_its_verdict(tmp_path, small_bench_file):
    log = frames_of_log(tmp_path / "still.csv", 5)
    found = run_hilstar_here("replay", small_bench_file, log, *UNPACED, "--strict")
    assert found.returncode == 0, found.stderr
    assert found.stdout.splitlines()[-1].startswith("verdict             the sky was right in all")


def test_a_log_in_another_convention_is_a_wrong_sky_for_all_of_it(tmp_path, small_bench_file):
    log = tmp_path / "slew.jsonl"
    with log.open("w") as file:
        for k in range(200):
            q = conjugate(propagate(np.array(ORION), TURN_RAD_S, k / 50))
            file.write(
                json.dumps({"t_ns": k * 20_000_000, "q": q.tolist(), "rate": TURN_RAD_S.tolist()})
                + "\n"
            )
    found = run_hilstar_here("replay", small_bench_file, log, *UNPACED, "--strict", "--json")
    told = json.loads(found.stdout)
    assert found.returncode == 1 and [one["kind"] for one in told["wrong_sky"]["conditions"]] == [
        "convention-wrong"
    ]
    assert '{ direction = "cam_to_icrs" }' in told["wrong_sky"]["conditions"][0]["text"]
