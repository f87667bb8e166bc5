"""Photographs of a planted camera, by a renderer of their own: no part of hilstar's cameras,
PSFs, light or detector.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.special import erf

from hilstar.sky.catalog import load_catalog

WIDTH, HEIGHT = 640, 480
FAINTEST_V_MAG = 12.0


@dataclass(frozen=True)
class Planted:
    """A camera: lens, PSF sigmas (px, in the middle and by the square of the half diagonals),
    light and detector.
    """

    focal_px: float = 3000.0
    centre_px: tuple[float, float] = (326.0, 234.0)
    k1: float = 0.35
    sigma_px: tuple[float, float] = (0.75, 0.35)
    stretch: float = 1.15
    zero_e: float = 6.0e6  # electrons of V = 0
    colour: float = -0.15
    vignetting_mag: float = 0.45
    sky_e: float = 600.0
    gain_e_per_dn: float = 0.8
    read_e: float = 5.0
    pedestal_dn: float = 0.0
    full_dn: int = 65535
    gamma: float = 1.0
    hot: tuple[tuple[int, int], ...] = ()
    epoch_jyear: float = 2020.0


@dataclass(frozen=True)
class Extras:
    """What is wrong in a photograph: false stars (x, y, electrons), a trail's two ends, a cloud
    over the lower right corner.
    """

    false_stars: tuple[tuple[float, float, float], ...] = ()
    trail_px: tuple[tuple[float, float], tuple[float, float]] | None = None
    cloud_mag: float = 0.0
    sky_times: float = 1.0
    smear_px: float = 0.0
    stars: bool = True
    # ICRS: 58.3 arcsec tan z of refraction, and k_mag sec z of extinction
    zenith: tuple[float, ...] | None = None
    k_mag: float = 0.0
    blur_px: float = 0.0


NOTHING_WRONG = Extras()


def rotation_of(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """ICRS to camera (x right, y down, z boresight): at roll 0 north is up and east left."""
    ra, dec, roll = np.radians([ra_deg, dec_deg, roll_deg])
    z = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(z, east)
    x, y = -east, -north
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, -s * x + c * y, z])


def photograph(
    camera: Planted,
    pointing: tuple[float, float, float],
    rng: np.random.Generator,
    extras: Extras = NOTHING_WRONG,
) -> np.ndarray:
    """One photograph, uint16 (height, width), DN."""
    catalog = load_catalog()
    bright = catalog.v_mag < FAINTEST_V_MAG
    ra, dec = np.radians(catalog.ra_deg[bright]), np.radians(catalog.dec_deg[bright])
    years = camera.epoch_jyear - 1991.25
    dec = dec + np.radians(catalog.pm_dec_mas_yr[bright] / 3.6e6) * years
    ra = ra + np.radians(catalog.pm_ra_cosdec_mas_yr[bright] / 3.6e6) * years / np.cos(dec)
    stars = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    extinct_mag = np.zeros(len(stars))
    if extras.zenith is not None:
        up = np.array(extras.zenith)
        cosine = np.maximum(stars @ up, 0.1)
        stars = stars + np.radians(58.3 / 3600) * (up / cosine[:, None] - stars)
        stars /= np.linalg.norm(stars, axis=1, keepdims=True)
        extinct_mag = extras.k_mag / cosine
    x, y, z = (stars @ rotation_of(*pointing).T).T
    front = z > 0.5
    u, v = x[front] / z[front], y[front] / z[front]
    gain = 1 + camera.k1 * (u * u + v * v)
    px, py = (
        camera.centre_px[0] + camera.focal_px * u * gain,
        camera.centre_px[1] + camera.focal_px * v * gain,
    )
    mag = (catalog.v_mag[bright] + camera.colour * catalog.bv_mag[bright] + extinct_mag)[front]
    near = (px > -10) & (px < WIDTH + 10) & (py > -10) & (py < HEIGHT + 10)
    px, py, mag = px[near], py[near], mag[near]
    if not extras.stars:
        px, py, mag = px[:0], py[:0], mag[:0]
    mag = mag + extras.cloud_mag * ((px > 0.62 * WIDTH) & (py > 0.62 * HEIGHT))
    light = camera.zero_e * 10 ** (-0.4 * mag)
    for fx, fy, e in extras.false_stars:
        px, py, light = np.append(px, fx), np.append(py, fy), np.append(light, e)
    electrons = np.full((HEIGHT, WIDTH), camera.sky_e * extras.sky_times)
    for cx, cy, e in zip(px, py, light, strict=True):
        _add(electrons, camera, (cx, cy), e, extras)
    if extras.trail_px is not None:
        (x0, y0), (x1, y1) = extras.trail_px
        for share in np.linspace(0, 1, 400):
            _add(
                electrons,
                camera,
                (x0 + share * (x1 - x0), y0 + share * (y1 - y0)),
                3.0e5 / 400,
                NOTHING_WRONG,
            )
    yy, xx = np.mgrid[:HEIGHT, :WIDTH]
    r2 = ((xx - camera.centre_px[0]) ** 2 + (yy - camera.centre_px[1]) ** 2) / (
        (WIDTH**2 + HEIGHT**2) / 4
    )
    electrons *= 10 ** (-0.4 * camera.vignetting_mag * r2)
    counted = rng.poisson(electrons) + rng.normal(0, camera.read_e, electrons.shape)
    dn = counted / camera.gain_e_per_dn + camera.pedestal_dn
    for row, column in camera.hot:
        dn[row, column] += 3000
    if camera.gamma != 1.0:
        dn = camera.full_dn * (np.clip(dn, 0, None) / camera.full_dn) ** (1 / camera.gamma)
    return np.clip(np.rint(dn), 0, camera.full_dn).astype(np.uint16)


def _add(
    image: np.ndarray, camera: Planted, place: tuple[float, float], electrons: float, extras: Extras
) -> None:
    x, y = place
    half_diagonal2 = (WIDTH**2 + HEIGHT**2) / 4
    r2 = ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / half_diagonal2
    sigma = np.hypot(camera.sigma_px[0] + camera.sigma_px[1] * r2, extras.blur_px)
    reach = int(6 * sigma + extras.smear_px) + 2
    x0, y0 = round(x), round(y)
    columns, rows = (
        np.arange(max(x0 - reach, 0), min(x0 + reach + 1, WIDTH)),
        np.arange(max(y0 - reach, 0), min(y0 + reach + 1, HEIGHT)),
    )
    if not len(columns) or not len(rows):
        return

    def shares(at: np.ndarray, middle: float, width: float) -> np.ndarray:
        edges = np.append(at - 0.5, at[-1] + 0.5) - middle
        return np.diff(erf(edges / (width * np.sqrt(2)))) / 2

    steps = (
        np.linspace(-0.5, 0.5, max(1, int(2 * extras.smear_px))) * extras.smear_px
        if extras.smear_px
        else [0.0]
    )
    across = np.mean([shares(columns, x + step, sigma) for step in steps], axis=0)
    image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += electrons * np.outer(
        shares(rows, y, sigma * camera.stretch), across
    )


BENCH = """[tracker]
aperture_mm = 20.0
focal_length_mm = {focal_mm}
pixel_pitch_um = 6.0
resolution_px = [640, 480]
quantum_efficiency = 0.5
exposure_s = 0.2
{more}
"""


def write_bench(path: Path, focal_mm: float = 18.6, more: str = "") -> Path:
    """A file with [tracker] alone, whose focal length is 3 % off the planted one."""
    path.write_text(BENCH.format(focal_mm=focal_mm, more=more))
    return path


@dataclass(frozen=True)
class Sky:
    """Pointings of photographs in which stars of V = 4 to 8 lie thick enough."""

    pointings: tuple[tuple[float, float, float], ...] = field(
        default=((84.0, 2.0, 20.0), (290.0, 30.0, 250.0), (310.0, 40.0, 110.0))
    )


SKY = Sky()
