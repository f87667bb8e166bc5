"""The stars of one bench: directions, colours and electron rates, sorted for culling.

A spatial index over directions: which stars can lie within an angle of an axis.

Where a star is seen: proper motion, aberration and refraction, on unit vectors in float64 (ICRS).
"""

import logging
import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import LIGHT_KM_S
from hilstar.sky.catalog import Catalog

log = logging.getLogger(__name__)

MAX_SHIFT = 1.1  # largest aberration in units of v/c, for speeds up to 0.1 c

BODY_CELL_RAD = 1e-6  # radius of a cell with one body: rounding
# Measured over 116 812 stars and an 18 by 10 degree monitor: cells of 2 to 10 degrees take 23 to 11
# us and pass on 1200 to 2700 stars; 4 degrees (13 us, 1500 stars) minimises the time of both steps.
# results/tradeoff.csv, culling: 1 to 6 degrees take the same time, a scan twenty times as long.
CELL_DEG = 4.0
# Within a cell stars are sorted by PARTS^2 parts of it: neighbours on the image follow each other,
# which saves a twelfth of drawing them.
PARTS = 4
# arccos near 1 is accurate to 1e-8 rad only; a cell is enlarged by this.
RADIUS_MARGIN_RAD = 1e-6
MIN_ACROSS, MIN_UP = 1e-6, 0.05  # ERFA's limits of refraction (atioq)
MOST_BENT_RAD = 0.012  # by those, in 1100 hPa and -50 C; 0.69 degrees
LOW_RAD, LESS_BENT_RAD = 0.35, 0.0015  # above 20 degrees light is bent by less than 5 arcmin
RAD_PER_MAS = np.pi / (180 * 3600 * 1000)
BV_MAG = np.linspace(-0.4, 2.4, 57)  # for light that is no star's
# Of each star, beside its vector.
COLUMNS = (
    "hip",
    "v_mag",
    "bv_mag",
    "temperature_k",
    "electrons_per_s",
    "row",
    "colours",
    "primaries",
)


@dataclass(frozen=True, slots=True)
class AirAbove:
    """The air over a place at a moment: the zenith `up` (3,), ICRS, and the constants of
    refraction, rad.

    Refraction is ERFA's: A tan z + B tan^3 z, z the observed zenith distance, with constants for
    pressure, temperature and humidity (refco), one for all colours; below 3 degrees of altitude it
    stays what it is there. `told` are warnings given.
    """

    up: FloatArray
    refraction_rad: tuple[float, float]
    told: set[str] = field(default_factory=set)

    def bent(self, vectors: FloatArray) -> FloatArray:
        """Directions (n, 3), ICRS, as the air bends them towards the zenith."""
        a, b = self.refraction_rad
        z = vectors @ self.up
        level = vectors - z[:, None] * self.up
        across = np.sqrt(np.einsum("ij,ij->i", level, level))
        r = np.maximum(across, MIN_ACROSS)
        up = np.maximum(z, MIN_UP)
        tangent = r / up
        w = b * tangent**2
        by = (a + w) * tangent / (1 + (a + 3 * w) / up**2)
        cosine = 1 - by**2 / 2
        along_level = cosine - by * z / r
        along_up = cosine * z + by * r
        return np.asarray(along_level[:, None] * level + along_up[:, None] * self.up)

    def lowest_rad(self, axis: FloatArray, radius_rad: float) -> float:
        """The lowest altitude within an angle of a direction (3,)."""
        altitude_rad = float(np.arcsin(np.clip(axis @ self.up, -1.0, 1.0)))
        return altitude_rad - radius_rad

    def most_rad(self, axis: FloatArray, radius_rad: float) -> float:
        """By how much light within an angle of a direction (3,) is bent at most."""
        if self.lowest_rad(axis, radius_rad) < LOW_RAD:
            return MOST_BENT_RAD
        return LESS_BENT_RAD

    def risen(self, which: IntArray, vectors: FloatArray, lowest_rad: float) -> IntArray:
        """Those of directions (n, 3) above the horizon, which a field that reaches down to
        `lowest_rad` may cut.
        """
        if lowest_rad > MOST_BENT_RAD:
            return which
        up = self.altitude_rad(vectors[which]) > 0
        if lowest_rad < 0 and not up.all():
            tell(
                self.told,
                "horizon",
                "[site]: the field reaches below the horizon; the stars there are not shown",
            )
        return which[up]

    def altitude_rad(self, vectors: FloatArray) -> FloatArray:
        """Apparent altitudes (n,) of directions outside the air (n, 3)."""
        sine = np.clip(self.bent(vectors) @ self.up, -1.0, 1.0)
        return np.asarray(np.arcsin(sine))


