"""How the proper motion of a field's stars turns the attitude of a tracker whose places are old.

Such a tracker takes stars that have moved for stars at their old places: its attitude is off by the
turn that carries the old places onto the new ones, to the least squares. The turn is that of the
field's BRIGHTEST stars, as a tracker takes them. Where a star is faster than MAX_ARCSEC_YR the turn
hangs on whether the tracker takes that star, and is not known.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.case_table import VARY, Columns
from hilstar.instruments.campaign.plan import MOTION_QUANTITIES, Require
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.bench_config import jyear
from hilstar.server.bench.star_light import catalogue_choice
from hilstar.sky.star_table import choose_catalog
from hilstar.sky.stars import unit_vectors_icrs

BRIGHTEST = 15
MIN_STARS = 3
MAX_ARCSEC_YR = 1.0
# columns of a campaign's table that are found afterwards: years after the bench's date, and the
# turn in one by the likely stars
YEARS, YEARLY_TURN = "years", "yearly_turn_{}_arcsec"


@dataclass(frozen=True, slots=True)
class StarMotion:
    """The stars of a bench, the brightest first: unit vectors (n, 3), ICRS, at the bench's date
    `jyear`, and how these change in a year (n, 3).
    """

    jyear: float
    vectors: FloatArray
    yearly: FloatArray

    @classmethod
    def of(cls, file: BenchFile) -> "StarMotion":
        """The stars of a bench file. Raises InputError as its catalogue does."""
        sky = file.config.sky
        catalog = choose_catalog(catalogue_choice(file.config, file.folder))
        catalog = catalog.brighter_than(sky.faintest_v_mag)
        catalog = catalog.taken(np.argsort(catalog.v_mag, kind="stable"))
        date = sky.epoch_jyear
        before = unit_vectors_icrs(catalog, date - 0.5)
        after = unit_vectors_icrs(catalog, date + 0.5)
        return cls(date, unit_vectors_icrs(catalog, date), after - before)

    def in_field(self, q_icrs_to_cam: FloatArray, scale: Scale) -> IntArray:
        """The rows of the stars in the tracker's field, the brightest first."""
        seen_cam = self.vectors @ to_matrix(q_icrs_to_cam).T
        width, height = scale.resolution_px
        half_x = width / 2 / scale.focal_px
        half_y = height / 2 / scale.focal_px
        depth = seen_cam[:, 2]
        inside = depth > 0
        inside &= np.abs(seen_cam[:, 0]) < half_x * depth
        inside &= np.abs(seen_cam[:, 1]) < half_y * depth
        return np.flatnonzero(inside)

    def turn_rad(self, q_icrs_to_cam: FloatArray, rows: IntArray) -> FloatArray:
        """The rotation vector (3,), cam, of an attitude by places of these stars that are a year
        old; zeros for fewer than MIN_STARS.
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
        if len(rows) < MIN_STARS or fastest > MAX_ARCSEC_YR:
            return np.full(3, np.nan)
        return self.turn_rad(q_icrs_to_cam, rows)


def with_motion(cases: Columns, requires: list[Require], file: BenchFile, scale: Scale) -> Columns:
    """The cases with the columns YEARS and YEARLY_TURN where a requirement is found from them."""
    if not {require.quantity for require in requires} & set(MOTION_QUANTITIES):
        return cases
    motion = StarMotion.of(file)
    q = cases.vectors("q{}", "wxyz")
    turns = np.zeros((len(q), 3))
    for case, attitude in enumerate(q):
        turns[case] = motion.likely_turn_rad(attitude, scale)
    numbers = dict(cases.numbers)
    numbers[YEARS] = _jyears(cases, motion.jyear) - motion.jyear
    for k, axis in enumerate("xy"):
        numbers[YEARLY_TURN.format(axis)] = ARCSEC_PER_RAD * turns[:, k]
    return replace(cases, numbers=numbers)


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
