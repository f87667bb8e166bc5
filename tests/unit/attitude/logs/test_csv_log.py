"""CSV logs as loggers write them: cut off, with rows that do not hold, in any dialect and unit."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs import telemetry as tables
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.basics.errors import InputError
from hilstar.basics.reading import warn_once
from tests.support.commands import run_hilstar_here
from tests.support.refusals import refusal

Q = "0.6987226,0.7135120,-0.0370377,0.0362700"
OTHER = "0.5,0.5,-0.5,0.5"
LOST = "1.0000000,0.0000000,0.0000000,0.0000000"
HEAD = "t_s,qw,qx,qy,qz\n"


@pytest.fixture
def csv_of(tmp_path):
    warn_once.cache_clear()

    def write(text, name="log.csv"):
        path = tmp_path / name
        path.write_text(text, newline="")
        return path

    return write


def slew(columns="t_s,qw,qx,qy,qz", tail=lambda k: ""):
    """60 rows of a slew about the image's y by 0.01 degree each, as a logger writes them."""
    start = Rotation.from_quat([0.6987226, 0.7135120, -0.0370377, 0.0362700], scalar_first=True)
    lines = [f"{columns}\n"]
    for k in range(60):
        q = (Rotation.from_rotvec([0, np.radians(0.01 * k), 0]) * start).as_quat(scalar_first=True)
        lines.append(f"{k * 0.1:.1f},{','.join(f'{c:.7f}' for c in q)}{tail(k)}\n")
    return "".join(lines)


CUTS = {
    "in the last number": (slew(), 6, 59),
    "one figure": (slew(), 2, 59),
    "the line end alone": (slew(), 1, 60),
    "in the rates": (
        slew("t_s,qw,qx,qy,qz,rx,ry,rz", lambda k: ",0.0001000,0.0017453,0.0002000"),
        5,
        59,
    ),
    "in the sequence": (slew("t_s,qw,qx,qy,qz,sequence", lambda k: f",{100 + k}"), 2, 59),
    "within a row": (slew(), 20, 59),
    "within t_s as the last column": (
        "qw,qx,qy,qz,t_s\n" + "".join(f"{Q},{k}.25\n" for k in range(4)),
        2,
        3,
    ),
    "within the exponent": (HEAD + f"0,{Q}\n1,1,0,0,1.5e-05\n2,1,0,0,1.5e-05\n", 2, 2),
}


@pytest.mark.parametrize("name", CUTS)
def test_a_row_that_was_cut_off_is_left_out_and_said(csv_of, name, caplog):
    text, cut, count = CUTS[name]
    path = csv_of(text[:-cut])
    found = open_log(path)
    assert len(found.samples) == count
    assert ("log-cut" in dict(found.told)) == (cut > 1)
    telemetry = read_telemetry(path)
    assert len(telemetry.t_ns) == count
    assert ("as of a file that was cut off" in caplog.text) == (cut > 1)
    assert len(open_log(csv_of(text)).samples) == len(text.splitlines()) - 1


def test_the_attitude_at_the_end_of_a_cut_log_is_the_last_whole_one(csv_of):
    result = run_hilstar_here("attitude", csv_of(slew()[:-6]), "--time", "5.8")
    assert "RA 84.6371, Dec -1.1999, roll 0.0122 deg" in result.stdout
    assert "the last line has no line end" in result.stderr
    assert run_hilstar_here("attitude", csv_of(slew()[:-6]), "--time", "5.9").returncode == 2


def telemetry_text(header, good, bad, lost=LOST):
    rows = [
        f"{k * 0.1:.1f},{lost if k in (4, 5) else Q},{bad if k in (4, 5) else good}\n"
        for k in range(10)
    ]
    return f"t_s,qw,qx,qy,qz,{header}\n" + "".join(rows)