def tell(told: set[str], key: str, text: str, *values: object) -> None:
    """A warning, once."""
    if key not in told:
        told.add(key)
        log.warning(text, *values)


@dataclass(frozen=True, slots=True)
class Stars:
    """Stars in the order of `grid`; `vectors` (n, 3) are ICRS unit vectors, the rest has shape
    (n,).

    Vectors are kept component by component (Fortran's order): they are gathered and turned several
    times faster.

    `row` is each star's place in `catalog`, which has what no frame needs; -1 for what is in no
    catalogue. With a `velocity_km_s` (3,), ICRS, they are seen by an observer who moves so against
    the one who sees `vectors`: `near` and `directions` then say what that observer sees. The last
    stars may be `bodies`, by name: whoever moves them rewrites their part of the arrays. Those that
    `near` does not find (satellites) come first.

    `colours` (n, channels) are the shares of `electrons_per_s` that each channel of the tracker
    has, which sum to 1; None where it has one channel. `primaries` (n, 3) are the light that each
    of a monitor's primaries gives of it, as shares of `electrons_per_s`; None where they are not
    driven apart. `colours_by_bv` and `primaries_by_bv` (k, columns) are the same of light of BV_MAG
    (k,). Through `air` directions are bent, and `near` finds none below the horizon.
    """

    hip: npt.NDArray[np.int32]
    vectors: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    temperature_k: FloatArray
    electrons_per_s: FloatArray
    grid: "CellGrid"
    catalog: Catalog
    row: IntArray
    velocity_km_s: FloatArray | None = None
    bodies: tuple[str, ...] = ()
    colours: FloatArray | None = None
    primaries: FloatArray | None = None
    colours_by_bv: FloatArray | None = None
    primaries_by_bv: FloatArray | None = None
    air: AirAbove | None = None

    def __len__(self) -> int:
        return len(self.hip)

    @property
    def rates_e_per_s(self) -> FloatArray:
        """The electron rates of the stars alone, without bodies."""
        return self.electrons_per_s[: len(self) - len(self.bodies)]

    def near(
        self,
        axis: FloatArray,
        radius_rad: float,
        edges: FloatArray | None = None,
        reach_rad: float = 0.0,
    ) -> IntArray:
        """Every star seen within `radius_rad` and `reach_rad` of the unit vector `axis` (ICRS), and
        some more; rising.

        With `edges` (k, 3), unit vectors (ICRS), those within `reach_rad` of the inner side of each
        one's plane.
        """
        if self.velocity_km_s is not None:
            speed_km_s = float(np.linalg.norm(self.velocity_km_s))
            reach_rad += MAX_SHIFT * speed_km_s / LIGHT_KM_S
        if self.air is None:
            return self.grid.near(axis, radius_rad, edges, reach_rad)
        field_rad = radius_rad + reach_rad
        bent_rad = self.air.most_rad(axis, field_rad)
        near_stars = self.grid.near(axis, radius_rad, edges, reach_rad + bent_rad)
        return self.air.risen(near_stars, self.vectors, self.air.lowest_rad(axis, field_rad))

    def directions(self, which: IntArray) -> FloatArray:
        """Where stars are seen: ICRS unit vectors (n, 3)."""
        vectors = self.vectors
        if vectors.flags.f_contiguous:
            vectors = vectors.T.take(which, axis=1).T
        else:
            vectors = vectors[which]
        if self.velocity_km_s is not None:
            vectors = aberrate(vectors, self.velocity_km_s)
        if self.air is not None:
            vectors = self.air.bent(vectors)
        return vectors

    def seen_at(self, velocity_km_s: FloatArray | None) -> "Stars":
        """The same stars for such an observer; None: for the one who sees `vectors`."""
        if velocity_km_s is None:
            return self
        return replace(self, velocity_km_s=velocity_km_s)

    def names(self, which: IntArray) -> list[str]:
        """The names of bodies and of stars without a HIP number among stars (n,), empty text for
        the others.
        """
        first_body = len(self) - len(self.bodies)
        names = [""] * len(which)
        for place in np.flatnonzero(self.hip[which] == 0).tolist():
            names[place] = self._name(int(which[place]), first_body)
        return names

    def _name(self, star: int, first_body: int) -> str:
        """The name of a body, or of a catalogue's star; empty for what has none."""
        if star >= first_body:
            return self.bodies[star - first_body]
        if self.row[star] < 0:
            return ""
        return self.catalog.name(int(self.row[star]))

    def designations(self, which: IntArray) -> list[int | str]:
        """The HIP numbers of stars (n,), and the names of those that have none."""
        hips = self.hip[which].tolist()
        return [name or hip for name, hip in zip(self.names(which), hips, strict=True)]


