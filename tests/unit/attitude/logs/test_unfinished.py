"""Logs whose programs began before their estimator, ended within a line, or name rates otherwise."""

from __future__ import annotations

import pytest

from tests.support.commands import run_hilstar_here

ROW = "1,0,0,0"
OBJECT = '{"t_ns":%d,"q":[1,0,0,0]}'


def attitudes_of_text(path, text):
    path.write_text(text)
    return run_hilstar_here("attitude", path)


def test_blank_quaternions_at_the_beginning_are_left_out_with_a_notice(tmp_path):
    told = attitudes_of_text(
        tmp_path / "a.csv", f"t_s,qw,qx,qy,qz\n0,,,,\n1,,,,\n2,{ROW}\n3,{ROW}\n"
    )
    assert told.returncode == 0
    assert "2 attitudes are left out at the beginning" in told.stderr
    assert "t_ns 2000000000" in told.stdout


@pytest.mark.parametrize(
    "names", ["wx,wy,wz", "omega_x,omega_y,omega_z", "p,q,r", "gyro_x,gyro_y,gyro_z"]
)
def test_rates_by_other_names_are_not_passed_over_without_a_word(tmp_path, names):
    told = attitudes_of_text(
        tmp_path / "a.csv", f"t_s,qw,qx,qy,qz,{names}\n0,{ROW},1,0,0\n1,{ROW},1,0,0\n"
    )
    assert told.returncode == 0
    for name in names.split(","):
        assert name in told.stderr
    assert "rates are named rx,ry,rz" in told.stderr


def test_rates_by_hilstars_names_are_used_without_a_word(tmp_path):
    text = f"t_s,qw,qx,qy,qz,rx,ry,rz,wx,wy,wz\n0,{ROW},0,0,0,1,1,1\n1,{ROW},0,0,0,1,1,1\n"
    told = attitudes_of_text(tmp_path / "a.csv", text)
    assert told.returncode == 0 and "rates are named" not in told.stderr


@pytest.mark.parametrize(
    "text",
    [
        f'{OBJECT % 0}\n{OBJECT % 10**9}\n{{"t_ns":20',
        f'[{OBJECT % 0},\n{OBJECT % 10**9},\n{{"t_ns":2000000000,"q":[1,0',
    ],
)
def test_an_object_that_the_files_end_cuts_is_left_out_with_a_notice(tmp_path, text):
    told = attitudes_of_text(tmp_path / "a.jsonl", text)
    assert told.returncode == 0
    assert "the last object has no end" in told.stderr