@pytest.mark.parametrize(
    ("header", "good", "bad", "lost"),
    [
        ("valid", "1", "0", LOST),
        ("valid", "true", "false", LOST),
        ("Valid", "True", "False", "nan,nan,nan,nan"),
        ("is_valid", "1", "0", ",,,"),
        ("lost", "0", "1", LOST),
        ("valid", "ok", "bad", "0,0,0,0"),
        ("AttitudeValid", "1", "0", LOST),
        ("isValid", "true", "false", LOST),
        ("st_valid", "Y", "N", LOST),
        ("Valid Flag", "VALID", "INVALID", LOST),
        ("validity [-]", "1", "0", "NULL,NULL,NULL,NULL"),
        ("trackerLost", "0", "1", LOST),
    ],
)
def test_rows_that_the_log_marks_as_not_valid_are_left_out_and_said(
    csv_of, header, good, bad, lost
):
    path = csv_of(telemetry_text(header, good, bad, lost))
    found = open_log(path)
    assert [round(sample.t_ns / 1e8) for sample in found.samples] == [0, 1, 2, 3, 6, 7, 8, 9]
    assert (
        dict(found.told)["log-valid"]
        == "2 rows are marked as not valid by the log itself, and left out"
    )
    assert read_telemetry(path).valid.tolist() == [k not in (4, 5) for k in range(10)]


def test_json_lines_that_say_they_are_not_valid_are_left_out_and_said(csv_of):
    text = "".join(
        f'{{"t_ns": {k}, "q": [{LOST if k == 1 else Q}], "valid":'
        f" {'false' if k == 1 else 'true'}}}\n"
        for k in range(3)
    )
    found = open_log(csv_of(text))
    assert [sample.t_ns for sample in found.samples] == [0, 2]
    assert (
        dict(found.told)["log-valid"]
        == "1 line is marked as not valid by the log itself, and left out"
    )


@pytest.mark.parametrize("key", ["is_valid", "attitudeValid", "st_valid"])
def test_json_says_what_holds_by_the_names_of_tables(csv_of, key):
    rows = [f'{{"t_ns": {k}, "q": [{Q}], "{key}": {"false" if k else "true"}}}\n' for k in (0, 1)]
    found = open_log(csv_of("".join(rows)))
    assert [sample.t_ns for sample in found.samples] == [0]
    assert "1 line is marked as not valid" in dict(found.told)["log-valid"]


@pytest.mark.parametrize("key", ["st_lost", "invalid"])
def test_json_says_what_does_not_hold_by_the_names_of_tables(csv_of, key):
    rows = [f'{{"t_ns": {k}, "q": [{Q}], "{key}": {"true" if k else "false"}}}\n' for k in (0, 1)]
    found = open_log(csv_of("".join(rows)))
    assert [sample.t_ns for sample in found.samples] == [0]


def test_null_in_one_number_of_a_quaternion_is_no_attitude_that_is_missing(csv_of):
    path = csv_of(f'{{"t_ns": 0, "q": [1, 0, null, 0]}}\n{{"t_ns": 5, "q": [{Q}]}}\n', "log.jsonl")
    with pytest.raises(InputError, match=":1: "):
        open_log(path)


@pytest.mark.parametrize("q", ["null", "[null, null, null, null]", "[NaN, NaN, NaN, NaN]"])
def test_json_without_a_quaternion_is_left_out_at_the_start(csv_of, q):
    blank, row = f'{{"t_ns": 0, "q": {q}}}\n', f'{{"t_ns": 5, "q": [{Q}]}}\n'
    found = open_log(csv_of(blank + row, "log.jsonl"))
    assert [sample.t_ns for sample in found.samples] == [5]
    assert "1 attitude is left out at the beginning" in dict(found.told)["log-start"]


@pytest.mark.parametrize(
    ("header", "good", "bad"),
    [
        ("status", "TRACK", "ACQUIRE"),
        ("attitude_status", "1", "0"),
        ("qualityFlag", "0.9", "0.1"),
        ("q_ok", "1", "0"),
        ("rate_valid", "1", "0"),
        ("error", "0", "1"),
    ],
)
def test_a_column_of_marks_that_is_not_used_is_named(csv_of, header, good, bad):
    found = open_log(csv_of(telemetry_text(header, good, bad)))
    assert f"column {header} is not used" in dict(found.told)["log-table"]


