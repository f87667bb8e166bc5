"""What a user states of a log is used or refused by name: every format with every statement."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import OPTIONS, Stated
from hilstar.attitude.logs.log_file import open_log, write_log
from hilstar.attitude.logs.log_formats import check_stated, log_formats
from hilstar.attitude.wire.source import Convention, Mounting
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import propagate
from tests.support.log_files import FILES, QUATERNIONS, TURNS, ledger
from tests.support.sources.aem_messages import kvn

ROUNDING = 1e-14  # of four products of unit quaternions
SEVEN_DECIMALS_RAD = 2e-7  # half a last digit in each of four components, twice as an angle
MOUNTING = (0.5, -0.5, -0.5, -0.5)
STATEMENTS = {
    "mounting": Mounting(MOUNTING, by_option=True),
    "kernels": (Path("no_such_file.tls"),),
    "topic": "/other",
    "body": "OTHER",
    "reference": "ned",
    "epoch_utc": "2024-01-01T00:00:00",
    "place": (47.0, 8.0, 400.0),
    "convention": Convention(direction="cam_to_icrs"),
}


def attitudes_of_log(path: Path, stated: Stated) -> np.ndarray:
    return np.array([sample.q_icrs_to_cam for sample in open_log(path, stated).samples])


def test_every_statement_is_looked_at_here():
    assert set(STATEMENTS) == set(OPTIONS)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("statement", OPTIONS)
def test_a_statement_is_used_or_refused_by_name(tmp_path, name, statement):
    needed = FILES[name].stated
    path = FILES[name].make(tmp_path)
    stated = replace(needed, **{statement: STATEMENTS[statement]})
    own = next(each for each in log_formats() if each.name == name)
    if statement not in own.uses:
        with pytest.raises(InputError, match=f"{path}: {OPTIONS[statement]}: .*; leave it out"):
            open_log(path, stated)
        return
    assert check_stated(path, stated) == own
    try:
        found = attitudes_of_log(path, stated)
    except InputError as error:  # what it names is not there, or needs another statement beside it
        said = str(error)
        assert (
            f"{OPTIONS[statement]} " in said
            or str(STATEMENTS[statement]) in said
            or "no_such_file" in said
        )
        return
    assert not np.allclose(found, attitudes_of_log(path, needed), atol=1e-6), (
        "it was stated, and changed nothing"
    )


@pytest.mark.parametrize("name", ["CSV", "JSON lines", "an MCAP file"])
@pytest.mark.parametrize("statement", ["place", "epoch_utc"])
def test_a_place_or_a_date_of_attitudes_in_the_icrs_is_refused(tmp_path, name, statement):
    stated = Stated(**{statement: STATEMENTS[statement]})
    with pytest.raises(
        InputError, match=f"{OPTIONS[statement]} is for attitudes that refer to a level frame"
    ):
        open_log(FILES[name].make(tmp_path), stated)


@pytest.mark.parametrize("name", ["CSV", "JSON lines", "an MCAP file"])
def test_a_mounting_of_the_command_says_that_a_log_is_the_bodys(tmp_path, name):
    path = FILES[name].make(tmp_path)
    found = Rotation.from_quat(
        attitudes_of_log(path, Stated(Mounting(MOUNTING, by_option=True))), scalar_first=True
    )
    wanted = Rotation.from_quat(MOUNTING, scalar_first=True) * TURNS
    assert (found * wanted.inv()).magnitude().max() < ROUNDING


@pytest.mark.parametrize("name", ["CSV", "JSON lines", "an MCAP file"])
def test_a_mounting_of_the_bench_file_that_turns_nothing_is_told(tmp_path, name):
    log = open_log(FILES[name].make(tmp_path), Stated(Mounting(MOUNTING)))
    assert "[tracker] q_body_to_cam does not turn these attitudes" in dict(log.told)["mounting"]
    assert np.array_equal(log.samples[0].q_icrs_to_cam, QUATERNIONS[0])


def test_a_mounting_where_the_file_says_the_cameras_is_refused(tmp_path):
    path = tmp_path / "a.aem"
    path.write_text(
        kvn([f"2026-01-01T00:00:0{k} 0 0 0 1" for k in range(3)], REF_FRAME_B="STARTRACKER_1")
    )
    with pytest.raises(InputError, match="--mounting: its attitudes are the camera's own"):
        open_log(path, Stated(Mounting(MOUNTING, by_option=True)))
    assert not dict(open_log(path, Stated(Mounting(MOUNTING))).told)


@pytest.mark.parametrize(
    ("reference", "is_told"),
    [("ECI", True), ("Inertial", True), ("eci_j2000", True), ("J2000", False), ("icrs", False)],
)
def test_a_reference_that_only_simulators_call_inertial_is_told(tmp_path, reference, is_told):
    log = open_log(FILES["CSV"].make(tmp_path), Stated(reference=reference))
    line = f"the frame '{reference}' is taken as the ICRS; a frame of date is 0.4 deg off by now"
    assert [text for kind, text in log.told if kind == "reference"] == [line] * is_told
    assert np.array_equal([sample.q_icrs_to_cam for sample in log.samples], QUATERNIONS)


@pytest.mark.parametrize("reference", [None, "ned"])
def test_attitudes_that_were_not_set_at_the_beginning_are_counted_in_any_frame(tmp_path, reference):
    path = tmp_path / "a.csv"
    rows = ["t_s,qw,qx,qy,qz", "1,nan,nan,nan,nan", "2,0,0,0,0", "3,1,0,0,0", "4,1,0,0,0"]
    path.write_text("\n".join([*rows, ""]))
    stated = Stated()
    if reference is not None:
        stated = Stated(
            reference=reference, place=(47.0, 8.0, 0.0), epoch_utc=STATEMENTS["epoch_utc"]
        )
    log = open_log(path, stated)
    assert [sample.t_ns for sample in log.samples] == [3 * 10**9, 4 * 10**9]
    assert dict(log.told)["log-start"].startswith("2 attitudes are left out at the beginning: ")


def test_what_a_bench_file_says_of_packets_is_not_done_to_a_ledger_again(tmp_path):
    path = ledger(tmp_path)
    other = Convention(scalar="last", direction="cam_to_icrs", frame="body")
    by_bench = Stated(Mounting(MOUNTING), convention=other, convention_by="[attitude] convention")
    log = open_log(path, by_bench)
    assert np.array_equal([sample.q_icrs_to_cam for sample in log.samples], QUATERNIONS)
    assert not log.told
    with pytest.raises(
        InputError, match=r"\[attitude\] convention: a CCSDS AEM has a convention of its own"
    ):
        open_log(FILES["a CCSDS AEM"].make(tmp_path), by_bench)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 0, 1, 2), (1, 2, 3, 0)])
def test_the_columns_of_a_csv_are_told_by_name_or_in_their_order(tmp_path, order):
    names = [("qw", "qx", "qy", "qz")[k] for k in order]
    rows = [[repr(float(q[k])) for k in order] for q in QUATERNIONS]
    path = tmp_path / "a.csv"
    lines = [f"{k},{','.join(row)}" for k, row in enumerate(rows)]
    path.write_text("\n".join([f"t_s,{','.join(names)}", *lines]))
    assert np.array_equal(attitudes_of_log(path, Stated()), QUATERNIONS)
    last = [repr(float(c)) for c in TURNS[0].as_quat()]  # x, y, z, w
    path.write_text(f"t_s,{','.join(names)}\n0,{','.join(last)}\n")
    assert np.array_equal(
        attitudes_of_log(path, Stated(convention=Convention(scalar="last")))[0], QUATERNIONS[0]
    )


@pytest.mark.parametrize("scalar", ["first", "last"])
@pytest.mark.parametrize("direction", ["icrs_to_cam", "cam_to_icrs"])
@pytest.mark.parametrize("frame", ["cam", "body"])
def test_json_lines_of_each_convention(tmp_path, scalar, direction, frame):
    rate, to_cam = np.array([0.01, -0.02, 0.03]), Rotation.from_quat(MOUNTING, scalar_first=True)
    turn, own = (
        (TURNS[0], rate) if frame == "cam" else (to_cam.inv() * TURNS[0], to_cam.inv().apply(rate))
    )
    sent = turn if direction == "icrs_to_cam" else turn.inv()
    row = {
        "t_ns": 0,
        "q": sent.as_quat(scalar_first=scalar == "first").tolist(),
        "rate": own.tolist(),
    }
    path = tmp_path / "a.jsonl"
    path.write_text(json.dumps(row) + "\n")
    convention = Convention(scalar=scalar, direction=direction, frame=frame)
    (sample,) = open_log(path, Stated(Mounting(MOUNTING), convention=convention)).samples
    assert (
        Rotation.from_quat(sample.q_icrs_to_cam, scalar_first=True) * TURNS[0].inv()
    ).magnitude() < ROUNDING
    assert sample.rate_cam_rad_s == pytest.approx(rate, abs=ROUNDING)


def turning_log(folder: Path, sent: Convention) -> Path:
    """A log of a steady turn with rates, its quaternions sent in a convention."""
    path, rate_rad_s = folder / "turning.jsonl", np.array([0.02, 0.05, -0.03])
    lines = []
    for k in range(100):
        q = propagate(QUATERNIONS[0], rate_rad_s, 0.05 * k)
        message = {
            "t_ns": k * 50_000_000,
            "q": sent.as_sent(q).tolist(),
            "rate": rate_rad_s.tolist(),
        }
        lines.append(json.dumps(message))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("stated", "advice"),
    [
        (Stated(), "write --convention scalar=last,direction=cam_to_icrs"),
        (
            Stated(convention=Convention(scalar="last")),
            "write --convention scalar=last,direction=cam_to_icrs",
        ),
        (
            Stated(Mounting(MOUNTING, by_option=True)),
            "write --convention scalar=last,direction=cam_to_icrs,frame=body",
        ),
        (
            Stated(convention_by="[attitude] convention"),
            'write [attitude] convention = { scalar = "last", direction = "cam_to_icrs" }',
        ),
    ],
)
def test_a_log_that_is_read_otherwise_is_told_what_to_state_in_place_of_what_is(
    tmp_path, stated, advice
):
    sent = Convention(scalar="last", direction="cam_to_icrs")
    told = dict(open_log(turning_log(tmp_path, sent), stated).joins().told)
    assert told["convention-wrong"].endswith(advice)


def test_a_log_that_is_read_as_it_was_sent_is_told_nothing(tmp_path):
    sent = Convention(scalar="last", direction="cam_to_icrs")
    assert open_log(turning_log(tmp_path, sent), Stated(convention=sent)).joins().told == []


def test_a_log_with_a_convention_of_its_own_is_told_no_statement_that_it_refuses(tmp_path):
    log = open_log(turning_log(tmp_path, Convention(direction="cam_to_icrs")))
    path = tmp_path / "conjugates.aem"
    write_log(path, log.samples)
    told = dict(open_log(path).joins().told)
    assert "look at what the simulator puts into its quaternion" in told["convention-wrong"]
    assert (
        "convention =" not in told["convention-wrong"]
        and "--convention" not in told["convention-wrong"]
    )


@pytest.mark.parametrize("reference", ["icrs", "enu", "ned"])
@pytest.mark.parametrize("scalar", ["first", "last"])
@pytest.mark.parametrize("direction", ["icrs_to_cam", "cam_to_icrs"])
def test_the_check_value_of_a_log_is_read_as_the_attitude_that_it_is_told_for(
    tmp_path, reference, scalar, direction
):
    """What the log has to say at its first time, for Orion in the middle, brings Orion there."""
    stated = Stated(convention=Convention(scalar=scalar, direction=direction), reference=reference)
    if reference != "icrs":
        stated = replace(stated, place=(47.0, 8.0, 400.0), epoch_utc="2026-11-21T06:00:00")
    path = tmp_path / "a.csv"
    head = "t_s,qw,qx,qy,qz"
    path.write_text(f"{head}\n1.5,{','.join(map(repr, QUATERNIONS[0].tolist()))}\n")
    q_orion = Rotation.from_quat([0.6987226, 0.7135120, -0.0370377, 0.0362700], scalar_first=True)
    text = open_log(path, stated).conventions.written(q_orion.as_quat(scalar_first=True))
    numbers = re.findall(r"-?\d+\.\d+", text)
    assert numbers[4:] in ([], ["1.500000000"])
    path.write_text(f"{head}\n1.5,{','.join(numbers[:4])}\n")
    found = Rotation.from_quat(attitudes_of_log(path, stated)[0], scalar_first=True)
    assert (found * q_orion.inv()).magnitude() < SEVEN_DECIMALS_RAD
