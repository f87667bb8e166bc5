"""The last step: stars on the screen against the sky, their places and their light, and the twin's verdict."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench
from hilstar.bench.cameras import bench_camera
from hilstar.bench.config import Verify
from hilstar.calibrate.first_light.pictures import draw_light, draw_residuals
from hilstar.calibrate.first_light.records import Figure, Outcome
from hilstar.calibrate.first_light.rooms import Room
from hilstar.calibrate.first_light.stars import MIN_STARS, StarsSeen, see_stars
from hilstar.errors import InputError
from hilstar.monitor.calibration import BUILT_IN
from hilstar.twin.verify.run import verify as run_twin
from hilstar.twin.verify.summary import VerifySummary, summarise
from hilstar.units import ARCSEC_PER_RAD, magnitude

VERIFY_FIELDS, VERIFY_SEED = 3, 0
LOST_SHARE = 0.1
GRID = 21  # places along each side of the screen at which a truth is compared


def verify(room: Room) -> Outcome:
    """Show stars through what was found, compare them with the sky, and run the twin. Raises InputError."""
    seen = see_stars(room)
    figures, reasons = _star_figures(room, seen), []
    picture, light = room.session / "verify.png", room.session / "verify-light.png"
    rms = f"{figures['star_rms_px']:.3f} px ({figures['star_rms_arcsec']:.2f} arcsec) rms"
    width_px = room.file.config.tracker.resolution_px[0]
    draw_residuals(picture, seen.place_px, seen.residual_px, width_px, f"{len(seen.place_px)} stars are {rms} from the sky")
    line = f"{len(seen.place_px)} stars on the screen are {rms} from where the sky has them"
    pictures = [picture]
    if seen.sure.sum() >= MIN_STARS:
        found, finding = _light_figures(room, seen, light)
        figures |= found
        pictures.append(light)
        line += f", and {figures['flux_p95_mag']:.3f} mag from its light (95 % of {figures['flux_stars']})"
        reasons += [finding] if finding else []
    else:
        line += f"; the light of {int(seen.sure.sum())} can be read, too few to judge it"
    reasons += _star_reasons(room, figures)
    twin = summarise(run_twin(_twin_file(room), VERIFY_FIELDS, np.random.default_rng(VERIFY_SEED)))
    reasons += [f"the twin: {reason}" for reason in twin.reasons]
    figures |= _twin_figures(twin)
    if room.truth is not None:
        figures |= _against_truth(room)
        line += (
            f"; against the truth, places are {figures['truth_rms_arcsec']:.2f} arcsec rms off, and stars of the twin"
            f" {figures['twin_flux_p95_mag']:.3f} mag at 95 %"
        )
    files = (*pictures, *seen.images)
    if reasons:
        return Outcome("failed", f"{line}: {'; '.join(reasons)}", figures, files, tuple(pictures))
    return Outcome("done", line, figures, files, tuple(pictures))


def _twin_file(room: Room) -> BenchFile:
    """The bench as the session has it; in a virtual session what is true is the truth."""
    truth, file = room.truth, room.file
    if truth is None:
        return file
    monitor, collimator, folder = truth.config.monitor, truth.config.collimator, truth.folder.resolve()
    with open_bench(truth) as bench:
        white = bench.flux_at_white_e_per_s
    named = monitor.calibration in BUILT_IN
    limits = file.config.verify
    known = Verify(
        flux_mag=limits.flux_mag,
        centroid_px=limits.centroid_px,
        lost_share=limits.lost_share,
        black_e_per_s_px=limits.black_e_per_s_px,
        true_calibration=monitor.calibration if named else str(folder / monitor.calibration),
        true_flux_at_white_e_per_s=white,
    )
    if collimator.geometry is not None:
        known = replace(known, true_geometry=str(folder / collimator.geometry))
    else:
        known = replace(
            known,
            true_focal_length_mm=collimator.focal_length_mm,
            true_pixel_pitch_um=monitor.pixel_pitch_um,
            true_q_cam_to_mon=collimator.q_cam_to_mon,
        )
    return dataclasses.replace(file, config=replace(file.config, verify=known))


def _twin_figures(twin: VerifySummary) -> dict[str, Figure]:
    """Of the twin, in a virtual session against the truth."""
    spreads = {"flux": (twin.flux_error_mag, "mag"), "centroid": (twin.centroid_error_px, "px")}
    return {
        "twin_passed": str(twin.passed).lower(),
        "twin_stars": twin.stars,
        "twin_zero_point_mag": "not known" if twin.zero_point_mag is None else twin.zero_point_mag,
        **{f"twin_{name}_p95_{unit}": spread.p95 or 0.0 for name, (spread, unit) in spreads.items()},
    }


def _light_figures(room: Room, seen: StarsSeen, picture: Path) -> tuple[dict[str, Figure], str]:
    """How far the light of stars is from the sky's, by the tracker's gain and exposure, their common zero point aside.

    And what is wrong where they scatter far beyond their errors.
    """
    gain, exposure_s = room.file.config.tracker.detector.gain_e_per_dn, room.exposure_s
    off = np.asarray(magnitude(seen.dn * gain / (seen.e_per_s * exposure_s)))[seen.sure]
    zero_point = float(np.median(off))
    spread = np.abs(off - zero_point)
    p95 = float(np.percentile(spread, 95))
    finding = f"the light of {len(off)} stars is {p95:.3f} mag from the sky's at 95 %, {zero_point:+.3f} mag in common"
    from_middle = np.hypot(*seen.screen[seen.sure].T)
    draw_light(picture, seen.e_per_s[seen.sure], off, seen.noise_mag[seen.sure], finding, from_middle)
    scatter = seen.scatter(off, seen.sure)
    figures: dict[str, Figure] = {
        "flux_stars": len(off),
        "flux_rms_mag": float(np.sqrt((spread**2).mean())),
        "flux_p95_mag": p95,
        "flux_max_mag": float(spread.max()),
        "flux_zero_point_mag": zero_point,
        "flux_scatter_mag": scatter.rms_mag,
        "flux_error_mag": scatter.error_mag,
        "flux_by_place": scatter.by_place,
    }
    return figures, scatter.finding


def _star_reasons(room: Room, figures: dict[str, Figure]) -> list[str]:
    """What is wrong with the stars that were seen."""
    limits, found = room.file.config.verify, []
    if float(figures["star_p95_px"]) > limits.centroid_px:
        off = f"stars are {figures['star_p95_px']:.3f} px off at 95 % (limit {limits.centroid_px:g})"
        found.append(f"{off}: run the geometry again")
    if float(figures["lost"]) > LOST_SHARE * (float(figures["lost"]) + float(figures["stars"])):
        found.append(f"{figures['lost']} bright stars are not there")
    if float(figures.get("flux_p95_mag", 0.0)) > limits.flux_mag:
        off = f"the light of stars is {figures['flux_p95_mag']:.3f} mag off at 95 % (limit {limits.flux_mag:g})"
        found.append(f"{off}: measure the response (photometry)")
    if abs(float(figures.get("flux_zero_point_mag", 0.0))) > limits.flux_mag:
        off = f"all stars are {figures['flux_zero_point_mag']:+.3f} mag off (limit {limits.flux_mag:g})"
        found.append(f"{off}: measure what white is worth (scale)")
    return found


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
