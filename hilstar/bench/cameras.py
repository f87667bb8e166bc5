"""The two cameras of a bench file: the monitor behind its collimator, and the tracker."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.bench.config import BenchConfig, Tracker
from hilstar.errors import InputError
from hilstar.monitor.geometry import load_distortion, load_geometry, monitor_camera
from hilstar.scene.camera import Camera, bounded
from hilstar.scene.psf import footprint_px

NO_MISALIGNMENT = np.array([1.0, 0.0, 0.0, 0.0])


def bench_camera(config: BenchConfig, folder: Path) -> Camera:
    """The monitor behind its collimator, by its geometry file where it has one. Raises InputError."""
    if config.collimator.geometry is None:
        return ideal_monitor(config)
    return real_monitor(config, folder / config.collimator.geometry)


def ideal_monitor(config: BenchConfig) -> Camera:
    """The monitor behind an ideal collimator, whatever geometry file the bench has."""
    return monitor_camera(
        config.monitor.resolution_px,
        config.monitor.pixel_pitch_um,
        config.collimator.focal_length_mm,
        np.array(config.collimator.q_cam_to_mon),
        config.collimator.principal_point_px,
    )


def real_monitor(config: BenchConfig, path: Path) -> Camera:
    """The monitor as a geometry file has it, bounded to what sprites on it need. Raises InputError."""
    camera = load_geometry(path, config.monitor.resolution_px)
    return _bounded(camera, footprint_px(config.render.sprite_sigma_px) / 2 + 1, path)


def tracker_camera(tracker: Tracker, folder: Path) -> Camera:
    """The tracker, with its flight model where it has one. Raises InputError."""
    camera = monitor_camera(
        tracker.resolution_px, tracker.pixel_pitch_um, tracker.focal_length_mm, NO_MISALIGNMENT, tracker.principal_point_px
    )
    if tracker.distortion is None:
        return camera
    path = folder / tracker.distortion
    return _bounded(load_distortion(path, camera), footprint_px(tracker.psf_sigma_px) / 2 + 1, path)


def _bounded(camera: Camera, margin_px: float, path: Path) -> Camera:
    try:
        return bounded(camera, margin_px)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