def split_by_rate(
    stars: Stars, faintest_e_per_s: float, drive: FloatArray | float = 1.0
) -> tuple[Stars, Stars]:
    """The stars of at least `faintest_e_per_s` electrons per second times `drive`, and the fainter
    ones, each in own cells.

    The first are `stars` itself where no star is fainter.
    """
    is_bright = stars.electrons_per_s * drive >= faintest_e_per_s
    faint = _selected(stars, ~is_bright)
    if is_bright.all():
        return stars, faint
    return _selected(stars, is_bright), faint


def _selected(stars: Stars, is_selected: npt.NDArray[np.bool_]) -> Stars:
    """Stars (k,) of those given, in cells of their own."""
    grid = cell_grid(stars.vectors[is_selected])
    order = np.flatnonzero(is_selected)[grid.order]
    columns = {}
    for name in COLUMNS:
        values = getattr(stars, name)
        if values is not None:
            columns[name] = values[order]
    vectors = np.asfortranarray(stars.vectors[order])
    return replace(
        stars, **columns, vectors=vectors, grid=grid, velocity_km_s=None, bodies=(), air=None
    )


def make_stars(
    catalog: Catalog, vectors: FloatArray, temperature_k: FloatArray, electrons_per_s: FloatArray
) -> Stars:
    """Sort a catalogue's stars by cell; their electrons (n,), or by channel (n, channels)."""
    electrons_per_s, colours = total_and_colours(electrons_per_s)
    grid = cell_grid(vectors)
    order = grid.order
    if colours is not None:
        colours = colours[order]
    return Stars(
        hip=catalog.hip[order],
        vectors=np.asfortranarray(vectors[order]),
        v_mag=catalog.v_mag[order],
        bv_mag=catalog.bv_mag[order],
        temperature_k=temperature_k[order],
        electrons_per_s=electrons_per_s[order],
        grid=grid,
        catalog=catalog,
        row=order,
        colours=colours,
    )


class Flux(NamedTuple):
    """Electrons per second of all channels (n,), and each channel's share of them (n, channels),
    None for one channel.
    """

    electrons_per_s: FloatArray
    colours: FloatArray | None


def total_and_colours(electrons_per_s: FloatArray) -> Flux:
    """The flux of electrons (n,), or by channel (n, channels)."""
    if electrons_per_s.ndim == 1 or electrons_per_s.shape[1] == 1:
        return Flux(electrons_per_s.reshape(len(electrons_per_s)), None)
    total = electrons_per_s.sum(axis=1)
    return Flux(total, electrons_per_s / total[:, None])


def with_bodies(
    stars: Stars,
    bodies: tuple[str, ...],
    bv_mag: FloatArray,
    found: bool = True,
    colours: FloatArray | None = None,
) -> Stars:
    """The stars, in arrays of their own, and after them bodies of colours `bv_mag` (k,), which have
    no place or light yet.

    Bodies not to be `found` are in no cell: `near` passes over them, whoever moves them adds them
    to an image. Their `colours` (k, channels) or (channels,) are wanted where stars have theirs.
    """
    count = len(bodies)
    places = len(stars) + np.arange(count)
    nowhere = np.full(count, np.nan)
    vectors = np.concatenate([stars.vectors, np.full((count, 3), np.nan)])
    all_colours = None
    if stars.colours is not None and colours is not None:
        body_colours = np.broadcast_to(colours, (count, colours.shape[-1]))
        all_colours = np.vstack([stars.colours, body_colours])
    return Stars(
        hip=np.concatenate([stars.hip, np.zeros(count, dtype=np.int32)]),
        vectors=np.asfortranarray(vectors),
        v_mag=np.concatenate([stars.v_mag, nowhere]),
        bv_mag=np.concatenate([stars.bv_mag, bv_mag]),
        temperature_k=np.concatenate([stars.temperature_k, nowhere]),
        electrons_per_s=np.concatenate([stars.electrons_per_s, nowhere]),
        grid=_with_cells(stars.grid, places, count if found else 0),
        catalog=stars.catalog,
        row=np.concatenate([stars.row, np.full(count, -1)]),
        bodies=(*stars.bodies, *bodies),
        colours=all_colours,
        colours_by_bv=stars.colours_by_bv,
    )


