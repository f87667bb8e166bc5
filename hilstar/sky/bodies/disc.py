"""A body that is seen as a disc, not a point: in which directions, how bright each place of it is,
and what it hides.

All is computed in axes in which the body's spheroid is a unit sphere, and limb and terminator are
circles. The true distance is used, so that of a near Earth only the cap is seen that is in view.
Laws give the radiance relative to `normal_e_per_s_sr`:

- `lambert`: mu0, the cosine of the Sun's angle from the place's normal;
- `lunar-lambert`: 2 l mu0 / (mu0 + mu) + (1 - l) mu0, mu the observer's (McEwen 1991, Icarus 92,
  298), l = `lunar_share`;
- `limb-darkened`: 0.30 + 0.93 mu - 0.23 mu^2, sunlight at 550 nm (Cox 2000, Allen's Astrophysical
  Quantities, 14.7);
- `uniform`: 1.

The law gives how light is spread over a disc, the body's magnitude gives its sum: `of_rate` scales
the disc to that.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from hilstar.basics.arrays import FloatArray

Law = Literal["uniform", "lambert", "lunar-lambert", "limb-darkened"]
SOLAR_LIMB = (0.30, 0.93, -0.23)
# Gauss-Legendre nodes along each axis of the lit face: the flux is right to 1e-5
# (tests/unit/sky/bodies/test_disc.py).
QUADRATURE = 40
# Height of the air over the limb, in scale heights. Above it the optical depth of the Earth's air
# along a ray is 1e-8, which no code shows.
AIR_TOP = 20.0


@dataclass(frozen=True, slots=True)
class Air:
    """An exponential atmosphere: its scale height, and its vertical optical depth above the
    surface.
    """

    scale_km: float
    depth: float


@dataclass(frozen=True, eq=False)
class Disc:
    """A body's disc as the observer sees it. In ICRS axes, each (3,) and unit: `direction` to its
    centre, `pole` along its axis, and `sun`, the direction from the body to the Sun.

    `equator_km` and `polar_km` are the spheroid's radii. `normal_e_per_s_sr` is the radiance,
    electrons per second and steradian, where the law's function is 1.
    """

    name: str
    direction: FloatArray
    distance_km: float
    equator_km: float
    polar_km: float
    pole: FloatArray
    sun: FloatArray
    law: Law
    normal_e_per_s_sr: float = 1.0
    lunar_share: float = 1.0
    air: Air | None = None

    @cached_property
    def to_sphere(self) -> FloatArray:
        """The matrix (3, 3) that turns ICRS vectors, in equatorial radii, into axes in which the
        body is a unit sphere with its centre on +z, and the Sun to the right (+x).
        """
        stretch = self.equator_km / self.polar_km - 1
        squash = np.eye(3) + stretch * np.outer(self.pole, self.pole)
        towards = squash @ self.direction
        z = towards / np.linalg.norm(towards)
        sun = squash @ self.sun
        # x points to the Sun's side; any x will do where the Sun is in front of or behind the body.
        side = sun - (sun @ z) * z
        if side @ side < 1e-12 * (sun @ sun):
            side = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x = side / np.linalg.norm(side)
        return np.asarray(np.stack([x, np.cross(z, x), z]) @ squash)

    @cached_property
    def distance_radii(self) -> float:
        """The distance of the body's centre in the axes of `to_sphere`, in sphere radii."""
        direction_length = float(np.linalg.norm(self.to_sphere @ self.direction))
        return direction_length * self.distance_km / self.equator_km

    @cached_property
    def sun_sphere(self) -> FloatArray:
        """The vector (3,) whose inner product with a place on the sphere is the cosine of the angle
        between the Sun and the normal there, times the length of the normal in space.
        """
        return np.asarray(self.to_sphere @ self.sun)

    @property
    def radius_rad(self) -> float:
        """The largest angle from the centre to the limb, rad."""
        sine = max(self.equator_km, self.polar_km) / self.distance_km
        return float(np.arcsin(min(1.0, sine)))

    @property
    def air_radii(self) -> float:
        """The air's scale height in equatorial radii, 0 without air."""
        if self.air is None:
            return 0.0
        return self.air.scale_km / self.equator_km

    @property
    def slant_depth(self) -> float:
        """The optical depth along a ray that touches the surface, 0 without air (Chapman's
        limit).
        """
        if self.air is None:
            return 0.0
        return self.air.depth * float(np.sqrt(2 * np.pi / self.air_radii))

    def limb(self, count: int, radii: float = 1.0) -> FloatArray:
        """Unit directions (count, 3), ICRS axes, of rays evenly around the body that pass its
        centre at a distance of `radii` of its radius; 1 is the limb.
        """
        sine = min(1.0, radii / self.distance_radii)
        turn = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
        forward = np.full(count, np.sqrt(1 - sine**2))
        ring = np.stack([sine * np.cos(turn), sine * np.sin(turn), forward], axis=1)
        on_sphere = ring @ np.linalg.inv(self.to_sphere).T
        return np.asarray(on_sphere / np.linalg.norm(on_sphere, axis=1, keepdims=True))

    def of_rate(self, electrons_per_s: float) -> "Disc":
        """The same disc scaled to this flux of the whole disc; black where none of it is lit."""
        whole_sr = self.law_integral_sr()
        radiance_e_per_s_sr = electrons_per_s / whole_sr if whole_sr > 0 else 0.0
        return replace(self, normal_e_per_s_sr=radiance_e_per_s_sr)

    def impact(self, directions: FloatArray) -> FloatArray:
        """The distance (n,), in radii, at which rays along ICRS directions (n, 3) pass the centre;
        infinite for rays that lead away from it.
        """
        return self._impact(directions @ self.to_sphere.T)

    def transmission(self, directions: FloatArray) -> FloatArray:
        """The share (n,) of light from behind the body that comes from ICRS directions (n, 3): 0
        on the disc, below 1 through its air.
        """
        impact = self._impact(directions @ self.to_sphere.T)
        height = (impact - 1) / (self.air_radii or 1.0)
        through = np.exp(-self.slant_depth * np.exp(-np.maximum(height, 0.0)))
        return np.where(height < 0, 0.0, through)

    def _impact(self, seen: FloatArray) -> FloatArray:
        """As `impact`, for rays (n, 3) in the axes of `to_sphere`."""
        across = np.hypot(seen[:, 0], seen[:, 1])
        impact = self.distance_radii * across / np.linalg.norm(seen, axis=1)
        return np.where(seen[:, 2] > 0, impact, np.inf)

    def radiance(self, directions: FloatArray) -> FloatArray:
        """The radiance (n,), electrons per second and steradian, of the solid disc in ICRS
        directions (n, 3); 0 beside it.
        """
        rays = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        sphere_rays = rays @ self.to_sphere.T
        on = np.flatnonzero(self._impact(sphere_rays) < 1)
        ray = sphere_rays[on] / np.linalg.norm(sphere_rays[on], axis=1, keepdims=True)
        squared = ray[:, 0] ** 2 + ray[:, 1] ** 2
        towards_centre = np.column_stack((ray[:, :2] * ray[:, 2:], -squared))
        closest = self.distance_radii * towards_centre
        half_chord = np.sqrt(np.maximum(0.0, 1 - self.distance_radii**2 * squared))
        place = closest - half_chord[:, None] * ray
        light = np.zeros(len(directions))
        light[on] = self.normal_e_per_s_sr * self._shaded(place, sphere_rays[on])
        return light

    def with_air(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The radiance (n,), electrons per second and steradian, of disc and air in ICRS directions
        (n, 3), and the share (n,) of the light behind them that they hide.
        """
        covered = 1 - self.transmission(directions)
        light = self.radiance(directions)
        if self.air is None:
            return light, covered
        beside = np.flatnonzero(covered < 1)
        light[beside], covered[beside] = self.air_light(directions[beside])
        return light, covered

    def air_light(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The radiance (n,), electrons per second and steradian, of the air beside the disc in ICRS
        directions (n, 3), and the share (n,) of the light behind it that it hides.

        The radiance is in proportion to that share; it continues the radiance of the ground that a
        ray just touches on that side.
        """
        height = np.maximum(self.impact(directions) - 1, 0.0) / (self.air_radii or 1.0)
        hidden = -np.expm1(-self.slant_depth * np.exp(-height))
        return self.touched_light(directions) * hidden, hidden

    def touched_light(self, directions: FloatArray) -> FloatArray:
        """The radiance (n,), electrons per second and steradian, of the ground that a ray just
        touches, divided by the share of light that the air hides there.

        Of the ICRS directions (n, 3) only the side of the disc on which each lies counts.
        """
        sphere_directions = directions @ self.to_sphere.T
        sideways = sphere_directions[:, :2]
        length = np.hypot(sphere_directions[:, 0], sphere_directions[:, 1])
        # at the disc's very middle, where no side is defined, any will do
        side = sideways / np.maximum(length, 1e-30)[:, None]
        sine = 1 / self.distance_radii
        up = np.column_stack((side * np.sqrt(1 - sine**2), np.full(len(side), -sine)))
        normal_length = np.linalg.norm(up @ self.to_sphere, axis=1)
        mu0 = np.maximum(0.0, up @ self.sun_sphere / normal_length)
        return np.asarray(self.normal_e_per_s_sr * mu0 / -np.expm1(-self.slant_depth))

    def _shaded(self, place: FloatArray, seen: FloatArray) -> FloatArray:
        """The law's function (n,) at places (n, 3) on the sphere, seen along the rays `seen` (n,
        3), which are unit vectors in space, in the sphere's axes.
        """
        length = np.linalg.norm(place @ self.to_sphere, axis=1)
        mu0: FloatArray = np.maximum(0.0, place @ self.sun_sphere / length)
        mu: FloatArray = np.maximum(0.0, -np.einsum("ij,ij->i", place, seen) / length)
        if self.law == "uniform":
            return np.ones(len(place))
        if self.law == "limb-darkened":
            a, b, c = SOLAR_LIMB
            return np.asarray(a + mu * (b + mu * c))
        if self.law == "lambert":
            return mu0
        lunar = np.divide(2 * mu0, mu0 + mu, out=np.zeros_like(mu), where=mu0 > 0)
        return np.asarray(self.lunar_share * lunar + (1 - self.lunar_share) * mu0)

    def law_integral_sr(self) -> float:
        """The integral of the law's function over the visible disc, sr."""
        _, shares_sr = self.points(QUADRATURE)
        return float(shares_sr.sum())

    def points(self, nodes: int) -> tuple[FloatArray, FloatArray]:
        """Unit directions (n, 3), ICRS axes, of places on the lit face, and the law's function
        times the solid angle, sr, of each (n,).

        `nodes` is the number of places along each axis of the face.
        """
        place, area = self._lit_face(nodes)
        # from the sphere's axes back to space
        back = np.linalg.inv(self.to_sphere)
        from_observer = place + np.array([0.0, 0.0, self.distance_radii])
        true = from_observer @ back.T
        distance = np.linalg.norm(true, axis=1)
        shaded = self._shaded(place, from_observer / distance[:, None])
        facing = -np.einsum("ij,ij->i", place, from_observer) * abs(np.linalg.det(back))
        return true / distance[:, None], shaded * facing * area / distance**3

    def _lit_face(self, nodes: int) -> tuple[FloatArray, FloatArray]:
        """Places (n, 3) on the sphere that are visible and lit, and the area (n,) that each
        represents.

        A place has a longitude from the observer's meridian towards the Sun, and a latitude from
        the plane in which observer and Sun are.
        """
        node, weight = gauss_legendre(nodes)
        top = np.arccos(1 / self.distance_radii)
        # Towards the ends of latitude the visible range of longitude falls as a square root. With
        # latitudes as the sine of an angle the integrand is smooth there.
        latitude = top * np.sin(node * np.pi / 2)
        stretch = top * np.cos(node * np.pi / 2) * np.pi / 2
        cos_reach = 1 / (self.distance_radii * np.cos(latitude))
        reach = np.arccos(np.minimum(1.0, cos_reach))
        first = -reach
        if self.law in ("lambert", "lunar-lambert"):
            # the Sun's longitude: it is on the side of +x, the observer on that of -z
            sun = np.arctan2(self.sun_sphere[0], -self.sun_sphere[2])
            first = np.clip(sun - np.pi / 2, -reach, reach)
        half = (reach - first) / 2
        longitude = first[:, None] + half[:, None] * (node + 1)
        area = (weight * stretch * np.cos(latitude) * half)[:, None] * weight
        cosine = np.cos(latitude)[:, None]
        right = cosine * np.sin(longitude)
        up = np.broadcast_to(np.sin(latitude)[:, None], longitude.shape)
        forward = -cosine * np.cos(longitude)
        place = np.stack([right, up, forward], axis=-1)
        return place.reshape(-1, 3), area.ravel()


@lru_cache(maxsize=64)
def gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """The nodes from -1 to 1 and the weights (count,) of Gauss-Legendre quadrature. They are
    cached, as each frame needs the same ones again.
    """
    place, weight = np.polynomial.legendre.leggauss(count)
    return place, weight
