"""A bench's glass: the PSFs of `[tracker.optics] psf` at its focus, and the lens and
transmission that belong with them.
"""

import logging
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.optics.camera import Camera
from hilstar.optics.glass.glass_psf import GlassPsf, NodeSpline, glass_psf, regridded
from hilstar.optics.glass.psf_file import Glass, read_glass
from hilstar.server.bench.config import GAUSSIAN, Tracker
from hilstar.sky.electrons import Optics
from hilstar.sky.spectrum import (
    QUANTUM_EFFICIENCIES,
    TRANSMISSIONS,
    Curve,
    integration_nodes,
    load_curve,
)

log = logging.getLogger(__name__)
MAX_UNSAID = 0.01  # share of a tracker's light beyond a file's wavelengths that is not worth a word
SAID_PX = 1.0  # by how much a detector or another lens may differ from a file's without a word
GRID = 9  # places along each side at which two lenses are compared


def glass_in(tracker: Tracker, folder: Path) -> Glass | None:
    """The glass of a tracker's file; None where its PSF is a Gaussian or one image. Raises
    InputError.
    """
    if tracker.optics.psf == GAUSSIAN:
        return None
    glass = read_glass(folder / tracker.optics.psf)
    if isinstance(glass, Glass):
        return glass
    return None


@dataclass(frozen=True, slots=True)
class Onto:
    """How the tracker's pixels lie on the display."""

    display: Camera
    tracker: Camera

    def places_px(self, places_px: FloatArray) -> FloatArray:
        """Display pixels (n, 2) of tracker pixels (n, 2), without a mirror."""
        x_px, y_px = places_px.T
        rays_cam = self.tracker.rays(x_px, y_px)
        rays_image = rays_cam @ self.display.cam_to_image.T
        return np.stack(self.display.project(rays_image), axis=1)

    @property
    def matrix(self) -> FloatArray:
        """The matrix (2, 2) from offsets in tracker pixels to offsets in display pixels, by
        differences half a pixel to either side of the principal point.
        """
        sides = np.array([(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)])
        ends = self.places_px(np.array(self.tracker.principal_point_px) + sides)
        return np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=1)


def bench_glass_psf(
    glass: Glass, tracker: Tracker, folder: Path, onto: Onto | None = None
) -> GlassPsf:
    """A tracker's glass at its focus, or as a display draws it; the same again is the same
    object. Says what is not covered.
    """
    shares = tuple(_mean_shares(glass, tracker, folder).tolist())  # a key of the cache
    optics = tracker.optics
    focus_um = optics.focus_um + optics.focus_um_per_k * optics.warmer_k
    return _glass_psf(glass, focus_um, decentre_px(tracker), shares, tracker.resolution_px, onto)


def decentre_px(tracker: Tracker) -> tuple[float, float]:
    """How far a tracker's lens stands beside its place, px."""
    return (
        tracker.optics.decentre_x_um / tracker.pixel_pitch_um,
        tracker.optics.decentre_y_um / tracker.pixel_pitch_um,
    )


@lru_cache(maxsize=4)
def _glass_psf(
    glass: Glass,
    focus_um: float,
    moved_px: tuple[float, float],
    shares: tuple[float, ...],
    resolution_px: tuple[int, int],
    onto: Onto | None,
) -> GlassPsf:
    if any(moved_px):
        glass = replace(glass, places_px=glass.places_px + np.array(moved_px))
    if onto is not None:
        return glass_psf(_glass_on_display(glass, onto), focus_um, np.array(shares))
    whole_psf = glass_psf(glass, focus_um, np.array(shares))
    right, bottom = resolution_px[0] - 1.0, resolution_px[1] - 1.0
    x_px = np.array([0.0, 0.0, right, right])
    y_px = np.array([0.0, bottom, 0.0, bottom])
    _, corners_beyond_px = whole_psf.field.within(x_px, y_px)
    beyond_px = float(corners_beyond_px.max())
    if len(glass.places_px) > 1 and beyond_px > SAID_PX:
        say_once(
            f"the detector reaches {beyond_px:.0f} px beyond the file's points; there the nearest"
            " PSF is taken"
        )
    first, last = glass.focuses_um[[0, -1]]
    if not first <= focus_um <= last:
        say_once(
            f"focus_um = {focus_um:g} is beyond the file's {first:g} to {last:g}; the nearest is"
            " taken"
        )
    return whole_psf