@pytest.mark.parametrize("header", ["q_ok", "qualityFlag"])
def test_beside_a_column_of_validity_no_other_marks_are_named(csv_of, header):
    rows = [f"{k}.0,{Q},{k % 2},1" for k in range(10)]
    found = open_log(csv_of("\n".join([f"t_s,qw,qx,qy,qz,{header},valid", *rows]) + "\n"))
    assert len(found.samples) == 10
    assert "log-table" not in dict(found.told)


def test_a_column_of_figures_is_no_mark(csv_of):
    """An error in arcseconds marks no row."""
    found = open_log(csv_of(telemetry_text("pointing_error_arcsec", "2.5", "3.5")))
    assert not found.told


# A time of 0.5 s after 2024-01-01T00:00:00 UTC, by which column and how programs write it.
DATES = [
    ("t_s", "2024-01-01T00:00:00.500"),
    ("time", "2024-01-01T00:00:00.500Z"),
    ("Time (UTC)", "2024-01-01 00:00:00.5 UTC"),
    ("timestamp", "2024-01-01T01:00:00.500+01:00"),
    ("datetime", "2023-12-31 19:00:00.5-0500"),
    ("utc", "2024-001T00:00:00.500"),
    ("date", "2024:001:00:00:00.500000000"),
    ("epoch", "2024/001 00:00:00.500"),
]


@pytest.mark.parametrize(("header", "written"), DATES)
def test_dates_are_read_to_the_nanosecond_and_that_is_said(csv_of, header, written):
    path = csv_of(f"{header},qw,qx,qy,qz\n{written},{Q}\n")
    found = open_log(path)
    assert found.samples[0].t_ns == 1_704_067_200_500_000_000
    assert f"column {header} has dates" in dict(found.told)["log-table"]
    if header == "t_s":  # the one name of it in telemetry
        assert read_telemetry(path).t_ns.tolist() == [1_704_067_200_500_000_000]


# What programs write for a quaternion before their estimator runs.
NOTHING_YET = ("nan", "NaN", "NULL", "null", "None", "-", "--", "N/A", "#N/A", "<NA>", "-nan(ind)")
NOTHING_YET += ("1.#QNAN", "?", ".", "", "0", "-0.0", "\\N")


@pytest.mark.parametrize("word", NOTHING_YET)
def test_rows_without_a_number_are_left_out_at_the_start_and_a_dropout_later(csv_of, word):
    blank = ",".join([word] * 4)
    found = open_log(csv_of(f"{HEAD}0.0,{blank}\n0.1,{blank}\n0.2,{Q}\n0.3,{Q}\n"))
    assert [sample.t_ns for sample in found.samples] == [200_000_000, 300_000_000]
    assert "2 attitudes are left out at the beginning" in dict(found.told)["log-start"]
    with pytest.raises(InputError, match=r"log\.csv:3: .*dropout"):
        open_log(csv_of(f"{HEAD}0.0,{Q}\n0.1,{blank}\n0.2,{Q}\n"))


def test_dialects_of_a_log_are_read(csv_of):
    plain = open_log(csv_of(HEAD + f"0,{Q}\n1,{OTHER}\n")).samples
    texts = (
        f"# t_s,qw,qx,qy,qz\n0,{Q}\n1,{OTHER}\n",
        f"{HEAD}0,{Q}\n1,{OTHER}\n".replace(",", ";"),
        f"{HEAD}0,{Q}\n1,{OTHER}\n".replace(",", ";").replace(".", ","),
        f"{HEAD}0,{Q}\n1,{OTHER}\n".replace(",", "\t"),
        f"{HEAD}0,{Q}\n1,{OTHER}\n".replace(",", "   "),
        f"t_ms,qw,qx,qy,qz\n0,{Q}\n1000,{OTHER}\n",
        f"time [us],qw,qx,qy,qz\n0,{Q}\n1000000,{OTHER}\n",
        f"t_ns;qw;qx;qy;qz\n0;{Q};\n1000000000;{OTHER};\n".replace(",", ";"),
        f"t,qw,qx,qy,qz\ns,-,-,-,-\n0,{Q}\n1,{OTHER}\n",
        f"{HEAD}0,{Q}\n1,{OTHER}\n".replace("-", "−"),
    )
    for text in texts:
        samples = open_log(csv_of(text)).samples
        assert [sample.t_ns for sample in samples] == [0, 10**9], text
        assert all(
            np.array_equal(a.q_icrs_to_cam, b.q_icrs_to_cam)
            for a, b in zip(samples, plain, strict=True)
        ), text


