"""Streaks of satellites against light that is summed up moment by moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import get_sun
from astropy.time import Time

from hilstar.basics.rotation import propagate, to_matrix
from hilstar.display.render.reference import extended_image
from hilstar.optics.camera import Camera
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf, pixel_shares
from hilstar.optics.sprites import FrameLight
from hilstar.optics.trails import (
    SPACING_SIGMA,
    Brush,
    DiscTrail,
    Lit,
    Trails,
    TrailView,
    disc_of,
    disc_trail,
    hidden,
    sprite_counts,
    trails,
    with_trails,
)
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.passes import Cone
from tests.support.satellites import element_set, lit_moment, looking_at, rate_now
from tests.support.skies import STATION_UTC
from tests.support.stars import sprites_at

SIGMA_PX = (0.7, 0.9)
SIZE_PX = (160, 120)
BRUSH = Brush(GaussianPsf(SIGMA_PX), 2000)
CAMERA = Camera(SIZE_PX, 3000.0, (79.5, 59.5), np.eye(3))
MOMENTS = 400
# Measured 4e-4 of a satellite's light; 1e-3 is what stars' paths may be off.
PIXEL_LIMIT = 1e-3
FLUX_LIMIT = 1e-5  # the midpoints of 400 moments, where the light changes; float32
# One over the poles, which crosses the station's path
LIST = "OTHER\n" + element_set(7, (97.0, 252.0, 130.0, 322.0), 0.001, 15.0)
NORTH = np.array([0.0, 0.0, 1.0])
DISC_FLUX = 0.02  # a crescent by five rays across a pixel
# of a crescent: the Sun's and the camera's aberration of 20 arcsec each, and a quadrature's share
LAMBERT = 1e-3


def is_lit(sky, seconds: int) -> bool:
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), seconds * 10**9)
    return seen is not None and rate_now(seen) > 0


def image_of(sprites: FrameLight) -> np.ndarray:
    """Sprites as exact Gaussians, (h, w)."""
    return gaussians(sprites.x_px, sprites.y_px, sprites.data["electrons_per_s"].astype(np.float64))


def gaussians(x_px: np.ndarray, y_px: np.ndarray, light: np.ndarray) -> np.ndarray:
    across = pixel_shares(np.arange(SIZE_PX[0]) - x_px[:, None], SIGMA_PX[0])
    down = pixel_shares(np.arange(SIZE_PX[1]) - y_px[:, None], SIGMA_PX[1])
    return (down * light[:, None]).T @ across


def moment_by_moment(
    sky, t_ns: int, q: np.ndarray, rate: np.ndarray, exposure_s: float, before: float = 0.5
) -> np.ndarray:
    """The mean image, each moment from a pass of its own and an attitude of its own; a share
    `before` of the exposure is before the attitude.
    """
    places, light = [], []
    for seconds in ((np.arange(MOMENTS) + 0.5) / MOMENTS - before) * exposure_s:
        seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns + round(seconds * 1e9))
        if seen is None:
            continue
        direction = (
            seen.directions(slice(None), np.zeros(1)) @ to_matrix(propagate(q, rate, seconds)).T
        )
        places.append([float(place[0]) for place in CAMERA.project(direction)])
        half = np.array([exposure_s / MOMENTS / 2])
        light.append(float(seen.rates_e_per_s(np.array([0]), -half, half)[0]) / MOMENTS)
    return gaussians(*np.array(places).T, np.array(light)) if places else np.zeros(SIZE_PX[::-1])


def streak(sky, t_ns: int, q: np.ndarray, rate: np.ndarray, exposure_s: float) -> Trails:
    seen = sky.passing(Cone(to_matrix(q)[2], 0.5, exposure_s / 2), t_ns)
    view = TrailView(CAMERA, to_matrix(q), rate)
    return trails(seen, view, Lit(np.full(len(seen), -exposure_s / 2), exposure_s), BRUSH)


@pytest.mark.parametrize("rate_deg_s", [(0.0, 0.0, 0.0), (1.5, -2.0, 10.0)])
@pytest.mark.parametrize("exposure_s", [0.02, 0.4, 2.0])
def test_a_streak_is_the_light_of_all_its_moments(rate_deg_s, exposure_s):
    sky, t_ns = lit_moment(LIST)
    q = looking_at(
        sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).directions(slice(None), np.zeros(1))[0]
    )
    found = streak(sky, t_ns, q, np.radians(rate_deg_s), exposure_s)
    wanted = moment_by_moment(sky, t_ns, q, np.radians(rate_deg_s), exposure_s)
    total = wanted.sum()
    # part of it is off the image
    assert found.electrons_per_s[0] == pytest.approx(total, rel=5e-4) or exposure_s == 2.0
    assert image_of(found.sprites).sum() == pytest.approx(total, rel=5e-4)
    assert np.abs(image_of(found.sprites) - wanted).max() < PIXEL_LIMIT * total
    assert np.allclose(to_matrix(q) @ found.middle[0], [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("exposure_s", [1e-3, 0.4])
def test_a_wide_satellite_has_the_light_of_all_its_moments_along_its_path(exposure_s):
    """Of 4 km: discs, one after the other, whose light is the streak's and lies no farther from it
    than their radius.
    """
    sky, t_ns = lit_moment(LIST, "norad,size_m\n7,4000\n")
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).only(np.array([0]))
    q = looking_at(seen.directions(slice(None), np.zeros(1))[0])
    rate = np.radians((0.5, -1.0, 10.0))
    lit = Lit(np.array([-exposure_s / 8]), exposure_s)
    trail = disc_trail(seen, "wide", TrailView(CAMERA, to_matrix(q), rate), lit, BRUSH)
    wanted = moment_by_moment(sky, t_ns, q, rate, exposure_s, 1 / 8)
    assert trail.electrons_per_s == pytest.approx(wanted.sum(), rel=1e-3)
    assert trail.shares.sum() == pytest.approx(1)
    assert len(trail.along) == len(trail.shares)
    assert (len(trail.along) > 1) == (exposure_s > 0.1)
    image = extended_image(trail.lights, SIZE_PX)
    assert image.sum() == pytest.approx(wanted.sum(), rel=DISC_FLUX)
    path = np.argwhere(wanted > 1e-3 * wanted.max())
    light = np.argwhere(image > 1e-3 * image.max())
    away_px = np.linalg.norm(light[:, None] - path, axis=2).min(axis=1)
    assert away_px.max() < trail.along[0].radius_rad * CAMERA.focal_length_px + 4 * max(SIGMA_PX)


def test_its_length_is_its_own_rate_against_the_camera_s():
    """Seen by a camera at rest: the angle between the directions at both ends."""
    sky, t_ns = lit_moment(LIST)
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns)
    q = looking_at(seen.directions(slice(None), np.zeros(1))[0])
    at_rest = Cone(NORTH, np.pi, 0.0)
    ends = [
        sky.passing(at_rest, t_ns + k).directions(slice(None), np.zeros(1))[0]
        for k in (-500_000_000, 500_000_000)
    ]
    length_px = 3000 * np.linalg.norm(ends[1] - ends[0])
    found = streak(sky, t_ns, q, np.zeros(3), 1.0).sprites
    wide_px = np.hypot(np.ptp(found.x_px), np.ptp(found.y_px))
    assert length_px > 1
    # from the first sprite to the last
    assert wide_px == pytest.approx(length_px * (1 - 1 / len(found)), rel=1e-3)


def test_a_flash_shines_where_the_satellite_is_at_its_time():
    sky, t_ns = lit_moment(LIST)
    at_s = t_ns / 1e9 + 0.3
    table = f"norad,period_s,amplitude_mag,flash_s,flash_at_s\n7,10,5,0.01,{at_s}\n"
    flashing, _ = lit_moment(LIST, table)
    q = looking_at(
        flashing.passing(Cone(NORTH, np.pi, 0.0), t_ns).directions(slice(None), np.zeros(1))[0]
    )
    rate = np.radians([0.0, 1.0, 0.0])
    found, plain = (streak(one, t_ns, q, rate, 1.0) for one in (flashing, sky))
    bright = found.sprites.data["electrons_per_s"] / plain.sprites.data["electrons_per_s"]
    # 99 times the steady light for 0.01 s at half height
    extra = 99 * 0.01 * np.sqrt(np.pi / (4 * np.log(2)))
    assert found.electrons_per_s[0] / plain.electrons_per_s[0] == pytest.approx(1 + extra, rel=0.01)
    there = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns + 300_000_000).directions(
        slice(None), np.zeros(1)
    )
    x_px, y_px = CAMERA.project(there @ to_matrix(propagate(q, rate, 0.3)).T)
    k = int(np.argmax(bright))
    assert np.hypot(found.sprites.x_px[k] - x_px[0], found.sprites.y_px[k] - y_px[0]) < 0.3 * max(
        SIGMA_PX
    )


def test_a_path_into_the_shadow_ends_there():
    sky, _ = lit_moment(LIST)
    seconds = 0
    for step in (60, 4, 1):
        while not is_lit(sky, seconds):
            seconds += step
        while is_lit(sky, seconds):
            seconds += step
        seconds -= step
    t_ns = (seconds - 3) * 10**9
    seen = sky.passing(Cone(NORTH, np.pi, 5.0), t_ns)
    q = looking_at(seen.directions(slice(None), np.zeros(1))[0])
    found = streak(sky, t_ns, q, np.zeros(3), 10.0)
    wanted = moment_by_moment(sky, t_ns, q, np.zeros(3), 10.0)
    assert wanted.sum() > 0
    # a sprite each 0.25 s; measured 0.3 %
    assert image_of(found.sprites).sum() == pytest.approx(wanted.sum(), rel=0.01)


def test_streaks_follow_the_stars_of_an_image():
    sky, t_ns = lit_moment(LIST)
    q = looking_at(
        sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).directions(slice(None), np.zeros(1))[0]
    )
    found = streak(sky, t_ns, q, np.zeros(3), 0.5)
    stars = sprites_at(
        np.array([[5.0, 6.0], [7.0, 8.0]]), np.array([1.0, 2.0]), BRUSH.psf.footprint_px
    )
    both = with_trails(stars, found, 100)
    assert both.star.tolist() == [0, 1] + [100] * len(found.sprites)
    assert both.per_star == len(found.sprites) > 1
    assert both.star_count == 3


def test_beyond_what_an_image_may_cost_streaks_are_coarser_and_counted():
    sky, t_ns = lit_moment(LIST)
    q = looking_at(
        sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).directions(slice(None), np.zeros(1))[0]
    )
    seen = sky.passing(Cone(to_matrix(q)[2], 0.5, 1.0), t_ns)
    lit, view = Lit(np.array([-1.0]), 2.0), TrailView(CAMERA, to_matrix(q), np.zeros(3))
    fine, coarse = (trails(seen, view, lit, Brush(BRUSH.psf, most)) for most in (2000, 5))
    assert (len(coarse.sprites), coarse.sprites.capped, fine.sprites.capped) == (5, 1, 0)
    assert image_of(coarse.sprites).sum() == pytest.approx(image_of(fine.sprites).sum(), rel=0.02)
    undrawn = trails(seen, view, lit, Brush(BRUSH.psf, 5), faintest_e_per_s=np.inf)
    assert (len(undrawn.sprites), undrawn.sprites.capped) == (0, 0)
    # beside three stars that are drawn coarser than they should be
    stars = replace(
        sprites_at(np.array([[5.0, 6.0]]), np.ones(1), BRUSH.psf.footprint_px), capped=3
    )
    assert [with_trails(stars, one, 100).capped for one in (fine, coarse)] == [3, 4]


def test_the_sun_lights_a_satellite_s_disc_from_where_astropy_has_it():
    sky, t_ns = lit_moment(LIST, "norad,size_m\n7,100\n")
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns)
    disc = disc_of(seen, "OTHER", 0.0, None)
    utc = Time(STATION_UTC.removesuffix("Z"), scale="utc") + t_ns * 1e-9 * units.s
    sun = get_sun(utc).cartesian.xyz.to_value("au")
    # from the satellite within 10 arcsec; the Sun's aberration of 20 arcsec is in theirs
    assert np.degrees(np.arccos(disc.sun @ sun / np.linalg.norm(sun))) < 0.01
    assert disc.radius_rad == pytest.approx(0.05 / disc.distance_km)


def test_a_disc_s_brightest_pixel_is_its_own_light_over_the_disc():
    """In a telescope, for an exposure in which it stands still. Of the light where the Sun is
    overhead, a Lambert sphere's disc has 2 / (3 pi) (sin a + (pi - a) cos a) in the mean, a its
    phase angle.
    """
    sky, t_ns = lit_moment(LIST, "norad,size_m\n7,100\n")
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns)
    direction = seen.directions(slice(None), np.zeros(1))[0]
    telescope = Camera(SIZE_PX, 1e6, (79.5, 59.5), np.eye(3))
    view = TrailView(telescope, to_matrix(looking_at(direction)), np.zeros(3))
    exposure_s = 1e-6
    trail = disc_trail(seen, "x", view, Lit(np.full(1, -exposure_s / 2), exposure_s), BRUSH)
    radius_px = np.tan(trail.along[0].radius_rad) * telescope.focal_length_px
    assert radius_px > 10
    mean = trail.electrons_per_s / (np.pi * radius_px**2)
    phase_rad = np.arccos(-trail.along[0].direction @ trail.along[0].sun)
    lambert = np.sin(phase_rad) + (np.pi - phase_rad) * np.cos(phase_rad)
    share = 2 / (3 * np.pi) * lambert
    assert mean / trail.brightest_e_per_s == pytest.approx(share, rel=LAMBERT)


class StraightPass:
    """A satellite whose place runs evenly along x, from tangent -0.2 to 0.2 in a second."""

    def __len__(self) -> int:
        return 1

    def directions(self, which, seconds, velocity_km_s=None):
        tangent = -0.2 + 0.4 * seconds
        rays = np.stack([tangent, np.zeros_like(tangent), np.ones_like(tangent)], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_a_path_across_the_image_is_drawn_from_edge_to_edge():
    """It has 1200 px, from 600 px before the principal point: the image's edges lie 80 px from
    that, and half a footprint and a pixel outside them light still reaches the image.
    """
    view = TrailView(CAMERA, np.eye(3), np.zeros(3))
    lit = Lit(np.zeros(1), 1.0)
    (count,), (begin, end) = sprite_counts(StraightPass(), view, lit, BRUSH)
    half_px = 80 + BRUSH.psf.footprint_px / 2 + 1
    assert [begin[0], end[0]] == pytest.approx([0.5 - half_px / 1200, 0.5 + half_px / 1200])
    assert count == 1 + np.floor(2 * half_px / SIGMA_PX[0] / SPACING_SIGMA)
    # one at rest has a sprite for each quarter of a second, in which its light may change
    counts, _ = sprite_counts(StillPass(np.zeros(1)), view, Lit(np.zeros(1), 1.1), BRUSH)
    assert counts.tolist() == [5]


class BentPass(StraightPass):
    """As StraightPass, along y an arc that bulges to the principal point from 0.1 above it."""

    def directions(self, which, seconds, velocity_km_s=None):
        tangent = -0.2 + 0.4 * seconds
        height = -0.1 + 0.4 * seconds * (1 - seconds)
        rays = np.stack([tangent, height, np.ones_like(tangent)], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_a_path_that_bulges_into_the_image_is_drawn_though_its_ends_line_misses_it():
    """300 px above the principal point at its ends, and through it in its middle: the line between
    the ends passes 240 px above the image.
    """
    view = TrailView(CAMERA, np.eye(3), np.zeros(3))
    lit = Lit(np.zeros(1), 1.0)
    (bent,), _ = sprite_counts(BentPass(), view, lit, BRUSH)
    assert bent > 0


class StillPass:
    """Satellites that stand at tangents along x, and move by up to 0.01 rad/s."""

    def __init__(self, tangents: np.ndarray) -> None:
        self._rays = np.stack([tangents, np.zeros_like(tangents), np.ones_like(tangents)], axis=1)

    def __len__(self) -> int:
        return len(self._rays)

    def directions(self, which, seconds, velocity_km_s=None):
        rays = self._rays[which]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def speeds_rad_s(self):
        return np.linspace(0.0, 0.01, len(self))


@pytest.mark.parametrize(
    ("turning_rad_s", "reach_rad"), [((0.0, 0.0, 0.0), 0.005), ((0.0, -0.02, 0.0), 0.015)]
)
def test_what_comes_into_view_by_its_own_way_or_the_camera_s_is_in_reach(turning_rad_s, reach_rad):
    """In half a second, at 0.01 rad/s and the camera's rate: 0.9 of that beside the image's edge,
    at 80 px of 3000, on either side; 0.2 rad beside it nothing comes in.
    """
    edge = 80 / 3000
    near = edge + 0.9 * reach_rad
    tangents = np.array([-0.2, -near, 0.0, near, 0.2])
    view = TrailView(CAMERA, np.eye(3), np.array(turning_rad_s))
    assert view.in_reach(StillPass(tangents), 0.5, 0.0).tolist() == [1, 2, 3]


@pytest.mark.parametrize(("share", "is_drawn"), [(0.99, True), (1.01, False)])
def test_a_satellite_under_the_faintest_rate_is_left_out(share, is_drawn):
    sky, t_ns = lit_moment(LIST)
    q = looking_at(
        sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).directions(slice(None), np.zeros(1))[0]
    )
    seen = sky.passing(Cone(to_matrix(q)[2], 0.5, 0.01), t_ns)
    view = TrailView(CAMERA, to_matrix(q), np.zeros(3))
    lit = Lit(np.full(len(seen), -0.005), 0.01)
    rate = float(trails(seen, view, lit, BRUSH).electrons_per_s[0])
    drawn = trails(seen, view, lit, BRUSH, share * rate)
    assert (len(drawn.index), len(drawn.sprites) > 0) == (int(is_drawn), is_drawn)


def test_a_star_behind_a_disc_loses_the_share_of_the_time_of_each_place_that_hides_it():
    """Of two places of a disc of 1 mrad, which have a quarter and a half of the time: within the
    first, the second, both, and a tenth beyond the one's limb and the other's.
    """

    def disc_at(x: float) -> Disc:
        direction = np.array([x, 0.0, 1.0]) / np.hypot(x, 1.0)
        return Disc("x", direction, 1000.0, 1.0, 1.0, NORTH, NORTH, "lambert")

    trail = DiscTrail(
        index=0,
        electrons_per_s=1.0,
        middle=NORTH,
        along=(disc_at(0.0), disc_at(1.2e-3)),
        shares=np.array([0.25, 0.5]),
        lights=(),
        brightest_e_per_s=1.0,
    )
    x = np.array([-0.9e-3, 2.1e-3, 0.6e-3, -1.1e-3, 2.3e-3])
    directions = np.stack([x, np.zeros(5), np.ones(5)], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    stars = sprites_at(np.arange(10.0).reshape(5, 2), np.full(5, 8.0), BRUSH.psf.footprint_px)
    left = hidden(stars, directions, trail)
    assert left.data["electrons_per_s"].tolist() == [6.0, 4.0, 2.0, 8.0, 8.0]
    assert left.star.tolist() == [0, 1, 2, 3, 4]
    whole = replace(trail, shares=np.array([1.0, 0.5]))
    assert hidden(stars, directions, whole).star.tolist() == [1, 3, 4]


@pytest.mark.parametrize("poses", [1, 5])
def test_the_places_of_a_disc_hide_together_what_the_one_in_the_middle_hides(poses):
    """A disc of some 20 px along 40 px of the image, before an even light of 1."""
    sky, t_ns = lit_moment(LIST, "norad,size_m\n7,12000\n")
    seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns).only(np.array([0]))
    q = looking_at(seen.directions(slice(None), np.zeros(1))[0])
    view = TrailView(CAMERA, to_matrix(q), np.array([0.0, 0.1, 0.0]))
    lit = Lit(np.array([-0.07]), 0.14)
    trail = disc_trail(seen, "wide", view, lit, Brush(BRUSH.psf, 2000, poses=poses))
    assert len(trail.along) == poses
    (covering,) = (light for light in trail.lights if getattr(light, "covers", False))
    even = LightMap(np.ones(SIZE_PX[::-1], np.float32))
    behind = extended_image((even, covering), SIZE_PX) - extended_image((covering,), SIZE_PX)
    covered = 1 - behind
    x_px, y_px = (float(place[0]) for place in view.places_px(seen, slice(None), np.zeros(1)))
    rows, columns = np.indices(covered.shape)
    # the disc's edge by five rays a pixel
    assert (covered * columns).sum() / covered.sum() == pytest.approx(x_px, abs=0.05)
    assert (covered * rows).sum() / covered.sum() == pytest.approx(y_px, abs=0.05)
