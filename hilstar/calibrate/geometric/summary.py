"""What a geometric calibration says: the file's notes, one JSON object, lines for a person, and a chart."""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import Any

import numpy as np

import hilstar
from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.calibration import Calibrated
from hilstar.calibrate.geometric.fit import residuals_px
from hilstar.charts import chart
from hilstar.monitor.geometry_file import write_geometry
from hilstar.scene.lens import Lens
from hilstar.units import ARCSEC_PER_RAD

ONE_POSE = "one pose: the tracker's own distortion and the collimator's cannot be told apart; this file holds both"
ROUND = "poses turned about the boresight do not tell apart distortions that are round about it; they are in the stated error"
ARROW_SHARE = 0.03  # of the screen's width: the median residual's arrow


def summary_of(found: Calibrated) -> dict[str, Any]:
    """The JSON object, without what was written."""
    chosen = found.chosen
    return {
        "model": chosen.name,
        "poses": len(found.problem.q_poses),
        "dots": {"planned": len(found.plan), "recognised": len(np.unique(found.data.dot))},
        "centroids": {"given": found.centroids, "matched": len(found.data), "lost": found.lost, "false": found.false},
        "noise_px": found.problem.noise_px,
        "noise_arcsec": found.noise_arcsec,
        "held_out": {
            "rms_arcsec": chosen.rms_arcsec,
            "max_arcsec": chosen.max_arcsec,
            "noise_arcsec": found.held_out_noise_arcsec,
        },
        "error": {"rms_arcsec": found.uncertainty.rms_arcsec, "max_arcsec": found.uncertainty.max_arcsec},
        "models": [{"name": m.name, "rms_arcsec": m.rms_arcsec, "max_arcsec": m.max_arcsec} for m in found.models],
        "parameters": parameters_of(found),
        "tracker": "held" if found.tracker_known else "fitted",
        "notes": _notes(found),
    }


def _notes(found: Calibrated) -> list[str]:
    if len(found.problem.q_poses) == 1:
        return [ONE_POSE]
    return [] if found.tracker_known else [ROUND]


def parameters_of(found: Calibrated) -> dict[str, dict[str, float]]:
    """Each parameter's value and one sigma, in its own unit."""
    monitor, sigma = found.fit.geometry.monitor, found.uncertainty.sigma
    lens = monitor.lens or Lens()
    focal, pitch = monitor.focal_length_px, ARCSEC_PER_RAD
    values = {
        "focal_length_px": (focal, focal * sigma.get("log_focal", 0.0)),
        "principal_point_x_px": (monitor.principal_point_px[0], sigma.get("centre_x", 0.0)),
        "principal_point_y_px": (monitor.principal_point_px[1], sigma.get("centre_y", 0.0)),
        "rotation_x_arcsec": (0.0, pitch * sigma["rotation_x"]),
        "rotation_y_arcsec": (0.0, pitch * sigma["rotation_y"]),
        "rotation_z_arcsec": (0.0, pitch * sigma["rotation_z"]),
        "tilt_x_deg": (math.degrees(lens.tilt_rad[0]), math.degrees(sigma.get("tilt_x", 0.0))),
        "tilt_y_deg": (math.degrees(lens.tilt_rad[1]), math.degrees(sigma.get("tilt_y", 0.0))),
    }
    for name, value in zip(("k1", "k2", "k3", "p1", "p2"), (*lens.radial, *lens.tangential), strict=True):
        values[name] = (value, sigma.get(name, 0.0))
    for name in found.fit.model.tracker_names:
        values[name] = (_tracker_value(found, name), sigma[name])
    return {name: {"value": float(value), "sigma": float(s)} for name, (value, s) in values.items()}


def _tracker_value(found: Calibrated, name: str) -> float:
    lens = found.fit.geometry.tracker.lens or Lens()
    k1, k2, _ = lens.radial
    p1, p2 = lens.tangential
    return {"tracker_k1": k1, "tracker_k2": k2, "tracker_p1": p1, "tracker_p2": p2}[name]


