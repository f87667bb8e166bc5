"""The ledger's own rules, and what reading an MCAP file may cost."""

from __future__ import annotations

import io
import json
import os
import re
import resource
import shutil
import threading
import time
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Header
from mcap.writer import MCAP0_MAGIC, Writer

from hilstar.attitude.logs.log_file import read_log
from hilstar.attitude.logs.mcap_log import parts_of, read_chunks
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, encode
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notice, Notices
from hilstar.cli.options import parse_split
from hilstar.cli.running import optional_ledger
from hilstar.server.record import ledger as ledger_module
from hilstar.server.record.ledger import (
    MAX_WAITING_BYTES,
    FloodFilter,
    Ledger,
    LedgerQueue,
    LedgerSwitch,
    ProcessProbe,
    QueueEntry,
    SplitLimits,
)
from hilstar.server.record.ledger_records import (
    FAULT_TOPIC,
    AnswerRecord,
    FaultRecord,
    FrameRecord,
    drawable_frames,
    run_blocks,
)
from hilstar.server.record.run_figures import RunFigures, figures_of, summarise
from tests.support.full_disk import files_of_at_most
from tests.support.ledgers import read_events
from tests.support.refusals import refusal
from tests.support.waiting import wait_for

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def keep(ledger: Ledger, first: int, last: int) -> None:
    for k in range(first, last):
        sample = AttitudeSample(k, UPRIGHT, None, k)
        ledger.packet(1000 + k, encode(sample), sample, None)
        ledger.frame(
            FrameRecord(frame=k, t_ns=k, light_ns=k, draw_ns=k, swap_ns=k + 1, q=(1, 0, 0, 0))
        )


def read_topics(path):
    return [
        (topics[channel], data)
        for topics, messages in read_chunks(path)
        for channel, data in messages
    ]


def test_a_ledger_goes_on_in_other_files_and_is_read_as_one(tmp_path, small_bench):
    path = tmp_path / "run.mcap"
    with Ledger(path, small_bench, split=SplitLimits(bytes=1)) as ledger:
        keep(ledger, 0, 50)
        wait_for((tmp_path / "run.0001.mcap").exists, "the next file")
        keep(ledger, 50, 100)
    assert len(parts_of(path)) >= 2
    assert ledger.summary()["files"] == len(parts_of(path))
    assert [sample.sequence for sample in read_log(path)] == list(range(100))
    assert [frame.frame for frame in drawable_frames(path)] == list(range(100))
    assert [sample.sequence for sample in read_log(tmp_path / "run.0001.mcap")][-1] == 99 or len(
        parts_of(path)
    ) > 2


def test_a_split_is_a_size_or_a_time():
    assert (
        parse_split("1GB").bytes,
        parse_split("30min").seconds,
        parse_split("1.5h").seconds,
    ) == (1e9, 1800, 5400)
    for wrong in ("1", "GB", "1kB", "5s", "-1h", "1e3GB", "1 fortnight"):
        assert "--ledger-split" in refusal(parse_split, wrong)


def test_a_disk_without_room_loses_frames_first_and_says_so_and_is_tried_again(
    tmp_path, small_bench
):
    notices = Notices()
    with Ledger(tmp_path / "run.mcap", small_bench, notices) as ledger:
        keep(ledger, 0, 10)
        wait_for(
            lambda: len(list(drawable_frames(ledger.path))) == 10, "the first frames on the disk"
        )
        with files_of_at_most((tmp_path / "run.mcap").stat().st_size):
            keep(ledger, 10, 20)
            wait_for(lambda: "ledger-failed" in notices.active)
        wait_for(lambda: "ledger-failed" not in notices.active)
    assert ledger.failure == "File too large"
    assert ledger.summary()["unrecorded"] == 10
    assert [sample.sequence for sample in read_log(tmp_path / "run.mcap")] == list(range(20))
    assert [frame.frame for frame in drawable_frames(tmp_path / "run.mcap")] == list(range(10))


