"""The model of a certificate: reference stars, and how a bench's deviations change their light and
places, and the attitude and delay that a tracker would measure.

A star's light is the sum over its pixels, each with the deviation of its own level and place. Its
place is where the true lens shows the pixel at which the bench draws it. A field's attitude error
is the rotation that best fits the displacements of all its stars (Wahba's problem, by SVD), as a
tracker would report it.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import random_attitudes, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE, magnitude
from hilstar.display.quantise import shown_light
from hilstar.instruments.certify.bench_readings import (
    geometry_of,
    grey_response,
    in_true_image,
)
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import full_scale_e_per_s, open_bench
from hilstar.server.bench.frame import Bench, Frame
from hilstar.server.bench.monitor import bench_calibration

ATTITUDES, SEED = 40, 3  # random attitudes, of which the fields with the most stars are chosen
# In widths of the PSF: stars nearer to each other than the first share pixels; the second is the
# reach of a star's own pixels.
ALONE_SIGMAS, REACH_SIGMAS = 9.0, 4.0
EDGE_TRACKER_PX = 10.0
STARS_A_THIRD = 4
NO_LIGHT = 1e-6
SMALLEST = 1e-300  # smallest sine to divide by, so that the rotation vector of no rotation is 0
MIN_STARS = 3  # of a field, for an attitude
THIRDS = ("left third", "middle third", "right third")
STAR_QUANTITIES = (("flux", "mag"), ("place_along", "arcsec"), ("place_across", "arcsec"))
AXES = ("attitude_x", "attitude_y", "attitude_z")


@dataclass(frozen=True, slots=True)
class ReferenceStar:
    """A star of a reference field. `row` is its row in the bench's catalogue, `field` and `third`
    number its field and the third of the screen in which it is; `x_px` and `y_px` are its place on
    the monitor, `direction` (3,) is the unit vector to it in cam axes.

    Of its p lit pixels, `log_light` (p,) is the natural logarithm of the light of their codes,
    relative to white, `share` (p,) their shares of the star's light, and `pixel_px` (p, 2) their
    rows and columns on the screen. `quantised_mag` is how much too faint their codes make the star.
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
    pixel_px: IntArray


def reference_stars(file: BenchFile) -> list[ReferenceStar]:
    """The stars of a bench's reference fields, as the bench itself draws them. Raises InputError
    where no field has MIN_STARS stars that stand alone.
    """
    rng = np.random.default_rng(SEED)
    stars: list[ReferenceStar] = []
    attitudes = random_attitudes(ATTITUDES, rng)
    geometry = geometry_of(file)
    number = 0
    with open_bench(file) as bench:
        for q in sorted(attitudes, key=lambda q: -len(bench.sprites(q))):
            members = _of_field(bench, bench.frame(q), number, geometry)
            if len(members) >= MIN_STARS:
                stars += members
                number += 1
            if number == file.config.certify.fields:
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
    rows = frame.rows
    x = rows["x_px"].astype(np.float64)
    y = rows["y_px"].astype(np.float64)
    third = thirds(geometry, x)
    width_px = max(bench.psf.width_px)
    of_catalogue = bench.stars.row[frame.star] >= 0
    usable = np.flatnonzero(usable_stars(rows, of_catalogue, width_px, geometry))
    shown = shown_light(frame.levels, bench.panel)
    vectors = bench.stars.directions(frame.star) @ to_matrix(frame.q_icrs_to_cam).T
    stars = []
    for third_number in range(len(THIRDS)):
        members = usable[third[usable] == third_number]  # the brightest first
        if not len(members):
            continue
        steps = np.linspace(0, len(members) - 1, STARS_A_THIRD)
        picked = np.unique(steps.astype(np.intp))
        for k in members[picked]:
            pixel_px = _window(width_px, x[k], y[k])
            at = pixel_px[:, 0], pixel_px[:, 1]
            light = shown[at]
            wanted = float(frame.linear[at].sum(dtype=np.float64))
            lit = light > 0
            if not lit.any() or wanted <= 0:
                continue
            total = float(light.sum())
            levels = frame.levels[at][lit]
            star = ReferenceStar(
                hip=int(rows["hip"][k]),
                row=int(bench.stars.row[frame.star[k]]),
                v_mag=float(rows["v_mag"][k]),
                b_v_mag=float(rows["bv"][k]),
                field=number,
                third=third_number,
                x_px=float(x[k]),
                y_px=float(y[k]),
                direction=vectors[k],
                quantised_mag=float(magnitude(total / wanted)),
                log_light=np.log(bench.calibration.response.light[levels]),
                share=light[lit] / total,
                pixel_px=pixel_px[lit],
            )
            stars.append(star)
    return stars


