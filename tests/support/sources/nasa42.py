"""42's stream as 42 wrote it, its own report of the same run, and messages of the same form.

`stream_2025.txt` is what commit 11e3cc3 (27 March 2025) of github.com/ericstoneking/42 sent, built
with
`make GUIFLAG= SHADERFLAG=`; `report_2025.csv` has columns of its output files time.42, svn.42,
svb.42, qbn.42, PosN.42 and PosW.42 of that run: InOut/ as it comes, but PASSIVE_FSW, 6 s of 0.1 s,
2, -1.5 and 3 deg/s at the start, only the Earth and its Moon, prefixes "SC[0].B[0]" and
"SC[0].svb". `stream_2024.txt` is the beginning of what commit 0019f24 (2 January 2024) sends, the
form until 2025.
"""

from __future__ import annotations

import csv

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from tests.support.benches import ROOT

FOLDER = ROOT / "tests" / "unit" / "attitude" / "wire" / "nasa42"
STREAM_2025, STREAM_2024 = (FOLDER / f"stream_{year}.txt" for year in (2025, 2024))
BEGIN_NS = 1_712_534_400_000_000_000  # 2024-04-08 00:00:00 UTC


def report() -> dict[int, dict[str, FloatArray]]:
    """42's own figures by time (ns, as hilstar counts): `svn`, `svb`, `q` (scalar last),
    `posn_m`, `posw_m`.
    """
    rows = {}
    with (FOLDER / "report_2025.csv").open() as file:
        for row in csv.DictReader(file):
            columns: dict[str, list[float]] = {}
            for name, value in row.items():
                stem = name.replace("_x", "").replace("_y", "").replace("_z", "").replace("_w", "")
                columns.setdefault(stem, []).append(float(value))
            rows[BEGIN_NS + round(columns.pop("t_s")[0] * 1e9)] = {
                name: np.array(each) for name, each in columns.items()
            }
    return rows


def message(
    seconds_of_day: float,
    n_to_b: Rotation,
    rate: FloatArray | None = None,
    *,
    old: bool = False,
    number: int = 0,
) -> str:
    """A message of 8 April 2024: vectors turn from N to B by `n_to_b`; rate in B, rad/s. 42's q is
    then that of B to N.

    That it is so is what the recorded stream shows.
    """
    minute, second = divmod(seconds_of_day, 60)
    x, y, z, w = n_to_b.inv().as_quat()
    left, right, end = ("", "", "[EOF]\n\n") if old else ("[", "]", "[ENDMSG]\n")
    lines = [f"TIME 2024-099-{int(minute // 60):02d}:{int(minute % 60):02d}:{second:012.9f}\n"]
    if rate is not None:
        lines.append(
            f"SC[{number}].B[0].wn = {left}" + " ".join(f"{c:18.12e}" for c in rate) + f"{right}\n"
        )
    lines.append(
        f"SC[{number}].B[0].qn = {left}"
        + " ".join(f"{c:18.12e}" for c in (x, y, z, w))
        + f"{right}\n"
    )
    return "".join(lines) + end
