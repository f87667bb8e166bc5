"""The steps that measure: geometry, photometry, scale, latency, and the verification of them all."""

from __future__ import annotations

import os

import numpy as np

from hilstar.bench.cameras import bench_camera
from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.calibrate.first_light.pictures import draw_residuals
from hilstar.calibrate.first_light.records import Change, Figure, Outcome
from hilstar.calibrate.first_light.rooms import Room
from hilstar.calibrate.first_light.stars import StarsSeen, see_stars
from hilstar.calibrate.first_light.steps.look import plan_for, sharp_dots
from hilstar.calibrate.geometric.calibration import calibrate_files
from hilstar.calibrate.geometric.dots import dot_image, write_plan
from hilstar.calibrate.geometric.summary import GeometricSummary, write_calibrated
from hilstar.errors import InputError
from hilstar.files import make_directory
from hilstar.twin.verify.run import verify as run_twin
from hilstar.twin.verify.summary import summarise
from hilstar.units import ARCSEC_PER_RAD

VERIFY_FIELDS, VERIFY_SEED = 3, 0
LOST_SHARE = 0.1
GRID = 21  # places along each side of the screen at which a truth is compared


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


def photometry(room: Room) -> Outcome:
    """Say how the response is measured, which this session does not."""
    how = "`hilstar calibrate plan --show`, then `hilstar calibrate photometric`"
    return Outcome("skipped", f"not measured; the bench file says {room.file.config.monitor.calibration}: run {how}")


def scale(room: Room) -> Outcome:
    """Say how full scale is measured, which this session does not."""
    return Outcome("skipped", "not measured: show a star, sum its DN, and run `hilstar calibrate scale`")


def latency(room: Room) -> Outcome:
    """Say how the delay is measured, which takes a photodiode and a run with a ledger."""
    how = "`hilstar serve ... --ledger RUN.mcap`, then `hilstar latency RUN.mcap --diode ... --write` the bench file"
    return Outcome("skipped", f"not measured: it takes a photodiode and a run; run {how}")


def verify(room: Room) -> Outcome:
    """Show stars through what was found, compare them with the sky, and run the twin. Raises InputError."""
    seen = see_stars(room)
    limit_px = room.file.config.verify.centroid_px
    figures = _star_figures(room, seen)
    picture = room.session / "verify.png"
    rms = f"{figures['star_rms_px']:.3f} px ({figures['star_rms_arcsec']:.2f} arcsec) rms"
    width_px = room.file.config.tracker.resolution_px[0]
    draw_residuals(picture, seen.place_px, seen.residual_px, width_px, f"{len(seen.place_px)} stars are {rms} from the sky")
    line, reasons = f"{len(seen.place_px)} stars on the screen are {rms} from where the sky has them", []
    if float(figures["star_p95_px"]) > limit_px:
        reasons.append(f"stars are {figures['star_p95_px']:.3f} px off at 95 % (limit {limit_px:g}): run the geometry again")
    if seen.lost > LOST_SHARE * (seen.lost + len(seen.place_px)):
        reasons.append(f"{seen.lost} bright stars are not there")
    twin = summarise(run_twin(room.file, VERIFY_FIELDS, np.random.default_rng(VERIFY_SEED)))
    reasons += twin.reasons
    figures |= {"twin_passed": str(twin.passed).lower(), "twin_stars": twin.stars}
    if room.truth is not None:
        figures |= _against_truth(room)
        line += f"; against the truth, places are {figures['truth_rms_arcsec']:.2f} arcsec rms off"
    if reasons:
        return Outcome("failed", f"{line}: {'; '.join(reasons)}", figures, (seen.looked.path, picture), (picture,))
    return Outcome("done", line, figures, (seen.looked.path, picture), (picture,))


def _star_figures(room: Room, seen: StarsSeen) -> dict[str, Figure]:
    off = np.hypot(*seen.residual_px.T)
    tracker = room.geometry().tracker
    rms = float(np.sqrt((off**2).mean()))
    return {
        "stars": len(off),
        "lost": seen.lost,
        "star_rms_px": rms,
        "star_p95_px": float(np.percentile(off, 95)),
        "star_max_px": float(off.max()),
        "star_rms_arcsec": rms * ARCSEC_PER_RAD / tracker.focal_length_px,
    }


def _against_truth(room: Room) -> dict[str, Figure]:
    """How far the directions of the screen's places, as the bench file has them now, are from the truth's.

    Only places that the tracker sees were calibrated; the others have no direction.
    """
    truth = room.truth
    assert truth is not None
    width, height = room.resolution_px
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID)))
    mine, its = (bench_camera(file.config, file.folder).rays(x, y) for file in (room.file, truth))
    mine, its = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (mine, its))
    off = np.linalg.norm(np.cross(mine, its), axis=1) * ARCSEC_PER_RAD
    known = np.isfinite(off)
    if not known.any():
        raise InputError("no place of the screen has a direction both in the bench file and in the truth; look at the truth")
    rms, largest = float(np.sqrt((off[known] ** 2).mean())), float(off[known].max())
    return {"truth_rms_arcsec": rms, "truth_max_arcsec": largest, "truth_share_of_screen": float(known.mean())}
