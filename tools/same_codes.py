"""Do two installations of hilstar draw the same codes, bit for bit?

    python tools/same_codes.py BEFORE/bin/hilstar AFTER/bin/hilstar

Both replay a log of ten attitudes on each of BENCHES (round, exact, temporal, dither, bit stealing,
a black level, 10 bits, a lens, bodies, satellites, faults, motion, effort, primaries), write one
linear image with its truth table, and simulate one exposure of the virtual tracker; every picture, table and
exposure is compared by its pixels. Exit code 1 where one differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import png

SEED = 31
FRAMES = 10
STEP_S = 0.1
GEOMETRY = """kind = "hilstar geometry 1"
resolution_px = [640, 480]
focal_length_px = 2081.5
principal_point_px = [321, 238.5]
q_cam_to_mon = [0.99999, 0, 0, 0.00447]
k1 = 0.6
p1 = 0.001
tilt_deg = [0.8, -0.5]
"""
STATION = """ISS (ZARYA)
1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927
2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537
"""
OTHERS = """OBJECT A
1 25545U 98067B   08264.51782528 -.00002182  00000-0 -11606-4 0  2928
2 25545  51.6416 247.4627 0006703 130.5360 325.9288 15.72125391563537
OBJECT B
1 25546U 98067C   08264.51782528 -.00002182  00000-0 -11606-4 0  2929
2 25546  51.6416 247.1627 0006703 130.5360 325.4288 15.72125391563530
"""
SCENARIO = """seed = 1
[[fault]]
name = "ghost"
kind = "false-star"
at_s = 0.1
for_s = 0.5
radec_deg = [84.05, -1.2]
v_mag = 2.0
[[fault]]
name = "no Mintaka"
kind = "star-gone"
at_s = 0.1
for_s = 0.3
star = "Mintaka"
[[fault]]
name = "protons"
kind = "cosmic-rays"
at_s = 0.2
for_s = 0.4
number = 40
electrons = 8000
length_px = 12.0
[[fault]]
name = "sun glow"
kind = "glow"
at_s = 0.3
for_s = 0.4
tracker_px = [-600.0, 200.0]
electrons_per_s = 3000.0
scale_deg = 2.0
exponent = 2.5
[[fault]]
name = "wrong"
kind = "attitude-step"
at_s = 0.7
for_s = 0.2
turn_deg = [0.0, 0.1, 0.0]
"""

SRGB = {"xy_r": [0.64, 0.33], "xy_g": [0.3, 0.6], "xy_b": [0.15, 0.06], "layout": "rgb-stripe"}

Tables = dict[str, dict[str, Any]]
BASE: Tables = {
    "tracker": {
        "aperture_mm": 30,
        "focal_length_mm": 70,
        "pixel_pitch_um": 13,
        "resolution_px": [512, 512],
        "quantum_efficiency": "ccd47-20",
        "transmission": "n-bk7-10mm",
    },
    "tracker.detector": {"read_noise_e": 12, "dark_e_per_s": 50, "prnu": 0.01, "dsnu_e_per_s": 5},
    "sky": {"faintest_v_mag": 8.0, "epoch_utc": "2008-09-20T13:16:00Z"},
    "monitor": {"resolution_px": [640, 480], "pixel_pitch_um": 57.65},
    "collimator": {"focal_length_mm": 120},
    "render": {"quantisation": "exact", "brightest_v_mag": 2.0},
}
BENCHES: dict[str, Tables] = {
    "round": {"render": {"quantisation": "round"}},
    "exact": {},
    "temporal": {"render": {"quantisation": "temporal", "cycle_frames": 6}},
    "dither": {"render": {"quantisation": "dither"}, "monitor": {"calibration": "gamma2.2"}},
    "bit stealing": {"render": {"quantisation": "round", "bit_stealing": True}},
    "lcd-example": {"monitor": {"calibration": "lcd-example"}},
    "10 bits, turned": {"monitor": {"bits": 10, "flip_x": True, "rotate_deg": 90}},
    "lens": {"collimator": {"geometry": "geometry.toml"}},
    "bodies": {
        "sky.bodies": {"planets": True, "moon": True, "sun": True, "earth": True},
        "spacecraft": {"orbit": "station.tle"},
    },
    "satellites": {
        "sky.bodies": {"satellites": "others.tle", "satellite_standard_mag": 3},
        "spacecraft": {"orbit": "station.tle"},
    },
    "faults": {},
    "motion": {"render": {"quantisation": "exact", "motion": "on"}, "monitor": {"scanout_ms": 15}},
    "effort": {"render": {"quantisation": "auto", "effort": "auto", "tolerance_px": 0.05}},
    "primaries": {"monitor.primaries": SRGB, "render": {"colour": "star"}},
    "primaries, round": {
        "monitor.primaries": SRGB,
        "render": {"colour": "star", "quantisation": "round"},
    },
    "primaries, temporal": {
        "monitor.primaries": SRGB,
        "render": {"colour": "star", "quantisation": "temporal", "cycle_frames": 6},
    },
    "primaries, dither": {
        "monitor.primaries": SRGB | {"layout": "white"},
        "render": {"colour": "star", "quantisation": "dither"},
    },
    "primaries, motion": {
        "monitor": {"scanout_ms": 15},
        "monitor.primaries": SRGB,
        "render": {"colour": "star", "motion": "on"},
    },
    "primaries, bodies": {
        "sky.bodies": {"planets": True, "moon": True, "sun": True, "earth": True},
        "spacecraft": {"orbit": "station.tle"},
        "monitor.primaries": SRGB,
        "render": {"colour": "star"},
    },
}
RATES_DEG_S = {
    "motion": (2.0, 1.0, 3.0),
    "bodies": (0.3, -0.2, 0.1),
    "satellites": (0.0, 0.5, 0.0),
    "primaries, motion": (2.0, 1.0, 3.0),
    "primaries, bodies": (0.3, -0.2, 0.1),
}
ORION_DEG = (84.057, -1.2)
# at the epoch, from the station: the Moon, Jupiter, the Earth's limb, and the two other satellites
BODIES_DEG = [(62.5, 26.0), (283.8, -23.15), (12.3, -25.6)]
TARGETS_DEG = {
    "bodies": BODIES_DEG,
    "primaries, bodies": BODIES_DEG,
    "primaries, motion": [ORION_DEG],
    "satellites": [(262.7, 18.56), (240.95, 32.7)],
    "motion": [ORION_DEG],
}
USUAL_RATE_DEG_S = (0.05, 0.02, 0.1)


def toml_of(name: str) -> str:
    """The bench file of one of BENCHES."""
    tables = {table: dict(keys) for table, keys in BASE.items()}
    for table, keys in BENCHES[name].items():
        tables.setdefault(table, {}).update(keys)
    return "\n".join(
        f"[{table}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
        for table, keys in tables.items()
    )


def product(p: Any, q: Any) -> Any:
    """The Hamilton product of two quaternions (w, x, y, z)."""
    (a, *u), (b, *v) = p, q
    u, v = np.array(u), np.array(v)
    return np.concatenate([[a * b - u @ v], a * v + b * u + np.cross(u, v)])


def pointing_at(ra_deg: float, dec_deg: float) -> Any:
    """`q_icrs_to_cam` (4,) of a boresight with north up: +x right is west, +y down is south."""
    ra, dec = np.radians([ra_deg, dec_deg])
    west = np.array([np.sin(ra), -np.cos(ra), 0.0])
    south = np.array([np.sin(dec) * np.cos(ra), np.sin(dec) * np.sin(ra), -np.cos(dec)])
    boresight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    matrix = np.array([west, south, boresight])
    symmetric = np.block(
        [
            [np.trace(matrix), np.zeros((1, 3))],
            [np.zeros((3, 1)), matrix + matrix.T - np.trace(matrix) * np.eye(3)],
        ]
    )
    odd = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    symmetric[0, 1:] = symmetric[1:, 0] = odd
    return np.linalg.eigh(symmetric)[1][:, -1]


def write_log(path: Path, name: str) -> None:
    """Write ten attitudes that turn at the bench's rate: from TARGETS_DEG in equal parts, the
    others' second half anywhere.
    """
    rng = np.random.default_rng([SEED, list(BENCHES).index(name)])
    omega = np.radians(RATES_DEG_S.get(name, USUAL_RATE_DEG_S))
    targets = TARGETS_DEG.get(name, [ORION_DEG])
    lines = ["t_s,qw,qx,qy,qz,rx,ry,rz"]
    for k in range(FRAMES + 1):
        angle = np.linalg.norm(omega) * k * STEP_S
        turn = np.concatenate(
            [[np.cos(angle / 2)], -np.sin(angle / 2) * omega / np.linalg.norm(omega)]
        )
        start = pointing_at(*targets[min(k * len(targets) // FRAMES, len(targets) - 1)])
        if name not in TARGETS_DEG and k >= FRAMES // 2:
            start = rng.normal(size=4)
        q = product(turn, start / np.linalg.norm(start))
        lines.append(",".join(f"{value:.12f}" for value in (k * STEP_S, *q, *omega)))
    path.write_text("\n".join(lines) + "\n")


def hashed(path: Path) -> str:
    """A hash of what a file holds: pixels of a picture, data of a FITS image, a table's text."""
    if path.suffix == ".png":
        width, height, rows, info = png.Reader(filename=str(path)).read()
        data = repr((width, height, info["planes"])).encode() + b"".join(
            bytes(np.asarray(row)) for row in rows
        )
    elif path.suffix == ".fits":
        data = path.read_bytes()[2880 * (path.read_bytes().index(b"END" + b" " * 77) // 2880 + 1) :]
    else:
        data = path.read_bytes()
    return hashlib.sha256(data).hexdigest()


def drawn_by(program: str, name: str, folder: Path) -> dict[str, str]:
    """The hashes of all that a program draws of a bench, by the file's name."""
    folder.mkdir(parents=True)
    for file, text in {
        "bench.toml": toml_of(name),
        "geometry.toml": GEOMETRY,
        "station.tle": STATION,
        "others.tle": OTHERS,
        "faults.toml": SCENARIO,
    }.items():
        (folder / file).write_text(text)
    write_log(folder / "log.csv", name)
    faults = ["--scenario", "faults.toml"] if name == "faults" else []
    replay = [
        "replay",
        "bench.toml",
        "log.csv",
        "--headless",
        "--speed",
        "max",
        "--step",
        str(STEP_S),
        "-o",
        "frames",
        *faults,
    ]
    commands = [replay]
    first = ",".join((folder / "log.csv").read_text().splitlines()[1].split(",")[1:5])
    commands.append(
        [
            "frame",
            "bench.toml",
            "--quaternion",
            first,
            "-o",
            "linear.fits",
            "--truth",
            "truth.csv",
            *faults,
        ]
    )
    commands.append(
        [
            "simulate",
            "bench.toml",
            "--quaternion",
            first,
            "--rate",
            "0.1,0.2,0.3",
            "-o",
            "dn.fits",
            *faults,
        ]
    )
    for words in commands:
        done = subprocess.run(
            [program, *words], cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            sys.exit(
                f"{program} {' '.join(words)} ({name}): exit {done.returncode}:"
                f" {done.stderr.strip()}"
            )
    files = [
        *sorted((folder / "frames").glob("*.png")),
        *(folder / file for file in ("linear.fits", "truth.csv", "dn.fits")),
    ]
    return {file.name: hashed(file) for file in files}


def main() -> None:
    """Compare two installations bench by bench."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before")
    parser.add_argument("after")
    given = parser.parse_args()
    different = 0
    with tempfile.TemporaryDirectory() as scratch:
        for name in BENCHES:
            before, after = (
                drawn_by(str(Path(program).absolute()), name, Path(scratch, side, name))
                for side, program in (("before", given.before), ("after", given.after))
            )
            others = sorted(
                file for file in before.keys() | after.keys() if before.get(file) != after.get(file)
            )
            different += len(others)
            print(
                f"{name}: {len(before)} files,"
                f" {f'{len(others)} differ: ' + ', '.join(others) if others else 'the same'}"
            )
    sys.exit(1 if different else 0)


if __name__ == "__main__":
    main()
