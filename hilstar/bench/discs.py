"""The bodies of a sky that one camera sees as discs: what they hide, and the light that they bring to its image."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.rotation import propagate, to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.exposure_motion import MIDDLE_S, Motion
from hilstar.scene.extended import DiscLight, DiscView, ExtendedLight, LightMap, Pose, Shear, disc_lights
from hilstar.scene.frame_motion import NODES_PER_SIGMA, POINT_SIGMA, Scan, Turn, slowed
from hilstar.scene.sprites import Sprites
from hilstar.sky.bodies.disc import AIR_TOP, Disc, gauss_legendre
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky

# A wider disc moves light by more than a point's sprite does: 0.2 px across widens a sigma of 0.85 px by 0.2 %.
POINT_PX = 0.2
HIDDEN = 0.005  # of its light: a star or body of which less comes through is not drawn
MAX_POSES = 7  # of a disc in a frame whose camera turns
MAX_POSED_PX = 120  # of a radius: a larger disc is drawn once, in the middle of its time, so that the work is bounded
# Of a disc in an exposure, to a sigma of the camera's way: its limb is then a chain of edges 1.6 sigma apart at most.
EXPOSED_PER_SIGMA = 1.0
MAX_EXPOSED = 63
LIMB_PLACES = 24  # of a disc that may be hidden: one beside another hides their outline as a whole
LATTICE = 9  # places along each side of a disc's rectangle that are asked whether they clip


@dataclass(frozen=True, slots=True)
class When:
    """A moment of a sky: its time (None: the start), and an observer's velocity (3,) and place (3,) as in `MovingSky.seen`."""

    t_ns: int | None = None
    velocity_km_s: FloatArray | None = None
    place_km: FloatArray | None = None


