"""calibrate alignment: a misaligned bench, what its tracker reports, and the same tracker after
the correction.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import hilstar
from hilstar.basics.rotation import (
    angle_between_rad,
    from_radec_roll_deg,
    from_rotation_vector,
    from_rotation_vectors,
    multiply,
    normalise,
    propagate,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.geometry import (
    ErrorTable,
    MadeTable,
    Notes,
    load_geometry,
    load_notes,
    monitor_camera,
    write_geometry,
)
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.twin import true_geometry
from hilstar.optics.camera import Lens
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import NO_MISALIGNMENT, tracker_camera
from hilstar.server.record.ledger import Ledger
from hilstar.server.record.ledger_records import FrameRecord
from tests.support.alignment import HEADER, reported, write_pairs
from tests.support.benches import TWIN, bench_text
from tests.support.commands import assert_refused, run_hilstar_here, typed

# 1020 arcsec across the boresight, 1815 about it
TRUE_Q = normalise(np.array([1.0, 0.0021, -0.0013, 0.0044]))
ATTITUDES = [
    from_radec_roll_deg(*angles)
    for angles in [(84, -1, 0), (83, 2, 70), (187, -60, 140), (56, 24, 250), (280, 38, 300)]
]
# Rotations are found to rounding, and the lens is undone to 1e-8 px of 12 arcsec.
EXACT_ARCSEC = 1e-3
NOISE_ARCSEC = np.array([3.0, 3.0, 20.0])


def true_q_bench(folder, name, true_q=TRUE_Q, **collimator):
    verify = {} if true_q is None else {"verify": {"true_q_cam_to_mon": true_q.tolist()}}
    path = folder / name
    path.write_text(
        bench_text(TWIN, {"monitor": {"pixel_pitch_um": 57.65}, "collimator": collimator}, verify)
    )
    return path


def bench_and_truth(folder, lens):
    """A bench file that is wrong about its alignment, and how the bench truly stands."""
    if lens is None:
        path = true_q_bench(
            folder,
            "bench.toml",
            q_cam_to_mon=normalise(np.array([1.0, 0.0005, 0.001, 0.0])).tolist(),
        )
        with hilstar.load(path) as bench:
            return path, true_geometry(bench, tracker_camera(bench.config.tracker, folder))
    camera = monitor_camera((640, 480), 57.65, 121.0, NO_MISALIGNMENT, (325.0, 236.0))
    camera = replace(camera, lens=lens)
    wrong = normalise(np.array([1.0, -0.0002, 0.0008, -0.001]))
    write_geometry(
        folder / "lens.toml",
        camera,
        wrong,
        Notes({"k1": 0.01}, ErrorTable(rms_arcsec=0.1), MadeTable(when="2026-01-02", poses=2)),
    )
    write_geometry(folder / "truth.toml", camera, TRUE_Q, Notes({}, ErrorTable(), MadeTable()))
    path = true_q_bench(folder, "bench.toml", None, geometry="lens.toml")
    tracker = tracker_camera(read_bench_file(path).config.tracker, folder)
    return path, BenchGeometry(load_geometry(folder / "truth.toml", (640, 480)), tracker)


@pytest.mark.parametrize(
    "lens", [None, Lens((0.4, 0.0, 0.0), (0.002, -0.001), (0.02, -0.01))], ids=["ideal", "lens"]
)
def test_with_the_file_that_is_written_the_tracker_reports_what_is_commanded(tmp_path, lens):
    path, true = bench_and_truth(tmp_path, lens)
    with hilstar.load(path) as bench:
        before = [reported(bench, true, q) for q in ATTITUDES]
    assert (
        min(angle_between_rad(a, b) for a, b in zip(before, ATTITUDES, strict=True))
        * ARCSEC_PER_RAD
        > 1000
    )
    pairs = write_pairs(tmp_path / "pairs.csv", ATTITUDES, before)
    result = run_hilstar_here(
        "calibrate", "alignment", path, pairs, "-o", tmp_path / "geometry.toml", "--json"
    )
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["residual_arcsec"]["cross"] < EXACT_ARCSEC
    assert (
        angle_between_rad(np.array(summary["q_cam_to_mon"]), TRUE_Q) * ARCSEC_PER_RAD < EXACT_ARCSEC
    )
    with hilstar.load(
        true_q_bench(tmp_path, "aligned.toml", None, geometry="geometry.toml")
    ) as bench:
        after = [reported(bench, true, q) for q in ATTITUDES]
    assert (
        max(angle_between_rad(a, b) for a, b in zip(after, ATTITUDES, strict=True)) * ARCSEC_PER_RAD
        < EXACT_ARCSEC
    )
    notes = load_notes(tmp_path / "geometry.toml")
    assert notes.made.pairs == notes.made.pairs_used == 5
    assert notes.sigma["rotation_z_arcsec"] == summary["sigma_arcsec"][2]
    kept = (notes.sigma.get("k1"), notes.error.rms_arcsec, notes.made.poses)
    assert kept == ((None, None, None) if lens is None else (0.01, 0.1, 2))
    assert load_geometry(tmp_path / "geometry.toml", (640, 480)).lens == (lens or Lens())


def test_a_lens_that_the_bench_does_not_know_is_no_rotation_and_the_summary_says_so(tmp_path, rng):
    path = true_q_bench(tmp_path, "bench.toml", None)
    with hilstar.load(path) as bench:
        lens = Lens((0.6, 0.0, 0.0), (0.004, -0.002), (0.02, 0.0))
        true = BenchGeometry(
            replace(bench.camera, lens=lens), tracker_camera(bench.config.tracker, tmp_path)
        )
        seen = np.repeat([reported(bench, true, q) for q in ATTITUDES], 6, axis=0)
    noise = from_rotation_vectors(rng.normal(size=(30, 3)) * [1.0, 1.0, 5.0] / ARCSEC_PER_RAD)
    pairs = write_pairs(
        tmp_path / "pairs.csv", np.repeat(ATTITUDES, 6, axis=0), multiply(noise, seen)
    )
    result = run_hilstar_here(
        "calibrate", "alignment", path, pairs, "-o", tmp_path / "g.toml", "--json"
    )
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["repeat_arcsec"]["cross"] == pytest.approx(1.0, rel=0.3)
    assert summary["unexplained_arcsec"]["cross"] > 3 * summary["repeat_arcsec"]["cross"]
    assert any(
        "a rotation does not explain" in note and "with dots" in note for note in summary["notes"]
    )


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A bench, and 300 pairs of which three are wild."""
    folder = tmp_path_factory.mktemp("alignment")
    bench = true_q_bench(folder, "bench.toml", None)
    rng = np.random.default_rng(8)
    commanded = normalise(rng.normal(size=(300, 4)))
    noise = from_rotation_vectors(rng.normal(size=(300, 3)) * NOISE_ARCSEC / ARCSEC_PER_RAD)
    seen = multiply(noise, multiply(from_rotation_vector(np.array([2e-3, -1e-3, 5e-3])), commanded))
    seen[[10, 100, 299]] = normalise(rng.normal(size=(3, 4)))
    return bench, write_pairs(folder / "pairs.csv", commanded, seen)