def test_a_ledger_that_cannot_be_begun_leaves_nothing(tmp_path, small_bench, monkeypatch):
    """Neither a file that is half begun nor a descriptor of one."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ledger_module, "McapWriter", full)
    open_files = len(list(Path("/proc/self/fd").iterdir()))
    assert "choose another place for the ledger" in refusal(
        Ledger, tmp_path / "run.mcap", small_bench
    )
    assert not list(tmp_path.iterdir())
    assert len(list(Path("/proc/self/fd").iterdir())) == open_files


def disk_of(monkeypatch, free_bytes: int, total_bytes: int = 100_000_000_000) -> list[int]:
    """A disk with so much free for a user, in blocks of 4 kB; root has 5 GB more, and files are
    read in pieces of 1 MB. The list grows with each look.
    """
    block = 4096
    disk = SimpleNamespace(
        f_frsize=block,
        f_bsize=1 << 20,
        f_blocks=total_bytes // block,
        f_bavail=free_bytes // block,
        f_bfree=(free_bytes + 5_000_000_000) // block,
    )
    looks: list[int] = []

    def fstatvfs(fd: int) -> SimpleNamespace:
        looks.append(fd)
        return disk

    monkeypatch.setattr(os, "fstatvfs", fstatvfs)
    return looks


def test_of_a_disk_that_fills_packets_have_the_last_64_mb_and_its_state_is_said(
    tmp_path, small_bench, monkeypatch
):
    monkeypatch.setattr(ledger_module, "EACH_S", 0.0)
    disk_of(monkeypatch, 50_000_000_000)
    notices, path = Notices(), tmp_path / "run.mcap"
    with Ledger(path, small_bench, notices) as ledger:
        keep(ledger, 0, 10)
        wait_for(lambda: len(list(drawable_frames(path))) == 10, "the first frames on the disk")
        assert not notices.active
        disk_of(monkeypatch, 9_900_000_000)
        wait_for(lambda: notices.active, "a disk of which less than a tenth is free")
        assert "disk-low" in notices.active and "ledger-thin" not in notices.active
        looks = disk_of(monkeypatch, 11_000_000_000)
        wait_for(lambda: len(looks) > 1)
        assert "disk-low" in notices.active  # until 12 % are free
        disk_of(monkeypatch, 63_000_000)
        wait_for(lambda: "ledger-thin" in notices.active)
        keep(ledger, 10, 20)
        wait_for(lambda: ledger.summary()["unrecorded"] == 10, "frames are not recorded")
        disk_of(monkeypatch, 12_100_000_000)
        wait_for(lambda: not notices.active, "there is room again")
        keep(ledger, 20, 30)
        # on a small disk frames go on until 2 % are free
        looks = disk_of(monkeypatch, 30_000_000, 1_000_000_000)
        wait_for(lambda: len(looks) > 1)
    assert [sample.sequence for sample in read_log(path)] == list(range(30))
    assert [frame.frame for frame in drawable_frames(path)] == [*range(10), *range(20, 30)]
    assert ledger.summary()["unrecorded"] == 10
    told = dict.fromkeys(("ledger-thin", "ledger-whole", "disk-low", "disk-well"), 1)
    assert notices.counts() == told | {"disk-low": 2}


def test_a_process_s_memory_is_what_the_kernel_says_it_is():
    """In kB of /proc/self/status, and not in pages; it may change between the two readings."""
    probe = ProcessProbe()
    cpu_s = time.process_time()
    record = probe.record()
    probe.close()
    assert record is not None
    status = Path("/proc/self/status").read_text()
    (resident_kb,) = re.findall(r"VmRSS:\s+(\d+) kB", status)
    assert record.resident_bytes == pytest.approx(1024 * int(resident_kb), rel=0.1)
    assert cpu_s <= record.cpu_s <= time.process_time()


def delete(path, _):
    path.unlink()


def replace_by_another(path, folder):
    (folder / "other").write_bytes(b"another file")
    (folder / "other").replace(path)


def cut_file(path, _):
    os.truncate(path, 300)


def write_anew(path, _):
    path.write_bytes(b"x" * 10)


def write_longer(path, _):
    path.write_bytes(b"x" * 1_000_000)


def write_over(path, _):
    time.sleep(0.05)  # a later tick of the clock by which a file system dates changes
    with path.open("r+b") as file:
        file.seek(100)
        file.write(b"over what was there")


def harm_until_said(path, harm, notices):
    """The harmed file and its bytes. The newest file is harmed, and the next one where the
    ledger had just gone on to that.
    """
    seen, harmed, left = set(), None, None

    def said():
        nonlocal harmed, left
        if "ledger-lost" in notices.active:
            return True
        parts = sorted(path.parent.glob("run.[0-9]*.mcap")) or [path]
        if parts[-1] not in seen:
            seen.update(parts, [path])
            harmed = parts[-1]
            harm(harmed, path.parent)
            left = harmed.read_bytes() if harmed.exists() else None
        return False

    wait_for(said)
    return harmed, left


@pytest.mark.parametrize("split", [SplitLimits(), SplitLimits(bytes=1)])
@pytest.mark.parametrize(
    "harm", [delete, replace_by_another, cut_file, write_anew, write_longer, write_over]
)
def test_a_ledger_that_is_harmed_is_said_and_goes_on_in_another_file(
    tmp_path, small_bench, harm, split
):
    notices, path = Notices(), tmp_path / "run.mcap"
    with Ledger(path, small_bench, notices, split=split) as ledger:
        keep(ledger, 0, 10)
        wait_for(lambda: len(list(drawable_frames(path))) == 10, "the first frames on the disk")
        if split.bytes == 1:
            wait_for((tmp_path / "run.0001.mcap").exists, "the next file")
        harmed, left = harm_until_said(path, harm, notices)
        keep(ledger, 10, 20)
    assert ledger.path == tmp_path / "run.next1.mcap"
    assert [frame.frame for frame in drawable_frames(ledger.path)] == list(range(10, 20))
    assert (harmed.read_bytes() if harmed.exists() else None) == left
    assert ledger.failure.startswith(f"{harmed} was ")
    assert ledger.failure.split(" was ")[1].split()[0] in {"deleted", "truncated", "overwritten"}
    assert ledger.summary()["failure"] == ledger.failure
    assert notices.counts()["ledger-lost"] == 1


@pytest.mark.parametrize("with_folder", [False, True])
def test_a_ledger_that_is_harmed_at_the_very_end_is_said_too(tmp_path, small_bench, with_folder):
    """Also where no other can be begun any more."""
    folder = tmp_path / "runs"
    folder.mkdir()
    with Ledger(folder / "run.mcap", small_bench) as ledger:
        keep(ledger, 0, 10)
        wait_for(
            lambda: len(list(drawable_frames(ledger.path))) == 10, "the first frames on the disk"
        )
        (folder / "run.mcap").unlink()
        if with_folder:
            folder.rmdir()
    assert ledger.failure.endswith("run.mcap was deleted while it was written")
    assert ledger.summary()["unrecorded"] >= 20


def test_a_ledger_whose_folder_is_gone_is_said_and_the_run_goes_on(tmp_path, small_bench):
    notices, folder = Notices(), tmp_path / "runs"
    folder.mkdir()
    with Ledger(folder / "run.mcap", small_bench, notices) as ledger:
        keep(ledger, 0, 10)
        wait_for(
            lambda: len(list(drawable_frames(ledger.path))) == 10, "the first frames on the disk"
        )
        shutil.rmtree(folder)
        wait_for(lambda: "ledger-lost" in notices.active)
        folder.mkdir()
        wait_for((folder / "run.next1.mcap").exists, "another file, once there is a place for it")
        keep(ledger, 10, 20)
    assert [frame.frame for frame in drawable_frames(folder / "run.next1.mcap")][-1] == 19
    assert ledger.failure.endswith("run.mcap was deleted while it was written")


def test_a_ledger_that_is_moved_touched_or_linked_is_whole(tmp_path, small_bench):
    notices = Notices()
    with Ledger(tmp_path / "run.mcap", small_bench, notices) as ledger:
        keep(ledger, 0, 10)
        (tmp_path / "link.mcap").hardlink_to(tmp_path / "run.mcap")
        (tmp_path / "run.mcap").touch()
        (tmp_path / "run.mcap").rename(tmp_path / "moved.mcap")
        wait_for(lambda: notices.counts().get("ledger-moved"))
        keep(ledger, 10, 20)
    assert ledger.failure is None
    counts = notices.counts()
    counts.pop("disk-low", None)  # who tests may have a disk that is nearly full
    assert counts == {"ledger-moved": 1}
    assert [frame.frame for frame in drawable_frames(tmp_path / "moved.mcap")] == list(range(20))


def test_a_ledger_begun_in_the_place_of_another_knows_the_faults_that_are_on(tmp_path, small_bench):
    notices, path = Notices(), tmp_path / "run.mcap"
    with LedgerSwitch(Ledger(path, small_bench, notices)) as switch:
        for number, event in ((9, "scenario"), (0, "start"), (1, "start"), (0, "end")):
            record = {
                "name": f"f{number}",
                "kind": "blank",
                "who": "file",
                "t_ns": 0,
                "table": "{}",
            }
            switch.fault(FaultRecord(host_ns=1, event=event, number=number, **record))
        wait_for(
            lambda: sum(topic == FAULT_TOPIC for topic, _ in read_topics(path)) == 4,
            "the faults on the disk",
        )
        path.unlink()
        wait_for(lambda: "ledger-lost" in notices.active)
    found = [
        json.loads(data) for topic, data in read_topics(switch.last.path) if topic == FAULT_TOPIC
    ]
    assert [(each["event"], each["number"]) for each in found] == [("scenario", 9), ("start", 1)]


def test_what_waits_is_bounded_by_bytes_and_frames_go_first():
    backlog = LedgerQueue()
    frames = sum(backlog.put(QueueEntry("frame", 0, 0, bytes)) for _ in range(50_000))
    packets = sum(backlog.put(QueueEntry("packet", 0, 0, bytes, 1000)) for _ in range(50_000))
    assert 0 < frames < 50_000 and 0 < packets < 50_000
    assert sum(entry.size_bytes for entry in backlog.take()) <= MAX_WAITING_BYTES
    assert backlog.put(QueueEntry("frame", 0, 0, bytes))


def test_what_a_full_queue_dropped_is_counted_once_by_kind():
    backlog = LedgerQueue()
    large = QueueEntry("packet", 0, 0, bytes, MAX_WAITING_BYTES + 1)
    for entry in (large, large, QueueEntry("frame", 0, 0, bytes, MAX_WAITING_BYTES + 1)):
        assert not backlog.put(entry)
    assert backlog.dropped == 3
    assert backlog.take_dropped() == {"packet": 2, "frame": 1}
    assert (backlog.dropped, backlog.take_dropped()) == (0, {})


def test_what_is_dropped_once_the_last_turn_is_written_is_unrecorded_too(
    tmp_path, small_bench, monkeypatch
):
    ledger = Ledger(tmp_path / "run.mcap", small_bench)
    keep(ledger, 0, 10)
    ledger.close()
    monkeypatch.setattr("hilstar.server.record.ledger.MAX_WAITING_BYTES", 0)
    keep(ledger, 10, 13)
    assert ledger.summary()["unrecorded"] == 6  # three packets and three frames


def test_what_had_no_room_is_counted_in_the_ledger_by_its_kind(tmp_path, small_bench, monkeypatch):
    """A fault is counted as an event: a replay would lack either."""
    ledger = Ledger(tmp_path / "run.mcap", small_bench)
    with monkeypatch.context() as full:
        full.setattr(ledger_module, "MAX_WAITING_BYTES", 0)
        keep(ledger, 0, 3)
        ledger.frame(FrameRecord(frame=9, t_ns=9, light_ns=9, draw_ns=9, swap_ns=9))
        ledger.answer(AnswerRecord(host_ns=5, raw=""))
        ledger.notice(Notice.now("mark", "a mark"))
        ledger.fault(
            FaultRecord(
                host_ns=1, event="start", number=1, name="f", kind="blank", who="", t_ns=0, table=""
            )
        )
    ledger.close()
    counted = {
        (each["kind"], each["reason"]): each["count"]
        for each in map(json.loads, of_topic(tmp_path / "run.mcap", "/not_kept"))
    }
    assert counted == {
        ("packet", "no room"): 3,
        ("frame", "no room"): 4,
        ("answer", "no room"): 1,
        ("event", "no room"): 2,
    }
    # they are lost, and no flood
    assert ledger.summary()["unrecorded"] == 10 and "only_counted" not in ledger.summary()


def of_topic(path: Path, wanted: str) -> list[bytes]:
    """The messages of a topic of a ledger."""
    return [data for topic, data in read_topics(path) if topic == wanted]


def test_a_disk_that_takes_nothing_is_told_by_the_frames_and_its_return_by_the_writer(
    tmp_path, small_bench, monkeypatch
):
    notices = Notices()
    told: list[str] = []
    notices.listen(lambda notice: told.append(notice.kind))
    with Ledger(tmp_path / "run.mcap", small_bench, notices) as ledger:
        keep(ledger, 0, 1)
        assert "ledger-stalled" not in notices.active
        with monkeypatch.context() as slow:
            slow.setattr(ledger_module, "STALLED_S", -1.0)  # any time is too long
            keep(ledger, 1, 2)
            assert "ledger-stalled" in notices.active
        wait_for(lambda: "ledger-stalled" not in notices.active)
    assert told.count("ledger-stalled") == told.count("ledger-back") == 1


def test_what_is_shown_by_force_is_an_event_of_its_ledger(tmp_path, small_bench):
    path = tmp_path / "run.mcap"
    forced = replace(small_bench, output={"forced": ["it is scaled"]})
    with optional_ledger(path, forced, Notices(), overwrite=False, split=SplitLimits()):
        pass
    (event,) = read_events(path)
    assert (event.kind, event.detail) == ("forced", "it is scaled: shown anyway (--force)")


@pytest.mark.parametrize(("ended_by", "waited_s"), [(None, "0.2"), ("SIGTERM", "0.1")])
def test_the_end_of_a_run_waits_for_its_disk_and_a_stopped_one_less(
    tmp_path, small_bench, monkeypatch, ended_by, waited_s
):
    monkeypatch.setattr(ledger_module, "DISK_WAITS_S", 0.2)
    monkeypatch.setattr(ledger_module, "STOPPED_DISK_WAITS_S", 0.1)
    monkeypatch.setattr(ledger_module, "caught", lambda: ended_by)
    taken = threading.Event()
    ledger = Ledger(tmp_path / "run.mcap", small_bench)
    finish = ledger._writer.finish

    def finish_later() -> None:
        taken.wait()
        finish()

    monkeypatch.setattr(ledger._writer, "finish", finish_later)
    ledger.close()
    taken.set()
    ledger._thread.join()
    assert f"did not take its last messages within {waited_s} s" in ledger.failure


def test_a_split_ledger_that_cannot_go_on_elsewhere_stays_and_says_so(
    tmp_path, small_bench, monkeypatch
):
    """Its next part's name is taken by a folder."""
    notices = Notices()
    told: list[str] = []
    notices.listen(lambda notice: told.append(notice.kind))
    (tmp_path / "run.0001.mcap").mkdir()
    split = SplitLimits(bytes=1.0)
    with Ledger(tmp_path / "run.mcap", small_bench, notices, split=split) as ledger:
        keep(ledger, 0, 5)
        wait_for(lambda: "ledger-split-failed" in told)
        keep(ledger, 5, 8)
    assert "files" not in ledger.summary() and ledger.summary()["unrecorded"] == 0
    frames = [json.loads(data)["frame"] for data in of_topic(tmp_path / "run.mcap", "/frame")]
    assert frames == list(range(8))


