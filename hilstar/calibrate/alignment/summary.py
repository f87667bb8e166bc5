"""What an alignment says: the geometry file with its notes, one JSON object, and lines for a person."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

import hilstar
from hilstar.bench.bench_file import BenchFile
from hilstar.calibrate.alignment.calibration import Aligned
from hilstar.calibrate.alignment.residual import AxesArcsec
from hilstar.monitor.geometry import ErrorTable, MadeTable, Notes, load_geometry, load_notes, write_geometry

MAX_NAMED = 10  # wild rows
ONE_ATTITUDE = (
    "one attitude: it determines the rotation, but does not tell what changes with attitude; take several, all over the sky"
)
NO_REPEATS = "no attitude was repeated: the residual cannot be told from the tracker's noise; take some attitudes several times"


@dataclass(frozen=True, slots=True)
class AlignmentSummary:
    """What was found and written; its field names are the keys of --json.

    `rotation_arcsec` is the rotation vector from the commanded to the reported attitude, cam axes, with `sigma_arcsec` of each
    axis. `wild_rows` are lines of the file. `repeat_arcsec` and `unexplained_arcsec` are None where too few attitudes repeat.
    """

    pairs: int
    used: int
    wild: int
    wild_rows: tuple[int, ...]
    skipped: int
    attitudes: int
    rotation_arcsec: tuple[float, float, float]
    sigma_arcsec: tuple[float, float, float]
    residual_arcsec: AxesArcsec
    repeat_arcsec: AxesArcsec | None
    unexplained_arcsec: AxesArcsec | None
    q_cam_to_mon: tuple[float, ...]
    notes: tuple[str, ...]
    written: tuple[str, ...] = ()


def write_alignment(path: Path, found: Aligned, file: BenchFile) -> AlignmentSummary:
    """Write the bench's present geometry with the alignment that was found. Raises InputError where it cannot be written."""
    name = file.config.collimator.geometry
    if name is None:
        camera, notes, lens_of = found.camera, Notes({}, ErrorTable(model="ideal lens"), MadeTable()), "the bench file"
    else:
        # As the file has it: the bench's own camera is bounded to what this screen needs.
        camera = load_geometry(file.folder / name, found.camera.resolution_px)
        notes = load_notes(file.folder / name)
        lens_of = f"{Path(name).name}, {notes.made.when or 'no date'}"
    write_geometry(path, camera, found.q_cam_to_mon, _notes(found, notes, lens_of))
    return summary_of(found, (str(path),))


def summary_of(found: Aligned, written: tuple[str, ...] = ()) -> AlignmentSummary:
    """An alignment in figures."""
    return AlignmentSummary(
        pairs=len(found.pairs),
        used=int(found.fit.used.sum()),
        wild=len(found.wild),
        wild_rows=found.wild,
        skipped=found.pairs.skipped,
        attitudes=found.residual.attitudes,
        rotation_arcsec=found.rotation_arcsec,
        sigma_arcsec=found.sigma_arcsec,
        residual_arcsec=found.residual.rms,
        repeat_arcsec=found.residual.repeat,
        unexplained_arcsec=found.residual.unexplained,
        q_cam_to_mon=tuple(found.q_cam_to_mon.tolist()),
        notes=_remarks(found),
        written=written,
    )


def _notes(found: Aligned, lens: Notes, lens_of: str) -> Notes:
    """What the file says of its lens, with what the alignment changes of it."""
    axes = ("rotation_x_arcsec", "rotation_y_arcsec", "rotation_z_arcsec")
    made = MadeTable(
        by=f"hilstar {hilstar.__version__}",
        when=datetime.datetime.now(datetime.UTC).date().isoformat(),
        poses=lens.made.poses,
        pairs=len(found.pairs),
        pairs_used=int(found.fit.used.sum()),
        wild_rows=list(found.wild),
        rotation_arcsec=found.rotation_arcsec,
        lens_of=lens_of,
    )
    rms = found.residual.rms
    error = replace(lens.error, alignment_cross_arcsec=rms.cross, alignment_roll_arcsec=rms.roll)
    return Notes(lens.sigma | dict(zip(axes, found.sigma_arcsec, strict=True)), error, made)


def _remarks(found: Aligned) -> tuple[str, ...]:
    residual = found.residual
    remarks = []
    unexplained = residual.unexplained
    if residual.attitudes == 1:
        remarks.append(ONE_ATTITUDE)
    elif unexplained is None:
        remarks.append(NO_REPEATS)
    elif unexplained.cross > 0 or unexplained.roll > 0:
        parts = (("across", unexplained.cross), ("about", unexplained.roll))
        excess = " and ".join(f"{value:.3g} arcsec rms {where} the boresight" for where, value in parts if value > 0)
        remarks.append(f"a rotation does not explain {excess}: calibrate the geometry with dots (hilstar calibrate geometric)")
    return (*remarks, *residual.causes)


def lines_of(summary: AlignmentSummary) -> list[str]:
    """The alignment for a person."""
    x, y, z = (
        f"{value:.2f} +- {sigma:.2f}" for value, sigma in zip(summary.rotation_arcsec, summary.sigma_arcsec, strict=True)
    )
    named = ", ".join(map(str, summary.wild_rows[:MAX_NAMED])) + (", ..." if summary.wild > MAX_NAMED else "")
    skipped = f", {summary.skipped} skipped" if summary.skipped else ""
    of = "all of one attitude" if summary.attitudes == 1 else f"of {summary.attitudes} attitudes"
    rows = [
        ("pairs", f"{summary.used} of {summary.pairs} used, {of}{skipped}"),
        ("wild", f"{summary.wild}, on lines {named}" if summary.wild else "none"),
        ("reported - commanded", f"x {x}, y {y}, about the boresight {z} arcsec"),
        ("residual", _both(summary.residual_arcsec)),
    ]
    if summary.repeat_arcsec is not None and summary.unexplained_arcsec is not None:
        rows.append(("repeats of an attitude", _both(summary.repeat_arcsec)))
        rows.append(("not a rotation", _both(summary.unexplained_arcsec)))
    width = max(len(name) for name, _ in rows) + 2
    return [f"{name:{width}}{text}" for name, text in rows] + list(summary.notes)


def _both(axes: AxesArcsec) -> str:
    return f"{axes.cross:.3g} arcsec rms across the boresight, {axes.roll:.3g} about it"
