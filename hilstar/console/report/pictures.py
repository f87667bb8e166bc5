"""Pictures of a run, drawn again from its ledger by the bench that its head has: the same codes, if the bench is the same."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.bench.bench_file import BenchFile, bench_file_of
from hilstar.bench.build import open_bench
from hilstar.bench.faults.kinds import Freeze
from hilstar.bench.frame import Bench
from hilstar.console.overlay import Overlay, catalogue_sky, overlay_of
from hilstar.errors import InputError, MachineError
from hilstar.notices import Notices
from hilstar.run.faults import Recording, read_recording
from hilstar.run.record.ledger_reader import wrong_in_frame
from hilstar.run.record.ledger_records import FrameRecord
from hilstar.run.record.report_figures import Figures
from hilstar.run.replay import RunPlay, replay
from hilstar.run.serve import Outlet
from hilstar.run.shown import Shown
from hilstar.units import NS_PER_S

MAX_BYTES = 3_000_000  # of all pictures together, packed
NO_BENCH = "the ledger's head has no bench file"
CAUTION = (
    "Drawn by a bench that is not the run's own: a file that it names has changed since, or another version of hilstar wrote "
    "the ledger. Codes may differ from those shown."
)


class _Unsaid(Notices):
    """Events of drawing again, which are not the run's."""

    def tell(self, kind: str, detail: str, who: str = "") -> None:
        """Say nothing."""


def run_pictures(run: Figures, ledger: Path) -> dict[str, Any]:
    """`pictures` in the order of the run, with a `caution` where the bench has changed, or `no_pictures`, why there are none.

    And the whole `sky` about them.
    """
    try:
        file = _bench_file(run.head, ledger)
        with open_bench(file) as bench:
            overlay = overlay_of(bench)
            return {
                "pictures": _pictures(bench, overlay, run, ledger),
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


def _pictures(bench: Bench, overlay: Overlay, run: Figures, ledger: Path) -> list[dict[str, Any]]:
    """The frames that are worth one, replayed with the faults that they had."""
    recording = read_recording(ledger)
    frames = run.keyframes.chosen(run.last)
    chosen = [(record, why) for record, why in frames if not (_stays(record, recording) or wrong_in_frame(record))]
    found: list[dict[str, Any]] = []

    def take(shown: Shown) -> None:
        record, why = chosen[len(found)]
        picture = _picture(overlay, shown)
        t_s = (record.swap_ns - run.first_swap_ns) / NS_PER_S
        told = {"why": why, "operator": record.operator, "stale": record.stale}
        found.append(picture | told | {"t_s": round(t_s, 3)})

    if chosen:
        replay(
            bench,
            RunPlay([record for record, _ in chosen], 0, paced=False, recording=recording),
            take,
            Outlet(notices=_Unsaid()),
        )
    return _within(found, MAX_BYTES)


def _stays(record: FrameRecord, recording: Recording) -> bool:
    """Whether a fault held the picture, so that it was that of a frame before."""
    return any(isinstance(recording.faults.get(number), Freeze) for number in record.faults)


def _within(pictures: list[dict[str, Any]], size: int) -> list[dict[str, Any]]:
    """As many of them, evenly over the run, as are not larger together."""
    while len(pictures) > 1 and sum(len(picture["data"]) for picture in pictures) > size:
        pictures = pictures[::2]
    return pictures


def _picture(overlay: Overlay, shown: Shown) -> dict[str, Any]:
    """One frame: its levels, packed, and the truth about them."""
    levels = shown.drawn.levels
    truth = None
    if shown.attitude is not None:
        truth = overlay.truth(shown.attitude.q_icrs_to_cam, shown.drawn.clipped_hip, grid=True)
    wide = levels.dtype.itemsize == 2
    data = np.ascontiguousarray(levels, dtype="<u2" if wide else "u1").tobytes()
    return {
        "frame": shown.number,
        "w": levels.shape[1],
        "h": levels.shape[0],
        "dtype": "u2" if wide else "u1",
        "data": base64.b64encode(zlib.compress(data, 9)).decode(),
        "truth": truth,
    }
