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
# of a star in every pixel (scene/exposure_motion.py); JITTER's 37 Hz over the longest exposure are
# well within the minimum.
NODES_PER_SIGMA, MIN_NODES = 1.02, 24
REACH_SIGMAS = 4.0
LOST_SHARE = 0.1  # a star with a smaller share of its light in its pixels is lost
LOST_MAG = MAG_PER_RELATIVE  # a lost star's flux is off by all of it
PATH_STEP_PX = 0.5
# limit for others' light on a star's path, as a share of its own: at 50 px it moves the centre by
# 0.05 px
OTHERS_SHARE = 1e-3


def points(bench: Bench, q_icrs_to_cam: FloatArray, stars: Stars | None = None) -> FrameLight:
    """Stars, by default all of the bench's, as whole sprites at an attitude."""
    icrs_to_image = bench.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    return make_sprites(
        bench.stars if stars is None else stars, icrs_to_image, bench.camera, bench.psf.footprint_px
    )


def sky_light(bench: Bench, movement: Movement, seen: PanelExposure) -> FloatArray:
    """The sky's own mean light (H, W) over an exposure, electrons per second, by enough instants
    for every star's path.
    """
    times_s = [seen.begin_s + seen.length_s / 2]
    shares = [1.0]
    if movement.turns:
        path_rad = math.radians(abs(movement.rate_deg_s)) * seen.length_s
        sigmas = path_rad * bench.camera.scales_px_rad()[1] / min(bench.psf.width_px)
        nodes, weights = np.polynomial.legendre.leggauss(
            max(MIN_NODES, math.ceil(NODES_PER_SIGMA * sigmas) + 3)
        )
        times_s = (seen.begin_s + seen.length_s * (nodes + 1) / 2).tolist()
        shares = (weights / 2).tolist()
    total = np.zeros(bench.camera.resolution_px[::-1])
    for t_s, share in zip(times_s, shares, strict=True):
        sprites = points(bench, movement.at(round(t_s * NS_PER_S)))
        add_stars(total, sprites, bench.psf, sprites.footprint_px, share=share)
    return total


def linear_light(bench: Bench, sprites: FrameLight) -> Lit:
    """The pixels that a frame's sprites light, and the light of each before any quantisation."""
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

    def close(self) -> None:
        """Free the GL context."""
        self.optics.close()


