"""The bench files that studies measure on: one tracker, and the tables in which each study differs."""

from __future__ import annotations

import json
from collections.abc import Mapping

Value = str | float | tuple[int, int]
Table = Mapping[str, Value]

TRACKER: Table = {"aperture_mm": 30, "focal_length_mm": 70, "pixel_pitch_um": 13, "quantum_efficiency": "ccd47-20"}


def bench_text(tables: Mapping[str, Table]) -> str:
    """The text of a bench file with `tables` by name; [tracker] extends TRACKER."""
    lines = []
    for name, table in tables.items():
        whole = {**TRACKER, **table} if name == "tracker" else table
        # Text, numbers and pairs are written alike in JSON and TOML.
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in whole.items())]
    return "\n".join(lines) + "\n"
