"""Bench files: one text, and what a test changes of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

Tables = Mapping[str, Mapping[str, object]]

_SMALL: dict[str, dict[str, object]] = {
    "tracker": {
        "aperture_mm": 30,
        "focal_length_mm": 70,
        "pixel_pitch_um": 13,
        "resolution_px": [1024, 1024],
        "quantum_efficiency": "ccd47-20",
        "transmission": "n-bk7-10mm",
    },
    "monitor": {"resolution_px": [320, 240], "pixel_pitch_um": 57.65},
    "collimator": {"focal_length_mm": 60},
}


def bench_tables(*changes: Tables) -> dict[str, dict[str, object]]:
    """The tables of the small bench, with other values and tables."""
    tables = {name: dict(keys) for name, keys in _SMALL.items()}
    for change in changes:
        for name, keys in change.items():
            tables.setdefault(name, {}).update(keys)
    return tables


def bench_text(*changes: Tables) -> str:
    """The small bench as TOML, with other values and tables; a value of None takes a key away."""
    lines = []
    for name, keys in bench_tables(*changes).items():
        lines.append(f"\n[{name}]")
        lines += [
            f"{key} = {json.dumps(value)}" for key, value in keys.items() if value is not None
        ]
    return "\n".join(lines) + "\n"


# A monitor of 320 x 240: a frame takes a millisecond.
SMALL_BENCH = bench_text()

# The same where frames have to be in time, whatever else the machine does: exact codes take several
# milliseconds.
LIVE_BENCH = bench_text({"render": {"quantisation": "round"}})

# Lines of [attitude] and [render] for stars that move within a frame: of exact codes a turn costs
# more.
MOVING = '[render]\nmotion = "on"\nquantisation = "round"\n'

# The size of the X servers of tests/support/x11/screens.py. On a busy machine `auto` might choose
# other codes than `frame`.
SCREEN_BENCH = bench_text(
    {"monitor": {"resolution_px": [640, 480]}, "render": {"quantisation": "exact"}}
)

# Changes that make a bench of it whose light the twin can see whole: 10 bits, and a tracker's pixel
# for a monitor's.
TWIN: Tables = {
    "tracker": {"focal_length_mm": 25, "resolution_px": [400, 400], "transmission": None},
    "sky": {"faintest_v_mag": 5.5},
    "monitor": {"resolution_px": [640, 480], "bits": 10},
    "collimator": {"focal_length_mm": 120},
    "render": {"quantisation": "exact"},
}

# Orion's belt, right ascension 84.057, declination -1.2, roll 0 (degrees).
ORION_Q = (0.6987226, 0.7135120, -0.0370377, 0.0362700)
ATTITUDE = "0.6987226,0.7135120,-0.0370377,0.0362700"


def still_log(path: Path, seconds: float = 60) -> Path:
    """A log that stands on Orion's belt for so long."""
    path.write_text(f"t_s,qw,qx,qy,qz\n0,{ATTITUDE}\n{seconds},{ATTITUDE}\n")
    return path


def attitude_table(port: int, more: str = "") -> str:
    """The `[attitude]` table of a bench that listens to a port of this machine."""
    return f'\n[attitude]\nendpoint = "tcp://127.0.0.1:{port}"\n{more}\n'