def test_one_percent_of_wild_ones_is_named_by_row(measured, tmp_path):
    bench, pairs = measured
    result = run_hilstar_here(
        "calibrate", "alignment", bench, pairs, "-o", tmp_path / "g.toml", "--json"
    )
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert (summary["pairs"], summary["used"], summary["wild"]) == (300, 297, 3)
    assert summary["wild_rows"] == [12, 102, 301]
    error = np.array(summary["rotation_arcsec"]) - np.array([2e-3, -1e-3, 5e-3]) * ARCSEC_PER_RAD
    assert np.abs(error / NOISE_ARCSEC).max() < 4 / np.sqrt(297)
    assert summary["written"] == [str(tmp_path / "g.toml")]
    lines = run_hilstar_here(
        "calibrate", "alignment", bench, pairs, "-o", tmp_path / "g.toml"
    ).stdout
    assert "3, on lines 12, 102, 301" in lines
    assert "no attitude was repeated" in lines


@pytest.fixture(scope="module")
def run_of_a_slew(tmp_path_factory):
    """A ledger of a slew at 0.5 deg/s at 50 Hz, with a blank second, and telemetry at 4 Hz whose
    clock is 0.04 s late.
    """
    folder = tmp_path_factory.mktemp("slew")
    bench = true_q_bench(folder, "bench.toml", None)
    rate = np.radians([0.3, -0.4, 0.1])

    def shown(t_s):
        return propagate(ATTITUDES[0], rate, t_s)

    with hilstar.load(bench) as opened, Ledger(folder / "run.mcap", opened) as ledger:
        for k in range(1000):
            t_ns = 10**15 + k * NS_PER_S // 50
            q = None if 500 <= k < 550 else tuple(shown(k / 50).tolist())
            ledger.frame(
                FrameRecord(frame=k, t_ns=t_ns, light_ns=t_ns, draw_ns=k, swap_ns=k + 1, q=q)
            )
    turned = from_rotation_vector(np.array([1e-3, 2e-3, -3e-3]))
    rows = ["t_s,qw,qx,qy,qz,valid"]
    for k in range(90):
        t_s = k / 4 - 1
        q = multiply(turned, shown(t_s + 0.04)) * (-1.0 if k % 3 else 1.0)
        rows.append(
            ",".join(
                [
                    repr(1e6 + t_s),
                    *(map(repr, q.tolist()) if k != 40 else ["nan"] * 4),
                    "0" if k == 40 else "1",
                ]
            )
        )
    (folder / "telemetry.csv").write_text("\n".join(rows) + "\n")
    return bench, folder / "run.mcap", folder / "telemetry.csv"


