"""What a geometric calibration says: the file's notes, one JSON object, lines for a person, and a chart."""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hilstar
from hilstar.arrays import FloatArray, IntArray
from hilstar.calibrate.geometric.calibration import Calibrated
from hilstar.calibrate.geometric.fit import residuals_px
from hilstar.charts import BLUE, SMALL_PT, chart
from hilstar.monitor.geometry_file import ErrorTable, MadeTable, Notes, write_geometry
from hilstar.scene.lens import Lens
from hilstar.units import ARCSEC_PER_RAD

ONE_POSE = "one pose: the tracker's own distortion and the collimator's cannot be told apart; this file holds both"
COLLIMATOR_ALONE = "one pose, with the tracker's lens as its flight model says: this file holds the collimator alone"
ROUND = "poses turned about the boresight do not tell apart distortions that are round about it; they are in the stated error"
WIDE_INCH = 5.6  # of a panel
ARROW_SHARE = 0.03  # of the screen's width: the median residual's arrow


@dataclass(frozen=True, slots=True)
class Dots:
    """How many dots the plan has, and how many were recognised."""

    planned: int
    recognised: int


@dataclass(frozen=True, slots=True)
class CentroidCounts:
    """Centroids given, those that are dots, lit dots in the tracker's field without one, and centroids that are no dot."""

    given: int
    matched: int
    lost: int
    false: int


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The error of dots held out of the fit, arcsec, and the rms that the noise of their centroids alone makes."""

    rms_arcsec: float
    max_arcsec: float
    noise_arcsec: float


@dataclass(frozen=True, slots=True)
class StarError:
    """One sigma of a star's place over the screen."""

    rms_arcsec: float
    max_arcsec: float


@dataclass(frozen=True, slots=True)
class ModelError:
    """A model, and its error on dots held out of its fit."""

    name: str
    rms_arcsec: float
    max_arcsec: float


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter's value and one sigma, in the unit of its name."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class GeometricSummary:
    """What was fitted and written; `tracker` is "held" or "fitted", its own lens."""

    model: str
    poses: int
    dots: Dots
    centroids: CentroidCounts
    noise_px: float
    noise_arcsec: float
    held_out: HeldOut
    error: StarError
    models: tuple[ModelError, ...]
    parameters: dict[str, Parameter]
    tracker: str
    notes: tuple[str, ...]
    written: tuple[str, ...]


def summary_of(found: Calibrated, written: tuple[str, ...]) -> GeometricSummary:
    """A calibration in figures; its field names are the keys of --json."""
    chosen = found.chosen
    return GeometricSummary(
        model=chosen.name,
        poses=len(found.problem.q_poses),
        dots=Dots(len(found.plan), len(np.unique(found.data.dot))),
        centroids=CentroidCounts(found.centroids, len(found.data), found.lost, found.false),
        noise_px=found.problem.noise_px,
        noise_arcsec=found.noise_arcsec,
        held_out=HeldOut(chosen.rms_arcsec, chosen.max_arcsec, found.held_out_noise_arcsec),
        error=StarError(found.uncertainty.rms_arcsec, found.uncertainty.max_arcsec),
        models=tuple(ModelError(model.name, model.rms_arcsec, model.max_arcsec) for model in found.models),
        parameters=parameters_of(found),
        tracker="held" if found.tracker_known else "fitted",
        notes=_notes(found),
        written=written,
    )


def _notes(found: Calibrated) -> tuple[str, ...]:
    if len(found.problem.q_poses) == 1:
        notes: tuple[str, ...] = (ONE_POSE if found.problem.nominal.tracker.lens is None else COLLIMATOR_ALONE,)
    else:
        notes = () if found.tracker_known else (ROUND,)
    lens = found.fit.geometry.monitor.lens
    if lens is None or not math.isfinite(lens.max_tangent):
        return notes
    known_deg = math.degrees(math.atan(lens.max_tangent))
    return (*notes, f"the tracker sees {known_deg:.2f} deg from the axis: no star is shown farther out")


def parameters_of(found: Calibrated) -> dict[str, Parameter]:
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
    return {name: Parameter(float(value), float(s)) for name, (value, s) in values.items()}


def _tracker_value(found: Calibrated, name: str) -> float:
    lens = found.fit.geometry.tracker.lens or Lens()
    k1, k2, _ = lens.radial
    p1, p2 = lens.tangential
    return {"tracker_k1": k1, "tracker_k2": k2, "tracker_p1": p1, "tracker_p2": p2}[name]