def _with_cells(grid: "CellGrid", places: IntArray, cell_count: int) -> "CellGrid":
    """A grid and after it stars at `places` (n,), the first of them each in a cell of its own,
    which has no centre yet.
    """
    ones = np.ones(cell_count)
    return replace(
        grid,
        order=np.concatenate([grid.order, places]),
        start=np.concatenate([grid.start, places[:cell_count]]),
        count=np.concatenate([grid.count, ones.astype(grid.count.dtype)]),
        centre=np.concatenate([grid.centre, np.full((cell_count, 3), np.nan)]),
        cos_radius=np.concatenate([grid.cos_radius, ones * np.cos(BODY_CELL_RAD)]),
        sin_radius=np.concatenate([grid.sin_radius, ones * np.sin(BODY_CELL_RAD)]),
    )


@dataclass(frozen=True, slots=True)
class CellGrid:
    """Stars grouped in cells of the sphere, each cell bounded by a cap.

    `order` (n,) sorts the stars by cell: cell k holds `order[start[k] : start[k] + count[k]]`.
    """

    order: IntArray
    start: IntArray
    count: IntArray
    centre: FloatArray
    cos_radius: FloatArray
    sin_radius: FloatArray

    def near(
        self,
        axis: FloatArray,
        radius_rad: float,
        edges: FloatArray | None = None,
        reach_rad: float = 0.0,
    ) -> IntArray:
        """Positions in `order`, rising, of every star within `radius_rad` and `reach_rad` of the
        unit vector `axis`, and more.

        With `edges` (k, 3), unit normals of planes through the centre, the stars within `reach_rad`
        of the inner side of each.
        """
        if not len(self.start):
            return np.empty(0, dtype=np.intp)
        # one bound for all cells, then each hit cell's own
        widest_rad = math.acos(self.cos_radius.min())
        farthest_rad = radius_rad + reach_rad + widest_rad
        if farthest_rad >= math.pi:  # to the other side of the sky
            return self._stars(np.isfinite(self.centre[:, 0]).nonzero()[0])
        hit = (self.centre @ axis >= math.cos(farthest_rad)).nonzero()[0]
        centre = self.centre.take(hit, axis=0).T
        cos_radius = self.cos_radius.take(hit)
        sin_radius = self.sin_radius.take(hit)
        cosine = math.cos(radius_rad + reach_rad)
        sine = math.sin(radius_rad + reach_rad)
        within = axis @ centre >= cosine * cos_radius - sine * sin_radius
        if edges is not None and reach_rad < math.pi / 2:
            cosine = math.cos(reach_rad)
            sine = math.sin(reach_rad)
            deepest = cosine * sin_radius + sine * cos_radius
            if widest_rad + reach_rad >= math.pi / 2:
                # a cell wider than a plane bounds
                deepest[cosine * cos_radius <= sine * sin_radius] = 1.0
            within &= (edges @ centre + deepest).min(axis=0) >= 0
        return self._stars(hit[within])

    def _stars(self, cells: IntArray) -> IntArray:
        """Positions in `order` of the stars of rising `cells`."""
        if not len(cells):
            return np.empty(0, dtype=np.intp)
        start = self.start.take(cells)
        end = start + self.count.take(cells)
        # neighbours in a band follow each other: few ranges
        gaps = (start[1:] != end[:-1]).nonzero()[0]
        firsts = [int(start[0]), *start[gaps + 1].tolist()]
        lasts = [*end[gaps].tolist(), int(end[-1])]
        ranges = []
        for first, last in zip(firsts, lasts, strict=True):
            ranges.append(np.arange(first, last))
        return np.concatenate(ranges)


