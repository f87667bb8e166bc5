"""Stars as the bench's virtual tracker measures them, in the sky itself and on the display.

At rest the bench's own centroider finds the stars (`[verify] centroider`). A star that leaves a
path is measured as the centre of mass of the pixels around the path, extended so that a late
attitude stays within it. Light is float64 and without noise: detector noise is not the display's.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import normalise, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE, NS_PER_S, magnitude
from hilstar.display.render.reference import add_stars
from hilstar.instruments.assess.bench_effects import turn_between
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.optics import TwinOptics
from hilstar.instruments.simulate.star_finder import (
    MATCH_PX,
    StarFinder,
    crowded,
    seen_psf,
    shared,
    star_finder,
)
from hilstar.instruments.study.chain.choices import Lit, PanelExposure, lead_ns
from hilstar.instruments.study.predictors import Movement
from hilstar.optics.camera import Camera
from hilstar.optics.sprites import FrameLight, make_sprites
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.frame import Bench
from hilstar.sky.stars import Stars

# Gauss-Legendre over the exposure: 1.02 nodes to a sigma of path and three more are right to 1e-6
# of a star in every pixel (optics/exposure_motion.py); JITTER's 37 Hz over the longest exposure are
# well within the minimum.
NODES_PER_SIGMA, MIN_NODES = 1.02, 24
REACH_SIGMAS = 4.0  # beyond which a star has 3e-4 of its light
LOST_SHARE = 0.1  # a star with a smaller share of its light in its pixels is lost
LOST_MAG = MAG_PER_RELATIVE  # a lost star's flux is off by all of it
PATH_STEP_PX = 0.5  # between the places of a path
# limit for others' light on a star's path, as a share of its own: at 50 px it moves the centre by
# 0.05 px
OTHERS_SHARE = 1e-3


def points(bench: Bench, q_icrs_to_cam: FloatArray, stars: Stars | None = None) -> FrameLight:
    """Stars, by default all of the bench's, as whole sprites at an attitude."""
    if stars is None:
        stars = bench.stars
    icrs_to_image = bench.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    return make_sprites(stars, icrs_to_image, bench.camera, bench.psf.footprint_px)


def sky_light(bench: Bench, movement: Movement, seen: PanelExposure) -> FloatArray:
    """The sky's mean light (H, W) over an exposure, electrons per second.

    It is summed over enough instants for every star's path.
    """
    times_s = [seen.begin_s + seen.length_s / 2]
    shares = [1.0]
    if movement.turns:
        path_rad = math.radians(abs(movement.rate_deg_s)) * seen.length_s
        sigmas = path_rad * bench.camera.scales_px_rad()[1] / min(bench.psf.width_px)
        count = max(MIN_NODES, math.ceil(NODES_PER_SIGMA * sigmas) + 3)
        nodes, weights = np.polynomial.legendre.leggauss(count)
        times_s = (seen.begin_s + seen.length_s * (nodes + 1) / 2).tolist()
        shares = (weights / 2).tolist()
    total = np.zeros(bench.camera.resolution_px[::-1])
    for t_s, share in zip(times_s, shares, strict=True):
        sprites = points(bench, movement.at(round(t_s * NS_PER_S)))
        add_stars(total, sprites, bench.psf, sprites.footprint_px, share=share)
    return total


def linear_light(bench: Bench, sprites: FrameLight) -> Lit:
    """The pixels that sprites light, and each one's light before quantisation."""
    image = np.zeros(bench.camera.resolution_px[::-1])
    add_stars(image, sprites, bench.psf, sprites.footprint_px)
    place = np.flatnonzero(image)
    return place, image.ravel()[place]


@dataclass(frozen=True, slots=True)
class MeasuredStars:
    """The judged stars (n,) of one exposure: unit directions (n, 3) in cam, NaN where lost, and
    light, electrons.
    """

    directions: FloatArray
    light_e: FloatArray

    @property
    def lost(self) -> BoolArray:
        """The stars that are not found."""
        return np.isnan(self.directions[:, 0])


@dataclass(frozen=True, slots=True)
class Off:
    """Differences of stars (n,) between two measurements, arcsec and mag, and which stars are
    lost.
    """

    arcsec: FloatArray
    mag: FloatArray
    lost: BoolArray


