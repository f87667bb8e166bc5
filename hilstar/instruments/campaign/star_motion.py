"""How the proper motion, or the parallax, of a field's stars turns the attitude of a tracker that
does not follow it.

Before a display the field is the part of it that the display covers: a tracker sees no other star.

Such a tracker takes stars that have moved for stars at their old places: its attitude is off by the
turn that carries the old places onto the new ones, to the least squares. The turn is that of the
field's BRIGHTEST stars, as a tracker takes them. Where a star moves by more than MAX_ARCSEC_YR in a
year, or MAX_PARALLAX_ARCSEC, the turn hangs on whether the tracker takes that star, and is not
known.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.reading import parse_toml
from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.case_table import VARY, Columns
from hilstar.instruments.campaign.plan import MOTION_QUANTITIES, PARALLAX, Require, changed_bench
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.bench.config.bench_config import jyear
from hilstar.server.bench.star_light import bench_moving, star_catalog
from hilstar.sky.stars import unit_vectors_icrs

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky

BRIGHTEST = 15
MIN_STARS = 3
MAX_ARCSEC_YR = 1.0
MAX_PARALLAX_ARCSEC = 0.3
# columns of a campaign's table that are found afterwards: years after the bench's date, and the
# turn in one by the likely stars; the turn by their parallax, and the observer's velocity
YEARS, YEARLY_TURN = "years", "yearly_turn_{}_arcsec"
PARALLAX_TURN, OBSERVER_KM_S = "parallax_turn_{}_arcsec", "observer_{}_km_s"
OF_OBSERVER = ("sky", "spacecraft")  # tables of the bench file that place the observer


@dataclass(frozen=True, slots=True)
class StarMotion:
    """The stars of a bench, the brightest first: unit vectors (n, 3), ICRS, at the bench's date
    `jyear`, how these change in a year (n, 3), their parallaxes (n,), the largest change of a star
    with which a field's turn is known, and the display before the tracker, if there is one.
    """

    jyear: float
    vectors: FloatArray
    yearly: FloatArray
    parallax_mas: FloatArray
    max_arcsec: float = MAX_ARCSEC_YR
    display: Camera | None = None

    @classmethod
    def of(cls, file: BenchFile, display: Camera | None = None) -> "StarMotion":
        """The stars of a bench file, seen on its display or in the sky. Raises InputError as its
        catalogue does.
        """
        catalog = star_catalog(file.config, file.folder)
        catalog = catalog.taken(np.argsort(catalog.v_mag, kind="stable"))
        date = file.config.sky.epoch_jyear
        before = unit_vectors_icrs(catalog, date - 0.5)
        after = unit_vectors_icrs(catalog, date + 0.5)
        vectors = unit_vectors_icrs(catalog, date)
        yearly = after - before
        return cls(date, vectors, yearly, catalog.parallax_mas, display=display)

    def by_parallax(self, moving: "MovingSky") -> "StarMotion":
        """The same stars, whose change (n, 3) is that by their parallax for an observer."""
        infinitely_far = moving.stars_seen(self.vectors, np.zeros(len(self.vectors)))
        shift = moving.stars_seen(self.vectors, self.parallax_mas) - infinitely_far
        return replace(self, yearly=shift, max_arcsec=MAX_PARALLAX_ARCSEC)

    def in_field(self, q_icrs_to_cam: FloatArray, scale: Scale) -> IntArray:
        """The rows of the stars in the tracker's field, the brightest first."""
        seen_cam = self.vectors @ to_matrix(q_icrs_to_cam).T
        width, height = scale.resolution_px
        half_x = width / 2 / scale.focal_px
        half_y = height / 2 / scale.focal_px
        # below 0 behind the camera, where no size is smaller
        depth = seen_cam[:, 2]
        inside = np.abs(seen_cam[:, 0]) < half_x * depth
        inside &= np.abs(seen_cam[:, 1]) < half_y * depth
        if self.display is not None:
            x_px, y_px = self.display.project(seen_cam @ self.display.cam_to_image.T)
            inside &= self.display.contains_px(x_px, y_px)
        return np.flatnonzero(inside)

    def turn_rad(self, q_icrs_to_cam: FloatArray, rows: IntArray) -> FloatArray:
        """The rotation vector (3,), cam, of an attitude by places of these stars from before the
        change; zeros for fewer than MIN_STARS.
        """
        if len(rows) < MIN_STARS:
            return np.zeros(3)
        to_cam = to_matrix(q_icrs_to_cam)
        return turn_of(self.vectors[rows] @ to_cam.T, self.yearly[rows] @ to_cam.T)

    def whole_turn_rad(self, q_icrs_to_cam: FloatArray, scale: Scale) -> FloatArray:
        """`turn_rad` by all stars of the field."""
        return self.turn_rad(q_icrs_to_cam, self.in_field(q_icrs_to_cam, scale))

    def likely_turn_rad(self, q_icrs_to_cam: FloatArray, scale: Scale) -> FloatArray:
        """`turn_rad` by the stars that a tracker is likely to take; NaN where it hangs on one."""
        rows = self.in_field(q_icrs_to_cam, scale)[:BRIGHTEST]
        motion = np.linalg.norm(self.yearly[rows], axis=1)
        fastest = ARCSEC_PER_RAD * float(motion.max(initial=0.0))
        if len(rows) < MIN_STARS or fastest > self.max_arcsec:
            return np.full(3, np.nan)
        return self.turn_rad(q_icrs_to_cam, rows)


