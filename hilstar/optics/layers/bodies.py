"""Bodies that a camera sees as discs: what they hide, and the light that they add."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import propagate, to_matrix
from hilstar.optics.camera import Camera
from hilstar.optics.extended import (
    DiscLight,
    DiscView,
    ExtendedLight,
    LightMap,
    Pose,
    Shear,
    disc_lights,
)
from hilstar.optics.frame_motion import NODES_PER_SIGMA, POINT_SIGMA, slowed
from hilstar.optics.layers.view import POINT_PX, Canvas, View
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight
from hilstar.sky.bodies.disc import AIR_TOP, Disc, gauss_legendre
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky

HIDDEN = 0.005  # a star or a body is not drawn if less than this share of its light comes through
MAX_POSES = 7  # camera poses at which a disc is drawn in a frame
# a disc of a larger radius is drawn at one pose, in the middle of the time, which bounds the work
MAX_POSED_PX = 120
# Poses in an exposure for each sigma that the camera moves: a limb is then a chain of edges at most
# 1.6 sigma apart.
EXPOSED_PER_SIGMA = 1.0
MAX_EXPOSED = 63  # poses, which bounds an exposure's work; odd, so that one is in the middle
# places of a limb that are asked whether they are hidden: a body hides another's outline as a whole
LIMB_PLACES = 24
LATTICE = 9  # places along each side of a disc's rectangle at which clipping is tested


class DiscDrawing:
    """The light of discs on a canvas, nearest first, at rest, in an exposure or row by row."""

    def __init__(self, canvas: Canvas) -> None:
        self.canvas = canvas
        smallest_px_rad, largest_px_rad = canvas.camera.scales_px_rad()
        self._px_sr = smallest_px_rad**-2
        self._px_per_rad = largest_px_rad
        self._reach_rad = canvas.camera.field_radius_rad(canvas.psf.footprint_px / 2 + 1)

    @property
    def wide_rad(self) -> float:
        """The radius from which on a body is a disc."""
        return POINT_PX / self._px_per_rad

    def reach_rad(self, view: View) -> float:
        """How far from the boresight light may be on the image at some time of a view."""
        if not view.turns:
            return self._reach_rad
        away_s = view.scan.whole_s / 2 if view.exposed else view.scan.longest_s
        return self._reach_rad + view.turn.speed_rad_s * away_s

    def drawn(self, light: FrameLight, discs: list[Disc], view: View) -> FrameLight:
        """The light with that of discs on top, the farthest first."""
        if view.exposed:
            posed = self._exposed(view)
        elif view.turns:
            large = any(disc.radius_rad * self._px_per_rad > MAX_POSED_PX for disc in discs)
            posed = self._turning(view, 1 if large else MAX_POSES)
        else:
            posed = self._still(view.icrs_to_image(self.canvas.camera))
        white_e_per_s = self.canvas.white_in(view)
        extended = list(light.extended)
        names = []
        over_white = []
        drawn_lights = self._lights(discs, posed, is_before_light=bool(extended))
        for disc, lights in zip(reversed(discs), drawn_lights, strict=True):
            extended.extend(lights)
            if lights:
                names.append(disc.name)
            if self._clips(lights, white_e_per_s):
                over_white.append(disc.name)
        return replace(
            light, extended=tuple(extended), discs=tuple(names), over_white=tuple(over_white)
        )

    def on_image(self, discs: list[Disc], view: View) -> list[Disc]:
        """Those of some discs that touch the image of a camera at rest, and that no nearer ones
        hide.
        """
        camera = self.canvas.camera
        icrs_to_image = view.icrs_to_image(camera)
        touching = []
        for disc in seen_discs(discs):
            light = DiscLight(disc, icrs_to_image, camera, self.canvas.psf)
            if light.region(camera.resolution_px) is not None:
                touching.append(disc)
        return touching

    def alone(self, disc: Disc, view: View) -> tuple[ExtendedLight, ...]:
        """The light of a disc that nothing covers, at rest."""
        posed = self._still(view.icrs_to_image(self.canvas.camera))
        (lights,) = self._lights([disc], posed)
        return tuple(lights)

    def any_lights(self) -> tuple[ExtendedLight, ...]:
        """Discs of several sizes in the middle of the image: for a driver that compiles a shader
        for each kind.
        """
        ahead = np.array([0.0, 0.0, 1.0])
        sigma_rad = max(self.canvas.psf.width_px) / self._px_per_rad
        discs = []
        for radius_sigma in (2.0, 20.0, 100.0, 400.0):
            distance_km = 1 / math.sin(min(radius_sigma * sigma_rad, 1.0))
            discs.append(Disc("", ahead, distance_km, 1.0, 1.0, ahead, -ahead, "lambert"))
        lights = self._lights(discs, self._still(np.eye(3)))
        return tuple(itertools.chain.from_iterable(lights))

    def _still(self, icrs_to_image: FloatArray) -> DiscView:
        """The camera at rest."""
        return DiscView(self.canvas.camera, self.canvas.psf, (Pose(icrs_to_image),))

    def _exposed(self, view: View) -> DiscView:
        """The camera during an exposure: poses that follow one another along its turn, all with
        the exposure's mean light.
        """
        camera = self.canvas.camera
        exposure_s = view.scan.hold_s
        length_px = view.turn.speed_rad_s * exposure_s * self._px_per_rad
        length_sigma = length_px / min(self.canvas.psf.width_px)
        count = min(math.ceil(EXPOSED_PER_SIGMA * length_sigma) | 1, MAX_EXPOSED)
        place, weight = gauss_legendre(count)
        maps = view.motion.icrs_to_image(place / 2 * exposure_s, camera)
        poses = []
        for icrs_to_image, share in zip(maps, weight, strict=True):
            poses.append(Pose(icrs_to_image, float(share / 2)))
        shear = _shear(view.scan, view.turn.rate_cam_rad_s, camera)
        return DiscView(camera, self.canvas.psf, tuple(poses), shear)

    def _turning(self, view: View, max_poses: int) -> DiscView:
        """The camera while a screen's rows light up one after the other, each held for a time."""
        camera = self.canvas.camera
        scan = view.scan
        turn, _ = slowed(view.turn, scan, camera)
        length_px = turn.speed_rad_s * scan.hold_s * self._px_per_rad
        length_sigma = length_px / min(self.canvas.psf.width_px)
        count = 1
        if length_sigma > POINT_SIGMA:
            # odd: one is in the middle
            count = min(math.ceil(NODES_PER_SIGMA * length_sigma + 1) | 1, max_poses)
        place, weight = gauss_legendre(count)
        seconds = (place + 1) / 2 * scan.hold_s
        poses = []
        for second, share in zip(seconds.tolist(), (weight / 2).tolist(), strict=True):
            q_icrs_to_cam = propagate(turn.q_icrs_to_cam, turn.rate_cam_rad_s, second)
            poses.append(Pose(camera.cam_to_image @ to_matrix(q_icrs_to_cam), share))
        shear = _shear(scan, turn.rate_cam_rad_s, camera)
        return DiscView(camera, self.canvas.psf, tuple(poses), shear)

    def _lights(
        self, discs: list[Disc], posed: DiscView, is_before_light: bool = False
    ) -> list[list[ExtendedLight]]:
        """The light of each of some discs, which are nearest first, in the order in which they
        are drawn; they may stand before other light, such as diffuse light.
        """
        lights = []
        for number, disc in reversed([*enumerate(discs, 1)]):
            # the last of the list is drawn first: it covers no other disc
            covers = is_before_light or number < len(discs)
            lights.append(disc_lights(disc, posed, covers))
        return lights

    def _clips(self, lights: list[ExtendedLight], white_e_per_s: float) -> bool:
        """Whether a disc's lights have more than white in a pixel; a large disc is tested at a
        lattice of places.
        """
        if not math.isfinite(white_e_per_s):
            return False
        large = []
        brightest = 0.0
        for light in lights:
            if isinstance(light, LightMap):
                brightest += float(light.image.max(initial=0.0))
            elif isinstance(light, DiscLight):
                large.append(light)
        if large:
            brightest = self._px_sr * self._brightest(large[len(large) // 2])
        return brightest > white_e_per_s

    def _brightest(self, light: DiscLight) -> float:
        """The largest radiance at a lattice of places of a large disc that are on the image."""
        camera = self.canvas.camera
        region = light.region(camera.resolution_px)
        if region is None:
            return 0.0
        left, top, width, height = region
        across = np.linspace(left, left + width - 1, LATTICE)
        down = np.linspace(top, top + height - 1, LATTICE)
        x, y = np.meshgrid(across, down)
        u, v = camera.tangents(x.ravel(), y.ravel())
        rays = np.nan_to_num(np.stack([u, v, np.ones_like(u)], axis=1))
        # And of its lit face: a crescent may lie between those of the lattice
        places, _ = light.disc.points(LATTICE)
        on_image = camera.contains_px(*camera.project(places @ light.icrs_to_image.T))
        of_face = float(light.disc.radiance(places[on_image]).max(initial=0.0))
        return max(float(light.disc.radiance(rays @ light.icrs_to_image).max()), of_face)


class BodyLayer:
    """Bodies wider than POINT_PX as discs; narrower ones are points among the stars."""

    def __init__(self, moving: "MovingSky", canvas: Canvas) -> None:
        self.drawing = DiscDrawing(canvas)
        self._moving = moving

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light of the layers before, less what the discs of bodies hide, and the light of the
        discs, the farthest first.
        """
        discs = seen_discs(self._near(view))
        if not discs:
            return light
        distances_km = self._moving.distances_km(*view.observer)
        left = past_discs(light, stars, discs, distances_km)
        return self.drawing.drawn(left, discs, view)

    def on_image(self, view: View) -> list[Disc]:
        """Discs that touch the image of a camera at rest, nearest first."""
        return self.drawing.on_image(self._near(view), view)

    def _near(self, view: View) -> list[Disc]:
        """Discs that may be on the image at some time of a view, nearest first."""
        axis = view.icrs_to_image(self.drawing.canvas.camera)[2]
        reach_rad = self.drawing.reach_rad(view)
        return self._moving.discs(axis, reach_rad, self.drawing.wide_rad, *view.observer)


def seen_discs(discs: list[Disc]) -> list[Disc]:
    """Discs, nearest first, without those that nearer ones hide."""
    seen = []
    for k, disc in enumerate(discs):
        places = disc.direction[None]
        if k:
            places = np.vstack([disc.direction, disc.limb(LIMB_PLACES)])
        through = np.ones(len(places))
        for nearer in discs[:k]:
            through *= nearer.transmission(places)
        if through.max() >= HIDDEN:
            seen.append(disc)
    return seen


def past_discs(
    light: FrameLight, stars: Stars, discs: list[Disc], distances_km: FloatArray
) -> FrameLight:
    """Sprites as seen past discs and through their air, without those of the discs themselves.

    The last of the stars are bodies at distances (n,).
    """
    which = light.star
    first = len(stars) - len(distances_km)
    through = np.ones(len(which))
    directions = stars.directions(which)
    # Bodies hide only what is farther away. Satellites are left alone: `SatelliteLayer` adds
    # those that nothing hides.
    satellite = np.flatnonzero((which >= len(stars) - len(stars.bodies)) & (which < first))
    point = np.flatnonzero(which >= first)
    far_km = distances_km[which[point] - first]
    for disc in discs:
        sine = math.sin(disc.radius_rad) * (1 + AIR_TOP * disc.air_radii)
        # more than a cosine rounds
        reach_rad = math.asin(min(1.0, sine)) + 1e-7
        near = directions @ disc.direction > np.cos(reach_rad)
        near[point[far_km <= disc.distance_km]] = False  # itself among them
        near[satellite] = False
        behind = np.flatnonzero(near)
        if len(behind):
            through[behind] *= disc.transmission(directions[behind])
    itself = disc_stars(stars, (disc.name for disc in discs))
    through[np.isin(light.star, itself)] = 0.0
    is_shown = through >= HIDDEN
    if is_shown.all() and (through == 1).all():
        return light
    data = light.data[is_shown]
    data["electrons_per_s"] *= through[is_shown].astype(np.float32)
    return replace(
        light,
        data=data,
        star=light.star[is_shown],
        x_px=light.x_px[is_shown],
        y_px=light.y_px[is_shown],
    )


def _shear(scan: Scan, rate_cam_rad_s: FloatArray, camera: Camera) -> Shear | None:
    """The shear of a turning camera's image, whose rows are lit one after the other; None where all
    are lit at once.
    """
    if not scan.scanout_s:
        return None
    width, height = camera.resolution_px
    right, down = scan.down
    late_s = right * scan.scanout_s / width, down * scan.scanout_s / height
    middle_px = (width - 1) / 2, (height - 1) / 2
    return Shear(camera.cam_to_image @ rate_cam_rad_s, late_s, middle_px)


def disc_stars(stars: Stars, names: Iterable[str]) -> IntArray:
    """The rows of bodies among `stars`, by name: bodies are the last rows."""
    last_first = stars.bodies[::-1]  # a satellite may have a body's name; satellites come before
    return np.array([len(stars) - 1 - last_first.index(name) for name in names], dtype=np.intp)