class StarJudge:
    """One exposure of a scene: its stars that stand alone, as the tracker measures them in the
    sky itself.
    """

    def __init__(self, tracker: StudyTracker, movement: Movement, seen: PanelExposure) -> None:
        self.tracker, self.movement, self.seen = tracker, movement, seen
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
        places_px = self._paths() if movement.turns else (self._x_px, self._y_px)
        # Distance from the detector's edge beyond which a star is complete.
        radius_px = tracker.finder.settings.radius_px
        margin_px = self._reach_px + 1 if movement.turns else radius_px + MATCH_PX
        inside = np.atleast_2d(self._inside(*places_px, margin_px)).all(axis=0)
        if not (self._wanted & inside).any():
            return
        self._wanted &= inside
        sky_e = tracker.image_e(sky_light(bench, movement, seen), seen)
        if movement.turns:
            self._choose_paths(sky_e, *places_px)
        else:
            index = tracker.finder.match(sky_e, self._x_px, self._y_px).index
            alone = ~shared(index) & ~crowded(
                self._x_px, self._y_px, self._e, radius_px, tracker.psf
            )
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
        directions = normalise(
            self.tracker.camera.rays(match.found.x_px[index], match.found.y_px[index])
        )
        return MeasuredStars(
            np.where(is_matched[:, None], directions, np.nan),
            np.where(is_matched, match.found.flux[index], 0.0),
        )

    def _whole(self, star: IntArray) -> BoolArray:
        """Stars bright enough for the panel's `exact` that clip at no sub-pixel phase."""
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
        disc = (x * x + y * y <= reach_px**2).nonzero()
        near_x = disc[1] - reach_px
        near_y = disc[0] - reach_px
        width = sky_e.shape[1]
        flat = sky_e.ravel()
        judged = []
        pixels = []
        for k in np.flatnonzero(self._wanted):
            column = np.rint(x_px[:, k]).astype(np.intp)
            row = np.rint(y_px[:, k]).astype(np.intp)
            own_pixels = np.unique((row[:, None] + near_y) * width + column[:, None] + near_x)
            if flat[own_pixels].sum() <= (1 + OTHERS_SHARE) * self._e[k]:
                judged.append(k)
                pixels.append(own_pixels)
        self.judged = np.array(judged, dtype=np.intp)
        self._pixels = np.concatenate(pixels) if pixels else np.zeros(0, dtype=np.intp)
        self._begins = np.cumsum([0, *(len(own_pixels) for own_pixels in pixels)])[:-1]

    def _paths(self) -> tuple[FloatArray, FloatArray]:
        """Places (k, n) of the stars on the tracker along their whole paths, px."""
        tracker = self.tracker
        visible = self.seen
        count = max(5, math.ceil(self._path_px / PATH_STEP_PX))
        at_s = np.linspace(-self._late_s, visible.length_s + self._late_s, count) + visible.begin_s
        turns = []
        for t in at_s:
            turns.append(
                tracker.camera.cam_to_image @ to_matrix(self.movement.at(round(t * NS_PER_S)))
            )
        vectors = tracker.bench.stars.directions(self._star)
        places = [tracker.camera.project(vectors @ turn.T) for turn in turns]
        return np.stack([x for x, _ in places]), np.stack([y for _, y in places])

    def _measure_paths(self, image_e: FloatArray) -> MeasuredStars:
        if not len(self.judged):
            return MeasuredStars(np.zeros((0, 3)), np.zeros(0))
        width = image_e.shape[1]
        light = image_e.ravel()[self._pixels]
        row, column = np.divmod(self._pixels, width)
        total, by_x, by_y = (
            np.add.reduceat(part, self._begins) for part in (light, light * column, light * row)
        )
        is_lit = total > LOST_SHARE * self._e[self.judged]
        divisor = np.where(is_lit, total, 1.0)
        directions = normalise(self.tracker.camera.rays(by_x / divisor, by_y / divisor))
        return MeasuredStars(
            np.where(is_lit[:, None], directions, np.nan), np.where(is_lit, total, 0.0)
        )

    def _inside(self, x_px: FloatArray, y_px: FloatArray, margin_px: float) -> BoolArray:
        """Places on the tracker whose neighbourhood is whole on the detector and on the monitor."""
        tracker = self.tracker
        width, height = tracker.camera.resolution_px
        inside = (
            (x_px >= margin_px)
            & (x_px < width - 1 - margin_px)
            & (y_px >= margin_px)
            & (y_px < height - 1 - margin_px)
        )
        seen_x, seen_y = (
            part.reshape(x_px.shape)
            for part in tracker.geometry.to_monitor(x_px.ravel(), y_px.ravel())
        )
        reach = tracker.bench.psf.footprint_px / 2 + margin_px * tracker.monitor_px_per_px
        width, height = tracker.bench.camera.resolution_px
        inside &= (seen_x >= reach) & (seen_x < width - 1 - reach)
        return np.asarray(inside & (seen_y >= reach) & (seen_y < height - 1 - reach))


def off(judge: StarJudge, shown: MeasuredStars, wanted: MeasuredStars) -> Off:
    """Errors of the stars of a measurement in place and light.

    A lost one is off by all its light, and by 3 px or its path, whichever is longer: to lose a star
    is no better than to find it late.
    """
    lost = shown.lost | wanted.lost
    chord = np.linalg.norm(shown.directions - wanted.directions, axis=1)
    arcsec = np.where(
        lost, judge.lost_arcsec, 2 * np.arcsin(np.minimum(chord, 2.0) / 2) * ARCSEC_PER_RAD
    )
    mag = magnitude(np.where(lost, 1.0, shown.light_e) / np.where(lost, 1.0, wanted.light_e))
    return Off(arcsec, np.where(lost, LOST_MAG, mag), lost)


def attitude_off_arcsec(shown: MeasuredStars, wanted: MeasuredStars) -> tuple[float, float]:
    """Attitude error across the boresight and about it, least squares over the found stars; NaN
    for fewer than two.
    """
    is_usable = ~(shown.lost | wanted.lost)
    if is_usable.sum() < 2:
        return math.nan, math.nan
    x, y, z = ARCSEC_PER_RAD * turn_between(
        wanted.directions[is_usable], shown.directions[is_usable], np.ones(is_usable.sum())
    )
    return math.hypot(x, y), abs(float(z))