class LedgerTime:
    """The clock of a ledger, which stands until it is moved, and the turns of its writer."""

    def __init__(self, monkeypatch) -> None:
        self.now_s = 1000.0
        self._turns = 0
        monkeypatch.setattr(ledger_module, "FLUSH_S", 0.002)
        clock = SimpleNamespace(
            monotonic=lambda: self.now_s, monotonic_ns=time.monotonic_ns, time_ns=time.time_ns
        )
        monkeypatch.setattr(ledger_module, "time", clock)
        take = LedgerQueue.take

        def counted(queue: LedgerQueue) -> list[QueueEntry]:
            self._turns += 1
            return take(queue)

        monkeypatch.setattr(LedgerQueue, "take", counted)

    def pass_by(self, seconds: float) -> None:
        """Let time pass, and the writer see it."""
        self.now_s += seconds
        before = self._turns
        wait_for(lambda: self._turns > before + 2)


def test_a_ledger_that_is_split_by_its_age_begins_each_part_anew(
    tmp_path, small_bench, monkeypatch
):
    passing = LedgerTime(monkeypatch)
    path = tmp_path / "run.mcap"
    files = []
    with Ledger(path, small_bench, split=SplitLimits(seconds=60.0)) as ledger:
        for seconds in (59.0, 2.0, 57.0, 0.0, 3.0):
            passing.pass_by(seconds)
            files.append(ledger.summary().get("files", 1))
    assert files == [1, 2, 2, 2, 3]


