"""Rays against a spheroid that the Sun lights: what each ray brings, and what it lets through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# each way along a ray: 175 km up at the end, at which exp(-22) of the air is left
COLUMN_KM, COLUMN_STEPS = 1500.0, 3000
TABLE_KM = np.linspace(0.0, 400.0, 81)  # the logarithm is as good as straight
HEIGHT_ROUNDS = 6  # of Bowring's iteration: 1e-9 km


@dataclass(frozen=True)
class Body:
    """A spheroid at `centre_km` from the observer; all vectors (3,) in the axes of the rays.

    `normal` is the radiance where sunlight and sight are at right angles to the ground. `air` is
    the scale height, km, and the depth straight down.
    """

    centre_km: np.ndarray
    equator_km: float
    polar_km: float
    pole: np.ndarray
    sun: np.ndarray
    law: Callable[[np.ndarray, np.ndarray], np.ndarray]
    normal: float = 1.0
    air: tuple[float, float] | None = None


def lambert(mu0: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """Radiance by the cosines of incidence and emission."""
    return np.maximum(mu0, 0.0) + 0.0 * mu


def lommel_seeliger(mu0: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """As `lambert`, 1 where both are 1."""
    lit = mu0 > 0
    return np.where(lit, 2 * mu0 / np.where(lit, mu0 + mu, 1.0), 0.0)


def lunar_lambert(share: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """`share` of Lommel-Seeliger, the rest Lambert's (McEwen 1991, Icarus 92, 298)."""
    return lambda mu0, mu: share * lommel_seeliger(mu0, mu) + (1 - share) * lambert(mu0, mu)


