"""What the commands of `hilstar calibrate` hand to their engines, and what they say of the results:
the engines are the test's.
"""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.cli import calibrate
from hilstar.cli.calibrate import (
    FocusOptions,
    _check_focus_source,
    _focus_by_answers,
    _monitor_of_bench,
    _response_lines,
)
from hilstar.cli.pointing import PointingOptions
from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate import alignment as alignment_engine
from hilstar.instruments.calibrate import photometric as photometric_engine
from hilstar.instruments.calibrate import plan as plan_engine
from hilstar.instruments.calibrate import scale as scale_engine
from hilstar.instruments.calibrate.geometric import dots as dots_engine
from hilstar.instruments.calibrate.scale import MeasuredScale
from hilstar.server.answers.star_widths import FocusFigure, FocusReading
from hilstar.server.bench import build, frame_files
from hilstar.server.bench.bench_file import bench_file_of
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.refusals import refusal
from tests.support.tables import csv_rows


def response_summary(**changed: Any) -> dict[str, Any]:
    channel = {
        "shape": "power",
        "black_level": {"relative": 0.004},
        "holdout": {"rms_percent": 0.25},
    }
    known = {
        "black_level": {"relative": 0.002},
        "drift_percent": -0.5,
        "codes": 33,
        "bits": 10,
        "noise_relative": 0.0034,
        "holdout": {"rms_percent": 1.0, "p95_percent": 2.0, "max_percent": 3.0, "max_mag": 0.0321},
        "channels": {"w": channel},
        "crosstalk_percent": None,
    }
    return known | changed


def test_a_response_s_figures_are_said_in_their_units():
    assert list(_response_lines(response_summary())) == [
        "measured            33 codes above black, 10 bits; drift -0.50 %",
        "black level         2.000e-03 of white, contrast 1 : 500",
        "noise               0.34 % of a reading",
        "held-out levels     1.00 / 2.00 / 3.00 % (rms / 95 % / max), 0.0321 mag maximum",
    ]
    dark = response_summary(black_level={"relative": 0.0}, drift_percent=None)
    measured, black, *_ = _response_lines(dark)
    assert "drift not known" in measured and "contrast unknown: no light at code 0" in black


def test_channels_and_their_crosstalk_are_said_one_by_one():
    summary = response_summary()
    summary["channels"]["r"] = summary["channels"]["w"] | {"shape": "spline"}
    summary["crosstalk_percent"] = {"0.1": -1.25, "1": 2.0}
    summary["crosstalk_error_percent"] = {"0.1": 0.5, "1": 0.75}
    assert list(_response_lines(summary))[4:] == [
        "channel w           power, held-out levels 0.25 % rms, black 4.000e-03 of its white",
        "channel r           spline, held-out levels 0.25 % rms, black 4.000e-03 of its white",
        "crosstalk at 0.1    r + g + b is -1.25 +- 0.50 % from w",
        "crosstalk at 1      r + g + b is +2.00 +- 0.75 % from w",
    ]


@pytest.mark.parametrize(
    ("given", "sky", "words"),
    [
        ({}, False, "give --grab CMD"),
        ({"grab": "c", "virtual": Path("t")}, False, "give --grab CMD"),
        ({"virtual": Path("t"), "answers": True}, False, "give --grab CMD"),
        ({"answers": True, "exposure": 0.1}, True, "--exposure: is for --grab"),
        ({"grab": "c", "exposure": 0.1}, True, "are for --answers"),
        ({"grab": "c", "headless": True}, False, "--headless: is for --answers"),
        ({"answers": True, "headless": True}, True, "nobody sees the sky"),
        ({"answers": True, "headless": True, "feed": "tcp://h:1"}, True, None),
        ({"grab": "c", "exposure": 0.1}, False, None),
        ({"virtual": Path("t")}, False, None),
    ],
)
def test_a_focus_is_measured_by_one_source_with_its_own_options(given, sky, words):
    options = FocusOptions(bench_file=Path("bench.toml"), **given)
    pointing = PointingOptions(star="Vega" if sky else None)
    if words is None:
        _check_focus_source(options, pointing)
    else:
        assert words in refusal(_check_focus_source, options, pointing)


