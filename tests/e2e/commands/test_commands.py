"""The commands, as a user types them."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

import hilstar
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.response import encode, srgb_response
from tests.support import leftovers
from tests.support.benches import ROOT, SMALL_BENCH, still_log
from tests.support.commands import (
    HILSTAR,
    assert_refused,
    has_handlers,
    run_hilstar,
    run_hilstar_here,
)
from tests.support.senders import free_port
from tests.support.tables import csv_rows
from tests.support.waiting import PATIENCE_S, wait_for

ORION = ROOT / "configs" / "thesis-orion.toml"
ALNILAM, BETELGEUSE, RIGEL, ALNITAK = 26311, 27989, 24436, 26727


@pytest.fixture(scope="module")
def orion(tmp_path_factory):
    """The issue's frame of Orion: FITS, CSV and PNG."""
    folder = tmp_path_factory.mktemp("orion")
    result = run_hilstar_here(
        "frame", ORION, "--radec", "84.057,-1.200,0", "-o", folder / "o.fits", "--truth", folder / "o.csv",
        "--codes", folder / "o.png", "--json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder, json.loads(result.stdout)


def test_orion_is_the_right_way_up(orion):
    folder, _ = orion
    stars = {
        int(row["hip"]): (float(row["x_px"]), float(row["y_px"]))
        for row in csv_rows(folder / "o.csv")
    }
    x, y = stars[ALNILAM]
    assert np.hypot(x - 511.5, y - 511.5) < 1.0  # Alnilam is in the middle
    assert stars[BETELGEUSE][0] < 511 and stars[BETELGEUSE][1] < 511  # up left
    assert stars[RIGEL][0] > 511 and stars[RIGEL][1] > 511  # south is down, west is right
    assert stars[ALNITAK][0] < x  # east is left


def test_the_frame_s_files_agree_with_each_other(orion):
    folder, summary = orion
    rows = csv_rows(folder / "o.csv")
    first = [
        "hip",
        "x_px",
        "y_px",
        "v_mag",
        "bv",
        "temperature_k",
        "electrons_per_s",
        "drawn",
        "clipped",
    ]
    last = [
        "variable",
        "range_mag",
        "period_d",
        "double",
        "separation_arcsec",
        "name",
        "sigma_pos_mas",
        "sigma_mag",
        "ra_deg",
        "dec_deg",
    ]
    assert list(rows[0]) == [*first, *last]
    with fits.open(folder / "o.fits") as hdus:
        linear, header = hdus[0].data, hdus[0].header
        assert linear.dtype == np.dtype(">f4")
        assert linear.shape == (1024, 1024)
        assert header["BUNIT"] == "electron/s"
        assert [header[k] for k in ("QW", "QX", "QY", "QZ")] == pytest.approx(
            from_radec_roll_deg(84.057, -1.2, 0), abs=1e-15
        )
        assert header["EPOCHJYR"] == 2000.0
        assert header["CREATOR"] == f"hilstar {hilstar.__version__}"
        assert len(header["BENCHSHA"]) == 64
    inside = [r for r in rows if 6 < float(r["x_px"]) < 1017 and 6 < float(r["y_px"]) < 1017]
    assert len(inside) > 500
    # Every star's light is in the image: 1e-6 is cut, and the sum of half a million float32 pixels
    # is exact in float64.
    edge = sum(float(r["electrons_per_s"]) for r in rows if r not in inside)
    total = sum(float(r["electrons_per_s"]) for r in inside)
    assert total * (1 - 1e-5) < linear.sum(dtype=np.float64) < (total + edge) * (1 + 1e-5)
    for row in rows[:20]:
        x, y = round(float(row["x_px"])), round(float(row["y_px"]))
        peak = linear[y - 1 : y + 2, x - 1 : x + 2]
        assert peak.argmax() == 4, row["hip"]
    png = np.array(Image.open(folder / "o.png"))
    assert png.dtype == np.uint8
    assert np.array_equal(
        png, encode(linear.astype("=f4"), srgb_response(8), summary["flux_at_white_e_per_s"])
    )
    assert summary["stars"] == len(rows)
    assert {r["drawn"] for r in rows} == {"1"}
    assert {r["clipped"] for r in rows} == {"0"}


def test_the_python_road_gives_the_command_s_frame(orion):
    folder, _ = orion
    with hilstar.load(ORION) as bench:
        frame = bench.frame(from_radec_roll_deg(84.057, -1.2, 0))
    assert np.array_equal(frame.linear, fits.getdata(folder / "o.fits"))
    assert np.array_equal(frame.codes, np.array(Image.open(folder / "o.png")))
    assert frame.truth["hip"].tolist() == [int(r["hip"]) for r in csv_rows(folder / "o.csv")]


def test_a_quaternion_and_its_negative_are_the_attitude_of_its_radec(orion, tmp_path):
    folder, _ = orion
    q = from_radec_roll_deg(84.057, -1.2, 0)
    for sign in (1, -1):
        text = ",".join(repr(float(sign * c)) for c in q)
        result = run_hilstar_here("frame", ORION, f"--quaternion={text}", "-o", tmp_path / "q.fits")
        assert result.returncode == 0, result.stderr
        assert np.array_equal(fits.getdata(tmp_path / "q.fits"), fits.getdata(folder / "o.fits"))


def test_a_deep_monitor_s_codes_are_16_bit_and_left_aligned(tmp_path, small_bench_file):
    small_bench_file.write_text(SMALL_BENCH.replace("[collimator]", "bits = 10\n[collimator]"))
    result = run_hilstar_here(
        "frame", small_bench_file, "--radec", "84.057,-1.2,0", "--codes", tmp_path / "c.png"
    )
    assert result.returncode == 0, result.stderr
    png = np.array(Image.open(tmp_path / "c.png"))
    assert png.dtype == np.uint16
    assert png.max() > 255
    assert (png % 64 == 0).all()
    with hilstar.load(small_bench_file) as bench:
        assert np.array_equal(png >> 6, bench.frame(from_radec_roll_deg(84.057, -1.2, 0)).codes)


def test_clipped_stars_are_counted_and_named(tmp_path, small_bench_file):
    small_bench_file.write_text(SMALL_BENCH + "[render]\nflux_at_white_e_per_s = 5e5\n")
    result = run_hilstar_here(
        f"frame {small_bench_file} --radec 84.057,-1.2,0 --truth {tmp_path}/t.csv --json"
    )
    clipped = json.loads(result.stdout)["clipped"]
    assert {ALNILAM, ALNITAK} <= set(clipped)
    marked = {int(r["hip"]) for r in csv_rows(tmp_path / "t.csv") if r["clipped"] == "1"}
    assert marked == set(clipped)


def test_the_average_model_can_be_chosen(tmp_path, small_bench_file):
    """AGS knows no colour: two stars of one magnitude have one rate."""
    small_bench_file.write_text(SMALL_BENCH + '[sky]\nbrightness = "ags"\n')
    assert (
        run_hilstar_here(
            "frame", small_bench_file, "--radec", "84.057,-1.2,0", "--truth", tmp_path / "t.csv"
        ).returncode
        == 0
    )
    rates = {
        float(r["electrons_per_s"]) * 10 ** (0.4 * float(r["v_mag"]))
        for r in csv_rows(tmp_path / "t.csv")
    }
    assert max(rates) / min(rates) == pytest.approx(1, rel=1e-12)


WRONG = [
    ("frame none.toml --radec 1,2,3 -o x.fits", ("none.toml", "No such file")),
    ("budget none.toml", ("none.toml",)),
    ("frame bench.toml -o x.fits", ("--radec RA,DEC,ROLL", "--quaternion")),
    ("frame bench.toml --radec 1,2 -o x.fits", ("--radec 1,2", "RA,DEC,ROLL")),
    ("frame bench.toml --radec 1,95,0 -o x.fits", ("-90 to 90",)),
    ("frame bench.toml --quaternion 1,1,1,1 -o x.fits", ("norm is 2",)),
    ("frame bench.toml --quaternion nan,0,0,1 -o x.fits", ("finite",)),
    ("frame bench.toml --radec 1,2,3", ("no output", "-o OUT.fits")),
    ("frame bench.toml --radec 1,2,3 -o none/x.fits", ("none/x.fits", "cannot be written")),
    (
        "frame bench.toml --radec 1,2,3 -o x.png",
        ("-o x.png", "a FITS file is written there", "write x.fits"),
    ),
    ("frame bench.toml --radec 1,2,3 --truth x.fits", ("--truth x.fits", "CSV", "write x.csv")),
    ("frame bench.toml --radec 1,2,3 --codes x.jpg", ("--codes x.jpg", "PNG", "write x.png")),
    (
        "serve bench.toml --headless --frames 1 --ledger run.csv",
        ("--ledger run.csv", "write run.mcap"),
    ),
    ("frame bench.toml --radec 1,2,3 --truth none/x.csv", ("none/x.csv", "cannot be written")),
    ("frame bench.toml --radec 1,2,3 --codes none/x.png", ("none/x.png", "cannot be written")),
    ("replay bench.toml none.csv --headless", ("none.csv", "No such file")),
    ("replay bench.toml log.csv --headless --speed fast", ("fast", "realtime")),
    ("send", ("LOG or --spin",)),
    ("send --spin w,1", ("AXIS,DEG_PER_S",)),
    ("send --spin z,1 --to localhost", ("tcp://HOST:PORT",)),
    ("send --spin z,1 --to tcp://127.0.0.1:70000", ("tcp://HOST:PORT",)),
    ("send --spin z,1 --rate 0", ("--rate 0",)),
    ("nonsense", ("nonsense", "--help")),
    ("frame bench.toml --quaternion 1e308,1e308,0,0 -o x.fits", ("its norm is",)),
    ("serve bench.toml --headless --duration inf", ("--duration",)),
    ("send --spin z,1e300", ("AXIS,DEG_PER_S",)),
    ("send --spin z,1 --rate 1e-300", ("--rate",)),
    ("send --spin z,1 --wait inf", ("--wait",)),
    ("frame", ("BENCH.toml",)),
    ("serve bench.toml --headless --duration x", ("--duration", "number")),
    ("serve bench.toml --unknown", ("--unknown",)),
]


@pytest.mark.parametrize(("command", "words"), WRONG, ids=[command for command, _ in WRONG])
def test_a_wrong_command_gets_one_line_and_exit_code_2(tmp_path, command, words):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH)
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    assert_refused(run_hilstar_here(command, cwd=tmp_path), 2, *words)


