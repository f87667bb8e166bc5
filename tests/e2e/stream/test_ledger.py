"""The ledger: everything of a run, through a kill and a full disk, and the same light when it is
replayed.
"""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image

from hilstar.attitude.logs.log_file import read_log
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, propagate
from hilstar.basics.units import NS_PER_S
from hilstar.server.record.ledger_records import drawable_frames
from tests.support.benches import LIVE_BENCH, SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here, typed
from tests.support.forks import Started
from tests.support.ledgers import messages_by_topic
from tests.support.pages import page_of
from tests.support.senders import await_subscriber, connected, packet, publisher, talking
from tests.support.servers import bound, serving, summary_of
from tests.support.waiting import PATIENCE_S, CoreWaits, wait_for

START = from_radec_roll_deg(84, -1, 0)
RATE = (0.0, 0.0, 0.1)
LIMIT_BYTES = 20_000


def send_turn(sender, count: int) -> None:
    """A turn at 100 Hz, on a bench clock that stood at 50 s when it began; a wrong packet after
    each tenth.
    """
    start_ns = time.monotonic_ns()
    for k in range(count):
        run_ns = time.monotonic_ns() - start_ns
        q = propagate(START, np.array(RATE), run_ns / 1e9)
        sender.send(packet(k, 50_000_000_000 + run_ns, q=tuple(q), rate=RATE))
        if k % 10 == 9:
            sender.send(b"wrong")
        time.sleep(0.01)


@pytest.fixture(scope="module")
def served_ledger(tmp_path_factory) -> tuple[Path, dict]:
    """The ledger of a turn, and the run's summary."""
    folder = tmp_path_factory.mktemp("served")
    ledger = folder / "run.mcap"
    with (
        publisher() as (sender, port),
        serving(folder, port, "--ledger", str(ledger)) as process,
    ):
        process.shows()
        send_turn(sender, 100)
        process.has_received(110)
        process.send_signal(signal.SIGINT)
        return ledger, summary_of(process)


def test_every_packet_and_every_frame_is_there(served_ledger):
    ledger, summary = served_ledger
    assert summary["ledger"] == {"path": str(ledger), "failure": None, "unrecorded": 0}
    found = messages_by_topic(ledger)
    assert len(found["/attitude"]) == summary["packets"]["received"] == 110
    assert sum(not each["accepted"] for each in found["/attitude"]) == 10
    refused = [each for each in found["/attitude"] if not each["accepted"]]
    assert all(
        each["raw"] == b"wrong".hex() and each["reason"].startswith("format") for each in refused
    )
    for each in found["/attitude"]:
        if each["accepted"]:
            t_ns, *q = struct.unpack_from("<q4d", bytes.fromhex(each["raw"]), 8)
            assert (each["t_ns"], each["q"]) == (t_ns, q)
    frames = found["/frame"]
    assert len(frames) == summary["frames"]
    drawn = [frame for frame in frames if frame["q"] is not None]
    assert drawn == frames[-len(drawn) :]  # from the first packet on
    assert len(drawn) > 1
    for frame in drawn:
        assert frame["draw_ns"] < frame["swap_ns"]
        assert frame["receive_ns"] < frame["draw_ns"]
        assert frame["age_ns"] == frame["light_ns"] - frame["attitude_t_ns"]
        assert frame["timestamp_source"] == "headless"
        assert frame["stars_drawn"] > 0
    with ledger.open("rb") as file:
        head = next(iter(make_reader(file).iter_metadata())).metadata
    assert "[tracker]" in head["bench_text"]
    assert len(head["bench_sha256"]) == len(head["calibration_sha256"]) == 64


def test_what_was_drawn_is_drawn_again_bit_for_bit(tmp_path):
    """A run that is recorded as pictures, and again from its ledger: with temporal dither each
    frame's codes are its own.
    """
    log = tmp_path / "log.csv"
    rows = [propagate(START, np.array(RATE), k * 0.05) for k in range(9)]
    lines = [f"{k * 0.05},{','.join(repr(float(v)) for v in q)}" for k, q in enumerate(rows)]
    log.write_text("\n".join(["t_s,qw,qx,qy,qz", *lines]))
    bench = tmp_path / "bench.toml"
    bench.write_text(SMALL_BENCH + '[render]\nquantisation = "temporal"\n')
    first, second = tmp_path / "first", tmp_path / "second"
    ledger = tmp_path / "run.mcap"
    options = ["--headless", "--speed", "max"]
    assert (
        run_hilstar_here("replay", bench, log, *options, "-o", first, "--ledger", ledger).returncode
        == 0
    )
    again = run_hilstar_here("replay", bench, ledger, *options, "-o", second)
    assert again.returncode == 0, again.stderr
    names = sorted(path.name for path in first.glob("*.png"))
    assert len(names) == 25
    assert names == sorted(path.name for path in second.glob("*.png"))
    for name in names:
        assert (np.array(Image.open(first / name)) == np.array(Image.open(second / name))).all()
    assert (first / "frames.csv").read_text() == (second / "frames.csv").read_text()