def sunlit(mu0: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """1 in sunlight: the area of a crescent."""
    return np.where(mu0 > 0, 1.0, 0.0) + 0.0 * mu


def traced(body: Body, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (n,) and the share (n,) of what lies behind that comes through, along rays (n, 3)
    of any length.
    """
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    turn = _axes(body.pole)
    squeeze = np.array([1 / body.equator_km, 1 / body.equator_km, 1 / body.polar_km])
    p, q = -(turn @ body.centre_km) * squeeze, (d @ turn.T) * squeeze
    # |p + t q| = 1; by the ray's nearest point, which keeps the digits that b^2 - a c would lose at
    # a far body
    nearest = -(q @ p) / np.einsum("ij,ij->i", q, q)
    from_centre = p + nearest[:, None] * q
    half = 1.0 - np.einsum("ij,ij->i", from_centre, from_centre)
    length = np.linalg.norm(q, axis=1)
    hit = (half >= 0) & (nearest > 0)
    place = from_centre - (np.sqrt(np.maximum(half, 0.0)) / length)[:, None] * q
    normal = (place * squeeze) @ turn
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    mu0, mu = normal @ body.sun, -np.einsum("ij,ij->i", normal, d)
    radiance = np.where(hit, body.normal * body.law(mu0, np.maximum(mu, 0.0)), 0.0)
    through = np.where(hit, 0.0, 1.0)
    if body.air is not None:
        beside = np.flatnonzero(~hit & (nearest > 0))
        radiance[beside], through[beside] = _air(body, d[beside], turn)
    return radiance, through


def limb(body: Body, count: int) -> np.ndarray:
    """Directions (count, 3) of the limb all round: rays that touch the spheroid, by the polar
    plane of the observer.
    """
    turn = _axes(body.pole)
    axes = np.array([body.equator_km, body.equator_km, body.polar_km])
    p = -(turn @ body.centre_km) / axes
    far = np.linalg.norm(p)
    across = np.cross(p, [0.3, 0.5, 0.81])
    across /= np.linalg.norm(across)
    third = np.cross(p / far, across)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    ring = p / far**2 + np.sqrt(1 - 1 / far**2) * (np.cos(angle) * across + np.sin(angle) * third)
    seen = ((ring - p) * axes) @ turn
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


def _axes(pole: np.ndarray) -> np.ndarray:
    """The turn (3, 3) to axes whose third is the pole."""
    first = np.cross(pole, [1.0, 0.0, 0.0] if abs(pole[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(pole, first), pole])


def _air(body: Body, d: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and share let through of rays (n, 3) beside the ground: the light of one that
    touches it, by depth.
    """
    _, up, tau = columns(body, d)
    full = float(np.exp(_log_columns(body)[0]))
    lit = body.normal * np.maximum(up @ turn @ body.sun, 0.0)
    return lit * -np.expm1(-tau) / -np.expm1(-full), np.exp(-tau)


def columns(body: Body, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height (n,), km, and vertical (n, 3) in the body's axes where unit rays (n, 3) are lowest,
    and their air's depth (n,).

    The depth is that over a globe as curved as the ground is there along the ray.
    """
    along, start = d @ _axes(body.pole).T, -(_axes(body.pole) @ body.centre_km)
    near = -(along @ start)
    for _ in range(HEIGHT_ROUNDS):
        place = start + near[:, None] * along
        near -= np.einsum("ij,ij->i", along, _above(place, body)[1]) * np.linalg.norm(place, axis=1)
    height, up = _above(start + near[:, None] * along, body)
    a, e2 = body.equator_km, 1 - (body.polar_km / body.equator_km) ** 2
    root = 1 - e2 * up[:, 2] ** 2
    meridian, across = a * (1 - e2) / root**1.5, a / root**0.5
    north = np.stack([np.zeros(len(d)), np.zeros(len(d)), np.ones(len(d))], axis=1) - up[:, 2:] * up
    cos2 = np.einsum("ij,ij->i", along, north) ** 2 / np.maximum(
        np.einsum("ij,ij->i", north, north), 1e-12
    )
    radius = 1 / (cos2 / meridian + (1 - cos2) / across)
    table = _log_columns(body)
    return height, up, np.exp(np.interp(height, TABLE_KM, table)) * np.sqrt(radius / a)


def direct_columns(body: Body, d: np.ndarray) -> np.ndarray:
    """The air's depth along unit rays (n, 3), step by step: what `columns` is held to."""
    assert body.air is not None
    scale_km, depth = body.air
    along, start = d @ _axes(body.pole).T, -(_axes(body.pole) @ body.centre_km)
    steps = np.linspace(-COLUMN_KM, COLUMN_KM, COLUMN_STEPS)
    found = []
    for ray in along:
        height, _ = _above(start + (-(ray @ start) + steps)[:, None] * ray, body)
        found.append(depth / scale_km * np.trapezoid(np.exp(-height / scale_km), steps))
    return np.array(found)


def _log_columns(body: Body) -> np.ndarray:
    """Logarithm of the depth of rays that are lowest at TABLE_KM above a globe as large as the
    equator, step by step.
    """
    assert body.air is not None
    scale_km, depth = body.air
    steps = np.linspace(-COLUMN_KM, COLUMN_KM, COLUMN_STEPS)
    height = np.hypot(body.equator_km + TABLE_KM[:, None], steps) - body.equator_km
    return np.log(depth / scale_km * np.trapezoid(np.exp(-height / scale_km), steps, axis=1))


def _above(places: np.ndarray, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Geodetic height, km, and the vertical of places (..., 3) in the body's axes, by Bowring's
    iteration.
    """
    a, c = body.equator_km, body.polar_km
    rho, z = np.hypot(places[..., 0], places[..., 1]), places[..., 2]
    tan_u = z / np.maximum(rho, 1e-9) * (a / c)
    for _ in range(HEIGHT_ROUNDS):
        cos_u = 1 / np.sqrt(1 + tan_u**2)
        sin_u = tan_u * cos_u
        tan_phi = (z + (a * a - c * c) / c * sin_u**2 * sin_u) / (
            rho - (a * a - c * c) / a * cos_u**2 * cos_u
        )
        tan_u = tan_phi * c / a
    cos_phi = 1 / np.sqrt(1 + tan_phi**2)
    sin_phi = tan_phi * cos_phi
    height = rho * cos_phi + z * sin_phi - np.sqrt((a * cos_phi) ** 2 + (c * sin_phi) ** 2)
    east = np.stack([places[..., 0], places[..., 1]], axis=-1) / np.maximum(rho, 1e-9)[..., None]
    return height, np.concatenate([east * cos_phi[..., None], sin_phi[..., None]], axis=-1)
