"""Figures of docs/where-it-fails.md that are of no other test's subject, beside closed forms and
published figures.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest
from scipy.integrate import quad

import hilstar
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.optics.layers.truth import clipped_in
from hilstar.optics.layers.view import POINT_PX
from hilstar.server.bench.frame import clipping_hip
from hilstar.sky.bodies.disc import Disc
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings
from tests.support.claims import holds
from tests.support.skies import moving_sky, random_utcs_ns

ARCSEC = np.pi / (180 * 3600)
# GM (km3/s2) and semi-major axis (km) of the moons that move their planet most, and GM of the
# system: JPL Solar System Dynamics, satellites JUP365 and SAT441.
JUPITER_GM, SATURN_GM = 126_712_764.1, 37_940_584.8
JUPITER_MOONS = {
    "Io": (5959.9, 421_800.0),
    "Europa": (3202.7, 671_100.0),
    "Ganymede": (9887.8, 1_070_400.0),
    "Callisto": (7179.3, 1_882_700.0),
}
SATURN_MOONS = {
    "Titan": (8978.1, 1_221_900.0),
    "Iapetus": (120.5, 3_560_800.0),
    "Rhea": (153.9, 527_100.0),
    "Dione": (73.1, 377_400.0),
}
DATES = 150  # of 80 years: the nearest is within 3 % of the least distance


@pytest.fixture(scope="module")
def distances_km() -> dict[str, np.ndarray]:
    """The distances of bodies from the Earth on random dates."""
    rng = np.random.default_rng(5)
    found: dict[str, list[float]] = {}
    for utc in random_utcs_ns(rng, DATES):
        for disc in moving_sky(utc).discs(np.array([1.0, 0.0, 0.0]), np.pi):
            found.setdefault(disc.name, []).append(disc.distance_km)
    return {name: np.array(values) for name, values in found.items()}


def off_centre_km(moons: dict[str, tuple[float, float]], system_gm: float) -> float:
    """How far a planet may be from the centre of mass of its system, all moons on one side."""
    return sum(gm * axis_km for gm, axis_km in moons.values()) / system_gm


def test_a_planet_is_off_its_system_s_centre_of_mass(distances_km):
    for name, moons, gm in (
        ("Jupiter", JUPITER_MOONS, JUPITER_GM),
        ("Saturn", SATURN_MOONS, SATURN_GM),
    ):
        angle = off_centre_km(moons, gm) / distances_km[name].min()
        holds(f"off-centre-{name.lower()}", angle / ARCSEC)


def test_a_kilometre_at_the_moon(distances_km):
    holds("kilometre-of-moon", 1 / distances_km["Moon"].mean() / ARCSEC)


# a black level of less than a DN, and noise that does not spread it over codes, DN
BLACK_DN, NOISE_DN, SIDE_PX = 0.8, 0.2, 1000


def test_a_black_level_without_noise_is_rounded():
    """A code k has the black levels from k - 1/2 to k + 1/2."""
    settings = DetectorSettings(gain_e_per_dn=1.0, offset_dn=BLACK_DN, read_noise_e=NOISE_DN)
    detector = Detector(settings, (SIDE_PX, SIDE_PX))
    dn = detector.expose(np.zeros((SIDE_PX, SIDE_PX)), 0.1, np.random.default_rng(1))
    read = NormalDist(BLACK_DN, NOISE_DN)
    foretold_dn = sum(1 - read.cdf(code - 0.5) for code in range(1, 5))
    assert dn.mean() == pytest.approx(foretold_dn, abs=5 * dn.std() / SIDE_PX)
    holds("rounded-black", 100 * (dn.mean() / BLACK_DN - 1))


PHASES_DEG = (30.0, 60.0, 90.0, 120.0, 150.0, 170.0)


def lambert_offset(phase: float) -> float:
    """The centroid of a Lambert sphere's light, radii from its middle, by its meridians.

    At longitude l from the observer, l from phase - pi / 2 to pi / 2, the light is cos(l - phase)
    cos(l) cos^3(latitude), and the place across is sin(l) cos(latitude).
    """
    light = quad(lambda lon: math.cos(lon - phase) * math.cos(lon), phase - np.pi / 2, np.pi / 2)
    moment = quad(
        lambda lon: math.cos(lon - phase) * math.cos(lon) * math.sin(lon),
        phase - np.pi / 2,
        np.pi / 2,
    )
    # of cos^3 and of cos^4 over latitudes
    return moment[0] / light[0] * (3 * np.pi / 8) / (4 / 3)


def test_the_light_of_a_crescent_that_is_drawn_as_a_point():
    """At the middle of a disc as wide as POINT_PX, up to which it is a point."""
    towards, far = np.array([0.0, 0.0, 1.0]), 1e6
    step = (np.arange(400) + 0.5) / 200 - 1
    x, y = (axis.ravel() / far for axis in np.meshgrid(step, step))
    rays = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=1)
    away_px = []
    for phase_deg in PHASES_DEG:
        phase = math.radians(phase_deg)
        sun = np.array([math.sin(phase), 0.0, -math.cos(phase)])
        disc = Disc("x", towards, far, 1.0, 1.0, np.array([0.0, 1.0, 0.0]), sun, "lambert", 1.0)
        light = disc.radiance(rays)
        away_radii = (light * x).sum() / light.sum() * far
        assert away_radii == pytest.approx(lambert_offset(phase), abs=0.01)
        away_px.append(away_radii * POINT_PX / 2)
    holds("crescent-away", max(away_px))


FIELDS, FIELDS_DRAWN = 30_000, 10  # with a star that clips, and as many without


def test_some_fields_have_a_star_that_clips():
    """Angles of the stars that may clip from random attitudes; of some the bench's own frames."""
    rng = np.random.default_rng(2)
    ra_deg, roll_deg = rng.uniform(0, 360, (2, FIELDS))
    dec_deg = np.degrees(np.arcsin(rng.uniform(-1, 1, FIELDS)))
    with hilstar.load(resource_path("configs", "demo.toml")) as bench:
        clipping = clipping_hip(bench)
        places = bench.stars.vectors[np.isin(bench.stars.hip, clipping)]
        camera = bench.camera
        half = (np.array(camera.resolution_px) / 2) / camera.focal_length_px
        turns = np.stack(
            [
                to_matrix(from_radec_roll_deg(*attitude))
                for attitude in zip(ra_deg, dec_deg, roll_deg, strict=True)
            ]
        )
        seen = np.einsum("kij,sj->ksi", turns, places)
        in_front = seen[:, :, 2] > 0
        slopes = np.abs(seen[:, :, :2] / np.where(in_front, seen[:, :, 2], 1.0)[:, :, None])
        inside = (in_front & (slopes < half).all(axis=2)).any(axis=1)
        holds("clipping-fields", 100 * inside.mean())
        for has_one in (True, False):
            for k in np.flatnonzero(inside == has_one)[:FIELDS_DRAWN]:
                q = from_radec_roll_deg(ra_deg[k], dec_deg[k], roll_deg[k])
                rows = bench.frame(q).rows
                assert np.isin(rows["hip"], clipping).any() == has_one
                # one that falls between pixels does not clip
                assert has_one or not clipped_in(rows)