@pytest.mark.parametrize("split", [SplitLimits(bytes=1.0), SplitLimits(seconds=5.0)])
def test_a_part_that_cannot_be_begun_is_tried_again_a_minute_later(
    tmp_path, small_bench, monkeypatch, split
):
    """And not five times a second, with an event each time."""
    passing = LedgerTime(monkeypatch)
    notices = Notices()
    taken = tmp_path / "run.0001.mcap"
    taken.mkdir()
    tried = []
    with Ledger(tmp_path / "run.mcap", small_bench, notices, split=split) as ledger:
        for seconds in (6.0, 0.0, 50.0, 12.0):
            passing.pass_by(seconds)
            tried.append(notices.counts()["ledger-split-failed"])
        taken.rmdir()
        passing.pass_by(61.0)
        assert ledger.summary()["files"] >= 2
    assert tried == [1, 1, 1, 2]


def test_a_ledger_that_is_harmed_again_and_again_rests_twice_as_long(
    tmp_path, small_bench, monkeypatch
):
    """One second, two, and at most three."""
    monkeypatch.setattr(ledger_module, "MAX_REST_S", 3.0)
    passing = LedgerTime(monkeypatch)
    notices = Notices()
    rested_s = []
    with Ledger(tmp_path / "run.mcap", small_bench, notices) as ledger:
        for harmed in range(1, 5):
            ledger.path.unlink()
            passing.pass_by(0.0)
            begun_s = passing.now_s
            while notices.counts().get("ledger-lost", 0) < harmed and passing.now_s < begun_s + 9:
                passing.pass_by(0.5)
            rested_s.append(passing.now_s - begun_s)
    assert rested_s == [0.0, 1.5, 2.5, 3.5]