class DiscPainter:
    """Turns bodies that are wider than a point into discs, for one camera whose stars have `footprint_px` and `sigma_px`.

    Discs over `white_e_per_s` in a pixel are named; `scan` is how a screen's rows light up.
    """

    def __init__(
        self,
        moving: MovingSky,
        camera: Camera,
        footprint_px: int,
        sigma_px: tuple[float, float],
        *,
        white_e_per_s: float = math.inf,
        scan: Scan | None = None,
    ) -> None:
        self.camera, self.sigma_px = camera, sigma_px
        self._moving, self._white_e_per_s, self._scan = moving, white_e_per_s, scan
        self._px_per_rad = camera.scales_px_rad()[1]
        self._px_sr = camera.scales_px_rad()[0] ** -2
        self._reach_rad = camera.field_radius_rad(footprint_px / 2 + 1)

    def over(self, sprites: Sprites, stars: Stars, q_icrs_to_cam: FloatArray, when: When, turn: Turn | None = None) -> Sprites:
        """The sprites of `stars` at an attitude (and a turn) without what discs hide, and with the discs' light."""
        icrs_to_image = self.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
        more_rad = 0.0 if turn is None or self._scan is None else turn.speed_rad_s * self._scan.longest_s
        discs = self._near(icrs_to_image, when, more_rad)
        if not discs:
            return sprites
        if turn is None or self._scan is None:
            return self.painted(sprites, stars, discs, self.still(icrs_to_image), when)
        large = any(disc.radius_rad * self._px_per_rad > MAX_POSED_PX for disc in discs)
        return self.painted(sprites, stars, discs, self.turning(turn, self._scan, 1 if large else MAX_POSES), when)

    def on_image(self, q_icrs_to_cam: FloatArray, when: When) -> list[Disc]:
        """Discs that touch the image of a camera at rest, nearest first."""
        icrs_to_image = self.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
        found = self._near(icrs_to_image, when, 0.0)
        lights = (DiscLight(disc, icrs_to_image, self.camera, self.sigma_px) for disc in found)
        return [light.disc for light in lights if light.region(self.camera.resolution_px) is not None]

    def alone(self, disc: Disc, q_icrs_to_cam: FloatArray) -> tuple[ExtendedLight, ...]:
        """The light of a disc that nothing covers, at rest."""
        return tuple(self._lights([disc], self.still(self.camera.cam_to_image @ to_matrix(q_icrs_to_cam)))[0])

    def _near(self, icrs_to_image: FloatArray, when: When, more_rad: float) -> list[Disc]:
        """Discs that may be on the image at an attitude (3, 3), or within `more_rad` of that, nearest first."""
        reach_rad, wide_rad = self._reach_rad + more_rad, POINT_PX / self._px_per_rad
        found = self._moving.discs(icrs_to_image[2], reach_rad, wide_rad, when.t_ns, when.velocity_km_s, when.place_km)
        return [disc for k, disc in enumerate(found) if not k or not _hidden(disc, found[:k])]

    def exposed(self, sprites: Sprites, stars: Stars, motion: Motion, when: When) -> Sprites:
        """The sprites of an exposure's `stars` without what discs hide, and with the discs' mean light."""
        camera = self.camera
        turn_rad = float(np.linalg.norm(motion.rate_cam_rad_s)) * motion.exposure_s
        icrs_to_image = motion.icrs_to_image(MIDDLE_S, camera)[0]
        discs = self._near(icrs_to_image, when, turn_rad / 2)
        if not discs:
            return sprites
        length_sigma = turn_rad * self._px_per_rad / min(self.sigma_px)
        count = min(math.ceil(EXPOSED_PER_SIGMA * length_sigma) | 1, MAX_EXPOSED)
        place, weight = gauss_legendre(count)
        maps = motion.icrs_to_image(place / 2 * motion.exposure_s, camera)
        poses = tuple(Pose(one, float(share / 2)) for one, share in zip(maps, weight, strict=True))
        return self.painted(sprites, stars, discs, DiscView(camera, self.sigma_px, poses), when)

    def still(self, icrs_to_image: FloatArray) -> DiscView:
        """The view of a camera at rest."""
        return DiscView(self.camera, self.sigma_px, (Pose(icrs_to_image),))

    def turning(self, turn: Turn, scan: Scan, max_poses: int) -> DiscView:
        """The view of a camera that turns while a screen's rows light up in turn, each held for a time."""
        camera = self.camera
        turn, _ = slowed(turn, scan, camera)
        length_sigma = turn.speed_rad_s * scan.hold_s * self._px_per_rad / min(self.sigma_px)
        count = 1
        if length_sigma > POINT_SIGMA:
            count = min(math.ceil(NODES_PER_SIGMA * length_sigma + 1) | 1, max_poses)  # odd: one is in the middle
        place, weight = gauss_legendre(count)
        times = zip(((place + 1) / 2 * scan.hold_s).tolist(), (weight / 2).tolist(), strict=True)
        attitudes = ((propagate(turn.q_icrs_to_cam, turn.rate_cam_rad_s, seconds), share) for seconds, share in times)
        poses = tuple(Pose(camera.cam_to_image @ to_matrix(q), share) for q, share in attitudes)
        late_s = tuple(down * scan.scanout_s / size for down, size in zip(scan.down, camera.resolution_px, strict=True))
        middle = tuple((size - 1) / 2 for size in camera.resolution_px)
        shear = Shear(camera.cam_to_image @ turn.rate_cam_rad_s, (late_s[0], late_s[1]), (middle[0], middle[1]))
        return DiscView(camera, self.sigma_px, poses, shear if scan.scanout_s else None)

    def painted(self, sprites: Sprites, stars: Stars, discs: list[Disc], view: DiscView, when: When) -> Sprites:
        """Sprites of `stars` without what `discs` hide, and with the discs' light."""
        lights = self._lights(discs, view)
        return replace(
            self.unhidden(sprites, stars, discs, when),
            extended=(*sprites.extended, *itertools.chain.from_iterable(lights)),
            discs=tuple(disc.name for disc, its in zip(reversed(discs), lights, strict=True) if its),
            over_white=tuple(disc.name for disc, its in zip(reversed(discs), lights, strict=True) if self._clips(its)),
        )

    def _lights(self, discs: list[Disc], view: DiscView) -> list[list[ExtendedLight]]:
        """The light of each of some discs, nearest first, in the order in which they are drawn."""
        ordered = reversed([*enumerate(discs, 1)])
        return [disc_lights(disc, view, covers=k < len(discs)) for k, disc in ordered]

    def any_lights(self) -> tuple[ExtendedLight, ...]:
        """Discs of several sizes in the middle of the image: for a driver that compiles what draws each."""
        ahead = np.array([0.0, 0.0, 1.0])
        radii_rad = np.array([2.0, 20.0, 100.0, 400.0]) * max(self.sigma_px) / self._px_per_rad
        discs = [Disc("", ahead, 1 / math.sin(min(r, 1.0)), 1.0, 1.0, ahead, -ahead, "lambert") for r in radii_rad.tolist()]
        return tuple(itertools.chain.from_iterable(self._lights(discs, self.still(np.eye(3)))))

    def seen_through(self, stars: Stars, q_icrs_to_cam: FloatArray, when: When) -> FloatArray:
        """The share of light (n,) of each of `stars` that comes past the discs near an attitude."""
        discs = self._near(self.camera.cam_to_image @ to_matrix(q_icrs_to_cam), when, 0.0)
        return self._through(stars, np.arange(len(stars)), discs, when)

    def unhidden(self, sprites: Sprites, stars: Stars, discs: list[Disc], when: When) -> Sprites:
        """Sprites as seen through the air of `discs` and beside them, and none of the discs' own."""
        through = self._through(stars, sprites.star, discs, when)
        through[np.isin(sprites.star, disc_stars(stars, (disc.name for disc in discs)))] = 0.0
        kept = through >= HIDDEN
        if kept.all() and (through == 1).all():
            return sprites
        data = sprites.data[kept]
        data["electrons_per_s"] *= through[kept].astype(np.float32)
        star, x_px, y_px = sprites.star[kept], sprites.x_px[kept], sprites.y_px[kept]
        return replace(sprites, data=data, star=star, x_px=x_px, y_px=y_px)

    def _through(self, stars: Stars, which: IntArray, discs: list[Disc], when: When) -> FloatArray:
        """The share of light (n,) of some of `stars` (n,) that comes past discs; bodies pass what is farther than they are.

        Satellites are not asked: what hides them is their own matter.
        """
        first = len(stars) - len(self._moving.names)
        through, directions = np.ones(len(which)), stars.directions(which)
        satellite = np.flatnonzero((which >= len(stars) - len(stars.bodies)) & (which < first))
        point = np.flatnonzero(which >= first)
        far_km = np.empty(0)
        if len(point):
            far_km = self._moving.distances_km(when.t_ns, when.velocity_km_s, when.place_km)[which[point] - first]
        for disc in discs:
            reach_rad = disc.radius_rad * (1 + AIR_TOP * disc.air_radii) + 1e-7  # more than a cosine rounds
            near = directions @ disc.direction > np.cos(min(reach_rad, np.pi))
            near[point[far_km <= disc.distance_km]] = False  # itself among them
            near[satellite] = False
            behind = np.flatnonzero(near)
            if len(behind):
                through[behind] *= disc.transmission(directions[behind])
        return through

    def _clips(self, lights: list[ExtendedLight]) -> bool:
        """Whether a disc's lights have more than white in a pixel: of a large disc, at some place of a lattice over it."""
        if not math.isfinite(self._white_e_per_s):
            return False
        brightest = sum(float(light.image.max(initial=0.0)) for light in lights if isinstance(light, LightMap))
        large = [light for light in lights if isinstance(light, DiscLight)]
        if large:
            brightest = self._px_sr * self._brightest(large[len(large) // 2])
        return brightest > self._white_e_per_s

    def _brightest(self, light: DiscLight) -> float:
        """The brightest radiance at a lattice of places over a large disc, on the image."""
        region = light.region(self.camera.resolution_px)
        if region is None:
            return 0.0
        left, top, width, height = region
        x, y = np.meshgrid(np.linspace(left, left + width - 1, LATTICE), np.linspace(top, top + height - 1, LATTICE))
        u, v = self.camera.tangents(x.ravel(), y.ravel())
        seen = np.nan_to_num(np.stack([u, v, np.ones_like(u)], axis=1))
        return max(float(light.disc.radiance(seen @ light.icrs_to_image).max()), self._brightest_place(light))

    def _brightest_place(self, light: DiscLight) -> float:
        """The same at a few places of its lit face: a crescent may lie between those of the image."""
        places, _ = light.disc.points(LATTICE)
        x_px, y_px = self.camera.project(places @ light.icrs_to_image.T)
        width, height = self.camera.resolution_px
        with np.errstate(invalid="ignore"):  # NaN: behind the camera
            inside = (np.abs(x_px - (width - 1) / 2) <= width / 2) & (np.abs(y_px - (height - 1) / 2) <= height / 2)
        return float(light.disc.radiance(places[inside]).max(initial=0.0))


def _hidden(disc: Disc, nearer: list[Disc]) -> bool:
    """Whether others hide a disc: its middle and all of its limb."""
    places = np.vstack([disc.direction, disc.limb(LIMB_PLACES)])
    through = np.ones(len(places))
    for one in nearer:
        through *= one.transmission(places)
    return bool(through.max() < HIDDEN)


def disc_stars(stars: Stars, names: Iterable[str]) -> IntArray:
    """The places of discs among `stars`, whose last are the bodies."""
    last_first = stars.bodies[::-1]  # a satellite may have a body's name; satellites come before
    return np.array([len(stars) - 1 - last_first.index(name) for name in names], dtype=np.intp)