def usable_stars(
    rows: npt.NDArray[np.void], of_catalogue: BoolArray, width_px: float, geometry: BenchGeometry
) -> BoolArray:
    """Whether each row of a frame (n,) is a star that stands alone, is wholly on the monitor, and
    is seen by the tracker; the sigma of the PSF is `width_px` along its longer axis.
    """
    x = rows["x_px"].astype(np.float64)
    y = rows["y_px"].astype(np.float64)
    places = np.nan_to_num(np.stack([x, y], axis=1), nan=-1e6)
    radius_px = ALONE_SIGMAS * width_px
    near = cKDTree(places).query_ball_point(places, radius_px, return_length=True)
    usable = rows["drawn"] & ~rows["clipped"] & (near == 1)
    usable &= of_catalogue
    usable &= _seen(geometry, x, y)
    edge_px = _reach(width_px) + 1
    for at, size in zip((x, y), geometry.monitor.resolution_px, strict=True):
        usable &= (at > edge_px) & (at < size - 1 - edge_px)
    return np.asarray(usable)


def _reach(width_px: float) -> int:
    """How many pixels a star has to each side of its middle."""
    return math.ceil(REACH_SIGMAS * width_px)


def _window(width_px: float, x_px: float, y_px: float) -> IntArray:
    """The rows and columns (n, 2) of a star's pixels about a place on the monitor."""
    reach = _reach(width_px)
    about = np.arange(-reach, reach + 1, dtype=np.intp)
    row, column = np.meshgrid(round(y_px) + about, round(x_px) + about, indexing="ij")
    return np.stack([row.ravel(), column.ravel()], axis=1)


def _seen(geometry: BenchGeometry, x_px: FloatArray, y_px: FloatArray) -> BoolArray:
    """Whether the tracker sees each place (n,) on the monitor, EDGE_TRACKER_PX or more within its
    image.
    """
    at = np.stack(geometry.to_tracker(x_px, y_px))
    size = np.array(geometry.tracker.resolution_px)[:, None]
    with np.errstate(invalid="ignore"):
        inside = (at > EDGE_TRACKER_PX) & (at < size - 1 - EDGE_TRACKER_PX)
    return np.asarray(inside.all(axis=0))


def thirds(geometry: BenchGeometry, x_px: FloatArray) -> IntArray:
    """The third (n,) in which each column of the monitor is, of the part that the tracker sees: 0,
    1 or 2 from the left.
    """
    along, down = geometry.monitor.grid_px((181, 61))
    visible = along[_seen(geometry, along, down)]
    if not len(visible):
        visible = np.array([0.0, geometry.monitor.resolution_px[0]])
    low = float(visible.min())
    width = max(float(visible.max()) - low, 1.0)
    third = np.floor((x_px - low) / width * len(THIRDS))
    return np.asarray(np.clip(third, 0, len(THIRDS) - 1).astype(np.intp))


@dataclass(frozen=True, slots=True)
class Deviations:
    """A bench's deviations in b trials: of the light of levels, of the light and places of stars,
    and of the delay.

    `levels` (b, levels) is true over expected light at the levels `Figures.log_light`; `even` (b,
    stars) is the natural logarithm of true over expected light at the stars' places;
    `place_arcsec` (b, stars, 2) is the error of the stars' places along and across; `delay_ms` (b,)
    is the true delay of the panel, and `late_ms` (b,) how much later than that light begins.
    """

    levels: FloatArray
    even: FloatArray
    place_arcsec: FloatArray
    delay_ms: FloatArray
    late_ms: FloatArray