def test_a_ledger_needs_no_new_file_once_it_has_begun(tmp_path, small_bench):
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with Ledger(tmp_path / "run.mcap", small_bench) as ledger:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        try:
            keep(ledger, 0, 10)
            time.sleep(1.5)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert ledger.failure is None
    assert (
        len([topic for topic, _ in read_topics(tmp_path / "run.mcap") if topic == "/process"]) >= 2
    )


def bomb(claimed: int, size: int) -> bytes:
    data = bytes(size)
    builder = RecordBuilder()
    Header("", "x").write(builder)
    Chunk("zstd", zstandard.compress(data), 0, 0, zlib.crc32(data), claimed).write(builder)
    return MCAP0_MAGIC + builder.end() + b"  "


@pytest.mark.parametrize(
    ("claimed", "word"),
    [
        (100_000_000, "at most 64 MB are unpacked"),
        (1000, "more than the 1000"),
        (50_000_000, "times"),
    ],
)
def test_a_small_file_that_unpacks_to_a_large_one_is_refused(tmp_path, claimed, word):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(claimed, 100_000_000 if claimed != 50_000_000 else 50_000_000))
    assert path.stat().st_size < 33_000
    with pytest.raises(InputError, match=word):
        read_log(path)


TOPICS = [f"/{letter}" for letter in "abcdefghijklm"]


