"""Zeros and NaN from before an estimator ran: left out at a log's beginning in every format,
refused anywhere else.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from mcap.writer import Writer

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.mcap_log import register_attitudes
from hilstar.basics.errors import InputError
from tests.support.sources import ros_bags
from tests.support.sources.aem_messages import kvn
from tests.support.sources.attitude_texts import cic_text, stk_text

ZEROS, NAN, SET = (0.0,) * 4, (np.nan,) * 4, (0.5, -0.5, 0.5, 0.5)
START_NS = ros_bags.START_NS


def csv(folder, rows):
    path = folder / "a.csv"
    path.write_text(
        "t_s,qw,qx,qy,qz\n" + "".join(f"{k},{','.join(map(str, q))}\n" for k, q in enumerate(rows))
    )
    return path


def json_lines(folder, rows):
    path = folder / "a.jsonl"
    path.write_text(
        "".join(json.dumps({"t_ns": k * 10**9, "q": q}) + "\n" for k, q in enumerate(rows))
    )
    return path


def unset_aem(folder, rows):
    path = folder / "a.aem"
    states = [f"2026-01-01T00:00:0{k} {' '.join(map(str, q))}" for k, q in enumerate(rows)]
    path.write_text(kvn(states, QUATERNION_TYPE="FIRST"))
    return path


def cic(folder, rows):
    path = folder / "a.cic"
    path.write_text(cic_text([f"60310 {k} {' '.join(map(str, q))}" for k, q in enumerate(rows)]))
    return path


def stk(folder, rows):
    path = folder / "a.a"
    lines = [f"{k} {' '.join(map(str, q))}" for k, q in enumerate(rows)]
    path.write_text(stk_text(lines, "AttitudeTimeQuatScalarFirst"))
    return path


def mcap(folder, rows):
    path = folder / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="another program")
        channel = register_attitudes(writer)
        for k, q in enumerate(rows):
            message = json.dumps({"t_ns": k * 10**9, "q": q}).encode()
            writer.add_message(channel, log_time=k, data=message, publish_time=k)
        writer.finish()
    return path


def unset_bag(folder, rows, stamped=True):
    make, sent = ros_bags.Make("humble"), []
    for k, q in enumerate(rows):
        t_ns = START_NS + k * 10**8
        stamp_ns = t_ns if stamped or q == SET else 0
        sent.append(
            (
                "/a",
                ros_bags.POSE_STAMPED,
                t_ns,
                make.of(ros_bags.POSE_STAMPED, stamp_ns, "icrs", "", q, ()),
            )
        )
    return ros_bags.write_bag2(folder / "bag", sent, "humble")


def unstamped_bag(folder, rows):
    return unset_bag(folder, rows, stamped=False)


WRITERS = [csv, json_lines, unset_aem, cic, stk, mcap, unset_bag, unstamped_bag]
# JSON has no NaN
CASES = [
    (write, empty) for write in WRITERS for empty in (ZEROS, NAN) if (write, empty) != (mcap, NAN)
]


@pytest.mark.parametrize(("write", "empty"), CASES)
def test_what_is_before_the_estimator_ran_is_left_out_with_a_notice(tmp_path, write, empty):
    log = open_log(write(tmp_path, [empty, empty, empty, SET, SET]))
    assert len(log.samples) == 2
    assert abs(log.samples[0].q_icrs_to_cam).tolist() == [0.5] * 4
    notice = (
        "3 attitudes are left out at the beginning: zeros or NaN, from before the estimator ran"
    )
    assert dict(log.told)["log-start"] == notice


@pytest.mark.parametrize(("write", "empty"), CASES)
def test_zeros_after_an_attitude_are_refused_with_their_place(tmp_path, write, empty):
    with pytest.raises(
        InputError,
        match=r"(norm is 0|not finite|NaN or Infinity).*are a dropout: leave those entries out",
    ):
        open_log(write(tmp_path, [empty, SET, empty, SET]))


@pytest.mark.parametrize(("write", "empty"), CASES)
def test_a_log_of_nothing_else_says_that_the_estimator_never_ran(tmp_path, write, empty):
    with pytest.raises(
        InputError, match=r"no attitude in 3 entries: zeros or NaN, from before the estimator ran"
    ):
        open_log(write(tmp_path, [empty, empty, empty]))


def test_a_level_frame_begins_at_the_first_attitude(tmp_path):
    stated = Stated(reference="enu", place=(47.0, 8.0, 400.0), epoch_utc="2024-01-01T00:00:00")
    path = csv(tmp_path, [ZEROS, SET, SET])
    late = open_log(path, stated)
    path.write_text(path.read_text().replace("0,0.0,0.0,0.0,0.0\n", ""))
    assert np.array_equal(
        late.samples[0].q_icrs_to_cam, open_log(path, stated).samples[0].q_icrs_to_cam
    )
