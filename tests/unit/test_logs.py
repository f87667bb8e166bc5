"""Log files: both forms, and every way that one can be wrong."""

from __future__ import annotations

import pytest

from hilstar.attitude.logs import read_log
from hilstar.errors import InputError

HEAD = "t_s,qw,qx,qy,qz\n"


def test_csv_and_json_lines_give_the_same_samples(tmp_path):
    (tmp_path / "a.csv").write_text("# a comment\n" + HEAD + "0.5,1,0,0,0\n\n1.25,0,1,0,0\n")
    (tmp_path / "a.jsonl").write_text('{"t_ns":500000000,"q":[1,0,0,0]}\n\n{"t_ns":1250000000,"q":[0,1,0,0],"rate":[1,2,3]}\n')
    csv, json = read_log(tmp_path / "a.csv"), read_log(tmp_path / "a.jsonl")
    assert [s.t_ns for s in csv] == [s.t_ns for s in json] == [500_000_000, 1_250_000_000]
    assert csv[1].q_icrs_to_cam.tolist() == json[1].q_icrs_to_cam.tolist() == [0, 1, 0, 0]
    assert csv[1].rate_cam_rad_s is None
    assert json[1].rate_cam_rad_s is not None


def test_csv_columns_may_come_in_any_order_and_with_others(tmp_path):
    (tmp_path / "a.csv").write_text("qx,qy,qz,qw,t_s,note\n0,0,0,1,2,hello\n")
    (sample,) = read_log(tmp_path / "a.csv")
    assert sample.t_ns == 2_000_000_000
    assert sample.q_icrs_to_cam.tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("", "", "no attitude"),
        (HEAD, "", "no attitude"),
        ("t_s,qw,qx,qy\n", ":1:", "qz"),
        (HEAD + "0,1,0,0,0\n1,nan,0,0,0\n", ":3:", "not finite"),
        (HEAD + "nan,1,0,0,0\n", ":2:", "finite"),
        (HEAD + "inf,1,0,0,0\n", ":2:", "finite"),
        (HEAD + "0,1,0,0,0\n0,1,0,0,0\n", ":3:", "does not rise"),
        (HEAD + "0,2,0,0,0\n", ":2:", "norm"),
        (HEAD + "0,1,0,0\n", ":2:", "wanted"),
        (HEAD + "0,x,0,0,0\n", ":2:", "wanted"),
        (HEAD + "1e30,1,0,0,0\n", ":2:", "64 bits"),
        ('{"t_ns":1,"q":[1,0,0,0]}\n{"t_ns":2,"q":[NaN,0,0,0]}\n', ":2:", "NaN"),
        ('{"t_ns":1,"q":[1,0,0,0]}\nnonsense\n', ":2:", "JSON"),
        ('{"t_ns":1}\n', ":1:", "q"),
        ("\xff\xfe", "", "cannot be read"),
    ],
)
def test_a_log_that_is_wrong_is_refused_with_its_line(tmp_path, text, line, word):
    path = tmp_path / "log"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError) as refusal:
        read_log(path)
    assert f"{path}{line}" in str(refusal.value)
    assert word in str(refusal.value)


def test_a_log_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        read_log(tmp_path / "none.csv")