class Figures:
    """Computes the figures of a bench's reference stars from its deviations, in a fixed order.
    `names` has the quantity, the star or field (-1 for the first field), and the unit of each.
    """

    def __init__(self, file: BenchFile, stars: list[ReferenceStar]) -> None:
        self.stars = stars
        self.file = file
        lights = np.concatenate([star.log_light for star in stars])
        self.log_light, place = np.unique(lights, return_inverse=True)
        self._shares = np.zeros((len(stars), len(self.log_light)))
        pixels = [len(star.share) for star in stars]
        star_of = np.repeat(np.arange(len(stars)), pixels)
        shares = np.concatenate([star.share for star in stars])
        np.add.at(self._shares, (star_of, place), shares)
        self.x_px = np.array([star.x_px for star in stars])
        self.y_px = np.array([star.y_px for star in stars])
        self._direction = np.stack([star.direction for star in stars])
        self.tangent = self._direction[:, :2] / self._direction[:, 2:]
        field = np.array([star.field for star in stars])
        fields = int(field.max()) + 1
        self._of_field = [np.flatnonzero(field == number) for number in range(fields)]
        self.names: list[tuple[str, int, str]] = []
        for quantity, unit in STAR_QUANTITIES:
            self.names += [(quantity, star, unit) for star in range(len(stars))]
        for number in range(len(self._of_field)):
            self.names += [(quantity, -1 - number, "arcsec") for quantity in AXES]
        self.names.append(("latency", 0, "ms"))

    def turned(self, turns_arcsec: FloatArray) -> FloatArray:
        """The displacements (n, stars, 2), arcsec, of the stars' places by turns (n, 3) of the
        bench, arcsec about the axes of cam.
        """
        u, v = self.tangent.T
        a, b, c = turns_arcsec.T[:, :, None]
        deeper = a * v - b * u
        along = b - c * v - u * deeper
        across = c * u - a - v * deeper
        return np.stack([along, across], axis=2)

    def of(self, off: Deviations) -> FloatArray:
        """The figures (b, figures), in the order of `names`: errors of flux, mag (fainter is
        positive), of places and attitudes, arcsec, and the latency, ms.
        """
        certify = self.file.config.certify
        monitor = self.file.config.monitor
        light = np.maximum(off.levels @ self._shares.T, NO_LIGHT)
        flux = magnitude(light) - MAG_PER_RELATIVE * off.even
        late_ms = off.delay_ms - monitor.panel_delay_ms + off.late_ms
        place = off.place_arcsec.copy()
        # 3.6 turns deg/s into arcsec/ms. A late star lags behind its motion.
        place[..., 0] -= certify.rate_deg_s * 3.6 * late_ms[:, None]
        columns = [flux, place[..., 0], place[..., 1]]
        columns += [self._attitude(place[:, stars], stars) for stars in self._of_field]
        return np.concatenate([*columns, off.delay_ms[:, None]], axis=1)

    def _attitude(self, place_arcsec: FloatArray, stars: IntArray) -> FloatArray:
        """The rotation vectors (b, 3), arcsec, in cam axes, from the commanded attitude to the one
        that a tracker would report, by the places of a field's `stars`.
        """
        rays = np.ones((len(place_arcsec), len(stars), 3))
        rays[..., :2] = self.tangent[stars] + place_arcsec / ARCSEC_PER_RAD
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        profile = np.einsum("bsi,sj->bij", rays, self._direction[stars])
        u, _, right = np.linalg.svd(profile)
        u[..., 2] *= np.linalg.det(u @ right)[:, None]
        turn = u @ right
        skew = turn - turn.transpose(0, 2, 1)
        # The skew part R - R^T of a rotation by an angle a is 2 sin(a) times its axis.
        axial = skew[:, (2, 0, 1), (1, 2, 0)] / 2
        sine = np.linalg.norm(axial, axis=1, keepdims=True)
        sine = np.clip(sine, SMALLEST, 1.0)
        angle = np.arcsin(sine)
        return np.asarray(axial * ARCSEC_PER_RAD * angle / sine)


def true_deviations(figures: Figures, truth: BenchFile) -> Deviations:
    """The deviations (b = 1) of a bench from the bench file `truth`, at its reference stars."""
    file = figures.file
    stated = grey_response(file).light[1:]
    ratio = grey_response(truth).light[1:] / stated
    levels = np.interp(figures.log_light, np.log(stated), ratio)
    levels *= full_scale_e_per_s(truth) / full_scale_e_per_s(file)
    here_px = figures.x_px, figures.y_px
    true_px = in_true_image(file, truth, *here_px)
    even = np.log(_evenness_at(truth, *true_px) / _evenness_at(file, *here_px))
    tangents = _tangents_at(truth, *true_px) - _tangents_at(file, *here_px)
    place_arcsec = tangents * ARCSEC_PER_RAD
    delay_ms = np.array([truth.config.monitor.panel_delay_ms])
    return Deviations(levels[None], even[None], place_arcsec[None], delay_ms, np.zeros(1))


def _evenness_at(file: BenchFile, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The relative light (n,) of a bench's pixels by its uniformity map; 1 without one."""
    size_px = file.config.monitor.resolution_px
    known = bench_calibration(file.config, file.folder).uniformity_map(size_px)
    if known is None:
        return np.ones(len(x_px))
    row = np.rint(y_px).astype(np.intp)
    column = np.rint(x_px).astype(np.intp)
    return known[row, column].astype(np.float64)


def _tangents_at(file: BenchFile, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """The directions (n, 2), tangents in cam axes, in which a bench's collimator shows pixels."""
    rays = geometry_of(file).monitor.rays(x_px, y_px)
    return np.asarray(rays[:, :2] / rays[:, 2:])
