"""What a run tells, counts and records of its faults, and which of them a replay has again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.optics.layers.fault_kinds import Now
from hilstar.server import faults
from hilstar.server.bench.build import load
from hilstar.server.bench.config.attitude import FaultSettings
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.scenario import parse_scenario
from hilstar.server.faults import MAX_NAMES, ReplayedFaults, RunFaults, act, read_recording
from hilstar.server.record.ledger_records import FaultRecord, FrameRecord
from tests.support.benches import bench_text

FRAME_NS = 20_000_000
TEXT = """
seed = 9
[[fault]]
kind = "blank"
name = "cover"
at_s = 0.1
for_s = 0.04
[[fault]]
kind = "flash"
name = "spark"
at_s = 0.1
for_s = 0.005
tracker_px = [520, 500]
electrons = 2e5
[[fault]]
kind = "light-map"
name = "stray"
at_s = 0.14
for_s = 0.1
file = "stray.npy"
[[fault]]
kind = "freeze"
name = "stuck"
"""


class Kept:
    """A ledger's records of faults."""

    def __init__(self) -> None:
        self.records: list[FaultRecord] = []

    def fault(self, record: FaultRecord) -> None:
        self.records.append(record)


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Iterator[Bench]:
    """A bench of 50 Hz."""
    path = tmp_path_factory.mktemp("bench") / "bench.toml"
    tables = {"monitor": {"refresh_hz": 50.0}, "render": {"quantisation": "round"}}
    path.write_text(bench_text(tables))
    with load(path) as opened:
        yield opened


@pytest.fixture
def scenario(tmp_path):
    np.save(tmp_path / "stray.npy", np.ones((3, 4)))
    return parse_scenario(tmp_path / "faults.toml", TEXT)


def shown(run: RunFaults, seconds: float) -> dict[int, list[str]]:
    """The names of the faults that are on by the frame, of so long a run from 7 s on."""
    on = {}
    for frame in range(round(seconds * 50)):
        now = run.schedule.at(7 * 10**9 + frame * FRAME_NS)
        if now:
            on[frame] = [active.fault.name for active in now]
    return on