def _glass_on_display(glass: Glass, onto: Onto) -> Glass:
    """A glass whose images, places and lateral colour are in the display's pixels."""
    basis, per_px = regridded(glass.basis.astype(np.float64), glass.per_px, onto.matrix)
    sums = glass.weights @ basis.sum(axis=(1, 2))  # each image's light is 1, as it was
    weights = glass.weights / sums[..., None]
    places_px = np.round(onto.places_px(glass.places_px), 6)
    lateral_px = glass.lateral_px @ onto.matrix.T
    # points far beyond the detector may lie beyond either lens
    known = np.isfinite(places_px).all(axis=1)
    if not known.any():
        raise InputError("none of its points lies before the display's lens")
    return replace(
        glass,
        basis=basis.astype(np.float32),
        per_px=per_px,
        places_px=places_px[known],
        weights=weights[known],
        lateral_px=lateral_px[known],
        illumination=glass.illumination[known],
        outside=glass.outside[known],
    )


@lru_cache(maxsize=32)
def say_once(line: str, about: str = "[tracker.optics] psf") -> None:
    """Warn of what a glass does not cover or is not taken for, or of what else a tracker is
    `about`, each line once.
    """
    log.warning("%s: %s", about, line)


def _mean_shares(glass: Glass, tracker: Tracker, folder: Path) -> FloatArray:
    """The shares (L,) that a file's wavelengths have of as many photons at each wavelength, as
    the tracker detects them.
    """
    if len(glass.wavelengths_nm) == 1:
        return np.ones(1)
    channels = [_detected(tracker, key, folder) for key in tracker.quantum_efficiencies]
    nm, weight = np.concatenate(channels, axis=1)
    total = weight.sum()
    splines = NodeSpline(glass.wavelengths_nm)
    shares = weight @ splines(nm) / total
    first, last = glass.wavelengths_nm[[0, -1]]
    for side, limit, is_beyond in (("under", first, nm < first), ("over", last, nm > last)):
        share = weight[is_beyond].sum()
        if share > MAX_UNSAID * total:
            light = f"{share / total:.0%} of the light"
            say_once(f"{light} is {side} the file's {limit:g} nm, whose PSF it is given")
    return np.asarray(shares)


def _detected(tracker: Tracker, key: str, folder: Path) -> FloatArray:
    """Wavelengths and the tracker's relative response there, by the integration's nodes: (2, n)."""
    efficiency = load_curve(
        tracker.quantum_efficiencies[key], f"[tracker] {key}", folder, QUANTUM_EFFICIENCIES
    )
    optics = Optics(tracker.aperture_mm, efficiency, glass_transmission(tracker, folder))
    nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    response = optics.quantum_efficiency(nm) * optics.transmission(nm)
    return np.stack([nm, response * weight_m])


def glass_transmission(tracker: Tracker, folder: Path) -> Curve:
    """The transmission of a tracker's optics: its own key where that is given, else its glass's,
    else 1. Raises InputError.
    """
    glass = glass_in(tracker, folder)
    if glass is None or glass.transmission is None:
        return load_curve(tracker.transmission, "[tracker] transmission", folder, TRANSMISSIONS)
    if tracker.transmission == 1.0:
        return glass.transmission
    say_once(f"its transmission is not used: [tracker] transmission is {tracker.transmission}")
    return load_curve(tracker.transmission, "[tracker] transmission", folder, TRANSMISSIONS)


def through_glass(camera: Camera, tracker: Tracker, folder: Path) -> Camera:
    """The camera with its glass's distortion; one that has a lens keeps it, and a contradiction
    is said.
    """
    glass = glass_in(tracker, folder)
    if glass is None or glass.lens is None:
        return camera
    bent = replace(camera, lens=glass.lens)
    if camera.lens is None:
        return bent
    tangents = camera.tangents(*camera.grid_px(GRID))
    x_px, y_px = camera.places_px(*tangents)
    bent_x_px, bent_y_px = bent.places_px(*tangents)
    off_px = float(np.nanmax(np.hypot(x_px - bent_x_px, y_px - bent_y_px)))
    if off_px > SAID_PX:
        say_once(
            f"its distortion is up to {off_px:.1f} px from that of [tracker] distortion, which is"
            " taken"
        )
    return camera
