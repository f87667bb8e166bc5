"""What strikes a detector besides the stars: cosmic rays and false stars, new in every frame."""

from __future__ import annotations

import math

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError
from hilstar.tracker.settings import DetectorSettings

DEFAULT_PITCH_UM = 13.0
MAX_HITS = 1e6  # cosmic rays in one frame; each is a track of pixels

# A particle at minimum ionisation in silicon (Particle Data Group): 388 eV/um on average, 3.66 eV a pair. The mean
# alone, without Landau's tail.
RAY_E_PER_UM = 388.0 / 3.66
RAY_DEPTH_UM = 20.0  # sensitive silicon of a back-illuminated CCD, of the order of its pixel
RAY_STEP_PX = 0.25

FALSE_STAR_REACH_SIGMAS = 5.0


def cosmic_rays_e(
    settings: DetectorSettings,
    shape: tuple[int, int],
    exposure_s: float,
    rng: np.random.Generator,
    pixel_pitch_um: float = DEFAULT_PITCH_UM,
) -> FloatArray:
    """Electrons of one frame's cosmic rays, shape `shape`: straight tracks through RAY_DEPTH_UM of silicon.

    The rate is that of hits on the sensor's face. Rays come isotropically, so a face sees cos^2 of the angle to its
    normal spread evenly from 0 to 1. Raises InputError where more than MAX_HITS are expected.
    """
    height, width = shape
    area_cm2 = width * height * (pixel_pitch_um * 1e-4) ** 2
    expected = settings.cosmic_rays_per_cm2_s * area_cm2 * exposure_s
    if expected > MAX_HITS:
        raise InputError(f"{expected:.3g} cosmic rays in a frame; lower cosmic_rays_per_cm2_s or the exposure")
    hits = int(rng.poisson(expected))
    cosine = np.sqrt(1.0 - rng.random(hits))
    azimuth_rad = rng.uniform(0.0, 2 * np.pi, hits)
    start_px = rng.random((hits, 2)) * (width, height)
    # A grazing ray is longer than the sensor: only what the sensor can see of it is stepped through.
    length_px = RAY_DEPTH_UM / pixel_pitch_um * np.sqrt(1 - cosine**2) / cosine
    charge_e = RAY_E_PER_UM * RAY_DEPTH_UM / cosine
    seen_px = np.minimum(length_px, width + height)
    charge_e *= np.divide(seen_px, length_px, out=np.ones(hits), where=length_px > 0)
    steps = np.ceil(seen_px / RAY_STEP_PX).astype(np.intp) + 1
    ray = np.repeat(np.arange(hits), steps)
    along_px = (np.arange(len(ray)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[ray] * seen_px[ray]
    column = np.floor(start_px[ray, 0] + along_px * np.cos(azimuth_rad[ray])).astype(np.intp)
    row = np.floor(start_px[ray, 1] + along_px * np.sin(azimuth_rad[ray])).astype(np.intp)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    image_e = np.zeros(shape)
    np.add.at(image_e, (row[inside], column[inside]), rng.poisson((charge_e / steps)[ray[inside]]))
    return image_e


def false_stars_e(
    settings: DetectorSettings, shape: tuple[int, int], exposure_s: float, rng: np.random.Generator
) -> FloatArray:
    """Expected electrons, shape `shape`, of `false_stars` equal point sources at random places, new in every frame."""
    from scipy.special import ndtr

    height, width = shape
    x_px, y_px = (rng.random((settings.false_stars, 2)) * (width, height) - 0.5).T
    sigma_px = settings.false_star_sigma_px
    reach = math.ceil(FALSE_STAR_REACH_SIGMAS * sigma_px) + 1
    column = np.rint(x_px).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    row = np.rint(y_px).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    share_x = ndtr((column - x_px[:, None] + 0.5) / sigma_px) - ndtr((column - x_px[:, None] - 0.5) / sigma_px)
    share_y = ndtr((row - y_px[:, None] + 0.5) / sigma_px) - ndtr((row - y_px[:, None] - 0.5) / sigma_px)
    share_x *= (column >= 0) & (column < width)
    share_y *= (row >= 0) & (row < height)
    light_e = settings.false_star_e_per_s * exposure_s * share_y[:, :, None] * share_x[:, None, :]
    image_e = np.zeros(shape)
    np.add.at(image_e, (row.clip(0, height - 1)[:, :, None], column.clip(0, width - 1)[:, None, :]), light_e)
    return image_e
