"""What is stated of a log on the command line of each command that reads one: used by all of them
alike, or refused by name.
"""

from __future__ import annotations

import socket
import struct

import numpy as np
import pytest
from astropy.io import fits
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import OPTIONS
from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.benches import SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.tables import csv_rows

COMMANDS = ["attitude", "replay", "convert", "simulate", "send"]
MOUNTING = (0.5, -0.5, -0.5, -0.5)
TO_CAM = Rotation.from_quat(MOUNTING, scalar_first=True)
CAMERA = Rotation.from_quat(from_radec_roll_deg(84.0, -1.2, 10.0), scalar_first=True)
# A body's attitude, from the body to the ICRS, x, y, z, w.
SENT = (TO_CAM.inv() * CAMERA).inv().as_quat().tolist()
STATED = (
    "--convention",
    "scalar=last,direction=cam_to_icrs",
    "--mounting",
    ",".join(map(str, MOUNTING)),
)
SAME_RAD = 1e-9
ATTITUDE_BYTES = 64
SHOWN_RAD = np.radians(1e-6)  # a header's decimals


@pytest.fixture
def files(tmp_path):
    bench, log = tmp_path / "bench.toml", tmp_path / "log.csv"
    bench.write_text(SMALL_BENCH)
    row = ",".join(map(repr, SENT))
    log.write_text(f"t_s,qw,qx,qy,qz\n0,{row}\n1,{row}\n")
    return bench, log


def line_of(command: str, files, tmp_path, port: int = 9) -> str:
    bench, log = files
    return {
        "attitude": f"attitude {log}",
        "replay": f"replay {bench} {log} --headless --speed max --step 1 -o {tmp_path}/frames",
        "convert": f"convert {log} {tmp_path}/out.csv",
        "simulate": f"simulate {bench} --log {log} --frames 1 -o {tmp_path}/exposures",
        "send": f"send {log} --to udp://127.0.0.1:{port} --wait 0 --count 1",
    }[command]


def off_camera_rad(q) -> float:
    return (Rotation.from_quat([float(c) for c in q], scalar_first=True) * CAMERA.inv()).magnitude()


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_uses_a_convention_and_a_mounting(tmp_path, files, command):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(30)
        result = run_hilstar_here(
            line_of(command, files, tmp_path, receiver.getsockname()[1]), *STATED
        )
        assert result.returncode == 0, result.stderr
        assert (
            'read with convention = { scalar = "last", direction = "cam_to_icrs", frame = "body" }'
            in result.stderr
        )
        if command == "send":
            datagrams = iter(lambda: receiver.recv(100), b"")  # its time requests are among them
            packet = next(datagram for datagram in datagrams if len(datagram) == ATTITUDE_BYTES)
            assert off_camera_rad(struct.unpack_from("<4d", packet, 16)) < SAME_RAD
    if command == "attitude":
        assert "RA 84.0000, Dec -1.2000, roll 10.0000 deg" in result.stdout
    if command in {"replay", "convert"}:
        path = tmp_path / ("frames/frames.csv" if command == "replay" else "out.csv")
        rows = csv_rows(path)
        assert (
            max(off_camera_rad([row[name] for name in ("qw", "qx", "qy", "qz")]) for row in rows)
            < SAME_RAD
        )
    if command == "simulate":
        (path,) = (tmp_path / "exposures").glob("*.fits")
        header = fits.getheader(path)
        assert off_camera_rad([header[name] for name in ("QW", "QX", "QY", "QZ")]) < SHOWN_RAD


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--kernel", "no_such_file.tls"),
        ("--topic", "/imu"),
        ("--body", "base"),
        ("--place", "47,8,400"),
        ("--epoch-utc", "2024-01-01T00:00:00"),
        ("--reference", "map"),
        ("--convention", "scalar=middle"),
        ("--convention", "order=last"),
        ("--mounting", "1,1,1,1"),
    ],
)
def test_each_command_refuses_by_name_what_is_not_used(tmp_path, files, command, option, value):
    result = run_hilstar_here(line_of(command, files, tmp_path), option, value)
    assert_refused(result, 2, option)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_mounting_of_the_cameras_own_attitude_is_a_contradiction(tmp_path, files, command):
    stated = ("--mounting", "0.5,-0.5,-0.5,-0.5", "--convention", "frame=cam")
    result = run_hilstar_here(line_of(command, files, tmp_path), *stated)
    assert_refused(
        result,
        2,
        "says that the attitudes are the camera's; write frame=body, or leave out --mounting",
    )


def test_without_a_log_nothing_can_be_stated_of_one(files):
    bench, _ = files
    for command in (f"simulate {bench} --radec 84,-1,0 --png a.png", "send --spin z,1"):
        for option in OPTIONS.values():
            assert_refused(run_hilstar_here(command, option, "x"), 2, f"{option} x: it is for")


def test_the_convention_of_a_bench_file_holds_for_its_logs_and_the_command_line_takes_its_place(
    tmp_path, files
):
    bench, log = files
    table = 'convention = { scalar = "last", direction = "cam_to_icrs", frame = "body" }'
    bench.write_text(
        SMALL_BENCH.replace("[tracker]", f"[tracker]\nq_body_to_cam = {list(MOUNTING)}")
        + f"[attitude]\n{table}\n"
    )
    looked = run_hilstar_here("attitude", log, "--bench", bench)
    assert "RA 84.0000, Dec -1.2000, roll 10.0000 deg" in looked.stdout
    assert "([attitude] convention)" in looked.stderr
    own = tmp_path / "own.csv"
    q = ",".join(map(repr, CAMERA.as_quat(scalar_first=True).tolist()))
    own.write_text(f"t_s,qw,qx,qy,qz\n0,{q}\n")
    looked = run_hilstar_here("attitude", own, "--bench", bench, "--convention", "frame=cam")
    assert "RA 84.0000, Dec -1.2000, roll 10.0000 deg" in looked.stdout
    assert "[tracker] q_body_to_cam does not turn these attitudes" in looked.stderr