def test_a_ledger_says_what_was_commanded_at_the_moment_of_light(run_of_a_slew, tmp_path):
    bench, ledger, telemetry = run_of_a_slew
    wanted = typed(
        f"calibrate alignment {bench} {telemetry} --ledger {ledger} -o {tmp_path}/g.toml --json"
    )
    late, right = (
        json.loads(run_hilstar_here(*wanted, *more).stdout) for more in ((), ("--offset-s", "0.04"))
    )
    assert right["rotation_arcsec"] == pytest.approx(
        np.array([1e-3, 2e-3, -3e-3]) * ARCSEC_PER_RAD, abs=0.01
    )
    assert right["residual_arcsec"]["cross"] < 0.01
    assert right["pairs"] + right["skipped"] == 90
    # before and after the run, the blank second, and the one that is not valid
    assert 12 <= right["skipped"] <= 16
    assert late["rotation_arcsec"] != pytest.approx(right["rotation_arcsec"], abs=10)


def test_a_ledger_that_was_cut_short_is_used_and_said_in_one_line(run_of_a_slew, tmp_path):
    bench, ledger, telemetry = run_of_a_slew
    cut, whole = tmp_path / "cut.mcap", ledger.read_bytes()
    cut.write_bytes(whole[:-50])  # what is whole is one chunk, of all frames
    aligned = typed(
        f"calibrate alignment {bench} {telemetry} --ledger {cut} -o {tmp_path}/g.toml "
        "--offset-s 0.04"
    )
    for command in (aligned, ("report", cut, "-o", tmp_path / "report")):
        result = run_hilstar_here(*command, "--json")
        assert result.returncode == 0, result.stderr
        assert json.loads(result.stdout)
        (line,) = result.stderr.splitlines()
        assert f"{cut} has no end" in line


def row(text, number, value, column):
    lines = text.splitlines()
    cells = lines[number].split(",")
    cells[column] = value
    lines[number] = ",".join(cells)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("tw", "rw"), ("pairs.csv:1", "tw is missing", "scalar first")),
        (lambda text: text.replace("tw", "qw"), ("pairs.csv:1", "qw is there twice")),
        (lambda text: HEADER + "\n", ("0 pairs", "3 are needed")),
        (lambda text: "", ("qw is missing",)),
        (lambda text: "\n".join(text.splitlines()[:3]) + "\n", ("2 pairs", "3 are needed")),
        (lambda text: row(text, 4, "nan", 5), ("pairs.csv:5", "tx", "finite")),
        (lambda text: row(text, 4, "word", 0), ("pairs.csv:5", "qw", "word")),
        (lambda text: row(text, 4, "3", 0), ("pairs.csv:5", "norm", "qw,qx,qy,qz")),
        (lambda text: text.replace(HEADER, "qw,qx,qy,qz,tx,ty,tz,tw"), ("scalar", "first")),
        (lambda text: text + "1,0,0\n", ("pairs.csv:302", "3 cells")),
        (
            lambda text: text.replace("\n", ",perhaps\n").replace("tz,perhaps", "tz,valid"),
            ("valid = 'perhaps'", "1 or 0"),
        ),
    ],
)
def test_pairs_that_are_none_get_one_line(measured, tmp_path, change, words):
    bench, pairs = measured
    path = tmp_path / "pairs.csv"
    path.write_text(change(pairs.read_text()))
    result = run_hilstar_here("calibrate", "alignment", bench, path, "-o", tmp_path / "g.toml")
    assert_refused(result, 2, *words)
    assert not (tmp_path / "g.toml").exists()


def test_options_that_do_not_fit_get_one_line(measured, run_of_a_slew, tmp_path):
    bench, pairs = measured
    _, ledger, telemetry = run_of_a_slew
    wanted = ("calibrate", "alignment", bench)
    out = ("-o", tmp_path / "g.toml")
    assert_refused(
        run_hilstar_here(*wanted, pairs, *out, "--offset-s", "1"), 2, "--offset-s", "--ledger"
    )
    assert_refused(run_hilstar_here(*wanted, pairs, *out, "--ledger", ledger), 2, "t_s is missing")
    assert_refused(
        run_hilstar_here(*wanted, telemetry, *out, "--ledger", pairs),
        2,
        "pairs.csv: is no MCAP file",
    )
    assert_refused(
        run_hilstar_here(*wanted, telemetry, *out, "--ledger", ledger, "--offset-s", "99"),
        2,
        "meet no frame",
        "--offset-s",
    )
    assert_refused(run_hilstar_here(*wanted, pairs, "-o", pairs), 2, "pairs.csv")
    assert_refused(run_hilstar_here(*wanted, pairs, "-o", tmp_path / "g.csv"), 2, "TOML")