def test_a_live_run_s_ledger_is_an_attitude_log_too(tmp_path, served_ledger):
    ledger, _ = served_ledger
    bench = ledger.with_name("serve.toml")
    samples = read_log(ledger)
    assert len(samples) == 100
    converted = run_hilstar_here("convert", ledger, tmp_path / "run.csv")
    assert "100 attitudes" in converted.stdout
    replayed = run_hilstar_here("replay", bench, ledger, "--headless", "--speed", "max", "--json")
    assert json.loads(replayed.stdout)["frames"] == len(list(drawable_frames(ledger)))
    refused = run_hilstar_here("replay", bench, ledger, "--headless", "--step", "1")
    assert_refused(refused, 2, "run.mcap", "--step")


@pytest.mark.timing
def test_after_a_kill_all_but_the_last_half_second_can_be_read(tmp_path):
    ledger = tmp_path / "run.mcap"
    with publisher() as (sender, port), serving(tmp_path, port, "--ledger", str(ledger)) as process:
        process.shows()
        with CoreWaits(process.pid) as waited:
            send_turn(sender, 100)
            process.kill()
            process.wait()
    found, frames = read_log(ledger), list(drawable_frames(ledger))
    assert found and frames
    # The bench's clock began 50 s before its stream, which ended at the kill: frames and packets
    # reach to half a second of it.
    within_ns = 50_000_000_000 + 1_000_000_000 - 600_000_000 - waited.s * NS_PER_S
    assert found[-1].t_ns > within_ns and frames[-1].t_ns > within_ns, (
        found[-1].t_ns,
        frames[-1].t_ns,
        waited.s,
    )


