"""The model of a certificate: reference stars, and what a bench's deviations do to light, places,
attitude and delay.

A star's light is the sum over its pixels, each with the deviation of its own level and place; its
place is where the true lens shows the pixel that the bench draws it at. A field's attitude is the
rotation nearest to all its stars' displacements (Wahba's problem, by SVD), which is what a tracker
would report.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE, magnitude
from hilstar.display.quantise import shown_light
from hilstar.instruments.certify.readings import (
    geometry_of,
    grey_response,
    in_true_image,
    white_of,
)
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame import Bench, Frame
from hilstar.server.bench.monitor import bench_calibration

ATTITUDES, SEED = 40, 3  # random ones, of which the fields with the most stars are taken
# in sprites: stars nearer than this share pixels; a star's own pixels
ALONE_SIGMAS, REACH_SIGMAS = 9.0, 4.0
EDGE_TRACKER_PX = 10.0
STARS_A_THIRD = 4
NO_LIGHT = 1e-6
MIN_STARS = 3  # for an attitude
THIRDS = ("left third", "middle third", "right third")


@dataclass(frozen=True, slots=True)
class ReferenceStar:
    """A star of a reference field: its place on the monitor, its direction in cam, and its pixels
    with their shares of light.

    `log_light` (p,) is that asked of its pixels, relative to white, `quantised_mag` how much too
    faint their codes make it.
    """

    hip: int
    row: int
    v_mag: float
    b_v_mag: float
    field: int
    third: int
    x_px: float
    y_px: float
    direction: FloatArray
    quantised_mag: float
    log_light: FloatArray
    share: FloatArray


def reference_stars(file: BenchFile) -> list[ReferenceStar]:
    """The stars of a bench's reference fields, drawn by the bench itself. Raises InputError
    where they are too few.
    """
    rng = np.random.default_rng(SEED)
    stars: list[ReferenceStar] = []
    attitudes = [q / np.linalg.norm(q) for q in rng.normal(size=(ATTITUDES, 4))]
    geometry = geometry_of(file)
    with open_bench(file) as bench:
        fullest = sorted(attitudes, key=lambda q: -len(bench.sprites(q)))
        for q in fullest:
            found = _of_field(bench, bench.frame(q), len({star.field for star in stars}), geometry)
            if len(found) >= MIN_STARS:
                stars += found
            if len({star.field for star in stars}) == file.config.certify.fields:
                break
    if not stars:
        raise InputError(
            f"{file.path}: no {MIN_STARS} stars stand alone in a reference field; write a fainter"
            " [sky]"
        )
    return stars


def _of_field(
    bench: Bench, frame: Frame, number: int, geometry: BenchGeometry
) -> list[ReferenceStar]:
    truth = frame.rows
    sigma = max(bench.psf.width_px)
    vectors = bench.stars.directions(frame.star) @ to_matrix(frame.q_icrs_to_cam).T
    x = truth["x_px"].astype(np.float64)
    y = truth["y_px"].astype(np.float64)
    places = np.nan_to_num(np.stack([x, y], axis=1), nan=-1e6)
    near = cKDTree(places).query_ball_point(places, ALONE_SIGMAS * sigma, return_length=True)
    reach, (width, height) = math.ceil(REACH_SIGMAS * sigma), bench.camera.resolution_px
    is_usable = (
        truth["drawn"] & ~truth["clipped"] & (near == 1) & (bench.stars.row[frame.star] >= 0)
    )
    is_usable &= _seen(geometry, x, y)
    is_usable &= (
        (x > reach + 1) & (x < width - 2 - reach) & (y > reach + 1) & (y < height - 2 - reach)
    )
    third = thirds(geometry, x)
    shown = shown_light(frame.levels, bench.panel)
    stars = []
    for third_number in range(len(THIRDS)):
        here = np.flatnonzero(is_usable & (third == third_number))  # the brightest first
        for k in (
            here[np.unique(np.linspace(0, len(here) - 1, STARS_A_THIRD).astype(int))]
            if len(here)
            else []
        ):
            rows, columns = (slice(round(at) - reach, round(at) + reach + 1) for at in (y[k], x[k]))
            light = shown[rows, columns].ravel()
            level = frame.levels[rows, columns].ravel()
            wanted = float(frame.linear[rows, columns].sum(dtype=np.float64))
            lit = light > 0
            if not lit.any() or wanted <= 0:
                continue
            star = ReferenceStar(
                hip=int(truth["hip"][k]),
                row=int(bench.stars.row[frame.star[k]]),
                v_mag=float(truth["v_mag"][k]),
                b_v_mag=float(truth["bv"][k]),
                field=number,
                third=third_number,
                x_px=float(x[k]),
                y_px=float(y[k]),
                direction=vectors[k],
                quantised_mag=float(magnitude(float(light.sum()) / wanted)),
                log_light=np.log(bench.calibration.response.light[level[lit]]),
                share=light[lit] / light[lit].sum(),
            )
            stars.append(star)
    return stars


def _seen(geometry: BenchGeometry, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    at = np.stack(geometry.to_tracker(x_px, y_px))
    size = np.array(geometry.tracker.resolution_px)[:, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(((at > EDGE_TRACKER_PX) & (at < size - 1 - EDGE_TRACKER_PX)).all(axis=0))


def thirds(geometry: BenchGeometry, x_px: FloatArray) -> IntArray:
    """The third (n,) of what the tracker sees of the screen, 0 at the left, by columns."""
    along, down = geometry.monitor.grid_px((181, 61))
    visible_along = along[_seen(geometry, along, down)]
    low, high = (
        (float(visible_along.min()), float(visible_along.max()))
        if len(visible_along)
        else (0.0, float(geometry.monitor.resolution_px[0]))
    )
    return np.asarray(np.clip((x_px - low) / max(high - low, 1.0) * 3, 0, 2).astype(np.intp))


@dataclass(frozen=True, slots=True)
class Deviations:
    """A bench's deviations of one or many trials (b, ...): light at levels and at stars, places of
    stars, delay.

    `levels` (b, levels) is true over expected light at the model's `log_light`, `even` (b, stars)
    its log at stars' places; `place_arcsec` (b, stars, 2); `delay_ms` (b,); `late_ms` (b,) is what
    the moment of light is late beyond the delay.
    """

    levels: FloatArray
    even: FloatArray
    place_arcsec: FloatArray
    delay_ms: FloatArray
    late_ms: FloatArray


class Figures:
    """The figures of a bench's reference stars by its deviations, in a fixed order: `names` has
    quantity and place of each.
    """

    def __init__(self, file: BenchFile, stars: list[ReferenceStar]) -> None:
        self.stars = stars
        self.file = file
        self.log_light, place = np.unique(
            np.concatenate([star.log_light for star in stars]), return_inverse=True
        )
        self._shares = np.zeros((len(stars), len(self.log_light)))
        start = 0
        for number, star in enumerate(stars):
            np.add.at(self._shares[number], place[start : start + len(star.share)], star.share)
            start += len(star.share)
        self.x_px, self.y_px = (
            np.array([getattr(star, name) for star in stars]) for name in ("x_px", "y_px")
        )
        self._direction = np.stack([star.direction for star in stars])
        self.tangent = self._direction[:, :2] / self._direction[:, 2:]
        fields = np.array([star.field for star in stars])
        self._of_field = [
            np.flatnonzero(fields == number) for number in range(int(fields.max()) + 1)
        ]
        star_quantities = [("flux", "mag"), ("place_along", "arcsec"), ("place_across", "arcsec")]
        self.names = [
            (quantity, star, unit)
            for quantity, unit in star_quantities
            for star in range(len(stars))
        ]
        axes = [("attitude_x", "arcsec"), ("attitude_y", "arcsec"), ("attitude_z", "arcsec")]
        self.names += [
            (quantity, -1 - field, unit)
            for field in range(len(self._of_field))
            for quantity, unit in axes
        ]
        self.names.append(("latency", 0, "ms"))

    def turned(self, turns_arcsec: FloatArray) -> FloatArray:
        """What turns of the bench (n, 3), arcsec about cam's axes, add to the stars' places (n,
        stars, 2).
        """
        u, v = self.tangent.T
        a, b, c = turns_arcsec.T[:, :, None]
        return np.stack([b - c * v - u * (a * v - b * u), c * u - a - v * (a * v - b * u)], axis=2)

    def of(self, off: Deviations) -> FloatArray:
        """The figures (b, figures): flux mag (fainter is positive), places arcsec, attitudes
        arcsec, latency ms.
        """
        certify = self.file.config.certify
        monitor = self.file.config.monitor
        flux = (
            magnitude(np.maximum(off.levels @ self._shares.T, NO_LIGHT))
            - MAG_PER_RELATIVE * off.even
        )
        late_ms = off.delay_ms - monitor.panel_delay_ms + off.late_ms
        place = off.place_arcsec.copy()
        # deg/s to arcsec/ms; what is late lags behind
        place[..., 0] -= certify.rate_deg_s * 3.6 * late_ms[:, None]
        turned = [self._attitude(place[:, stars], stars) for stars in self._of_field]
        return np.concatenate(
            [flux, place[..., 0], place[..., 1], *turned, off.delay_ms[:, None]], axis=1
        )

    def _attitude(self, place_arcsec: FloatArray, stars: IntArray) -> FloatArray:
        """Rotation vectors (b, 3), arcsec, cam axes, from the commanded to the reported
        attitude.
        """
        rays = np.ones((len(place_arcsec), len(stars), 3))
        rays[..., :2] = self.tangent[stars] + place_arcsec / ARCSEC_PER_RAD
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        u, _, right = np.linalg.svd(np.einsum("bsi,sj->bij", rays, self._direction[stars]))
        u[..., 2] *= np.linalg.det(u @ right)[:, None]
        turn = u @ right
        # The axial vector of a rotation by an angle a is 2 sin(a) times its axis.
        axial = np.stack(
            [
                turn[:, 2, 1] - turn[:, 1, 2],
                turn[:, 0, 2] - turn[:, 2, 0],
                turn[:, 1, 0] - turn[:, 0, 1],
            ],
            axis=1,
        )
        sine = np.linalg.norm(axial, axis=1, keepdims=True) / 2
        return np.asarray(
            axial
            / 2
            * ARCSEC_PER_RAD
            * np.arcsin(np.clip(sine, 1e-300, 1.0))
            / np.maximum(sine, 1e-300)
        )


def true_deviations(figures: Figures, truth: BenchFile) -> Deviations:
    """The deviations of a bench whose truth is known (b = 1), at its reference stars."""
    file = figures.file
    mine = grey_response(file)
    its = grey_response(truth)
    levels = np.interp(figures.log_light, np.log(mine.light[1:]), its.light[1:] / mine.light[1:])
    levels *= white_of(truth) / white_of(file)
    even = np.zeros(len(figures.stars))
    rays = []
    here_px = figures.x_px, figures.y_px
    places_px = in_true_image(file, truth, *here_px), here_px
    for sign, bench, (x_px, y_px) in zip((1, -1), (truth, file), places_px, strict=True):
        size_px = bench.config.monitor.resolution_px
        known = bench_calibration(bench.config, bench.folder).uniformity_map(size_px)
        if known is not None:
            row = np.rint(y_px).astype(np.intp)
            column = np.rint(x_px).astype(np.intp)
            even += sign * np.log(known[row, column].astype(np.float64))
        rays.append(geometry_of(bench).monitor.rays(x_px, y_px))
    shown, wanted = rays
    place = (shown[:, :2] / shown[:, 2:] - wanted[:, :2] / wanted[:, 2:]) * ARCSEC_PER_RAD
    delay = np.array([truth.config.monitor.panel_delay_ms])
    return Deviations(levels[None], even[None], place[None], delay, np.zeros(1))