@pytest.mark.parametrize(
    ("mode", "is_its"),
    [
        ("1080x1920@60", True),
        ("1920x1080@144", True),
        ("1920x10800@60", False),
        ("800x600@60", False),
    ],
)
def test_a_display_of_the_bench_s_size_was_measured_on_either_side(
    tmp_path, monkeypatch, mode, is_its
):
    identity = MonitorIdentity(model="a monitor", mode=mode)
    asked = []

    def identity_here(display):
        asked.append(display)
        return identity

    monkeypatch.setattr("hilstar.display.window.this_monitor.identity_here", identity_here)
    monitor = {"resolution_px": [1920, 1080], "display": "DP-1"}
    file = bench_file_of(tmp_path / "bench.toml", bench_text({"monitor": monitor}))
    found = _monitor_of_bench(file)
    assert (found is identity, asked) == (is_its, ["DP-1"])


def run_calibrate(folder: Path, *words: object) -> Any:
    """A command of calibrate beside the small bench's file, and that file's words."""
    (folder / "bench.toml").write_text(
        bench_text({"monitor": {"bits": 10}, "tracker": {"exposure_s": 0.25}})
    )
    return run_hilstar_here("calibrate", *map(str, words), cwd=folder)


@pytest.mark.parametrize(("word", "offset_s"), [(None, 0.0), ("-3.5", -3.5)])
def test_an_alignment_s_offset_is_added_to_the_telemetry_s_time(
    tmp_path, monkeypatch, word, offset_s
):
    given = []
    monkeypatch.setattr(alignment_engine, "align_files", lambda *all_: given.append(all_))
    monkeypatch.setattr(alignment_engine, "write_alignment", lambda *_: None)
    monkeypatch.setattr(alignment_engine, "summary_of", lambda found: {})
    monkeypatch.setattr(alignment_engine, "lines_of", lambda found: ["aligned"])
    monkeypatch.setattr(calibrate, "_monitor_of_bench", lambda file: None)
    for name in ("told.csv", "run.mcap"):
        (tmp_path / name).write_bytes(b"")
    words = ["alignment", "bench.toml", "told.csv", "-o", "g.toml", "--ledger", "run.mcap"]
    done = run_calibrate(tmp_path, *words, *(["--offset-s", word] if word else []))
    assert done.returncode == 0, done.stderr
    assert given[0][1:] == (Path("told.csv"), Path("run.mcap"), offset_s)
    for far in ("4e9", "-4e9", "nan"):
        refused = run_calibrate(tmp_path, *words, "--offset-s", far)
        assert refused.returncode == 2 and "write seconds, less than 4e+09" in refused.stderr