class StudyTracker(Closing):
    """A bench's virtual tracker. Free it with `close`."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        tracker = bench.config.tracker
        self.camera: Camera = tracker_camera(tracker, bench.file.folder)
        self.geometry = BenchGeometry(bench.camera, self.camera)
        self.optics = TwinOptics(self.geometry, bench.tracker_psf)
        scale = bench.camera.focal_length_px / self.camera.focal_length_px
        self.finder: StarFinder = star_finder(bench, scale)
        self.psf = seen_psf(bench, scale)
        self.monitor_px_per_px = scale
        self.arcsec_per_px = ARCSEC_PER_RAD / self.camera.scales_px_rad()[1]

    def image_e(self, light_e_per_s: FloatArray, seen: PanelExposure) -> FloatArray:
        """Electrons (h, w) of an exposure to the mean light of a monitor (H, W)."""
        return self.optics.image_e_per_s(light_e_per_s) * seen.length_s

    def sees_around(self, x_px: FloatArray, y_px: FloatArray, margin_px: float) -> BoolArray:
        """Whether the surroundings of places are on the detector and on the monitor."""
        on_detector = within(x_px, y_px, self.camera.resolution_px, margin_px)
        monitor_x, monitor_y = self.geometry.to_monitor(x_px.ravel(), y_px.ravel())
        reach_px = self.bench.psf.footprint_px / 2 + margin_px * self.monitor_px_per_px
        size_px = self.bench.camera.resolution_px
        on_monitor = within(monitor_x, monitor_y, size_px, reach_px).reshape(x_px.shape)
        return np.asarray(on_detector & on_monitor)

    def close(self) -> None:
        """Free the GL context."""
        self.optics.close()


class StarJudge:
    """The lone stars of one exposure, as the tracker measures them in the sky itself."""

    def __init__(self, tracker: StudyTracker, movement: Movement, seen: PanelExposure) -> None:
        self.tracker = tracker
        self.movement = movement
        self.seen = seen
        bench = tracker.bench
        q = movement.at(seen.middle_ns())
        sprites = points(bench, q)
        self._star = sprites.star
        self._e = bench.stars.electrons_per_s[self._star] * seen.length_s
        self._wanted = self._whole(sprites.star)
        self.true = bench.stars.directions(self._star) @ to_matrix(q).T
        self._x_px, self._y_px = tracker.camera.project(self.true @ tracker.camera.cam_to_image.T)
        self.judged = np.zeros(0, dtype=np.intp)
        self.sky = MeasuredStars(np.zeros((0, 3)), np.zeros(0))
        # Distance from a path within which its star's light is summed.
        self._reach_px = math.ceil(REACH_SIGMAS * max(tracker.psf.width_px)) + 1
        # The largest delay of an attitude, and the length of a star's path, extended at both ends
        # by that.
        self._late_s = lead_ns(bench.config) / NS_PER_S + 1 / movement.packet_hz
        path_rad = math.radians(abs(movement.rate_deg_s)) * (seen.length_s + 2 * self._late_s)
        self._path_px = path_rad * tracker.camera.scales_px_rad()[1]
        self.lost_arcsec = max(MATCH_PX, self._path_px) * tracker.arcsec_per_px
        radius_px = tracker.finder.settings.radius_px
        places_px = self._x_px, self._y_px
        # Distance from the detector's edge beyond which a star is complete.
        margin_px = radius_px + MATCH_PX
        if movement.turns:
            places_px = self._paths()
            margin_px = self._reach_px + 1
        inside = np.atleast_2d(tracker.sees_around(*places_px, margin_px)).all(axis=0)
        if not (self._wanted & inside).any():
            return
        self._wanted &= inside
        sky_e = tracker.image_e(sky_light(bench, movement, seen), seen)
        if movement.turns:
            self._choose_paths(sky_e, *places_px)
        else:
            index = tracker.finder.match(sky_e, self._x_px, self._y_px).index
            crowd = crowded(self._x_px, self._y_px, self._e, radius_px, tracker.psf)
            alone = ~shared(index) & ~crowd
            self.judged = np.flatnonzero(self._wanted & (index >= 0) & alone)
        self.sky = self.measure(sky_e)

    def __len__(self) -> int:
        return len(self.judged)

    def measure(self, image_e: FloatArray) -> MeasuredStars:
        """The judged stars in an image of the tracker (h, w), electrons."""
        if self.movement.turns:
            return self._measure_paths(image_e)
        match = self.tracker.finder.match(image_e, self._x_px, self._y_px)
        index = match.index[self.judged]
        is_matched = index >= 0
        if not is_matched.any():
            return MeasuredStars(np.full((len(index), 3), np.nan), np.zeros(len(index)))
        index = np.where(is_matched, index, 0)
        centroids = match.found
        rays = self.tracker.camera.rays(centroids.x_px[index], centroids.y_px[index])
        directions = np.where(is_matched[:, None], normalise(rays), np.nan)
        return MeasuredStars(directions, np.where(is_matched, centroids.flux[index], 0.0))

    def _whole(self, star: IntArray) -> BoolArray:
        """Whether stars are bright enough for `exact` and clip at no place within a pixel."""
        bench = self.tracker.bench
        rates = bench.stars.electrons_per_s[star]
        white = bench.flux_at_white_e_per_s * bench.darkest
        clips = rates * bench.psf.peak_share > white
        return np.asarray((rates >= bench.calibration.response.half_step * white) & ~clips)

    def _choose_paths(self, sky_e: FloatArray, x_px: FloatArray, y_px: FloatArray) -> None:
        """Choose the stars whose paths (k, n), extended for a late attitude, are nearly free of
        other stars' light.
        """
        reach_px = self._reach_px
        y, x = np.mgrid[-reach_px : reach_px + 1, -reach_px : reach_px + 1]
        rows, columns = (x * x + y * y <= reach_px**2).nonzero()
        near_x = columns - reach_px
        near_y = rows - reach_px
        width = sky_e.shape[1]
        flat = sky_e.ravel()
        judged = []
        pixels = []
        for k in np.flatnonzero(self._wanted):
            column = np.rint(x_px[:, k]).astype(np.intp)
            row = np.rint(y_px[:, k]).astype(np.intp)
            path_pixels = (row[:, None] + near_y) * width + column[:, None] + near_x
            own_pixels = np.unique(path_pixels)
            if flat[own_pixels].sum() <= (1 + OTHERS_SHARE) * self._e[k]:
                judged.append(k)
                pixels.append(own_pixels)
        self.judged = np.array(judged, dtype=np.intp)
        counts = [len(own_pixels) for own_pixels in pixels]
        self._pixels = np.concatenate([np.zeros(0, dtype=np.intp), *pixels])
        self._begins = np.cumsum([0, *counts])[:-1]

    def _paths(self) -> tuple[FloatArray, FloatArray]:
        """Places (k, n) of the stars on the tracker along their whole paths, px."""
        tracker = self.tracker
        visible = self.seen
        count = max(5, math.ceil(self._path_px / PATH_STEP_PX))
        at_s = np.linspace(-self._late_s, visible.length_s + self._late_s, count) + visible.begin_s
        vectors = tracker.bench.stars.directions(self._star)
        places = []
        for t_s in at_s:
            q_icrs_to_cam = self.movement.at(round(t_s * NS_PER_S))
            turn = tracker.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
            places.append(tracker.camera.project(vectors @ turn.T))
        x_px, y_px = zip(*places, strict=True)
        return np.stack(x_px), np.stack(y_px)

    def _measure_paths(self, image_e: FloatArray) -> MeasuredStars:
        if not len(self.judged):
            return MeasuredStars(np.zeros((0, 3)), np.zeros(0))
        width = image_e.shape[1]
        light = image_e.ravel()[self._pixels]
        row, column = np.divmod(self._pixels, width)
        total = np.add.reduceat(light, self._begins)
        by_x = np.add.reduceat(light * column, self._begins)
        by_y = np.add.reduceat(light * row, self._begins)
        is_lit = total > LOST_SHARE * self._e[self.judged]
        divisor = np.where(is_lit, total, 1.0)
        rays = self.tracker.camera.rays(by_x / divisor, by_y / divisor)
        directions = np.where(is_lit[:, None], normalise(rays), np.nan)
        return MeasuredStars(directions, np.where(is_lit, total, 0.0))


def within(
    x_px: FloatArray, y_px: FloatArray, size_px: tuple[int, int], margin_px: float
) -> BoolArray:
    """Whether places on an image are at least a margin from its edges."""
    width, height = size_px
    inside = (x_px >= margin_px) & (x_px < width - 1 - margin_px)
    inside &= (y_px >= margin_px) & (y_px < height - 1 - margin_px)
    return np.asarray(inside)


def off(shown: MeasuredStars, wanted: MeasuredStars, lost_arcsec: float) -> Off:
    """The errors of stars in place and light, between two measurements.

    A lost star is off by all its light, and by `lost_arcsec`, that of 3 px or of its path,
    whichever is longer: to lose a star is no better than to find it late.
    """
    lost = shown.lost | wanted.lost
    chord = np.linalg.norm(shown.directions - wanted.directions, axis=1)
    angle_arcsec = 2 * np.arcsin(np.minimum(chord, 2.0) / 2) * ARCSEC_PER_RAD
    arcsec = np.where(lost, lost_arcsec, angle_arcsec)
    shown_e = np.where(lost, 1.0, shown.light_e)
    wanted_e = np.where(lost, 1.0, wanted.light_e)
    return Off(arcsec, np.where(lost, LOST_MAG, magnitude(shown_e / wanted_e)), lost)


def attitude_off_arcsec(shown: MeasuredStars, wanted: MeasuredStars) -> tuple[float, float]:
    """Attitude error across the boresight and about it, least squares over the found stars; NaN
    for fewer than two.
    """
    is_usable = ~(shown.lost | wanted.lost)
    if is_usable.sum() < 2:
        return math.nan, math.nan
    true = wanted.directions[is_usable]
    turn_rad = turn_between(true, shown.directions[is_usable], np.ones(len(true)))
    x, y, z = ARCSEC_PER_RAD * turn_rad
    return math.hypot(x, y), abs(float(z))