def with_motion(
    cases: Columns, requires: list[Require], file: BenchFile, scale: Scale, through: str
) -> Columns:
    """The cases with the columns that a requirement of proper motion or parallax is found from;
    `through` is the plan's: "tracker", or "display" or "bench", where the display bounds the field.
    """
    quantities = {require.quantity for require in requires}
    numbers: dict[str, FloatArray] = {}
    if quantities & {*MOTION_QUANTITIES, PARALLAX}:
        display = None
        if through != "tracker":
            display = bench_camera(file.config, file.folder)
        motion = StarMotion.of(file, display)
        if quantities & set(MOTION_QUANTITIES):
            numbers |= _of_proper_motion(cases, motion, scale)
        if PARALLAX in quantities:
            numbers |= _of_parallax(cases, motion, file, scale)
    return replace(cases, numbers=cases.numbers | numbers)


def _of_proper_motion(cases: Columns, motion: StarMotion, scale: Scale) -> dict[str, FloatArray]:
    """The columns YEARS and YEARLY_TURN."""
    q = cases.vectors("q{}", "wxyz")
    turns = np.zeros((len(q), 3))
    for case, attitude in enumerate(q):
        turns[case] = motion.likely_turn_rad(attitude, scale)
    numbers = _by_name(YEARLY_TURN, "xy", ARCSEC_PER_RAD * turns)
    numbers[YEARS] = _jyears(cases, motion.jyear) - motion.jyear
    return numbers


def _of_parallax(
    cases: Columns, motion: StarMotion, file: BenchFile, scale: Scale
) -> dict[str, FloatArray]:
    """The columns PARALLAX_TURN and OBSERVER_KM_S; NaN in cases without an observer."""
    q = cases.vectors("q{}", "wxyz")
    turns = np.full((len(q), 3), np.nan)
    velocity = np.full((len(q), 3), np.nan)
    by_observer: dict[tuple[tuple[str, Any], ...], list[int]] = {}
    for case, values in enumerate(_observers(cases, file)):
        by_observer.setdefault(tuple(values.items()), []).append(case)
    tables = parse_toml(file.path, file.text)
    for items, rows in by_observer.items():
        config = changed_bench(file, tables, dict(items)).config
        moving = bench_moving(config, file.folder)
        if moving is None:
            continue
        by_parallax = motion.by_parallax(moving)
        velocity[rows] = moving.sight(0).view.velocity_km_s
        for case in rows:
            turns[case] = by_parallax.likely_turn_rad(q[case], scale)
    return _by_name(PARALLAX_TURN, "xy", ARCSEC_PER_RAD * turns) | _by_name(
        OBSERVER_KM_S, "xyz", velocity
    )


def _by_name(form: str, axes: str, vectors: FloatArray) -> dict[str, FloatArray]:
    """Vectors (n, 3) as a column for each of these axes."""
    return {form.format(axis): vectors[:, k] for k, axis in enumerate(axes)}


def _observers(cases: Columns, file: BenchFile) -> list[dict[str, Any]]:
    """What each case varies of the keys that place the observer, as the bench file writes it."""
    values: list[dict[str, Any]] = [{} for _ in cases.numbers["frames"]]
    for name in cases.varied:
        key = name.removeprefix(VARY)
        if key.split(".")[0] not in OF_OBSERVER:
            continue
        column: Any = cases.texts.get(name)
        if column is None:
            column = cases.numbers[name].tolist()
        present: Any = file.config
        for part in key.split("."):
            present = getattr(present, part, None)
        for case, value in enumerate(column):
            # a table has numbers for true and false
            values[case][key] = bool(value) if isinstance(present, bool) else value
    return values


def _jyears(cases: Columns, usual: float) -> FloatArray:
    """The dates (n,) of the cases: varied by either key of [sky], or the bench's."""
    count = len(cases.numbers["frames"])
    dates = cases.texts.get(f"{VARY}sky.epoch_utc")
    if dates is None:
        return cases.numbers.get(f"{VARY}sky.epoch_jyear", np.full(count, usual))
    times = np.array([date.removesuffix("Z") for date in dates], dtype="datetime64[ns]")
    return np.array([jyear(int(utc_ns)) for utc_ns in times.astype(np.int64)])


def turn_of(vectors: FloatArray, motion: FloatArray) -> FloatArray:
    """The small rotation vector (3,) that moves unit vectors (n, 3) by a motion (n, 3), to the
    least squares.
    """
    # of |turn x v - motion|^2: (sum of 1 - v v^T) turn = sum of v x motion
    matrix = len(vectors) * np.eye(3) - vectors.T @ vectors
    moments = np.cross(vectors, motion)
    return np.asarray(np.linalg.solve(matrix, moments.sum(axis=0)))