def test_rates_are_in_the_unit_of_their_columns_and_that_is_said(csv_of):
    found = open_log(csv_of(f"t_s,qw,qx,qy,qz,rx [deg/s],ry_deg_s,rz (°/s)\n0,{Q},1,2,3\n"))
    assert found.samples[0].rate_cam_rad_s == pytest.approx(np.radians([1, 2, 3]), rel=1e-12)
    assert (
        sum("deg/s" in line or "°/s" in line for kind, line in found.told if kind == "log-table")
        == 3
    )


@pytest.mark.parametrize(
    "row",
    [
        "1_0,1,0,0,0,0,0,0,5",
        "0,0_1,0,0,0,0,0,0,5",
        "0,1,0,0,0_0,0,0,0,5",
        "0,1,0,0,0,1_0,0,0,5",
        "0,1,0,0,0,0,0,0.1_0,5",
        "0,1,0,0,0,0,0,0,1_0",
    ],
)
def test_a_number_that_python_alone_reads_is_refused_in_every_column(csv_of, row):
    """1_0 is 10 to it, and may be two numbers to who wrote it."""
    path = csv_of(f"t_s,qw,qx,qy,qz,rx,ry,rz,sequence\n{row}\n")
    with pytest.raises(InputError, match=re.escape(f"{path}:2: {row!r}")):
        open_log(path)


def test_a_table_with_decimal_commas_has_them_in_every_column(csv_of):
    head = "t_ms;qw;qx;qy;qz;rx [deg/s];ry [deg/s];rz [deg/s]"
    rows = "0,5;1,0;0,0;0,0;0,0;1,5;0;-3\n1500,25;0,5;-0,5;0,5;0,5;0;0,25;0"
    first, last = open_log(csv_of(f"{head}\n{rows}\n")).samples
    assert (first.t_ns, last.t_ns) == (500_000, 1_500_250_000)
    assert last.q_icrs_to_cam.tolist() == [0.5, -0.5, 0.5, 0.5]
    assert first.rate_cam_rad_s == pytest.approx(np.radians([1.5, 0.0, -3.0]))
    assert last.rate_cam_rad_s == pytest.approx(np.radians([0.0, 0.25, 0.0]))


def test_telemetry_has_the_rates_of_its_columns_in_their_unit(tmp_path: Path) -> None:
    path = tmp_path / "telemetry.csv"
    rows = ["0,1,0,0,0,1.8,0,-3.6,1", "1,1,0,0,0,,,,1", "2,0,0,0,0,9,9,9,0"]
    header = "t_s,qw,qx,qy,qz,rx [deg/s],ry [deg/s],rz [deg/s],valid"
    path.write_text("\n".join([header, *rows]) + "\n")
    rates = read_telemetry(path).rate_cam_rad_s
    assert rates is not None
    np.testing.assert_allclose(rates[0], np.radians([1.8, 0.0, -3.6]), rtol=1e-12)
    assert np.isnan(rates[1:]).all()


@pytest.mark.parametrize(
    "header, row, told",
    [
        ("rx,ry", "0,0", "column rz is missing beside the others of a rate"),
        ("rx,ry,rz", "0,,0", "leave all three blank where no rate is reported"),
    ],
)
def test_half_a_rate_is_refused(tmp_path: Path, header: str, row: str, told: str) -> None:
    path = tmp_path / "telemetry.csv"
    path.write_text(f"t_s,qw,qx,qy,qz,{header}\n0,1,0,0,0,{row}\n")
    with pytest.raises(InputError, match=told):
        read_telemetry(path)


