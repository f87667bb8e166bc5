"""42 on a real TCP connection: what the real program sent, sent again at its own pace, and what
else may come.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.wire.nasa42 import MessageReader, MessageSplitter, Nasa42Link, Nasa42Lockstep
from hilstar.attitude.wire.source import Mounting
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import angle_between_rad, propagate
from hilstar.server.bench.build import load
from hilstar.server.loop import Limit
from hilstar.server.record.ledger_records import frame_records
from hilstar.server.serve import serve
from tests.support.benches import SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.live_runs import MAX_EXTRAPOLATION_NS, attitudes, serve_until
from tests.support.senders import free_port
from tests.support.servers import interrupted, listening
from tests.support.sources.nasa42 import BEGIN_NS, STREAM_2025, message
from tests.support.waiting import PATIENCE_S

MOUNTING = (0.5, 0.5, -0.5, 0.5)
STEP_S = 0.02
RATE_RAD_S = np.radians([3.0, -8.0, 15.0])
# Between 42's thirteen digits and hilstar's float64 lie some rotations; rates are exact to 1e-13,
# and predict 20 ms.
FOLLOWED_RAD = 1e-9
# Predicted for 0.25 s at most, by a rate that changes by 2.5e-3 rad/s in that time.
NUTATED_RAD = 0.25 * 2.5e-3
MESSAGES = MessageSplitter().feed(STREAM_2025.read_bytes())


def nasa42_bench(folder: Path, *lines: str, mounting: tuple[float, ...] = MOUNTING) -> Path:
    path = folder / "bench.toml"
    mounted = SMALL_BENCH.replace("[tracker]", f"[tracker]\nq_body_to_cam = {list(mounting)}")
    path.write_text("\n".join([mounted, "[attitude]", 'source = "42"', *lines, ""]))
    return path


def as_42(connection: socket.socket, messages: Iterable[bytes], step_s: float = STEP_S) -> int:
    """Send each message at its time, as 42 does: only once the one before was acknowledged. How
    many were.
    """
    connection.settimeout(PATIENCE_S)
    begin_s = time.monotonic()
    count = 0
    for k, each in enumerate(messages):
        time.sleep(max(0.0, begin_s + k * step_s - time.monotonic()))
        connection.sendall(each)
        heard = b""
        while not heard.endswith(b"\n"):
            heard += connection.recv(4)
            if not heard:
                return count
        assert heard == b"Ack\n"
        count += 1
    return count


@contextlib.contextmanager
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(PATIENCE_S)
        yield made


def test_a_recorded_run_of_42_is_shown_and_every_message_acknowledged(tmp_path):
    ledger = tmp_path / "run.mcap"
    with server() as listener:
        bench = nasa42_bench(
            tmp_path,
            f'endpoint = "tcp://127.0.0.1:{listener.getsockname()[1]}"',
            'spacecraft = "SC[0]"',
        )
        with listening(bench, "connecting to tcp://", "--ledger", str(ledger)) as process:
            connection, _ = listener.accept()
            with connection:
                assert as_42(connection, MESSAGES[:12], 0.1) == 12
                process.has_received(12)
                summary = interrupted(process)
    assert summary["packets"]["accepted"] == summary["packets"]["received"] == 12
    assert summary["link"]["connections"] == 1
    reader = MessageReader(0, Mounting(MOUNTING))
    samples = [reader.decode(each) for each in MESSAGES[:12]]
    frames = [frame for frame in frame_records(ledger) if frame.attitude_t_ns is not None]
    assert {frame.attitude_t_ns for frame in frames} <= {sample.t_ns for sample in samples}
    # until the next message, an attitude is predicted by its rate, which nutates
    for frame in frames:
        sample = samples[(frame.attitude_t_ns - samples[0].t_ns) // 100_000_000]
        predicted_ns = min(frame.light_ns - sample.t_ns, MAX_EXTRAPOLATION_NS)
        expected = propagate(sample.q_icrs_to_cam, sample.rate_cam_rad_s, predicted_ns / 1e9)
        assert angle_between_rad(np.array(frame.q), expected) < NUTATED_RAD


def body_turn(seconds: float) -> Rotation:
    """The body after so long: v_B of v_N."""
    return Rotation.from_rotvec(-RATE_RAD_S * seconds) * Rotation.from_euler(
        "zyx", [84, 20, 30], degrees=True
    )


def test_every_frame_is_the_body_s_attitude_of_its_time_through_the_mounting(tmp_path):
    with server() as listener:
        port = listener.getsockname()[1]
        reader = MessageReader(0, Mounting(MOUNTING))
        with (
            load(nasa42_bench(tmp_path)) as bench,
            Nasa42Link(f"tcp://127.0.0.1:{port}", reader) as link,
        ):
            steps = (
                message(k * STEP_S, body_turn(k * STEP_S), RATE_RAD_S).encode()
                for k in range(10**6)
            )

            def simulate() -> None:
                connection, _ = listener.accept()
                with connection, contextlib.suppress(OSError):
                    as_42(connection, steps)

            simulator = threading.Thread(target=simulate)
            simulator.start()
            summary, frames = serve_until(
                bench, link, lambda shown, run: len(attitudes(shown)) > 60
            )
    simulator.join()
    shown = attitudes(frames)
    assert len(shown) > 60
    assert summary.packets.refused == 0
    for t_ns, attitude in shown:
        expected = Rotation.from_quat(MOUNTING, scalar_first=True) * body_turn(
            (t_ns - BEGIN_NS) / 1e9
        )
        assert (
            Rotation.from_quat(attitude.q_icrs_to_cam, scalar_first=True) * expected.inv()
        ).magnitude() < FOLLOWED_RAD


def test_in_lockstep_42_runs_as_fast_as_frames_come_and_each_message_is_a_frame(tmp_path):
    """Two hours of simulation, a message every 36 s: none is shown late, left out, or shown
    twice.
    """
    drawn = []
    steps = [message(36.0 * k, body_turn(float(k)), RATE_RAD_S).encode() for k in range(200)]
    with (
        server() as listener,
        load(nasa42_bench(tmp_path, "lockstep = true")) as bench,
        Nasa42Lockstep(
            f"tcp://127.0.0.1:{listener.getsockname()[1]}", MessageReader(0, Mounting(MOUNTING))
        ) as link,
    ):

        def simulate() -> None:
            connection, _ = listener.accept()
            with connection:
                as_42(connection, [*steps[:100], b"[ENDMSG]\n", *steps[100:]], 0.0)

        simulator = threading.Thread(target=simulate)
        simulator.start()
        summary = serve(
            bench, link, Limit(frames=200), lambda shown: drawn.append((shown.t_ns, shown.attitude))
        )
        simulator.join()
    assert [(t_ns - BEGIN_NS) // 36_000_000_000 for t_ns, _ in drawn] == list(range(200))
    assert summary.packets.refused == 1
    for k, (_, attitude) in enumerate(drawn):
        expected = Rotation.from_quat(MOUNTING, scalar_first=True) * body_turn(float(k))
        assert (
            Rotation.from_quat(attitude.q_icrs_to_cam, scalar_first=True) * expected.inv()
        ).magnitude() < FOLLOWED_RAD


def test_42_may_be_the_client_and_come_back_and_nobody_else_gets_in(tmp_path):
    port = free_port()
    bench = nasa42_bench(tmp_path, f'endpoint = "tcp://127.0.0.1:{port}"', "bind = true")
    with listening(bench, f"bound to tcp://127.0.0.1:{port}") as process:
        for first in (0, 10):
            with socket.create_connection(("127.0.0.1", port)) as connection:
                as_42(connection, MESSAGES[first : first + 3], 0.1)
                with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as second:
                    assert second.recv(1) == b""
                as_42(connection, MESSAGES[first + 3 : first + 6], 0.1)
        process.has_received(12)
        summary = interrupted(process)
    assert summary["packets"]["received"] == 12
    assert summary["reconnects"] == 1
    assert (summary["link"]["connections"], summary["link"]["refused"]) == (2, 2)


def test_what_is_wrong_is_refused_by_reason_and_the_display_goes_on(tmp_path):
    wrong = [
        b"[ENDMSG]\n",
        b"\0" * 500 + b"\n[EOF]\n",
        MESSAGES[0].replace(b"qn", b"q"),
        b"A" * 200_000 + b"\n[ENDMSG]\n",
    ]
    with server() as listener:
        bench = nasa42_bench(tmp_path, f'endpoint = "tcp://127.0.0.1:{listener.getsockname()[1]}"')
        with listening(bench, "connecting to") as process:
            connection, _ = listener.accept()
            with connection:
                assert as_42(connection, [MESSAGES[0], *wrong, MESSAGES[1]]) == 6
                # cut short: belongs to nothing after the connection is made anew
                connection.sendall(MESSAGES[2][:50])
            connection, _ = listener.accept()
            with connection:
                assert as_42(connection, MESSAGES[3:5], 0.1) == 2
            process.has_accepted(4)
            packets = interrupted(process)["packets"]
    assert packets["accepted"] == 4
    assert packets["refused_by"]["format"] == packets["refused"] == len(wrong)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (['endpoint = "tcp://*:10001"', "bind = true"], "allow"),
        (['endpoint = "udp://127.0.0.1:10001"'], "tcp://HOST:PORT"),
        (['endpoint = "ipc:///tmp/42"'], "tcp://HOST:PORT"),
        (['bind = "127.0.0.1:10001"'], "endpoint"),
        (['allow = ["127.0.0.1"]'], "bind = true"),
        (['spacecraft = "Aura"'], "SC[0]"),
        (['clock = "shared"'], "time of its simulation"),
    ],
)
def test_keys_that_are_wrong_get_one_line(tmp_path, lines, said):
    result = run_hilstar_here(
        "serve", nasa42_bench(tmp_path, *lines), "--headless", "--duration", "0.1"
    )
    assert_refused(result, 2, said)


def test_a_port_in_use_gets_one_line():
    with server() as listener, pytest.raises(InputError, match="in use"):
        Nasa42Link(
            f"tcp://127.0.0.1:{listener.getsockname()[1]}", MessageReader(0, Mounting()), bind=True
        )


def test_explain_says_42_s_conventions_with_an_attitude_in_its_words(tmp_path):
    bench = nasa42_bench(
        tmp_path, f'endpoint = "tcp://127.0.0.1:{free_port()}"', mounting=(1.0, 0.0, 0.0, 0.0)
    )
    result = run_hilstar_here("serve", bench, "--headless", "--frames", "1", "--explain")
    assert result.returncode == 4  # nobody sent an attitude
    assert "scalar last" in result.stderr
    assert "qn = (-0.7135120, 0.0370377, -0.0362700, 0.6987226) Alnilam" in result.stderr
