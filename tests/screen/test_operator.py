"""What an operator does to the window is in the record: the status, the ledger's frames and
events, and --json.
"""

from __future__ import annotations

import json
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq

from hilstar.attitude.wire.protocol import (
    HEALTH_BLANK,
    HEALTH_HIDDEN,
    HEALTH_NO_ATTITUDE,
    HEALTH_OPERATOR_OVERRIDE,
)
from hilstar.server.record.ledger_records import FrameRecord, frame_records
from tests.support.benches import ORION_Q, SCREEN_BENCH
from tests.support.forks import HILSTAR, Started
from tests.support.ledgers import read_events
from tests.support.senders import connected, free_port, packet
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.x11.events import Client, client
from tests.support.x11.screens import Screen, Shown, codes_of, lines_over, recorded

MS = 1_000_000


def last_frame(ledger: Path) -> FrameRecord | None:
    return next(reversed(recorded(ledger)), None)


@contextmanager
def shown_with_ledger(
    screen: Screen, screen_file: Path, *options: str
) -> Iterator[tuple[Shown, Client, Path]]:
    ledger = screen_file.parent / "run.mcap"
    with (
        Shown(screen, screen_file, "--ledger", str(ledger), *options) as shown,
        client(screen.display) as user,
    ):
        wait_for(lambda: last_frame(ledger) is not None)
        yield shown, user, ledger


def test_each_key_is_in_the_frames_and_the_events_and_a_hidden_sky_is_none(screen, screen_file):
    """Keys, what the frames then say, and whether they have an attitude."""
    steps = [
        ("b", "blank", False),
        ("g", "blank, grid", False),
        ("b", "grid", True),
        ("g", "", True),
        ("c", "crosshair", True),
    ]
    steps += [("t", "crosshair, patch 0%", False), ("b", "blank, crosshair, patch 0%", False)]
    with shown_with_ledger(screen, screen_file) as (shown, user, ledger):
        for key, operator, has_sky in steps:
            user.press(key)
            wait_for(lambda operator=operator: last_frame(ledger).operator == operator)
            frame = last_frame(ledger)
            assert (frame.q is not None, frame.age_ns is not None) == (has_sky, has_sky), (
                key,
                frame,
            )
            assert (frame.stars_drawn > 0) == has_sky
        summary = shown.stop()
    told = [event.detail for event in read_events(ledger) if event.kind == "operator"]
    assert len(told) == len(steps) == summary["events"]["operator"]
    for detail, (_, operator, _) in zip(told, steps, strict=True):
        assert (operator or "the sky of the attitude again") in detail
    frames = list(frame_records(ledger))
    overridden = [frame for frame in frames if frame.operator]
    assert summary["screen"]["operator"]["frames"] == len(overridden)
    assert 0 < summary["screen"]["operator"]["s"] < summary["duration_s"]
    assert summary["screen"]["hidden"] == {"frames": 0, "s": 0}


def test_a_paused_attitude_grows_old(screen, screen_file):
    with shown_with_ledger(screen, screen_file) as (shown, user, ledger):
        user.press("space")
        wait_for(lambda: last_frame(ledger).operator == "pause")
        first = next(frame for frame in frame_records(ledger) if frame.operator)
        wait_for(lambda: last_frame(ledger).frame > first.frame + 30)
        last = last_frame(ledger)
        shown.stop()
    assert last.q == first.q
    assert last.age_ns - first.age_ns == last.t_ns - first.t_ns
    assert last.attitude_t_ns == first.attitude_t_ns
    assert not last.stale


