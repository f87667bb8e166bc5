"""Pictures in a report are the codes that the run showed, or it says in a line why there are
none.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from PIL import Image

from hilstar.attitude.logs.mcap_log import NO_END
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.frame import Bench
from hilstar.server.console.report import _bench_file, report, run_pictures
from hilstar.server.record.ledger import Ledger
from hilstar.server.record.ledger_records import FaultRecord, FrameRecord
from hilstar.server.record.run_figures import RunFigures
from tests.support.benches import ORION_Q, SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.run_page import levels_of, run_data_of

pytestmark = pytest.mark.gpu
RATE = (0.0, 0.02, 0.0)


def attitude_of_frame(k: int) -> tuple[float, ...]:
    return tuple(
        multiply(from_rotation_vector(np.array([0.0, 1e-3 * k, 0.0])), np.array(ORION_Q)).tolist()
    )


@pytest.fixture
def pictures_ledger(bench_with, tmp_path) -> tuple[Path, Bench]:
    """40 frames of a turn, the first without an attitude."""
    bench = bench_with()
    with Ledger(tmp_path / "run.mcap", bench) as written:
        for k in range(40):
            q, rate = (None, None) if k == 0 else (attitude_of_frame(k), RATE)
            written.frame(
                FrameRecord(
                    frame=k, t_ns=k, light_ns=k, draw_ns=k, swap_ns=10**9 + k, q=q, rate=rate
                )
            )
    return tmp_path / "run.mcap", bench


def test_pictures_are_the_codes_of_the_run(pictures_ledger, tmp_path):
    path, bench = pictures_ledger
    report(path, tmp_path)
    data = run_data_of((tmp_path / "report.html").read_text())
    pictures = data["pictures"]
    assert [picture["frame"] for picture in pictures] == sorted(
        {picture["frame"] for picture in pictures}
    )
    assert pictures[0]["frame"] == 0 and pictures[-1]["frame"] == 39 and len(pictures) >= 8
    assert pictures[0]["truth"] is None and not levels_of(pictures[0]).any()
    for picture in pictures[1:]:
        shown = bench.draw(
            np.array(attitude_of_frame(picture["frame"])), picture["frame"], RATE
        ).levels
        assert np.array_equal(levels_of(picture), shown) and shown.any()
        x, y, *_ = picture["truth"]["stars"][0]
        about = shown[round(y) - 1 : round(y) + 2, round(x) - 1 : round(x) + 2]
        assert about.max() > shown.max() / 2 > 50  # the brightest star is where the overlay says
    assert data["sky"]["stars"] and data["caution"] == ""


def test_a_frame_that_stayed_as_the_one_before_has_no_picture(bench_with, tmp_path):
    table = {"name": "stay", "kind": "freeze", "for_s": 1.0}
    stay = FaultRecord(
        host_ns=1, event="start", number=4, name="stay", kind="freeze", who="", t_ns=9,
        table=json.dumps(table),
    )  # fmt: skip
    path = tmp_path / "run.mcap"
    with Ledger(path, bench_with()) as written:
        written.fault(stay)
        for k in range(30):
            record = FrameRecord(
                frame=k, t_ns=k, light_ns=k, draw_ns=k, swap_ns=k, q=attitude_of_frame(k)
            )
            record.faults = (4,) if 9 <= k < 30 else ()
            written.frame(record)
    report(path, tmp_path)
    pictures = run_data_of((tmp_path / "report.html").read_text())["pictures"]
    assert pictures and all(picture["frame"] < 9 for picture in pictures)


def test_pictures_have_the_faults_that_the_run_had(tmp_path):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH)
    (tmp_path / "faults.toml").write_text(
        '[[fault]]\nname = "ghost"\nkind = "false-star"\nat_s = 0.0\nfor_s = 9.0\nradec_deg ='
        " [84.05, -1.2]\nv_mag = 2.0\n"
    )
    rows = "\n".join(f"{t_s},{','.join(map(repr, ORION_Q))}" for t_s in (0.0, 0.5))
    (tmp_path / "log.csv").write_text(f"t_s,qw,qx,qy,qz\n{rows}\n")
    speed = ("--headless", "--speed", "max", "-o", tmp_path / "frames")
    files = [tmp_path / name for name in ("bench.toml", "log.csv")]
    faulty = ("--scenario", tmp_path / "faults.toml", "--ledger", tmp_path / "run.mcap")
    assert run_hilstar_here("replay", *files, *speed, *faulty).returncode == 0
    report(tmp_path / "run.mcap", tmp_path)
    pictures = run_data_of((tmp_path / "report.html").read_text())["pictures"]
    assert len(pictures) >= 8
    for picture in pictures:
        shown = np.array(Image.open(tmp_path / "frames" / f"frame_{picture['frame']:06d}.png"))
        assert np.array_equal(levels_of(picture), shown if shown.ndim == 2 else shown[..., 0])
    run_hilstar_here("replay", *files, *speed)
    sound = np.array(Image.open(tmp_path / "frames" / "frame_000000.png"))
    assert (levels_of(pictures[0]) != (sound if sound.ndim == 2 else sound[..., 0])).any()


def test_a_bench_that_has_changed_since_draws_with_a_caution_and_one_that_is_gone_says_why_not(
    bench_with, tmp_path
):
    bench = bench_with('[verify]\ntrue_calibration = "truth.toml"\n')
    with Ledger(tmp_path / "run.mcap", bench) as written:
        written.frame(
            FrameRecord(frame=0, t_ns=0, light_ns=0, draw_ns=0, swap_ns=1, q=attitude_of_frame(0))
        )
    (tmp_path / "truth.toml").write_text("# the bench's hash covers every file that it names\n")
    report(tmp_path / "run.mcap", tmp_path)
    data = run_data_of((tmp_path / "report.html").read_text())
    assert len(data["pictures"]) == 1 and "Codes may differ" in data["caution"]
    figures = RunFigures({"bench_text": "[monitor]\n"})
    none = run_pictures(figures, tmp_path / "run.mcap")
    assert none["pictures"] == [] and "bench.toml" in none["no_pictures"]
    assert none["sky"].stars[0].label == "α CMa"
    there = tmp_path / "there" / "bench.toml"
    gone = run_pictures(
        RunFigures({"bench_text": "[monitor]\n", "bench_file": str(there)}), tmp_path / "run.mcap"
    )
    assert str(there) in gone["no_pictures"]


def test_the_files_of_a_bench_are_those_of_its_run_else_those_beside_the_bench_file(tmp_path):
    """Not beside the ledger, where both have changed since."""
    text = SMALL_BENCH + '[verify]\ntrue_calibration = "truth.toml"\n'
    paths = [tmp_path / folder / "bench.toml" for folder in ("bench", "ledger")]
    for path in paths:
        path.parent.mkdir()
        (path.parent / "truth.toml").write_text(f"# in {path.parent.name}\n")
    hashes = [bench_file_of(path, text).sha256 for path in paths]
    head = {"bench_text": text, "bench_file": str(paths[0])}
    for sha256, path in ((hashes[0], paths[0]), (hashes[1], paths[1]), ("another", paths[0])):
        found = _bench_file(head | {"bench_sha256": sha256}, paths[1].with_name("run.mcap"))
        assert found.path == path


def test_of_a_ledger_that_was_cut_off_what_is_whole_is_reported_and_the_page_says_so(
    pictures_ledger, tmp_path
):
    path, _ = pictures_ledger
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-400])
    assert report(tmp_path / "cut.mcap", tmp_path).frames == 40
    data = run_data_of((tmp_path / "report.html").read_text())
    assert data["facts"][0] == ["no end", f"cut.mcap {NO_END}"]


ABSURD = {
    "times beyond all clocks": {"age_ns": -(2**63), "prediction_ns": 2**63 - 1},
    "a rate that nothing has": {"rate": [1e300, 0, 0]},
    "a speed over light's": {"velocity_km_s": [1e9, 0, 0]},
}


@pytest.mark.parametrize("absurd", ABSURD)
@pytest.mark.filterwarnings("error")
def test_a_foreign_ledger_of_absurd_figures_is_reported_without_a_word_too_many(tmp_path, absurd):
    form = {"light_ns": 1, "draw_ns": 1, "q": [1, 0, 0, 0]} | ABSURD[absurd]
    records = [
        (
            "/event",
            {"host_ns": 2**62, "kind": "<script>", "detail": "\0</script>", "who": "x" * 9999},
        )
    ]
    records += [
        ("/process", {"host_ns": k, "resident_bytes": 1, "cpu_s": 1e308 * (k - 1)})
        for k in range(3)
    ]
    for k, swap_ns in enumerate((0, 10**18, 5, 2**62, 7)):
        records.append(
            ("/frame", form | {"frame": k, "t_ns": (-1) ** k * (2**63 - 1), "swap_ns": swap_ns})
        )
    path = foreign_ledger(tmp_path, records)
    result = run_hilstar_here("report", path, "-o", tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    data = run_data_of((tmp_path / "report.html").read_text())
    assert len(data["path"]["t_s"]) == 5 and data["events"][0]["kind"] == "<script>"


def test_a_frame_without_an_attitude_s_norm_is_refused_by_its_number(tmp_path):
    path = foreign_ledger(
        tmp_path,
        [
            (
                "/frame",
                {
                    "frame": 0,
                    "t_ns": 0,
                    "light_ns": 0,
                    "draw_ns": 0,
                    "swap_ns": 1,
                    "q": [0, 0, 0, 0],
                },
            )
        ],
    )
    result = run_hilstar_here("report", path, "-o", tmp_path / "report")
    assert_refused(result, 2, "message 1, of /frame: the quaternion's norm is 0")


def foreign_ledger(folder: Path, records: list[tuple[str, dict[str, Any]]]) -> Path:
    """A ledger of the small bench that hilstar has not written."""
    file = io.BytesIO()
    writer = Writer(file)
    writer.start(library="test")
    head = {
        "bench_text": SMALL_BENCH,
        "bench_file": "bench.toml",
        "unix_ns": "<b>",
        "monotonic_ns": "9" * 400,
    }
    writer.add_metadata("hilstar", head)
    channels = {topic: writer.register_channel(topic, "json", 0) for topic, _ in records}
    for topic, record in records:
        writer.add_message(channels[topic], 1, json.dumps(record).encode(), 1)
    writer.finish()
    (folder / "foreign.mcap").write_bytes(file.getvalue())
    return folder / "foreign.mcap"
