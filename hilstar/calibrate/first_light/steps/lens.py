"""The step of geometry: lens, tilt and alignment by dots."""

from __future__ import annotations

import os

from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.calibrate.first_light.records import Change, Figure, Outcome
from hilstar.calibrate.first_light.rooms import Room
from hilstar.calibrate.first_light.steps.look import plan_for, sharp_dots
from hilstar.calibrate.geometric.calibration import GeometricSummary, calibrate_files, write_calibrated
from hilstar.calibrate.geometric.dots import dot_image, write_plan
from hilstar.files import make_directory


def geometry(room: Room) -> Outcome:
    """Fit the lens, the tilt and the alignment to dots, and name the file in the bench file. Raises InputError."""
    code = int(room.known.get("focus.dot_code", 0)) or sharp_dots(room)[0]
    plan = plan_for(room)
    make_directory(room.folder)
    write_plan(room.folder / "plan.csv", plan)
    dark = room.dark()
    paths = [
        room.take(Pattern(f"frame_{frame:03}", dot_image(plan, frame, room.resolution_px, code)))
        for frame in range(plan.frames)
    ]
    ideal = room.file.config.tracker.distortion is None
    found = calibrate_files(room.file, paths, room.folder / "plan.csv", dark, tracker_is_ideal=ideal)
    output, picture = room.session / "geometry.toml", room.session / "geometry.png"
    summary = write_calibrated(output, found, picture)
    figures = _geometry_figures(summary)
    collimator = room.file.config.collimator
    name = os.path.relpath(output, room.file.folder)
    changes = () if collimator.geometry == name else (_named("collimator", "geometry", collimator.geometry, name),)
    line = (
        f"{summary.model}: held-out dots {figures['held_out_rms_arcsec']:.2f} arcsec rms,"
        f" {figures['held_out_max_arcsec']:.2f} max; a star's place is known to {figures['error_rms_arcsec']:.2f} arcsec rms"
    )
    return Outcome("done", line, figures, (output, picture, room.folder / "plan.csv", dark, *paths), (picture,), changes)


def _named(table: str, key: str, before: str | None, after: str) -> Change:
    return Change(table=table, key=key, before=before, after=after)


def _geometry_figures(summary: GeometricSummary) -> dict[str, Figure]:
    found = {name: each.value for name, each in summary.parameters.items() if "rotation" not in name}
    return {
        "model": summary.model,
        "held_out_rms_arcsec": summary.held_out.rms_arcsec,
        "held_out_max_arcsec": summary.held_out.max_arcsec,
        "error_rms_arcsec": summary.error.rms_arcsec,
        "error_max_arcsec": summary.error.max_arcsec,
        "noise_px": summary.noise_px,
        "dots_recognised": summary.dots.recognised,
        "dots_planned": summary.dots.planned,
        "centroids_lost": int(summary.centroids.lost),
        "centroids_false": int(summary.centroids.false),
        **found,
        "notes": "; ".join(summary.notes) or "none",
    }