@pytest.mark.parametrize(("ratios", "is_unsure"), [((1, 1, 1), False), ((1, 10, 100), True)])
def test_a_scale_is_of_the_bench_s_exposure_and_told_with_its_error(
    tmp_path, monkeypatch, ratios, is_unsure
):
    found = MeasuredScale(1234.5, 1000.0, np.array(ratios), np.ones(3), noise_mag=0.0133)
    given = []

    def scale_by_tracker(bench, readings, exposure_s):
        given.append((len(readings), exposure_s))
        return found

    monkeypatch.setattr(scale_engine, "scale_by_tracker", scale_by_tracker)
    monkeypatch.setattr(build, "open_bench", nullcontext)
    words = ["scale", "bench.toml", *(f"--reading={hip},5000" for hip in (1, 2, 3))]
    done = run_calibrate(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[1:] == [
        "flux_at_white_e_per_s = 1234.5",
        "# and how well it is known, under [certify]:",
        f"flux_at_white_relative = {found.relative_error:.3g}",
        "flux_at_white_dof = 2",
    ]
    assert ("the readings disagree by 2.500 mag" in done.stderr) is is_unsure
    run_calibrate(tmp_path, *words, "--exposure", "2")
    assert given == [(3, 0.25), (3, 2.0)]


def test_dots_are_as_white_as_the_monitor_and_counted_in_each_frame(tmp_path, monkeypatch):
    images = []
    monkeypatch.setattr(
        frame_files, "write_codes_png", lambda path, image, bits: images.append((image, bits))
    )
    done = run_calibrate(
        tmp_path, "dots", "bench.toml", "-o", "dots", "--frames", "8", "--dots", "9", "--json"
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["frames"], len(images)) == (8, 8)
    assert {bits for _, bits in images} == {10}
    assert {int(image.max()) for image, _ in images} == {1023}
    plan = (tmp_path / "dots" / "plan.csv").read_text()
    assert told["lit"] == sum(not row.startswith("#") for row in plan.splitlines()) - 1
    words = ("dots", "bench.toml", "-o", "more", "--frames", "8", "--dots", "9")
    line = f"{told['dots']} dots in 8 frames, {told['lit'] / 8:.0f} lit in each, in more\n"
    assert run_calibrate(tmp_path, *words).stdout == line
    assert (tmp_path / "more" / "plan.csv").read_text() == plan
    run_calibrate(tmp_path, *words, "--seed", "1")
    assert (tmp_path / "more" / "plan.csv").read_text() != plan


def test_dots_and_patches_are_shown_as_long_and_where_they_are_asked_for(tmp_path, monkeypatch):
    shown = []

    def show_dots(plan, monitor, dwell_s, windowed):
        shown.append((plan.frames, dwell_s, windowed))
        return 7

    def show_patches(planned, bits, display, dwell_s):
        shown.append((bits, display, dwell_s))
        return 5

    monkeypatch.setattr(dots_engine, "show_dots", show_dots)
    monkeypatch.setattr(plan_engine, "show_patches", show_patches)
    words = "dots bench.toml -o dots --frames 8 --dots 9 --show --dwell 0.5 --windowed"
    assert "7 of 8 frames shown" in run_calibrate(tmp_path, *words.split()).stderr
    words = "plan -o plan.csv --levels 3 --repeats 1 --bits 10 --show --display HDMI-1 --dwell 2"
    assert "5 of " in run_calibrate(tmp_path, *words.split()).stderr
    assert shown == [(8, 0.5, True), (10, "HDMI-1", 2.0)]


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        ("geometric bench.toml seen.csv --plan d -o g.csv", "-o g.csv"),
        ("geometric bench.toml seen.csv --plan d -o g.toml --plot p.pdf", "--plot p.pdf"),
        ("psf bench.toml i.fits --plan d -o p.toml", "-o p.toml"),
        ("psf bench.toml i.fits --plan d -o p.fits --plot p.pdf", "--plot p.pdf"),
        ("alignment bench.toml pairs.csv -o g.csv", "-o g.csv"),
        ("plan -o plan.toml", "-o plan.toml"),
        ("photometric m.csv -o m.csv", "-o m.csv"),
        ("photometric m.csv -o m.toml --plot p.pdf", "--plot p.pdf"),
        ("scale bench.toml --reading 1,5 -o b.csv", "-o b.csv"),
        ("reference r.csv -o a.csv", "-o a.csv"),
    ],
)
def test_an_output_of_another_kind_is_refused_before_anything_is_read(tmp_path, line, refused):
    done = run_calibrate(tmp_path, *line.split())
    assert done.returncode == 2 and f"hilstar: {refused}: " in done.stderr, done.stderr


