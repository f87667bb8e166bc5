"""Log files: every way from one form to another, what CSV and JSON lines may hold, and how logs are
written.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hilstar.attitude.logs import log_file as logs
from hilstar.attitude.logs.log_file import read_log, write_log
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.errors import InputError
from tests.support.refusals import refusal

HEAD = "t_s,qw,qx,qy,qz\n"
FULL_HEAD = "t_s,qw,qx,qy,qz,rx,ry,rz,sequence,discontinuity\n"

FORMATS = ("csv", "jsonl", "kvn", "xml", "mcap")  # what the endings come down to
AEM_FORMS = {"aem", "kvn", "xml"}
# An AEM holds a rate as a quaternion derivative: there and back are 16 products summed by fours,
# each rounded to eps/2.
RATE_TOLERANCE = 16 * np.finfo(np.float64).eps


def random_samples(rng, count, every_rate=True):
    """Samples from before 1970 to after 2000, of unit length to the last bit, with breaks."""
    times = np.cumsum(rng.integers(1, 2 * 10**18 // count, size=count)) - 10**18
    samples = []
    while len(samples) < count:
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        if math.hypot(*q) != 1.0:  # what is not exactly unit is scaled once more by every reader
            continue
        i = len(samples)
        rate = (
            rng.normal(size=3) * 10.0 ** rng.integers(-9, 3)
            if every_rate or rng.random() < 0.7
            else None
        )
        samples.append(
            AttitudeSample(
                int(times[i]), q, rate, int(rng.integers(0, 2**32)), bool(i and rng.random() < 0.2)
            )
        )
    return samples


def as_aem_holds(samples):
    """What is left of samples in an AEM: no sequence, and no rates in a block where one is
    missing.
    """
    starts = [i for i, sample in enumerate(samples) if i == 0 or sample.discontinuity] + [
        len(samples)
    ]
    kept = []
    for begin, end in pairwise(starts):
        block = samples[begin:end]
        whole = all(sample.rate_cam_rad_s is not None for sample in block)
        kept += [
            replace(s, sequence=0, rate_cam_rad_s=s.rate_cam_rad_s if whole else None)
            for s in block
        ]
    return kept


def assert_same_samples(read, expected, rate_tolerance):
    assert [s.t_ns for s in read] == [s.t_ns for s in expected]
    assert [s.sequence for s in read] == [s.sequence for s in expected]
    assert [s.discontinuity for s in read] == [s.discontinuity for s in expected]
    for one, other in zip(read, expected, strict=True):
        assert one.q_icrs_to_cam.tolist() == other.q_icrs_to_cam.tolist()
        assert (one.rate_cam_rad_s is None) == (other.rate_cam_rad_s is None)
        if one.rate_cam_rad_s is not None and other.rate_cam_rad_s is not None:
            error = np.linalg.norm(one.rate_cam_rad_s - other.rate_cam_rad_s)
            assert error <= rate_tolerance * np.linalg.norm(other.rate_cam_rad_s)


# Round trips


@pytest.mark.parametrize("every_rate", [True, False])
@pytest.mark.parametrize("second", FORMATS)
@pytest.mark.parametrize("first", FORMATS)
def test_a_log_goes_from_any_form_to_any_other_and_keeps_what_both_can_hold(
    tmp_path, first, second, every_rate
):
    samples = random_samples(np.random.default_rng(7), 30, every_rate)
    write_log(tmp_path / f"a.{first}", samples)
    write_log(tmp_path / f"b.{second}", read_log(tmp_path / f"a.{first}"))
    aem = {first, second} & AEM_FORMS
    expected = as_aem_holds(samples) if aem else samples
    assert_same_samples(
        read_log(tmp_path / f"b.{second}"), expected, 2 * RATE_TOLERANCE if aem else 0.0
    )


@pytest.mark.parametrize(("one", "other"), [("jsonl", "json"), ("kvn", "aem")])
def test_two_endings_of_one_format_hold_the_same(tmp_path, one, other):
    samples = random_samples(np.random.default_rng(7), 30, every_rate=False)
    for form in (one, other):
        write_log(tmp_path / f"a.{form}", samples)
    texts = [
        re.sub("CREATION_DATE.*", "", (tmp_path / f"a.{form}").read_text()) for form in (one, other)
    ]
    assert texts[0] == texts[1]


# CSV and JSON lines


def test_csv_and_json_lines_give_the_same_samples(tmp_path):
    (tmp_path / "a.csv").write_text("# a comment\n" + HEAD + "0.5,1,0,0,0\n\n1.25,0,1,0,0\n")
    (tmp_path / "a.jsonl").write_text(
        '{"t_ns":500000000,"q":[1,0,0,0]}\n\n{"t_ns":1250000000,"q":[0,1,0,0],"rate":[1,2,3]}\n'
    )
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


def test_csv_cells_that_are_empty_are_not_known(tmp_path):
    (tmp_path / "a.csv").write_text(FULL_HEAD + "0,1,0,0,0,,,,,\n1,1,0,0,0,1,2,3,4,1\n")
    first, second = read_log(tmp_path / "a.csv")
    assert (first.rate_cam_rad_s, first.sequence, first.discontinuity) == (None, 0, False)
    assert second.rate_cam_rad_s is not None
    assert (second.rate_cam_rad_s.tolist(), second.sequence, second.discontinuity) == (
        [1, 2, 3],
        4,
        True,
    )


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1.7e9", 1_700_000_000 * 10**9),
        ("-0.0000000015", -2),
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        (" 2 ", 2 * 10**9),
    ],
)
def test_csv_seconds_are_read_as_decimals_to_the_nearest_nanosecond(tmp_path, text, t_ns):
    (tmp_path / "a.csv").write_text(HEAD + f"{text},1,0,0,0\n")
    assert read_log(tmp_path / "a.csv")[0].t_ns == t_ns


def test_json_lines_may_begin_with_blank_lines(tmp_path):
    (tmp_path / "a.jsonl").write_text('\n  \n {"t_ns":5,"q":[1,0,0,0]}\n')
    assert read_log(tmp_path / "a.jsonl")[0].t_ns == 5


# Writing


def test_a_name_that_says_no_form_is_refused_with_those_that_do(tmp_path):
    with pytest.raises(InputError, match="not a log's name; end it in one of ") as caught:
        write_log(tmp_path / "a.txt", random_samples(np.random.default_rng(0), 1))
    for ending in ("csv", "jsonl", "json", "aem", "kvn", "xml", "mcap"):
        assert f".{ending}" in str(caught.value)


def test_an_old_log_is_kept_when_the_new_one_fails_half_way(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")
    broken = AttitudeSample(1, None)  # type: ignore[arg-type]
    with pytest.raises(AttributeError):
        write_log(path, [*random_samples(np.random.default_rng(0), 3), broken])
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path):
    samples = random_samples(np.random.default_rng(0), 1)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.csv").mkdir()
    for path in (tmp_path / "none" / "a.csv", tmp_path / "file" / "a.csv", tmp_path / "folder.csv"):
        assert "cannot be written" in refusal(write_log, path, samples)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.csv"]


def test_a_log_has_no_more_attitudes_than_memory_can_hold(tmp_path, monkeypatch):
    monkeypatch.setattr(logs, "MAX_SAMPLES", 3)
    path = tmp_path / "log.csv"
    rows = [f"{k},1,0,0,0" for k in range(4)]
    path.write_text("\n".join(["t_s,qw,qx,qy,qz", *rows[:3]]) + "\n")
    assert len(read_log(path)) == 3
    path.write_text("\n".join(["t_s,qw,qx,qy,qz", *rows]) + "\n")
    with pytest.raises(
        InputError, match=r"log.csv:5: more than 3 attitudes; split the log into several"
    ):
        read_log(path)


@pytest.mark.parametrize(
    ("second", "words", "is_dropout"),
    [
        ("0.0,1,0,0,0", "two attitudes have one time; write more of its digits", False),
        ("0.5,0,0,0,0", ":3: ", True),
        ("0.5,1,1,0,0", ":3: ", False),
    ],
)
def test_what_follows_an_attitude_and_is_none_is_refused_with_its_line(
    tmp_path, second, words, is_dropout
):
    path = tmp_path / "log.csv"
    path.write_text(f"t_s,qw,qx,qy,qz\n0.0,0,1,0,0\n{second}\n1.0,1,0,0,0\n")
    line = refusal(read_log, path)
    assert words in line
    assert (logs.DROPOUT in line) is is_dropout


def starting_at(first_ns):
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    return [AttitudeSample(first_ns + k * 10**9, turn) for k in range(3)]


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        (None, 0),
        ("0.25", 250_000_000),
        ("2", 2_000_000_000),
        ("2024-01-01T00:00:01.5", 1_500_000_000),
    ],
)
def test_a_time_is_in_seconds_from_the_log_s_begin_or_a_date(tmp_path, text, t_ns):
    first_ns = 1_704_067_200 * 10**9
    assert logs.time_in_log(tmp_path, starting_at(first_ns), text) == first_ns + t_ns


@pytest.mark.parametrize(
    ("first_ns", "text", "words"),
    [
        (10**9, "2.1", "is 2 s long, and its times are no dates; write"),
        (1_704_067_200 * 10**9, "-0.1", "is 2 s long, from 2024-01-01T00:00:00"),
        (1_704_067_200 * 10**9, "nan", "--time nan: "),
        (1_704_067_200 * 10**9, "noon", "--time noon: "),
    ],
)
def test_a_time_beyond_a_log_is_refused_with_its_span(tmp_path, first_ns, text, words):
    assert words in refusal(logs.time_in_log, tmp_path, starting_at(first_ns), text)
