"""A sender of another convention over a real socket: the sky is right live, in the ledger and in
its replay, applied once.
"""

from __future__ import annotations

import json
import signal
import struct

import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.log_file import read_log
from hilstar.server.record.ledger_records import frame_records
from tests.support.benches import LIVE_BENCH, attitude_table
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.forks import HILSTAR
from tests.support.heads import heads_file
from tests.support.senders import free_port, publisher, talking
from tests.support.servers import Run, summary_of

MOUNTING = (0.5, -0.5, -0.5, -0.5)
TO_CAM = Rotation.from_quat(MOUNTING, scalar_first=True)
ICRS_TO_BODY = Rotation.from_euler("zyx", [10, 20, 30], degrees=True)
SENT = tuple(ICRS_TO_BODY.inv().as_quat().tolist())  # x, y, z, w, from the body to the ICRS
SAME_RAD = 1e-9
CONVENTION = 'convention = { scalar = "last", direction = "cam_to_icrs", frame = "body" }'


def off_rad(q, wanted: Rotation) -> float:
    return (Rotation.from_quat(q, scalar_first=True) * wanted.inv()).magnitude()


@pytest.fixture(scope="module")
def convention_run(tmp_path_factory):
    """A ledger of a run, and its bench file."""
    folder = tmp_path_factory.mktemp("convention")
    bench, ledger = folder / "bench.toml", folder / "run.mcap"
    with publisher() as (sender, port), talking(sender, 100.0, SENT):
        text = LIVE_BENCH.replace("[tracker]", f"[tracker]\nq_body_to_cam = {list(MOUNTING)}")
        bench.write_text(text + attitude_table(port, CONVENTION))
        with Run(
            [*HILSTAR, "serve", str(bench), "--headless", "--json", "--ledger", str(ledger)]
        ) as process:
            process.has_accepted(20)
            shown = process.counts()[0]
            process.shows(shown + 10)
            process.send_signal(signal.SIGINT)
            summary_of(process)
    return bench, ledger


def test_the_sky_is_the_cameras_and_the_ledger_keeps_the_bytes_with_their_convention(
    convention_run,
):
    _, ledger = convention_run
    shown = [record.q for record in frame_records(ledger) if record.q is not None]
    assert shown
    assert max(off_rad(q, TO_CAM * ICRS_TO_BODY) for q in shown) < SAME_RAD
    with ledger.open("rb") as file:
        head = next(iter(make_reader(file).iter_metadata())).metadata
    said = json.loads(head["raw_convention"])
    assert said == {
        "scalar": "last",
        "direction": "cam_to_icrs",
        "frame": "body",
        "q_body_to_cam": list(MOUNTING),
    }
    with ledger.open("rb") as file:
        packets = [
            json.loads(message.data)
            for _, _, message in make_reader(file).iter_messages(topics=["/attitude"])
        ]
    for each in packets:
        assert struct.unpack_from("<4d", bytes.fromhex(each["raw"]), 16) == SENT
        assert off_rad(each["q"], TO_CAM * ICRS_TO_BODY) < SAME_RAD


def test_a_replay_and_a_conversion_apply_it_no_second_time(tmp_path, convention_run):
    bench, ledger = convention_run
    again = tmp_path / "again.mcap"
    result = run_hilstar_here(
        "replay", bench, ledger, "--headless", "--speed", "max", "--ledger", again
    )
    assert result.returncode == 0, result.stderr
    shown = [record.q for record in frame_records(again) if record.q is not None]
    assert shown
    assert max(off_rad(q, TO_CAM * ICRS_TO_BODY) for q in shown) < SAME_RAD
    assert run_hilstar_here("convert", ledger, tmp_path / "a.csv").returncode == 0
    assert (
        max(
            off_rad(sample.q_icrs_to_cam, TO_CAM * ICRS_TO_BODY)
            for sample in read_log(tmp_path / "a.csv")
        )
        < SAME_RAD
    )
    looked = json.loads(run_hilstar_here("attitude", ledger, "--bench", bench, "--json").stdout)
    assert off_rad(looked["q_icrs_to_cam"], TO_CAM * ICRS_TO_BODY) < SAME_RAD
    for command in (
        ("replay", bench, ledger),
        ("convert", ledger, tmp_path / "b.csv"),
        ("attitude", ledger),
    ):
        for option in (
            ("--convention", "scalar=last"),
            ("--mounting", "0.5,-0.5,-0.5,-0.5"),
            ("--reference", "icrs"),
        ):
            assert_refused(
                run_hilstar_here(*command, *option),
                2,
                f"{option[0]}: the ledger of a run",
                "leave it out",
            )


def test_a_live_stream_is_looked_at_by_its_bench_file(tmp_path):
    bench = tmp_path / "bench.toml"
    with publisher() as (sender, port), talking(sender, 100.0, SENT):
        text = LIVE_BENCH.replace("[tracker]", f"[tracker]\nq_body_to_cam = {list(MOUNTING)}")
        bench.write_text(text + attitude_table(port, CONVENTION))
        looked = run_hilstar_here("attitude", bench, "--json", "--explain")
    assert looked.returncode == 0, looked.stderr
    found = json.loads(looked.stdout)
    assert off_rad(found["q_icrs_to_cam"], TO_CAM * ICRS_TO_BODY) < SAME_RAD
    assert (
        "q_body_to_icrs turns body components into ICRS components; scalar last"
        in found["conventions"][0]
    )
    for option, key in (
        ("--convention", "[attitude] convention"),
        ("--mounting", "[tracker] q_body_to_cam"),
    ):
        value = "scalar=last" if option == "--convention" else "1,0,0,0"
        assert_refused(
            run_hilstar_here("attitude", bench, option, value), 2, f"write it into {bench} as {key}"
        )
    for option in ("--kernel", "--topic", "--body", "--reference", "--epoch-utc", "--place"):
        assert_refused(
            run_hilstar_here("attitude", bench, option, "x"), 2, f"{option} x: it is for a log"
        )


def test_several_heads_have_one_body_and_none_is_the_frame_of_its_convention(tmp_path):
    """test_heads.py holds what else a convention may say."""
    path = heads_file(tmp_path, free_port())
    path.write_text(path.read_text() + 'convention = { scalar = "last", frame = "cam" }\n')
    refused = run_hilstar_here("serve", path, "--headless")
    assert_refused(refused, 2, 'frame = "cam"', 'write frame = "body", or leave it out')