def test_a_response_has_the_name_date_instrument_and_unit_of_its_readings(tmp_path, monkeypatch):
    given = []

    def calibrate_photometric(measured, output, provenance, bits, identity):
        given.append((measured, output, provenance, bits, identity))
        return response_summary() | {"written": ["m.toml"]}

    drawn = []
    monkeypatch.setattr(photometric_engine, "calibrate_photometric", calibrate_photometric)
    monkeypatch.setattr(photometric_engine, "draw_calibration", lambda *all_: drawn.append(all_))
    monkeypatch.setattr("hilstar.display.window.this_monitor.identity_here", lambda display: None)
    (tmp_path / "read.csv").write_text("")
    words = "--who me --when 2026-01-02 --instrument LS-160 --unit cd/m2 --bits 10 --plot p.png"
    done = run_calibrate(tmp_path, "photometric", "read.csv", "-o", "m.toml", *words.split())
    assert done.returncode == 0, done.stderr
    made = photometric_engine.Provenance(
        who="me", when="2026-01-02", instrument="LS-160", unit="cd/m2"
    )
    assert given == [(Path("read.csv"), Path("m.toml"), made, 10, None)]
    assert drawn == [(Path("read.csv"), Path("p.png"), 10)]
    assert done.stdout.splitlines()[4:] == [
        "written             m.toml, p.png",
        'in the bench file   [monitor] calibration = "m.toml"',
    ]


def test_a_plan_counts_its_codes_once_for_all_channels(tmp_path):
    words = ("plan", "-o", "plan.csv", "--levels", "3", "--repeats", "2", "--json")
    told = [
        json.loads(run_calibrate(tmp_path, *words, "--channels", channels).stdout)
        for channels in ("w", "wrgb")
    ]
    rows = csv_rows(tmp_path / "plan.csv")
    assert (told[1]["patches"], told[1]["codes"]) == (len(rows), len({row["code"] for row in rows}))
    assert told[0]["codes"] == told[1]["codes"] and told[0]["patches"] < told[1]["patches"]


def test_a_plan_that_was_filled_in_is_kept(tmp_path):
    words = ["plan", "-o", "plan.csv", "--levels", "3", "--repeats", "1", "--headless", "pictures"]
    assert run_calibrate(tmp_path, *words).returncode == 0
    assert run_calibrate(tmp_path, *words).returncode == 0  # the same again loses nothing
    path = tmp_path / "plan.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line + "5" if line.endswith(",") else line for line in lines) + "\n")
    filled = path.read_text()
    refused = run_calibrate(tmp_path, *words)
    assert refused.returncode == 2 and "plan.csv" in refused.stderr
    assert path.read_text() == filled
    assert run_calibrate(tmp_path, *words, "--overwrite").returncode == 0
    assert path.read_text() != filled


def reading_of(number):
    """A reading of an image each 3 s, of which the second is the sharpest."""
    sigma_px = 1.0 + abs(number - 2)
    return FocusReading(number, 3.0 * number, 9, FocusFigure(sigma_px, 0.01, 9, 0.0, 0.0))


@pytest.mark.parametrize(("images", "is_last"), [(None, [False, False]), (2, [False, True])])
def test_a_focus_ends_after_so_many_figures_or_at_a_signal(tmp_path, monkeypatch, images, is_last):
    told = []

    def by_images(file, options, take, stop, watch):
        for number in (1, 2):
            told.append(take(reading_of(number)))
        stop.set()
        told.append(take(reading_of(3)))

    monkeypatch.setattr(calibrate, "_focus_by_images", by_images)
    words = [] if images is None else ["--images", str(images)]
    done = run_calibrate(tmp_path, "focus", "bench.toml", "--grab", "take {output}", *words)
    assert done.returncode == 0, done.stderr
    assert told == [*is_last, True]
    assert done.stdout.splitlines()[-1].endswith(": image 2 of 3, after 6 s")


FIELDS = ", ".join(
    f'{{ name = "q{axis}", at = {4 * k}, type = "f32" }}' for k, axis in enumerate("wxyz")
)
FORMS = {"packet": "", "frame": f'framing = "fixed"\nlength = 16\nfields = [{FIELDS}]\n'}


@pytest.mark.parametrize("form", FORMS)
def test_answers_without_stars_have_no_focus(tmp_path, form):
    answers = f'[answers]\nsource = "udp"\nformat = "{form}"\n{FORMS[form]}'
    file = bench_file_of(tmp_path / "bench.toml", SMALL_BENCH + answers)
    said = refusal(_focus_by_answers, file, None, None, None, None, None)
    assert f'format = "{form}" carries no stars' in said