@pytest.mark.parametrize(
    ("topics", "listed"),
    [
        (["/imu"], "/imu"),
        (["/imu", "/gps"], "/gps, /imu"),
        (TOPICS[:12], ", ".join(TOPICS[:12])),
        (TOPICS, f"{', '.join(TOPICS[:12])}, ..."),
    ],
)
def test_an_mcap_without_attitudes_lists_its_topics(tmp_path, topics, listed):
    file = io.BytesIO()
    writer = Writer(file)
    writer.start(library="test")
    for topic in topics:
        writer.add_message(writer.register_channel(topic, "json", 0), 1, b"{}", 1)
    writer.finish()
    (tmp_path / "other.mcap").write_bytes(file.getvalue())
    line = refusal(read_log, tmp_path / "other.mcap")
    assert f"contains no attitude; its topics are {listed}, and only " in line


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"q": [2, 0, 0, 0]}, "norm"),
        ({"rate": [1e9, 0, 0]}, "rate"),
        ({"swap_ns": -5}, "Expected"),
        ({"t_ns": 2**70}, "Expected|range"),
        ({"velocity_km_s": [2e5, 0, 2.5e5]}, "a velocity over"),
        ({"place_km": [300, 0, 400]}, "a place beyond"),
        ({"place_km": [0, 3e9, 4e9]}, "a place beyond"),
    ],
)
def test_a_frame_that_the_wire_would_refuse_is_refused_with_its_number(tmp_path, wrong, word):
    form = {"frame": 1, "t_ns": 1, "light_ns": 1, "draw_ns": 1, "swap_ns": 2, "q": [1, 0, 0, 0]}
    path = frames_file(tmp_path, [form, form | wrong])
    with pytest.raises(InputError, match=f"run.mcap: message 2.*{word}"):
        list(drawable_frames(path))