def test_a_log_with_nan_is_refused_with_its_line(tmp_path, small_bench_file):
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,nan,0,0,0\n")
    result = run_hilstar_here("replay", small_bench_file, tmp_path / "log.csv", "--headless")
    assert_refused(result, 2, "log.csv:3", "not finite")


def test_a_stream_without_opengl_gets_one_line_and_exit_code_3(
    small_bench_file, tmp_path, no_opengl
):
    log = still_log(tmp_path / "log.csv", seconds=1)
    for words in (
        ("replay", small_bench_file, log, "--headless", "--speed", "max"),
        ("serve", small_bench_file, "--headless"),
    ):
        assert_refused(
            run_hilstar(*words, env=os.environ | no_opengl),
            3,
            "apt-get install libegl1 libgl1-mesa-dri",
        )


# by which two DN without noise may differ: float32 adds up light in another order, and the ADC
# rounds
NUMPY_DN = 2
NUMPY_OTHER = 1e-3  # of lit pixels, whose light is within rounding of a threshold


def test_without_opengl_numpy_draws_frame_and_simulate_as_opengl_does(
    small_bench_file, tmp_path, no_opengl
):
    small_bench_file.write_text(SMALL_BENCH + '[render]\nquantisation = "round"\n')
    drawn = {}
    for name, run in (
        ("gl", run_hilstar_here),
        ("numpy", partial(run_hilstar, env=os.environ | no_opengl)),
    ):
        folder = tmp_path / name
        folder.mkdir()
        at = (small_bench_file, "--radec", "84.057,-1.2,0", "--json", "-o", folder / "image.fits")
        framed = run("frame", *at, "--codes", folder / "codes.png")
        image = fits.getdata(folder / "image.fits")
        simulated = run("simulate", *at, "--noise", "none", "--slew", "0.1,0.2,0.3")
        for done in (framed, simulated):
            assert done.returncode == 0, done.stderr
            lines = [line for line in done.stderr.splitlines() if "star_sigma_ratio" not in line]
            assert len(lines) == (name == "numpy")  # which says that it is slower, and who helps
            assert (json.loads(done.stdout)["gl_renderer"] == "NumPy") == (name == "numpy")
        dn = fits.getdata(folder / "image.fits").astype(int)
        drawn[name] = image, np.array(Image.open(folder / "codes.png")).astype(int), dn
    (gl_light, gl_codes, gl_dn), (light, codes, dn) = drawn["gl"], drawn["numpy"]
    assert gl_codes.max() > 100 and np.ptp(gl_dn) > 100
    assert np.abs(light - gl_light).max() < 1e-6 * gl_light.max()
    assert np.abs(codes - gl_codes).max() <= 1
    assert (codes != gl_codes).sum() <= NUMPY_OTHER * (gl_codes > 0).sum()
    assert np.abs(dn - gl_dn).max() <= NUMPY_DN