def notes_of(found: Calibrated, made: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables `sigma`, `error` and `made` of the geometry file."""
    parameters = parameters_of(found)
    return {
        "sigma": {name: entry["sigma"] for name, entry in parameters.items()},
        "error": {
            "model": found.chosen.name,
            "held_out_rms_arcsec": found.chosen.rms_arcsec,
            "held_out_max_arcsec": found.chosen.max_arcsec,
            "noise_px": found.problem.noise_px,
            "rms_arcsec": found.uncertainty.rms_arcsec,
            "max_arcsec": found.uncertainty.max_arcsec,
            "map_arcsec": [[round(float(v), 4) for v in row] for row in found.uncertainty.map_arcsec],
        },
        "made": made | {"when": datetime.datetime.now(datetime.UTC).date().isoformat(), "poses": len(found.problem.q_poses)},
    }


def write_calibrated(path: Path, found: Calibrated) -> dict[str, Any]:
    """Write the geometry file; the summary."""
    geometry = found.fit.geometry
    write_geometry(path, geometry.monitor, geometry.q_cam_to_mon, notes_of(found, {"by": f"hilstar {hilstar.__version__}"}))
    return summary_of(found) | {"written": [str(path)]}


def lines_of(summary: dict[str, Any]) -> list[str]:
    """The calibration for a person."""
    held, dots, centroids = summary["held_out"], summary["dots"], summary["centroids"]
    rows = [
        ("dots", f"{dots['recognised']} of {dots['planned']} recognised in {summary['poses']} pose(s)"),
        ("centroids", f"{centroids['matched']} matched, {centroids['lost']} lost, {centroids['false']} false"),
        ("centroid noise", f"{summary['noise_px']:.4f} px, {summary['noise_arcsec']:.2f} arcsec"),
    ]
    for m in summary["models"]:
        rows.append((m["name"], f"{m['rms_arcsec']:.3f} / {m['max_arcsec']:.3f} arcsec (rms / max of held-out dots)"))
    error = summary["error"]
    rows += [
        ("chosen", summary["model"]),
        (
            "held-out dots",
            f"{held['rms_arcsec']:.3f} arcsec rms, {held['max_arcsec']:.3f} max; noise: {held['noise_arcsec']:.3f}",
        ),
        (
            "a star's place",
            f"known to {error['rms_arcsec']:.3f} arcsec rms, {error['max_arcsec']:.3f} max (1 sigma)",
        ),
    ]
    width = max(len(name) for name, _ in rows) + 2
    return [f"{name:{width}}{text}" for name, text in rows] + list(summary["notes"])


def draw_geometry(path: Path, found: Calibrated) -> None:
    """The error of a star's place over the screen, and the residuals of the dots as arrows."""
    error, width = found.uncertainty.map_arcsec, found.problem.nominal.monitor.resolution_px[0]
    height = found.problem.nominal.monitor.resolution_px[1]
    finding = (
        f"{found.chosen.name}: a star's place is known to {found.uncertainty.rms_arcsec:.2g} arcsec rms,"
        f" {found.uncertainty.max_arcsec:.2g} at the maximum; held-out dots {found.chosen.rms_arcsec:.2g} rms"
    )
    dot, right, down = _mean_residuals(found)
    to_arcsec = ARCSEC_PER_RAD / found.problem.nominal.tracker.focal_length_px
    median = float(np.median(np.hypot(right, down)))
    with chart(path, finding, panels=2, share_x=False) as (places, residuals):
        image = places.imshow(error, extent=(-0.5, width - 0.5, height - 0.5, -0.5), aspect="equal", cmap="viridis")
        places.figure.colorbar(image, ax=places, label="1 sigma [arcsec]", shrink=0.8)
        places.set_title("error of a star's place", fontsize=11)
        scale = ARROW_SHARE * width / max(median, 1e-9)
        x, y = found.plan.x_px[dot], found.plan.y_px[dot]
        residuals.quiver(x, y, right * scale, down * scale, angles="xy", scale_units="xy", scale=1, width=0.0015)
        residuals.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
        residuals.set_title(f"mean residual of each dot, median {median * to_arcsec:.2g} arcsec", fontsize=11)
        for axes in (places, residuals):
            axes.set_xlabel("monitor x [px]")
            axes.set_ylabel("monitor y [px]")


def _mean_residuals(found: Calibrated) -> tuple[IntArray, FloatArray, FloatArray]:
    """The dots that were seen, and the mean residual of each, tracker px."""
    right, down = residuals_px(found.problem, found.fit.geometry, found.data)
    dots, place, count = np.unique(found.data.dot, return_inverse=True, return_counts=True)
    return dots, np.bincount(place, right) / count, np.bincount(place, down) / count