# one answer of two stars, one of one, one of none, as JSON lines, as columns and as a row a star
STARS = [
    [[10.0, 20.5, 100.0, 26311.0, 0.9], [30.0, 40.0, None, None, None]],
    [[31.0, 41.0, 7.0, None, None]],
    [],
]
STAR_FORMS = {
    "stars.jsonl": "".join(
        f'{{"t_ns": {k * 10**8}, "q": [{Q}], "valid": true, "centroids": {json.dumps(stars)}}}\n'
        for k, stars in enumerate(STARS)
    ),
    "columns.csv": (
        "t_s,qw,qx,qy,qz,star1_x_px,star1_y_px,star1_dn,star1_hip,star1_width_px"
        ",star2_x,star2_y [px],star2_flux\n"
        f"0,{Q},10,20.5,100,26311,0.9,30,40,\n0.1,{Q},,,,,,31,41,7\n0.2,{Q},,,,,,,,\n"
    ),
    "rows.csv": (
        "t_s,qw,qx,qy,qz,star_x_px,star_y_px,star_dn,star_hip,star_width_px\n"
        f"0,{Q},10,20.5,100,26311,0.9\n0,{Q},30,40,,,\n0.1,{Q},31,41,7,,\n0.2,{Q},,,,,\n"
    ),
    "other_names.csv": (
        "t_s,qw,qx,qy,qz,centroid_1_x,centroid_1_y,centroid_1_dn,centroid_1_hip,centroid_1_width"
        ",centroid_2_x,centroid_2_y,centroid_2_mag\n"
        f"0,{Q},10,20.5,100,26311,0.9,30,40,\n0.1,{Q},,,,,,31,41,{-2.5 * math.log10(7)!r}\n"
        f"0.2,{Q},,,,,,,,\n"
    ),
}


@pytest.mark.parametrize("name", STAR_FORMS)
def test_a_tracker_s_stars_are_the_same_in_every_form_of_telemetry(csv_of, name):
    telemetry = read_telemetry(csv_of(STAR_FORMS[name], name))
    assert telemetry.t_ns.tolist() == [0, 10**8, 2 * 10**8]
    for row, stars in zip(telemetry.star_rows, STARS, strict=True):
        told = np.array(row, dtype=np.float64)  # NaN for None
        np.testing.assert_allclose(told, np.array(stars, dtype=np.float64), rtol=1e-12)


def test_a_row_s_stars_are_in_the_order_of_their_numbers(csv_of):
    """The tenth is no second one."""
    columns = ",".join(f"star{number}_x,star{number}_y" for number in (10, 2, 1))
    telemetry = read_telemetry(csv_of(f"t_s,qw,qx,qy,qz,{columns}\n0,{Q},10,0,2,0,1,0\n"))
    assert [star[0] for star in telemetry.star_rows[0]] == [1.0, 2.0, 10.0]


@pytest.mark.parametrize("magnitude", [-99.9, 99.9])
def test_a_magnitude_may_be_of_either_sign(csv_of, magnitude):
    text = f"t_s,qw,qx,qy,qz,star1_x,star1_y,star1_mag\n0,{Q},1,2,{magnitude}\n"
    star = read_telemetry(csv_of(text)).star_rows[0][0]
    assert star[2] == pytest.approx(10 ** (-0.4 * magnitude))


def test_telemetry_without_stars_has_no_rows_of_them(csv_of):
    text = f"t_s,qw,qx,qy,qz,star_counts,star_mag\n0,{Q},9,5.5\n0.1,{Q},8,5.4\n"
    assert not read_telemetry(csv_of(text)).star_rows