def test_without_opengl_verify_measures_the_same(small_bench_file, no_opengl):
    found = {}
    for name, run in (
        ("gl", run_hilstar_here),
        ("numpy", partial(run_hilstar, env=os.environ | no_opengl)),
    ):
        done = run("verify", small_bench_file, "--fields", "1", "--json")
        assert done.returncode == 0, done.stderr
        found[name] = json.loads(done.stdout)
    assert found["numpy"]["gl_renderer"] == "NumPy" != found["gl"]["gl_renderer"]
    assert found["numpy"]["stars"] == found["gl"]["stars"] > 0
    for figure in ("flux_error_mag", "centroid_error_px"):
        for part, value in found["gl"][figure].items():
            assert found["numpy"][figure][part] == pytest.approx(value, rel=0.05, abs=1e-4), (
                figure,
                part,
            )


def test_where_numpy_draws_moderngl_is_not_imported(small_bench_file, tmp_path, no_opengl):
    script = (
        "import sys; from hilstar.cli import run_command\nwords = ['frame',"
        f" {str(small_bench_file)!r}, '--radec', '1,2,3', '-o',"
        f" {str(tmp_path / 'x.fits')!r}]\nassert not run_command(words)\nprint('moderngl' in"
        " sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | no_opengl,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout.split()[-1:] == ["False"], done.stderr


def test_doctor_says_what_numpy_draws_where_opengl_is_missing(no_opengl):
    done = run_hilstar("doctor", "--json", env=os.environ | no_opengl)
    assert done.returncode == 3
    check = next(check for check in json.loads(done.stdout)["checks"] if check["name"] == "opengl")
    assert not check["ok"]
    assert (
        "apt-get install libegl1" in check["detail"]
        and "the processor draws frame, simulate and verify" in check["detail"]
    )


def test_doctor_says_what_is_there():
    result = run_hilstar("doctor", "--json")
    assert result.returncode == 0, result.stdout
    report = json.loads(result.stdout)
    assert report["ok"] is True and result.stderr == ""
    checks = {check["name"]: check for check in report["checks"]}
    assert {"opengl", "zeromq", "display", "files", "catalogue", "python"} <= set(checks)
    assert "OpenGL" in checks["opengl"]["detail"]
    plain = run_hilstar_here("doctor")
    assert plain.returncode == 0
    assert "opengl" in plain.stdout


def test_replay_writes_the_frames_of_a_log(tmp_path, small_bench_file):
    rows = ["t_s,qw,qx,qy,qz"]
    for k in range(3):
        q = from_radec_roll_deg(84.057 + k, -1.2, 0)
        rows.append(",".join(map(repr, [k * 0.1, *map(float, q)])))
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    result = run_hilstar_here(
        f"replay {small_bench_file} {tmp_path}/log.csv --headless --speed max -o "
        f"{tmp_path}/out --json"
    )
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["frames"] == 13  # 0.2 s at 60 Hz, both ends included
    assert summary["missed_frames"] == summary["stale_frames"] == 0
    table = csv_rows(tmp_path / "out" / "frames.csv")
    assert len(table) == len(list((tmp_path / "out").glob("frame_*.png"))) == 13
    with hilstar.load(small_bench_file) as bench:
        for number, ra in ((0, 84.057), (6, 85.057), (12, 86.057)):
            png = np.array(Image.open(tmp_path / "out" / f"frame_{number:06d}.png"))
            assert np.array_equal(png, bench.frame(from_radec_roll_deg(ra, -1.2, 0)).codes), number
    assert np.abs(float(table[3]["t_s"]) - 0.05) < 1e-9


def test_replay_in_real_time_takes_the_log_s_time(tmp_path, small_bench_file):
    (tmp_path / "log.jsonl").write_text(
        '{"t_ns":0,"q":[1,0,0,0]}\n{"t_ns":500000000,"q":[0.9999,0.01,0,0.0099]}\n'
    )
    summary = json.loads(
        run_hilstar_here(
            "replay", small_bench_file, tmp_path / "log.jsonl", "--headless", "--json"
        ).stdout
    )
    assert summary["frames"] + summary["missed_frames"] == 31
    assert summary["duration_s"] == pytest.approx(0.5, abs=0.2)


def test_an_unwritable_directory_is_refused(tmp_path, small_bench_file):
    blocker = tmp_path / "file"
    blocker.write_text("")
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    result = run_hilstar_here(
        "replay", small_bench_file, tmp_path / "log.csv", "--headless", "-o", blocker / "out"
    )
    assert_refused(result, 2, "cannot be written")
    assert_refused(run_hilstar("demo", "-o", blocker / "out"), 2, "cannot be written")


def test_output_to_a_closed_pipe_leaves_no_traceback():
    command = f"{shlex.quote(sys.executable)} -m hilstar doctor | true"
    result = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, env=os.environ, check=False
    )
    assert "Traceback" not in result.stderr