def test_a_run_tells_counts_and_records_each_of_its_faults(bench, scenario, tmp_path):
    kept, notices = Kept(), Notices()
    told: list[tuple[str, str]] = []
    notices.listen(lambda notice: told.append((notice.detail, notice.who)))
    run = RunFaults(bench, scenario, notices, kept)
    run.begin(7 * 10**9)
    assert shown(run, 0.2) == {
        5: ["cover", "spark"],
        6: ["cover"],
        7: ["stray"],
        8: ["stray"],
        9: ["stray"],
    }
    run.schedule.start("stuck", "ada")
    run.schedule.at(7 * 10**9 + 10 * FRAME_NS)
    assert told == [
        ("fault cover (blank) begins, by file", ""),
        ("fault spark (flash) begins, by file", ""),
        ("fault spark (flash) ends, by file", ""),
        ("fault cover (blank) ends, by file", ""),
        ("fault stray (light-map) begins, by file", ""),
        ("fault stuck (freeze) begins, by ada", "ada"),
    ]
    whole, *events = kept.records
    assert (whole.event, whole.table, whole.seed) == ("scenario", TEXT, 9)
    assert whole.name == str(tmp_path / "faults.toml")
    found = [(each.event, each.number, each.name, each.t_ns // FRAME_NS) for each in events]
    assert found == [
        ("start", 1, "cover", 5),
        ("start", 2, "spark", 5),
        ("end", 2, "spark", 6),
        ("end", 1, "cover", 7),
        ("start", 3, "stray", 7),
        ("start", 4, "stuck", 10),
    ]
    assert {each.folder for each in kept.records} == {str(tmp_path.resolve())}
    assert [each.who for each in events] == ["file"] * 5 + ["ada"]
    sha256 = hashlib.sha256((tmp_path / "stray.npy").read_bytes()).hexdigest()
    by_name = {each.name: each.file_sha256 for each in events}
    assert by_name == {"cover": "", "spark": "", "stray": sha256, "stuck": ""}
    assert msgspec.json.decode(events[0].table)["kind"] == "blank"
    run.frames.dropped, run.frames.frozen = 1, 2
    summary = run.summary()
    assert (summary["dropped_frames"], summary["frozen_frames"]) == (1, 2)
    assert summary["started"] == {"cover": 1, "spark": 1, "stray": 1, "stuck": 1}
    assert (summary["missed"], summary["on"]) == ({}, ["stray", "stuck"])
    assert summary["scenario"] == str(tmp_path / "faults.toml")


def test_a_fault_between_two_frames_is_missed_and_not_started(bench, scenario):
    notices, kept = Notices(), Kept()
    run = RunFaults(bench, scenario, notices, kept)
    run.begin(0)
    run.schedule.at(70_000_000)
    run.schedule.at(120_000_000)  # the frame of 90 ms, which had the flash in it, was missed
    summary = run.summary()
    assert (summary["missed"], summary["started"]) == ({"spark": 1}, {"cover": 1})
    found = {(each.event, each.name) for each in kept.records[1:]}
    assert found == {("start", "cover"), ("missed", "spark")}


def test_names_beyond_a_hundred_are_counted_together(bench, tmp_path):
    table = '[[fault]]\nkind = "blank"\nname = "f{}"\nat_s = {}\nfor_s = 0.01\n'
    text = "".join(table.format(k, k * 0.02) for k in range(MAX_NAMES + 4))
    run = RunFaults(bench, parse_scenario(tmp_path / "many.toml", text), Notices())
    run.begin(0)
    for frame in range(MAX_NAMES + 6):
        run.schedule.at(frame * FRAME_NS)
    started = run.summary()["started"]
    assert len(started) == MAX_NAMES + 1 and started["others"] == 4
    assert sum(started.values()) == MAX_NAMES + 4


def recorded(scenario, numbers: dict[str, int], sha256: str = "") -> list[FaultRecord]:
    """Starts of a scenario's faults by their numbers, and an end."""
    records = []
    for fault in scenario.faults:
        table = msgspec.json.encode(faults.table_of(fault)).decode()
        records.append(
            FaultRecord(
                host_ns=5,
                event="start",
                number=numbers[fault.name],
                name=fault.name,
                kind=fault.KIND,
                who="file",
                t_ns=6,
                table=table,
                seed=scenario.seed,
                folder=str(scenario.folder),
                file_sha256=sha256 if fault.KIND == "light-map" else "",
            )
        )
    ended = msgspec.structs.replace(records[0], event="end")
    return [*records, ended]


def test_a_replay_has_the_light_of_a_run_s_faults_again_and_what_froze_it(
    bench, scenario, tmp_path
):
    """What blanked or turned a frame is in its recorded attitude already."""
    sha256 = hashlib.sha256((tmp_path / "stray.npy").read_bytes()).hexdigest()
    numbers = {"cover": 1, "spark": 2, "stray": 3, "stuck": 4}
    records = recorded(scenario, numbers, sha256)
    recording = read_recording(tmp_path / "run.mcap", records)
    assert (recording.seed, recording.folder) == (9, tmp_path)
    assert {number: fault.name for number, fault in recording.faults.items()} == {
        number: name for name, number in numbers.items()
    }
    kept = Kept()
    replay = ReplayedFaults(bench, recording, kept)
    assert kept.records == records
    assert replay.summary() == {"recorded": dict.fromkeys(numbers, 1), "frozen_frames": 0}
    frame = FrameRecord(frame=1, t_ns=0, light_ns=0, draw_ns=0, swap_ns=0)
    frame.faults, frame.fault_since_ns = (1, 2, 3, 4, 77), (5, -16_000_000, 90_000_000, 8, 9)
    replay.recall(frame)
    now = replay.frames._source(0)
    by_number = {active.number: active for active in now}
    # the flash of 5 ms begins 16 ms into the frame; the map of 100 ms ends 10 ms into it
    assert list(by_number) == [2, 3, 4]
    assert [by_number[number].share for number in (2, 3, 4)] == pytest.approx([4 / 20, 0.5, 1.0])
    assert isinstance(now[0], Now) and by_number[2].since_ns == -16_000_000
    frame.faults, frame.fault_since_ns = (), ()
    replay.recall(frame)
    assert replay.frames._source(0) == ()
    replay.frames.dropped, replay.frames.frozen = 1, 2
    assert replay.summary()["frozen_frames"] == 2


def test_another_map_than_the_run_s_is_refused(scenario, tmp_path):
    records = recorded(scenario, dict.fromkeys(("cover", "spark", "stray", "stuck"), 1), "0" * 64)
    with pytest.raises(InputError, match=r"stray.npy is not the map that the run had"):
        read_recording(tmp_path / "run.mcap", records)


@pytest.mark.parametrize(
    ("message", "calls"),
    [
        ({"start": "spark"}, [("start", "spark", "stream")]),
        ({"stop": "spark"}, [("stop", "spark", "stream")]),
        ({"kind": "blank", "name": "own"}, [("ask", "own", "stream")]),
    ],
)
def test_a_message_starts_stops_or_asks_as_the_stream_s(message, calls):
    asked: list[tuple[str, str, str]] = []
    schedule = SimpleNamespace(
        start=lambda name, who: asked.append(("start", name, who)),
        stop=lambda name, who: asked.append(("stop", name, who)),
        ask=lambda fault, who: asked.append(("ask", fault.name, who)),
    )
    act(schedule, msgspec.json.encode(message))
    assert asked == calls


def test_a_run_listens_to_the_stream_of_its_bench_file_while_it_lasts(tmp_path, bench, scenario):
    run = RunFaults(bench, scenario, Notices(), Kept())
    with run.listening(FaultSettings(), tmp_path) as endpoint:
        assert endpoint == ""
    place = f"ipc://{tmp_path}/faults"
    for _ in range(2):  # it is free again afterwards
        with run.listening(FaultSettings(endpoint=place, bind=True), tmp_path) as endpoint:
            assert endpoint == f"bound to {place}"