def cell_grid(vectors: FloatArray, cell_deg: float = CELL_DEG) -> CellGrid:
    """Group unit vectors (n, 3) into bands of declination, cut into cells of about `cell_deg`
    squared.
    """
    bands = max(1, round(180.0 / cell_deg))
    down = np.arccos(np.clip(vectors[:, 2], -1, 1)) / np.pi * bands
    band = np.minimum(down.astype(np.intp), bands - 1)
    middles_rad = (np.arange(bands) + 0.5) * np.pi / bands
    per_band = np.maximum(1, np.round(360.0 / cell_deg * np.sin(middles_rad))).astype(np.intp)
    turn = np.arctan2(vectors[:, 1], vectors[:, 0]) / (2 * np.pi) % 1.0
    along = turn * per_band[band]
    sector = np.minimum(along.astype(np.intp), per_band[band] - 1)
    first_of_band = np.cumsum(per_band) - per_band
    cell = first_of_band[band] + sector
    # Few bits make NumPy's stable sort a radix sort, in a fifth of the time.
    part_down = ((down - band) * PARTS).astype(np.uint8)
    part_along = ((along - sector) * PARTS).astype(np.uint8)
    part = part_down * np.uint8(PARTS + 1) + part_along
    order = np.argsort(part, kind="stable")
    small_cell = cell.astype(np.min_scalar_type(per_band.sum()))
    order = order[np.argsort(small_cell[order], kind="stable")]
    # Not `np.unique`, here and wherever a bench opens: its first call imports `numpy.ma`, which
    # takes 10 ms.
    start = np.flatnonzero(np.diff(cell[order], prepend=-1))
    count = np.diff(start, append=len(order))
    if not len(start):
        nothing = np.empty(0)
        return CellGrid(order, start, count, np.empty((0, 3)), nothing, nothing)
    sorted_vectors = vectors[order]
    centre = np.add.reduceat(sorted_vectors, start)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    cosine = np.einsum("ij,ij->i", sorted_vectors, np.repeat(centre, count, axis=0))
    smallest_cosine = np.clip(np.minimum.reduceat(cosine, start), -1, 1)
    radius = np.arccos(smallest_cosine) + RADIUS_MARGIN_RAD
    return CellGrid(order, start, count, centre, np.cos(radius), np.sin(radius))


def unit_vectors_icrs(catalog: Catalog, epoch_jyear: float) -> FloatArray:
    """ICRS unit vectors of the catalogue's stars at `epoch_jyear`, shape (n, 3).

    Each star moves in a straight line in space at right angles to its direction at its catalogue's
    epoch (parallax
    and radial velocity zero): u = unit(u0 + t (mu_alpha* p + mu_delta q)), ESA SP-1200 vol. 1 eq.
    1.2.17.
    Nothing divides by cos(dec), so the poles are ordinary points.
    """
    ra = np.radians(catalog.ra_deg)
    dec = np.radians(catalog.dec_deg)
    sin_ra = np.sin(ra)
    cos_ra = np.cos(ra)
    sin_dec = np.sin(dec)
    cos_dec = np.cos(dec)
    years = epoch_jyear - catalog.epoch_jyear
    east = catalog.pm_ra_cosdec_mas_yr * RAD_PER_MAS * years
    north = catalog.pm_dec_mas_yr * RAD_PER_MAS * years
    # One component after the other: millions of stars cost half the time and memory of (n, 3)
    # intermediates.
    u = np.empty((len(ra), 3))
    u[:, 0] = cos_dec * cos_ra + east * -sin_ra + north * (-sin_dec * cos_ra)
    u[:, 1] = cos_dec * sin_ra + east * cos_ra + north * (-sin_dec * sin_ra)
    u[:, 2] = sin_dec + north * cos_dec
    u /= np.sqrt(np.einsum("ij,ij->i", u, u))[:, None]
    return u


def aberrate(
    vectors: FloatArray, observer_velocity_km_s: tuple[float, float, float] | FloatArray
) -> FloatArray:
    """Directions (n, 3) as a moving observer sees them; the velocity is ICRS, barycentric, in km/s.

    The exact special-relativistic formula (Klioner 2003, AJ 125, 1580, eq. 10). The caller keeps
    the speed under that of light.
    """
    beta = np.asarray(observer_velocity_km_s, dtype=np.float64) / LIGHT_KM_S
    gamma_inverse = np.sqrt(1.0 - beta @ beta)
    along = vectors @ beta
    apparent = gamma_inverse * vectors
    apparent = apparent + (1.0 + along / (1.0 + gamma_inverse))[:, None] * beta
    apparent /= (1.0 + along)[:, None]
    return np.asarray(apparent / np.linalg.norm(apparent, axis=1, keepdims=True))
