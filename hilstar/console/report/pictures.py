"""Pictures of a run, drawn again from its ledger by the bench that its head has: the same codes, if the bench is the same."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.bench_file import BenchFile, bench_file_of
from hilstar.bench.build import open_bench
from hilstar.bench.frame import Bench
from hilstar.console.overlay import Overlay, catalogue_sky, overlay_of
from hilstar.errors import InputError, MachineError
from hilstar.run.record.ledger_records import FrameRecord
from hilstar.run.record.report_figures import Figures
from hilstar.units import NS_PER_S

MAX_BYTES = 3_000_000  # of all pictures together, packed
NO_BENCH = "the ledger's head has no bench file"
CAUTION = (
    "Drawn by a bench that is not the run's own: a file that it names has changed since, or another version of hilstar wrote "
    "the ledger. Codes may differ from those shown."
)


def run_pictures(run: Figures, ledger: Path) -> dict[str, Any]:
    """`pictures` in the order of the run, with a `caution` where the bench has changed, or `no_pictures`, why there are none.

    And the whole `sky` about them.
    """
    try:
        file = _bench_file(run.head, ledger)
        with open_bench(file) as bench:
            overlay = overlay_of(bench)
            return {
                "pictures": _pictures(bench, overlay, run),
                "caution": "" if file.sha256 == run.head.get("bench_sha256") else CAUTION,
                "sky": overlay.sky(),
                "white_level": len(bench.calibration.response.light) - 1,
            }
    except (InputError, MachineError) as error:
        return {"pictures": [], "no_pictures": str(error), "sky": catalogue_sky()}


def _bench_file(head: dict[str, str], ledger: Path) -> BenchFile:
    """The bench of a run: the text in its head, with the files that it names where they are now, preferably unchanged.

    Raises InputError where the head has none, or one that cannot be read.
    """
    text, named = head.get("bench_text"), Path(head.get("bench_file", "bench.toml"))
    if not text:
        raise InputError(NO_BENCH)
    files = [bench_file_of(path, text) for path in (named, ledger.parent / named.name)]
    return next((file for file in files if file.sha256 == head.get("bench_sha256")), files[0])


def _pictures(bench: Bench, overlay: Overlay, run: Figures) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    size = 0
    for record, why in run.keyframes.chosen(run.last):
        picture = _picture(bench, overlay, record)
        size += len(picture["data"])
        if size > MAX_BYTES:
            break
        t_s = (record.swap_ns - run.first_swap_ns) / NS_PER_S
        found.append(picture | {"t_s": round(t_s, 3), "why": why, "operator": record.operator, "stale": record.stale})
    return found


def _picture(bench: Bench, overlay: Overlay, record: FrameRecord) -> dict[str, Any]:
    """One frame: its levels, packed, and the truth about them."""
    attitude = None if record.q is None else Attitude(np.array(record.q), 0, False)
    if attitude is None:
        levels, truth = bench.draw(None).levels, None
    else:
        velocity = None if record.velocity_km_s is None else np.array(record.velocity_km_s)
        sprites = bench.frame_sprites(attitude.q_icrs_to_cam, record.rate, velocity, record.t_ns)
        drawn = bench.draw_sprites(sprites, record.frame)
        levels = drawn.levels
        truth = overlay.truth(attitude.q_icrs_to_cam, drawn.clipped_hip, grid=True)
    height, width = levels.shape
    wide = levels.dtype.itemsize == 2
    data = np.ascontiguousarray(levels, dtype="<u2" if wide else "u1").tobytes()
    return {
        "frame": record.frame,
        "w": width,
        "h": height,
        "dtype": "u2" if wide else "u1",
        "data": base64.b64encode(zlib.compress(data, 9)).decode(),
        "truth": truth,
    }