@pytest.mark.parametrize(
    ("columns", "cells", "fault"),
    [
        ("star1_x_px", "1", "of star1 both x and y are needed"),
        ("star1_x_um,star1_y_um", "1,2", "column star1_x_um is in 'um', and px is wanted"),
        ("star_x [mm],star_y [mm]", "1,2", "column star_x [mm] is in 'mm', and px is wanted"),
        ("star1_x,star1_y", "1,", ":2: star1_y_px = '' is not a finite number; leave the cells"),
        ("star1_x,star1_y,star1_dn", "1,2,bright", "star1_dn = 'bright' is not a finite number"),
        (
            "star1_x,star1_y,star1_dn,star1_mag",
            "1,2,3,4",
            "star1 has several signals; keep one of dn",
        ),
        ("star1_x,star1_y,star1_mag", "1,2,-9999", "star1_mag = -9999 is no magnitude"),
        ("star1_x,star1_y,star1_dn,star1_flux", "1,2,3,4", "star1 has several signals"),
        ("star1_x,star1_y,centroid1_x,centroid1_y", "1,2,3,4", "two names of one star"),
        ("star_x,star_y,star1_x,star1_y", "1,2,3,4", "one star a row beside numbered ones"),
    ],
)
def test_columns_of_stars_that_mean_two_things_are_refused(csv_of, columns, cells, fault):
    text = f"t_s,qw,qx,qy,qz,{columns}\n0,{Q},{cells}\n"
    with pytest.raises(InputError, match=re.escape(fault)):
        read_telemetry(csv_of(text))


def test_two_attitudes_at_one_time_of_a_row_a_star_are_refused(csv_of):
    turned = f"{Q.rpartition(',')[0]},-0.0362700"  # the last component alone
    for other in (OTHER, turned):
        text = f"t_s,qw,qx,qy,qz,star_x,star_y\n0,{Q},1,2\n0,{other},3,4\n"
        with pytest.raises(InputError, match=":3: another attitude at t_s = 0; repeat the answer"):
            read_telemetry(csv_of(text))


@pytest.mark.parametrize("t_s", ["9.1e9", "-9.1e9", "noon"])
def test_a_time_of_telemetry_beyond_64_bits_is_refused_on_either_side(csv_of, t_s):
    with pytest.raises(InputError, match=f"t_s = '{t_s}' is no time"):
        read_telemetry(csv_of(f"t_s,qw,qx,qy,qz\n{t_s},{Q}\n"))
    late = "-9e9" if t_s.startswith("-") else "9e9"
    assert abs(read_telemetry(csv_of(f"t_s,qw,qx,qy,qz\n{late},{Q}\n")).t_ns[0]) == 9 * 10**18


@pytest.mark.parametrize(
    ("columns", "is_named"),
    [
        ("wx,wy,wz", True),
        ("omega_x,omega_y,omega_z", True),
        ("gyro_x,gyro_y,gyro_z", True),
        ("p,q,r", True),
        ("gyro_x,gyro_y", False),
        ("rx,ry,rz,wx,wy,wz", False),
    ],
)
def test_three_columns_like_rates_of_another_program_are_named(csv_of, columns, is_named):
    cells = ",".join("0" for _ in columns.split(","))
    text = f"t_s,qw,qx,qy,qz,{columns}\n0,{Q},{cells}\n0.1,{Q},{cells}\n"
    told = "\n".join(line for _, line in open_log(csv_of(text)).told)
    assert (f"columns {columns.replace(',', ', ')} are not used" in told) is is_named
    assert ("rates are named rx,ry,rz" in told) is is_named


def test_telemetry_s_attitudes_are_unit_and_its_times_rise(csv_of):
    """A norm within the tolerance is divided out; a row again is told, unless times may fall."""
    text = f"{HEAD}0,0.49995,0.49995,-0.49995,0.49995\n1,{OTHER}\n"
    path = csv_of(text)
    assert np.abs(np.linalg.norm(read_telemetry(path).q, axis=1) - 1).max() < 1e-15
    path = csv_of(f"{text}1,{OTHER}\n")
    assert ":4: time does not increase (t_s = 1 after 1)" in refusal(read_telemetry, path)
    assert read_telemetry(path, rising=False).t_ns.tolist() == [0, 10**9, 10**9]


def test_telemetry_has_so_many_rows_at_most(csv_of, monkeypatch):
    monkeypatch.setattr(tables, "MAX_ROWS", 2)
    text = f"{HEAD}0,{OTHER}\n1,{OTHER}\n"
    assert len(read_telemetry(csv_of(text)).t_ns) == 2
    assert "more than 2 rows" in refusal(read_telemetry, csv_of(f"{text}2,{OTHER}\n"))