@pytest.mark.parametrize(
    ("hide", "show", "why", "options"),
    [
        (lambda user: user.unmap(), lambda user, made: user.map(), "not on the screen", []),
        (
            lambda user: user.move(-200, 50),
            lambda user, made: user.move(0, 0),
            "moved off its display",
            [],
        ),
        (
            lambda user: user.move(-200, 0),
            lambda user, made: user.move(0, 0),
            "off the screen",
            ["--windowed"],
        ),
        (
            lambda user: user.cover(100, 100),
            lambda user, made: user.uncover(made),
            "covered in part",
            [],
        ),
        (lambda user: user.cover(640, 480), lambda user, made: user.uncover(made), "covered", []),
    ],
)
def test_a_window_that_is_not_seen_is_in_the_record(screen, screen_file, hide, show, why, options):
    with shown_with_ledger(screen, screen_file, *options) as (shown, user, ledger):
        window = user.window()
        user.window = lambda: window  # whatever lies above it
        made = hide(user)
        wait_for(lambda: why in last_frame(ledger).hidden)
        show(user, made)
        wait_for(lambda: not last_frame(ledger).hidden)
        summary = shown.stop()
    assert summary["events"]["hidden"] == summary["events"]["visible"] == 1
    assert (
        summary["screen"]["hidden"]["frames"]
        == sum(bool(frame.hidden) for frame in frame_records(ledger))
        > 0
    )


def test_the_status_says_what_the_screen_shows(screen, tmp_path):
    """In lockstep, where each attitude gets its status."""
    port, bench = free_port(), tmp_path / "bench.toml"
    bench.write_text(
        f'{SCREEN_BENCH}\n[attitude]\nlockstep = true\nendpoint = "tcp://127.0.0.1:{port}"\n'
    )
    count = 0

    def status() -> tuple[int, int]:
        nonlocal count
        count += 1
        asker.send(packet(count, count * 10 * MS, q=ORION_Q))
        _, _, health, _, _, age_ns, *_ = struct.unpack("<BBHIqqIIII", asker.recv())
        return health, age_ns

    command = [*HILSTAR, "serve", str(bench), "--json"]
    with (
        connected(port, zmq.REQ, PATIENCE_S) as asker,
        Started(command, stdout=subprocess.PIPE, env=screen.env) as process,
    ):
        try:
            bits = HEALTH_OPERATOR_OVERRIDE | HEALTH_BLANK | HEALTH_HIDDEN | HEALTH_NO_ATTITUDE
            health, age_ns = status()
            assert (health & bits, age_ns) == (0, 0)
            with client(screen.display) as user:
                user.press("b")
                wait_for(lambda: status()[0] & bits == HEALTH_OPERATOR_OVERRIDE | HEALTH_BLANK)
                assert status()[1] == -1
                user.press("b")
                wait_for(lambda: status() == (health, 0))
                user.press("space")
                wait_for(lambda: status()[0] & bits == HEALTH_OPERATOR_OVERRIDE)
                first, second = status()[1], status()[1]
                assert second - first == 10 * MS
                user.press("space")
                window = user.window()
                user.window = lambda: window
                user.unmap()
                wait_for(lambda: status()[0] & bits == HEALTH_HIDDEN)
                status()
                user.map()
                wait_for(lambda: status()[0] & bits == 0)
            process.terminate()
            summary = json.loads(process.communicate(timeout=PATIENCE_S)[0])
        finally:
            process.kill()
    assert summary["screen"]["operator"]["frames"] > 0 < summary["screen"]["hidden"]["frames"]


def test_b_blanks_a_patch_and_c_draws_the_crosshair_on_it(screen, screen_file):
    codes = codes_of(screen_file)
    black = np.zeros_like(codes)
    cross = lines_over(black, "c") > 0
    with Shown(screen, screen_file) as shown, client(screen.display) as user:
        assert (shown.wait_for(codes) == codes).all()
        for patch in (0, 64, 128, 191, 255):
            user.press("t")
            assert (shown.wait_for(np.full_like(black, patch)) == patch).all()
            user.press("c")
            wanted = np.where(cross, 96 if patch < 96 else 0, patch)
            assert (shown.wait_for(wanted) == wanted).all(), patch
            user.press("b")
            wanted = np.where(cross, 96, 0)
            assert (shown.wait_for(wanted) == wanted).all(), patch
            user.press("c")
            user.press("b")