def test_a_png_is_a_png_whatever_its_name(tmp_path, small_bench_file):
    result = run_hilstar_here(
        "frame", small_bench_file, "--radec", "84,-1,0", "--codes", "codes", cwd=tmp_path
    )
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "codes").read_bytes()[:4] == b"\x89PNG"


def test_ctrl_c_at_any_moment_leaves_no_traceback(tmp_path, small_bench_file):
    """While it starts, while it waits for a listener, while it serves."""
    sender = ["send", "--spin", "z,1", "--to", f"tcp://127.0.0.1:{free_port()}"]
    for command in (sender, ["serve", str(small_bench_file), "--headless"]):
        for delay_s in (0.0, 0.1, 0.4, 1.0):
            process = subprocess.Popen(
                [*HILSTAR, *command], stderr=subprocess.PIPE, stdout=subprocess.PIPE
            )
            try:
                # Python's own start is not ours to guard
                wait_for(lambda process=process: has_handlers(process), poll_s=0.005)
                time.sleep(delay_s)
                process.send_signal(signal.SIGINT)
                _, err = process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()
            assert b"Traceback" not in err, err


def test_a_command_that_is_killed_leaves_no_process_of_the_tests_behind(tmp_path):
    """`demo` starts a sender: killed with it by `run_hilstar`, and what is orphaned all the same
    is found and ended.
    """
    with pytest.raises(subprocess.TimeoutExpired):
        run_hilstar("demo", "--duration", "60", "-o", tmp_path, timeout=4)
    assert [
        command for command in leftovers.living_children().values() if str(tmp_path) in command
    ] == []
    orphan_command = [sys.executable, "-c", "import time; time.sleep(60)", f"-m hilstar {tmp_path}"]
    middle = f"import subprocess; subprocess.Popen({orphan_command!r})"
    subprocess.run([sys.executable, "-c", middle], check=True)

    def orphans() -> list[int]:
        return [
            number
            for number, command in leftovers.living_children().items()
            if str(tmp_path) in command
        ]

    wait_for(orphans)  # /proc may still have another name or parent for it
    orphan = orphans()
    assert len(orphan) == 1
    assert any(str(tmp_path) in command for command in leftovers.end_hilstar_leftovers())
    os.waitpid(orphan[0], 0)


def test_without_a_display_a_window_is_refused_as_the_machine_s_lack(small_bench_file):
    bare = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY")
    }
    assert_refused(run_hilstar("serve", small_bench_file, env=bare), 3, "DISPLAY", "--headless")
