"""A small bench and a plan over it: 30 cases of 128 x 128 pixels, in a second."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from tests.support.benches import bench_text

SMALL_TRACKER = {"focal_length_mm": 20, "resolution_px": [128, 128], "transmission": None}
DETECTOR = {
    "read_noise_e": 10,
    "dark_e_per_s": 200,
    "dsnu_e_per_s": 40,
    "prnu": 0.01,
    "gain_e_per_dn": 5,
    "full_well_e": 70000,
}
VARY: tuple[dict[str, Any], ...] = (
    {"key": "tracker.psf_sigma_px", "minimum": 0.5, "maximum": 1.0},
    {"key": "tracker.detector.temperature_k", "minimum": 260, "maximum": 300},
    {"key": "rate_deg_s.across", "minimum": 0.01, "maximum": 2.0, "scale": "log"},
)


def write_campaign(
    folder: Path, *vary: dict[str, Any], attitudes: dict[str, Any] | None = None, **keys: Any
) -> Path:
    """`bench.toml` and `plan.toml` in a folder; the plan's path."""
    (folder / "bench.toml").write_text(
        bench_text({"tracker": SMALL_TRACKER, "tracker.detector": DETECTOR})
    )
    plan = folder / "plan.toml"
    plan.write_text(plan_text(*(vary or VARY), attitudes=attitudes, **keys))
    return plan


def plan_text(*vary: dict[str, Any], attitudes: dict[str, Any] | None = None, **keys: Any) -> str:
    """A plan as TOML; a value of None takes a key away."""
    top = {"bench": "bench.toml", "seed": 7, "cases": 30} | keys
    lines = _lines(top)
    if attitudes is not None:
        lines += ["[attitudes]", *_lines(attitudes)]
    for varied in vary:
        lines += ["[[vary]]", *_lines(varied)]
    return "\n".join(lines) + "\n"


def _lines(table: dict[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in table.items() if value is not None]


def read_columns(path: Path) -> dict[str, Any]:
    """A campaign's table as columns of Python values."""
    table = pq.read_table(path)
    return {name: table.column(name).to_pylist() for name in table.column_names}


def rows_so_far(folder: Path) -> int:
    """The rows in the journal of a campaign that writes to `folder`/out."""
    journal = folder / "out" / "journal"
    return sum(path.read_bytes().count(b"\n") for path in journal.glob("*.jsonl"))