def test_a_full_disk_ends_the_ledger_and_not_the_display(tmp_path):
    """A file that may not grow over 20 kB stands for the disk."""
    ledger = tmp_path / "run.mcap"
    bench = tmp_path / "bench.toml"
    with publisher() as (sender, port):
        bench.write_text(f'{LIVE_BENCH}\n[attitude]\nendpoint = "tcp://127.0.0.1:{port}"\n')
        command = typed(f"serve {bench} --headless --json --ledger {ledger} --duration 1.5")
        limited = (
            f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({LIMIT_BYTES},"
            f" {LIMIT_BYTES}))"
        )
        program = f"{limited}; from hilstar.cli import main; main()"
        pipe = subprocess.PIPE
        with Started(
            [sys.executable, "-c", program, *command], stdout=pipe, stderr=pipe, text=True
        ) as process:
            assert process.stderr is not None
            process.stderr.readline()
            await_subscriber(sender)
            send_turn(sender, 140)
            out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1, err
    summary = json.loads(out)
    assert "the display goes on" in err
    assert summary["ledger"]["failure"]
    assert summary["ledger"]["unrecorded"] > 0
    assert summary["frames"] + summary["missed_frames"] == 90
    assert len(read_log(ledger)) > 20


def test_a_ledger_that_is_deleted_is_said_everywhere_and_ends_the_run_with_1(tmp_path):
    ledger = tmp_path / "run.mcap"
    with bound(tmp_path, "--ledger", str(ledger), "--console", "127.0.0.1:0") as served:
        page = page_of(served)
        with connected(served.port) as sender, talking(sender):
            wait_for(lambda: page.health_is(True))
            ledger.unlink()
            served.await_line(f"{ledger} was deleted while it was written")
            following = tmp_path / "run.next1.mcap"
            reason = "the ledger fails: a file was deleted, truncated or overwritten"
            wait_for(lambda: page.json("/health")["reasons"] == [reason])
            wait_for(lambda: len(list(drawable_frames(following))) > 10, "frames in the next file")
        served.process.send_signal(signal.SIGINT)
        assert served.process.wait(PATIENCE_S) == 1, served.lines
        told = json.loads(served.process.stdout.read())["ledger"]
    assert (told["path"], told["failure"]) == (
        str(following),
        f"{ledger} was deleted while it was written",
    )
    assert told["unrecorded"] > 0
    assert any(each["kind"] == "ledger-lost" for each in messages_by_topic(following)["/event"])
    assert not ledger.exists()


def test_a_ledger_that_cannot_be_begun_gets_one_line(tmp_path, small_bench_file):
    for place in (tmp_path / "no" / "run.mcap", "/dev/full"):
        result = run_hilstar_here(
            "serve", small_bench_file, "--headless", "--duration", "1", "--ledger", place
        )
        assert result.returncode == 2
        assert str(place) in result.stderr
        assert "Traceback" not in result.stderr


def test_no_output_is_written_over_an_input_or_an_older_run(tmp_path, small_bench_file):
    bench = small_bench_file
    qe = tmp_path / "qe.csv"
    qe.write_text("wavelength_nm,quantum_efficiency\n300,0.5\n1000,0.5\n")
    bench.write_text(SMALL_BENCH.replace('"ccd47-20"', '"qe.csv"'))
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n0.1,1,0,0,0\n")
    run = tmp_path / "run.mcap"
    headless = ["--headless", "--speed", "max"]
    assert run_hilstar_here("replay", bench, log, *headless, "--ledger", run).returncode == 0
    (tmp_path / "hard.mcap").hardlink_to(run)
    before = {path: path.read_bytes() for path in (bench, qe, log, run)}
    (tmp_path / "link.toml").symlink_to(bench)
    attitude = ["--quaternion", "1,0,0,0"]
    for command in (
        ["serve", bench, "--headless", "--ledger", tmp_path / "link.toml"],
        ["frame", bench, *attitude, "--truth", qe],
        ["frame", bench, *attitude, "-o", tmp_path / "x", "--truth", tmp_path / "x"],
        ["replay", bench, run, *headless, "--ledger", tmp_path / "hard.mcap", "--overwrite"],
        ["replay", bench, log, *headless, "--ledger", run],
        ["convert", log, log],
        ["convert", log, run],
        typed(
            f"serve {bench} --headless --duration 1 --ledger {tmp_path}/other.mcap "
            "--ledger-split '1 fortnight'"
        ),
    ):
        assert_refused(run_hilstar_here(*command), 2)
        assert {path: path.read_bytes() for path in before} == before, command
    again = run_hilstar_here("replay", bench, log, *headless, "--ledger", run, "--overwrite")
    assert again.returncode == 0, again.stderr
    assert run.read_bytes() != before[run]


def test_a_flood_of_wrong_packets_is_counted_and_the_ledger_stays_small(tmp_path):
    """A refused packet costs a count; the first of each reason are there whole."""
    ledger = tmp_path / "run.mcap"
    with publisher() as (sender, port), serving(tmp_path, port, "--ledger", str(ledger)) as process:
        process.shows()
        end_s = time.monotonic() + 1
        sent = 0
        while time.monotonic() < end_s:
            for _ in range(200):
                sender.send(b"x" * 3000)
            sent += 200
            time.sleep(0.01)
        process.has_received(1001)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process, code=4)  # nothing right ever came
    found = messages_by_topic(ledger)
    assert len(found["/attitude"]) < 40
    assert len(bytes.fromhex(found["/attitude"][0]["raw"])) == 1024
    counted = sum(each["count"] for each in found["/not_kept"] if each["kind"] == "packet")
    assert counted + len(found["/attitude"]) == summary["packets"]["received"] > 1000
    assert summary["ledger"]["unrecorded"] == 0
    assert ledger.stat().st_size < 1_000_000
    report = json.loads(
        run_hilstar_here("report", ledger, "-o", tmp_path / "report", "--json").stdout
    )
    assert sum(report["packets"].values()) == summary["packets"]["received"]


def test_no_flipped_bit_changes_an_attitude_unsaid(tmp_path, served_ledger, rng):
    ledger, _ = served_ledger
    data = ledger.read_bytes()
    truth = [(s.t_ns, *s.q_icrs_to_cam) for s in read_log(ledger)]
    damaged = tmp_path / "damaged.mcap"
    said = 0
    for place in rng.integers(0, 8 * len(data), 200):
        wrong = bytearray(data)
        wrong[place // 8] ^= 1 << (place % 8)
        damaged.write_bytes(bytes(wrong))
        try:
            found = [(s.t_ns, *s.q_icrs_to_cam) for s in read_log(damaged)]
        except InputError:
            said += 1
            continue
        assert found == truth[: len(found)]
        assert len(found) == len(truth)
    assert said > 150
