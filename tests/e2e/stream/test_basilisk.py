"""Basilisk itself drives `hilstar serve`: its own record of the attitude against every frame of
the ledger.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from tests.support.benches import bench_text
from tests.support.claims import holds
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.ledgers import messages_by_topic
from tests.support.senders import free_port, publisher
from tests.support.servers import interrupted, listening, serving
from tests.support.sources.basilisk import Truth, basilisk, rotation
from tests.support.sources.viz_message import craft, viz_message
from tests.support.waiting import is_connected_to, wait_for

# Two degrees a second, from just under |sigma| = 1: the switch to the shadow set comes within half
# a second. The other spacecraft is elsewhere, so that a choice of the wrong one is seen.
CHASER = [[0.512, 0.613, 0.596], [0.02, 0.027, 0.012]]
TARGET = [[-0.3, 0.1, 0.2], [0.0, 0.01, 0.0]]
MOUNTING = [0.6, 0.48, 0.64, 0.0]
BENCH = {"tracker": {"q_body_to_cam": MOUNTING}}
FOCAL_PX = 60e3 / 57.65  # of the small bench's collimator and monitor
CORNERS = np.array([[x, y, FOCAL_PX] for x in (-160, 0, 160) for y in (-120, 0, 120)])
SUBSCRIBED_S = 0.3  # Basilisk does not tell whether a subscription has come over the connection
# of 60 messages and 72 frames: a machine with three times as many processes as cores keeps some 8
SOME = 5
# sigma_BN is a double, as are all that is made of it.
SAMPLE_LIMIT_RAD = 1e-14
# Differences of three attitudes h apart: the rate's second derivative (1e-5 rad/s^3 here) times h^2
# / 3 is 1.3e-9 at 20 ms, and 3e-9 where a second message between them was lost.
RATE_LIMIT_RAD_S = 1e-8


def star_errors_px(mine: Rotation, true: Rotation) -> np.ndarray:
    """How far stars in the corners and the middle of the monitor are from where the true
    attitude has them.
    """
    seen = (mine * true.inv()).apply(CORNERS)
    return np.linalg.norm(FOCAL_PX * seen[:, :2] / seen[:, 2:] - CORNERS[:, :2], axis=1)


@pytest.fixture(scope="module")
def broadcast(tmp_path_factory) -> tuple[Truth, dict[str, list[dict]], dict]:
    """1.2 s of two spacecraft, broadcast in real time; the truth, the ledger, the summary."""
    folder, port = tmp_path_factory.mktemp("broadcast"), free_port()
    attitude = {"source": "vizard", "endpoint": f"tcp://127.0.0.1:{port}", "spacecraft": "chaser"}
    (folder / "bench.toml").write_text(bench_text(BENCH, {"attitude": attitude}))
    scenario = {"mode": "broadcastStream", "port": port, "shown_s": 0.02, "stops_s": [1.2]}
    crafts = {"chaser": CHASER, "target": TARGET}
    words = f"waiting for a sender at tcp://127.0.0.1:{port}"
    with (
        basilisk(folder, **scenario, spacecraft=crafts) as simulation,
        listening(folder / "bench.toml", words, "--ledger", str(folder / "run.mcap")) as served,
    ):
        wait_for(lambda: is_connected_to(port), "its link to Basilisk")
        time.sleep(SUBSCRIBED_S)
        simulation.run()
        summary = interrupted(served)
    return Truth(folder), messages_by_topic(folder / "run.mcap"), summary


def test_every_sample_is_basilisk_s_own_attitude_through_the_mounting_and_the_shadow_switch(
    broadcast,
):
    truth, topics, summary = broadcast
    mounting = rotation(MOUNTING)
    samples = topics["/attitude"]
    assert truth.shadow_switches() == 1
    assert summary["packets"]["refused"] == 0
    assert len(samples) == summary["packets"]["accepted"] >= SOME
    rates = 0
    for sample in samples:
        row = truth.row(sample["t_ns"])
        off = rotation(sample["q"]) * (mounting * truth.body_from_n[row]).inv()
        holds("basilisk-samples", off.magnitude())
        if sample["rate"] is not None:
            rates += 1
            assert (
                np.abs(sample["rate"] - mounting.apply(truth.omega_bn_b[row])).max()
                < RATE_LIMIT_RAD_S
            )
    assert rates >= SOME / 2


def test_stars_of_every_frame_are_where_basilisk_s_truth_has_them(broadcast):
    truth, topics, _ = broadcast
    for frame in topics["/frame"]:
        if frame["q"] is not None:
            at = truth.v_bn_n[truth.row(frame["attitude_t_ns"])] / 1000
            assert frame["velocity_km_s"] == pytest.approx(at, rel=1e-15)
    true_at = Slerp(truth.t_ns, rotation(MOUNTING) * truth.body_from_n)
    errors = [
        star_errors_px(rotation(frame["q"]), true_at(frame["light_ns"])).max()
        for frame in topics["/frame"]
        if frame["q"] is not None and not frame["stale"] and frame["light_ns"] <= truth.t_ns[-1]
    ]
    assert len(errors) >= SOME
    holds("basilisk-stars", max(errors))


def test_in_lockstep_every_step_is_one_frame(tmp_path):
    """As fast as both go: a second of simulation in twenty steps, each with the place from
    which the Earth is seen.
    """
    port = free_port()
    attitude = {"source": "vizard", "lockstep": True, "endpoint": f"tcp://127.0.0.1:{port}"}
    seen = {
        "attitude": attitude,
        "sky": {"epoch_utc": "2026-11-21T00:00:00Z"},
        "sky.bodies": {"earth": True, "moon": True},
        "spacecraft": {"orbit": "source"},
    }
    (tmp_path / "bench.toml").write_text(bench_text(BENCH, seen))
    scenario = {"mode": "liveStream", "port": port, "shown_s": 0.05, "stops_s": [1.0]}
    with (
        basilisk(tmp_path, **scenario, spacecraft={"chaser": CHASER}) as simulation,
        listening(
            tmp_path / "bench.toml", "bound to", "--ledger", str(tmp_path / "run.mcap")
        ) as served,
    ):
        simulation.run()
        summary = interrupted(served)
    truth, frames = Truth(tmp_path), messages_by_topic(tmp_path / "run.mcap")["/frame"]
    assert [frame["t_ns"] for frame in frames] == [50_000_000 * k for k in range(1, 21)]
    assert summary["packets"]["received"] == summary["packets"]["accepted"] == 20
    for frame in frames:
        row = truth.row(frame["t_ns"])
        true = rotation(MOUNTING) * truth.body_from_n[row]
        assert (rotation(frame["q"]) * true.inv()).magnitude() < SAMPLE_LIMIT_RAD
        assert frame["place_km"] == pytest.approx(truth.r_bn_n[row] / 1000)
        assert frame["velocity_km_s"] == pytest.approx(truth.v_bn_n[row] / 1000)


def test_broken_messages_among_good_ones_are_refused_and_other_topics_do_not_count(tmp_path):
    """A hundred good ones, each followed by one that is cut short and by settings; and at the
    end a part too many.
    """
    attitude = 'source = "vizard"\nspacecraft = "sat"'
    sigma = Rotation.from_rotvec([0.3, 0.4, 0.5]).as_mrp()
    with publisher() as (sender, port), serving(tmp_path, port, attitude=attitude) as process:
        begun_ns = time.monotonic_ns()
        for k in range(100):
            message = viz_message(
                time.monotonic_ns() - begun_ns, [craft(sigma=sigma), craft("other")], frame=k
            )
            sender.send_multipart([b"SIM_UPDATE", message])
            sender.send_multipart([b"SIM_UPDATE", message[:-1]])
            sender.send_multipart([b"SYNC_SETTINGS", b"not an attitude"])
            time.sleep(0.01)
        sender.send_multipart([b"SIM_UPDATE", b"a part too many", message])
        process.has_received(201)
        packets = interrupted(process)["packets"]
    assert (packets["received"], packets["accepted"], packets["refused_by"]["format"]) == (
        201,
        100,
        101,
    )


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"endpoint": "tcp://192.168.1.2:5570"}, "ssh -L 5570:127.0.0.1:5570 HOST"),
        ({"endpoint": "tcp://*:5556", "lockstep": True}, "Basilisk knows no keys"),
        ({"endpoint": "udp://127.0.0.1:5570"}, "tcp://HOST:PORT"),
        ({"curve_secret_key": "k"}, "[attitude] curve_secret_key: Basilisk knows no keys"),
        ({"clock": "shared"}, "Basilisk sends the time of its simulation"),
        ({"source": "zmq", "spacecraft": "a"}, "spacecraft is for source"),
        ({"spacecraft": ["a"]}, "[attitude] spacecraft"),
    ],
)
def test_keys_that_are_wrong_get_one_line(tmp_path, keys, said):
    (tmp_path / "bench.toml").write_text(bench_text({"attitude": {"source": "vizard"} | keys}))
    assert_refused(
        run_hilstar_here("serve", tmp_path / "bench.toml", "--headless", "--duration", "0.1"),
        2,
        said,
    )


@pytest.mark.parametrize("velocity", [True, False])
def test_explain_says_basilisk_s_conventions_with_an_attitude_in_its_words(tmp_path, velocity):
    attitude = {
        "source": "vizard",
        "endpoint": f"tcp://127.0.0.1:{free_port()}",
        "use_velocity": velocity,
    }
    (tmp_path / "bench.toml").write_text(bench_text(BENCH, {"attitude": attitude}))
    result = run_hilstar_here(
        "serve", tmp_path / "bench.toml", "--headless", "--frames", "1", "--explain"
    )
    assert result.returncode == 4  # nobody sent an attitude
    assert "sigma_BN = (-0.0399925, 0.2600642, -0.2854911) Alnilam" in result.stderr
    assert ("aberrates the stars" in result.stderr) is velocity