def notes_of(found: Calibrated) -> Notes:
    """What the geometry file says of how well it is known, and of what it was made."""
    error = ErrorTable(
        model=found.chosen.name,
        held_out_rms_arcsec=found.chosen.rms_arcsec,
        held_out_max_arcsec=found.chosen.max_arcsec,
        noise_px=found.problem.noise_px,
        rms_arcsec=found.uncertainty.rms_arcsec,
        max_arcsec=found.uncertainty.max_arcsec,
        map_arcsec=[[round(float(value), 4) for value in row] for row in np.nan_to_num(found.uncertainty.map_arcsec, nan=-1.0)],
    )
    sigma = {name: parameter.sigma for name, parameter in parameters_of(found).items()}
    when = datetime.datetime.now(datetime.UTC).date().isoformat()
    return Notes(sigma, error, MadeTable(by=f"hilstar {hilstar.__version__}", when=when, poses=len(found.problem.q_poses)))


def write_calibrated(path: Path, found: Calibrated, plot: Path | None) -> GeometricSummary:
    """Write the geometry file, and its chart where one is wanted. Raises InputError where one cannot be written."""
    geometry = found.fit.geometry
    write_geometry(path, geometry.monitor, geometry.q_cam_to_mon, notes_of(found))
    if plot is not None:
        draw_geometry(plot, found)
    return summary_of(found, tuple(str(each) for each in (path, plot) if each is not None))


def lines_of(summary: GeometricSummary) -> list[str]:
    """The calibration for a person."""
    held, dots, centroids, error = summary.held_out, summary.dots, summary.centroids, summary.error
    rows = [
        ("dots", f"{dots.recognised} of {dots.planned} recognised in {summary.poses} pose(s)"),
        ("centroids", f"{centroids.matched} matched, {centroids.lost} lost, {centroids.false} false"),
        ("centroid noise", f"{summary.noise_px:.4f} px, {summary.noise_arcsec:.2f} arcsec"),
    ]
    for model in summary.models:
        rows.append((model.name, f"{model.rms_arcsec:.3f} / {model.max_arcsec:.3f} arcsec (rms / max of held-out dots)"))
    rows += [
        ("chosen", summary.model),
        ("held-out dots", f"{held.rms_arcsec:.3f} arcsec rms, {held.max_arcsec:.3f} max; noise: {held.noise_arcsec:.3f}"),
        ("a star's place", f"known to {error.rms_arcsec:.3f} arcsec rms, {error.max_arcsec:.3f} max (1 sigma)"),
    ]
    width = max(len(name) for name, _ in rows) + 2
    return [f"{name:{width}}{text}" for name, text in rows] + list(summary.notes)


def draw_geometry(path: Path, found: Calibrated) -> None:
    """The error of a star's place over the screen, and the residuals of the dots as arrows."""
    error, width = found.uncertainty.map_arcsec, found.problem.nominal.monitor.resolution_px[0]
    height = found.problem.nominal.monitor.resolution_px[1]
    finding = (
        f"By {found.chosen.name} a star's place is known to {found.uncertainty.rms_arcsec:.2g} arcsec rms,"
        f" {found.uncertainty.max_arcsec:.2g} at most; held-out dots {found.chosen.rms_arcsec:.2g} rms"
    )
    dot, right, down = _mean_residuals(found)
    to_arcsec = ARCSEC_PER_RAD / found.problem.nominal.tracker.focal_length_px
    median = max(float(np.median(np.hypot(right, down))), 1e-9)
    with chart(path, finding, panels=2, height_inch=1.4 + 2 * WIDE_INCH * height / width) as (places, residuals):
        image = places.imshow(error, extent=(-0.5, width - 0.5, height - 0.5, -0.5), aspect="equal", cmap="viridis")
        places.figure.colorbar(image, ax=[places, residuals], label="1 sigma of a star's place [arcsec]", shrink=0.5)
        places.set_title("Error of a star's place")
        x, y = found.plan.x_px[dot], found.plan.y_px[dot]
        look = {"angles": "xy", "scale_units": "xy", "width": 0.002, "color": BLUE}
        arrows = residuals.quiver(x, y, right, down, scale=median / (ARROW_SHARE * width), **look)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        residuals.quiverkey(arrows, 0.75, 1.05, median, f"{median * to_arcsec:.2g} arcsec", **key)
        residuals.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="monitor x [px]")
        residuals.set_title("Mean residual of each dot; key: their median")
        for axes in (places, residuals):
            axes.set_ylabel("monitor y [px]")
            axes.grid(visible=False)


def _mean_residuals(found: Calibrated) -> tuple[IntArray, FloatArray, FloatArray]:
    """The dots that were seen, and the mean residual of each, tracker px."""
    right, down = residuals_px(found.problem, found.fit.geometry, found.data)
    dots, place, count = np.unique(found.data.dot, return_inverse=True, return_counts=True)
    return dots, np.bincount(place, right) / count, np.bincount(place, down) / count
