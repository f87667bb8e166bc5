"""Satellites wide enough to have a face: diffuse spheres along their paths, which hide the stars behind them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import BoolArray, FloatArray, IntArray
from hilstar.rotation import propagate, to_matrix
from hilstar.scene import discs
from hilstar.scene.discs import Pose, disc_lights
from hilstar.scene.extended import DiscLight, ExtendedLight, LightMap
from hilstar.scene.sprites import Sprites
from hilstar.scene.trails import SPACING_SIGMA, Brush, Lit, View, sprite_counts
from hilstar.sky.bodies.disc import Disc

if TYPE_CHECKING:
    from hilstar.sky.bodies.passes import Pass

STEPS_A_RADIUS = 4.0  # of a disc's places along its path: an edge of it is then uneven by 1 % of the radius
AT_REST = np.array([1.0, 0.0, 0.0, 0.0])
NORTH = np.array([0.0, 0.0, 1.0])
M_PER_KM = 1000.0


@dataclass(frozen=True, slots=True)
class DiscTrail:
    """One satellite in an image: its place in the list, its mean rate, its discs, one after the other, and the share of each.

    `lights` draw them in this order, `brightest_e_per_s` is about their brightest pixel.
    """

    index: int
    electrons_per_s: float
    middle: FloatArray
    along: tuple[Disc, ...]
    shares: FloatArray
    lights: tuple[ExtendedLight, ...]
    brightest_e_per_s: float


def wide(seen: Pass, px_per_rad: float, wider_px: float) -> BoolArray:
    """Which satellites (n,) of a pass are wider than so many pixels."""
    size_km = seen.brightness.size_m[seen.index] / M_PER_KM
    return np.asarray(size_km * px_per_rad > wider_px * np.linalg.norm(seen.seen_km[0], axis=1))


def disc_of(seen: Pass, name: str, second: float, velocity_km_s: FloatArray | None) -> Disc:
    """The disc of the only satellite of a pass at a time after its moment, without light."""
    at = np.array([second])
    radius_km = float(seen.brightness.size_m[seen.index[0]]) / M_PER_KM / 2
    return Disc(
        name=name,
        direction=seen.directions(slice(None), at, velocity_km_s)[0],
        distance_km=max(float(np.linalg.norm(seen.vectors_km(at)[0])), 1.001 * radius_km),
        equator_km=radius_km,
        polar_km=radius_km,
        pole=NORTH,
        sun=seen.now.sun_km / np.linalg.norm(seen.now.sun_km),
        law="lambert",
        normal_e_per_s_sr=0.0,
    )


def disc_trail(seen: Pass, name: str, view: View, lit: Lit, brush: Brush) -> DiscTrail | None:
    """The only satellite of a pass along its path; None where it misses the image or has no light."""
    counts, (begin, end) = sprite_counts(seen, view, lit, brush)
    radius_sigma = disc_of(seen, name, 0.0, None).radius_rad * view.camera.focal_length_px / min(brush.sigma_px)
    coarser = max(1.0, radius_sigma / (STEPS_A_RADIUS * SPACING_SIGMA))
    count = min(math.ceil(int(counts[0]) / coarser), brush.poses)
    if not count:
        return None
    edges_s = lit.begin_s[0] + np.linspace(begin[0], end[0], count + 1) * lit.length_s
    middles_s, share = (edges_s[1:] + edges_s[:-1]) / 2, float(end[0] - begin[0]) / count
    rates = seen.rates_e_per_s(np.zeros(count, dtype=np.intp), edges_s[:-1], edges_s[1:])
    if not rates.any():
        return None
    bare = [disc_of(seen, name, second, view.velocity_km_s) for second in middles_s.tolist()]
    lights: list[ExtendedLight] = []
    if count > 1:
        # Together they hide what the one in the middle hides: each after the other would hide the light of those before.
        lights += _lights(bare[count // 2], view, middles_s[count // 2], brush, 0.0, covers=True)
    along = tuple(disc.of_rate(float(rate)) for disc, rate in zip(bare, rates, strict=True))
    for disc, second in zip(along, middles_s.tolist(), strict=True):
        lights += _lights(disc, view, second, brush, share, covers=count == 1)
    if not lights:
        return None
    middle = seen.directions(slice(None), lit.middle_s)[0]
    brightest = _brightest_e_per_s(lights, view)
    return DiscTrail(
        int(seen.index[0]), float(rates.sum()) * share, middle, along, np.full(count, share), tuple(lights), brightest
    )


def _lights(disc: Disc, view: View, second: float, brush: Brush, share: float, covers: bool) -> list[ExtendedLight]:
    turned = to_matrix(propagate(AT_REST, view.rate_image_rad_s, second)) @ view.icrs_to_image
    return disc_lights(disc, discs.View(view.camera, brush.sigma_px, (Pose(turned, share),)), covers)


def _brightest_e_per_s(lights: list[ExtendedLight], view: View) -> float:
    maps = sum(float(light.image.max(initial=0.0)) for light in lights if isinstance(light, LightMap))
    radiance = sum(light.times * light.disc.normal_e_per_s_sr for light in lights if isinstance(light, DiscLight))
    return maps + radiance / view.camera.scales_px_rad()[0] ** 2


def hidden(sprites: Sprites, directions: FloatArray, found: DiscTrail) -> Sprites:
    """Sprites of stars seen in `directions` (n, 3), each without the share of its light that a satellite hides."""
    left = np.ones(len(sprites))
    for disc, share in zip(found.along, found.shares, strict=True):
        left -= share * (directions @ disc.direction > np.cos(disc.radius_rad))
    kept = left > 0
    data = sprites.data[kept]
    data["electrons_per_s"] *= left[kept].astype(np.float32)
    star, x_px, y_px = sprites.star[kept], sprites.x_px[kept], sprites.y_px[kept]
    return replace(sprites, data=data, star=star, x_px=x_px, y_px=y_px)


def places_of(found: list[DiscTrail]) -> tuple[IntArray, FloatArray, FloatArray]:
    """The places in the list, the directions (k, 3) and the rates (k,) of several."""
    index = np.array([one.index for one in found], dtype=np.intp)
    middle = np.array([one.middle for one in found]).reshape(-1, 3)
    return index, middle, np.array([one.electrons_per_s for one in found])