def test_records_come_in_blocks_of_the_size_that_is_asked_for(tmp_path):
    form = {"t_ns": 1, "light_ns": 1, "draw_ns": 1, "swap_ns": 2}
    path = frames_file(tmp_path, [form | {"frame": number} for number in range(5)])
    blocks = [[record.frame for record in block] for block in run_blocks(path, 2)]
    assert blocks == [[0, 1], [2, 3], [4]]


def frames_file(tmp_path, forms):
    file = io.BytesIO()
    writer = Writer(file)
    writer.start(library="test")
    channel = writer.register_channel("/frame", "json", 0)
    for form in forms:
        writer.add_message(channel, 1, json.dumps(form).encode(), 1)
    writer.finish()
    (tmp_path / "run.mcap").write_bytes(file.getvalue())
    return tmp_path / "run.mcap"


def test_a_report_of_absurd_times_is_a_report(tmp_path):
    form = {"light_ns": 1, "draw_ns": 1, "q": [1, 0, 0, 0]}
    times = (0, 10**18, 5, 2**62, 7)
    path = frames_file(
        tmp_path,
        [
            form | {"frame": k, "t_ns": -(2**63) if k % 2 else t, "swap_ns": t}
            for k, t in enumerate(times)
        ],
    )
    assert summarise(figures_of(path)).frames == 5


def test_a_report_s_memory_does_not_grow_with_the_run():
    figures, known = RunFigures({}), {"light_ns": 1, "draw_ns": 0, "q": (1.0, 0.0, 0.0, 0.0)}
    for begin in range(0, 140_000, 7000):
        figures.add(
            *(
                FrameRecord(
                    frame=k, t_ns=k, swap_ns=16_666_667 * k, missed_before=int(k == 70_000), **known
                )
                for k in range(begin, begin + 7000)
            )
        )
    assert figures.counted["frames"] == 140_000
    assert len(figures.samples.rows) <= 1 << 16 and figures.samples.stride == 4
    assert figures.spreads["interval"].percentile(50) == pytest.approx(16.667, rel=2e-3)
    begin, (_, _, lost) = figures.spans.begin, figures.spans.column(6)
    assert begin[lost > 0] == pytest.approx(70_000 / 60, abs=1.1)


def test_refused_packets_are_counted_by_reason(tmp_path, small_bench):
    with Ledger(tmp_path / "run.mcap", small_bench) as ledger:
        for k in range(500):
            ledger.packet(
                1000 + k, b"x" * 5000, None, Refusal("crc" if k % 5 else "norm", "d" * 5000)
            )
    figures_messages = [
        (topic, json.loads(data)) for topic, data in read_topics(tmp_path / "run.mcap")
    ]
    whole = [each for topic, each in figures_messages if topic == "/attitude"]
    counted = {
        each["reason"]: each["count"] for topic, each in figures_messages if topic == "/not_kept"
    }
    assert len(whole) == 40
    assert {each["reason"] for each in whole} == {f"{why}: {'d' * 200}" for why in ("crc", "norm")}
    assert counted == {"crc": 380, "norm": 80}
    assert max(len(each["raw"]) for each in whole) == 2048


def test_what_a_flood_left_out_is_counted_and_pulses_and_losses_are_no_messages(
    tmp_path, small_bench
):
    with Ledger(tmp_path / "run.mcap", small_bench) as ledger:
        for _ in range(7):
            ledger.pulse("sent")
        ledger.lost(5)
        ledger._filter.count("packet", "crc", 80)
    assert ledger.summary()["only_counted"] == 80
    assert ledger.summary()["unrecorded"] == 0


def test_a_flood_of_one_reason_leaves_the_first_packets_of_another():
    flood = FloodFilter()
    kept = [flood.keeps("packet", "crc", 0) for _ in range(100)]
    assert sum(kept) == 20  # of a burst
    assert flood.keeps("packet", "norm", 0)
    assert flood.counted() == {("packet", "crc"): 80}
    assert not flood.keeps("packet", "crc", 1)
    assert flood.counted() == {("packet", "crc"): 1}  # since the last call
