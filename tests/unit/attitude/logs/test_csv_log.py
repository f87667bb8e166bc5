"""CSV logs as loggers write them: cut off, with rows that do not hold, in other dialects and
units, and what is refused.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.basics.errors import InputError
from hilstar.basics.reading import warn_once
from tests.support.commands import run_hilstar_here

Q = "0.6987226,0.7135120,-0.0370377,0.0362700"
OTHER = "0.5,0.5,-0.5,0.5"
LOST = "1.0000000,0.0000000,0.0000000,0.0000000"
HEAD = "t_s,qw,qx,qy,qz\n"
WRITTEN_RAD = 1e-7  # seven decimals of a quaternion


@pytest.fixture
def log(tmp_path):
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
def test_a_row_that_was_cut_off_is_left_out_and_said(log, name, caplog):
    text, cut, count = CUTS[name]
    path = log(text[:-cut])
    found = open_log(path)
    assert len(found.samples) == count
    assert ("log-cut" in dict(found.told)) == (cut > 1)
    telemetry = read_telemetry(path)
    assert len(telemetry.t_ns) == count
    assert ("as of a file that was cut off" in caplog.text) == (cut > 1)
    assert len(open_log(log(text)).samples) == len(text.splitlines()) - 1


def test_the_attitude_at_the_end_of_a_cut_log_is_the_last_whole_one(log):
    result = run_hilstar_here("attitude", log(slew()[:-6]), "--at", "5.8")
    assert "RA 84.6371, Dec -1.1999, roll 0.0122 deg" in result.stdout
    assert "the last line has no line end" in result.stderr
    assert run_hilstar_here("attitude", log(slew()[:-6]), "--at", "5.9").returncode == 2


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
    ],
)
def test_rows_that_the_log_marks_as_not_valid_are_left_out_and_said(log, header, good, bad, lost):
    path = log(telemetry_text(header, good, bad, lost))
    found = open_log(path)
    assert [round(sample.t_ns / 1e8) for sample in found.samples] == [0, 1, 2, 3, 6, 7, 8, 9]
    assert (
        dict(found.told)["log-valid"]
        == "2 rows are marked as not valid by the log itself, and left out"
    )
    assert read_telemetry(path).valid.tolist() == [k not in (4, 5) for k in range(10)]


def test_json_lines_that_say_they_are_not_valid_are_left_out_and_said(log):
    text = "".join(
        f'{{"t_ns": {k}, "q": [{LOST if k == 1 else Q}], "valid":'
        f" {'false' if k == 1 else 'true'}}}\n"
        for k in range(3)
    )
    found = open_log(log(text))
    assert [sample.t_ns for sample in found.samples] == [0, 2]
    assert (
        dict(found.told)["log-valid"]
        == "1 line is marked as not valid by the log itself, and left out"
    )


def test_a_column_of_marks_that_is_not_used_is_named(log):
    found = open_log(log(telemetry_text("status", "TRACK", "ACQUIRE")))
    assert "column status is not used" in dict(found.told)["log-table"]


def test_dialects_of_a_log_are_read(log):
    plain = open_log(log(HEAD + f"0,{Q}\n1,{OTHER}\n")).samples
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
        samples = open_log(log(text)).samples
        assert [sample.t_ns for sample in samples] == [0, 10**9], text
        assert all(
            np.array_equal(a.q_icrs_to_cam, b.q_icrs_to_cam)
            for a, b in zip(samples, plain, strict=True)
        ), text


def test_rates_are_in_the_unit_of_their_columns_and_that_is_said(log):
    found = open_log(log(f"t_s,qw,qx,qy,qz,rx [deg/s],ry_deg_s,rz (°/s)\n0,{Q},1,2,3\n"))
    assert found.samples[0].rate_cam_rad_s == pytest.approx(np.radians([1, 2, 3]), rel=1e-12)
    assert (
        sum("deg/s" in line or "°/s" in line for kind, line in found.told if kind == "log-table")
        == 3
    )


REFUSED = {
    f"t_s,qw,qx,qy,qz,qw,qx,qy,qz\n0,{Q},{OTHER}\n": ":1: column qw is there twice",
    f"t_s,t_s,qw,qx,qy,qz\n0,1,{Q}\n": ":1: column t_s is there twice",
    f"t_s,qw,qx,qy,qz,valid,valid\n0,{Q},1,0\n": ":1: column valid is there twice",
    f"t_s,qw,qx,qy,qz,rx,ry,rz,rx\n0,{Q},1,2,3,4\n": ":1: column rx is there twice",
    f'{{"t_ns":1,"q":[{Q}],"q":[{OTHER}]}}\n': ':1: key "q" is there twice',
    f'{{"t_ns":1,"t_ns":2,"q":[{Q}]}}\n': ':1: key "t_ns" is there twice',
    HEAD + f"1763800000000,{Q}\n": (
        ":2: t_s = 1763800000000 s does not fit 64 bits of ns; t_s is in seconds; name"
    ),
    HEAD + f"100.01,{Q}\n100.01,{Q}\n": (
        ":3: time does not increase (t_ns 100010000000 after 100010000000): two attitudes have one"
    ),
    HEAD + f"2,{Q}\n1,{Q}\n": "; sort the log by time",
    f"t,qw,qx,qy,qz\n0,{Q}\n": ":1: column t has no unit; write t_s, or its unit as t [s]",
    f"0,{Q}\n1,{Q}\n": (
        ":1: column t_s is missing, as no line names the columns; the header must have"
        " t_s,qw,qx,qy,qz"
    ),
    HEAD + "0,0,7,0,7,0,0\n": (
        ":2: 7 cells and 5 columns (a decimal comma, or commas between thousands?"
    ),
    HEAD + f"0,{Q},5\n": ":2: 6 cells and 5 columns",
    f"t_s,qw,qx,qy,qz,valid\n0,{Q},maybe\n": ":2: valid = 'maybe'; write 1 or 0",
    "t_s;qw;qx;qy;qz\n0;1;0;0;0\n"
    + "".join(f"{k};1;0;0;0\n" for k in range(1, 101))
    + "200;1,5;0;0;0\n": ":103: '200;1,5;0;0;0' (a decimal comma: write a point)",
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_log_that_may_mean_two_things_is_refused(log, text):
    with pytest.raises(InputError) as refusal:
        open_log(log(text))
    assert REFUSED[text] in str(refusal.value)
