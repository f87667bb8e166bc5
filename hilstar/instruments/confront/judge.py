"""Photographs against what `simulate` predicts of them with the fitted camera: pixels, sources,
stars that are missing.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import MAD_TO_SIGMA as MAD
from hilstar.basics.units import flux_ratio
from hilstar.instruments.confront.background import EIGHT_NEIGHBOURS, source_mask
from hilstar.instruments.confront.camera_fit import CameraFit, Pointing
from hilstar.instruments.confront.light import BRIGHT_V_MAG
from hilstar.instruments.confront.photographed_sky import planets_seen
from hilstar.instruments.confront.session import MATCH_PX, Session, Shot, within_image
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.camera import Camera
from hilstar.optics.layers.view import STILL
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.star_light import bench_moving
from hilstar.sky.bodies.passes import Cone
from hilstar.sky.stars import make_stars, unit_vectors_icrs

ALL_STARS_MAG = 25.0
LISTED_SNR = 8.0  # from which a source that nothing explains counts
EXPECTED_SNR = 15.0  # expected of a star that is missing where no source is
# pixels whose noise a source's signal has: those of the Gaussian of 1 px by which it was found
NEFF_PX = 4 * math.pi
SAME_LIGHT = 0.15  # a star explains a source where it has so much of its light
# elements are off by 1 to 3 km a day, which is 0.2 degrees at 400 km
SATELLITE_RAD = math.radians(0.2)
PLANET_RAD = math.radians(3 / 60)
EDGE_PX = 3.0  # a star so far outside an image has light on it
HALO_PX = 15.0  # about a saturated star, sources are its own light
LIT_SIGMA, MASK_PX, MAX_CHI = 0.1, 5, 5.0
CELLS = 4
DIM_MAG, DIM_STARS, DIM_SIGMAS = 0.25, 2, 4.0
HOT_SIGMAS, HOT_SHARE = 6.0, 0.75
# of a hot pixel's light that its eight neighbours may have, where stars moved and where not
HOT_LIGHT, ALONE_LIGHT = 0.5, 0.1
MOVED_PX = 5.0  # by which stars move between photographs that tell them from hot pixels
# Hipparcos is complete to 7.3 + 1.1 |sin b| for late types (ESA SP-1200 vol. 1, 1.1). Over the last
# magnitude before it, its own stars grow by 0.477, 0.458 and 0.434 dex a magnitude for |sin b|
# under 0.2, 0.2 to 0.5 and 0.5 to 1.
GALACTIC_POLE = np.array([-0.867666, -0.198076, 0.455984])
COMPLETE_V_MAG, COUNTS_SLOPE = (7.3, 1.1), (0.484, -0.067)
Cell = tuple[int, int]
NOT_COUNTED = frozenset({"saturated", "blended", "missing", "dim region"})


@dataclass(frozen=True, slots=True)
class SourceRow:
    """One source of a photograph and what explains it, empty where nothing does."""

    x_px: float
    y_px: float
    snr: float
    explained_by: str


@dataclass(frozen=True, slots=True)
class StarRow:
    """One star of a photograph: place and DN seen (NaN where it is missing) and predicted, and
    flags.
    """

    star: int
    hip: int
    name: str
    x_px: float
    y_px: float
    x_predicted_px: float
    y_predicted_px: float
    dn: float
    sigma_dn: float
    dn_predicted: float
    v_mag: float
    b_v_mag: float
    flags: tuple[str, ...]

    @property
    def counted(self) -> bool:
        """Whether it counts in rms errors: to V = 6.5, alone, not saturated."""
        return self.v_mag <= BRIGHT_V_MAG and self.stands_alone and self.dn > 0

    @property
    def stands_alone(self) -> bool:
        """Whether nothing spoils its figures: saturation, a neighbour, a cloud."""
        return not NOT_COUNTED & set(self.flags)

    @property
    def figures(self) -> tuple[float, ...]:
        """Those of a row of stars.csv, in its order."""
        measured_px = (self.x_px, self.y_px)
        predicted_px = (self.x_predicted_px, self.y_predicted_px)
        light = (self.dn, self.dn_predicted)
        return *measured_px, *predicted_px, *light, self.v_mag, self.b_v_mag

    @property
    def off_px(self) -> tuple[float, float]:
        """Place seen less predicted, x and y, px."""
        return self.x_px - self.x_predicted_px, self.y_px - self.y_predicted_px

    @property
    def off_mag(self) -> float:
        """Magnitude seen less predicted; NaN without light."""
        if self.dn > 0 and self.dn_predicted > 0:
            return -2.5 * math.log10(self.dn / self.dn_predicted)
        return math.nan


@dataclass(frozen=True, slots=True)
class DatedBy:
    """How far the stars' own motions say that a date is off, years, with one sigma."""

    years: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """How one photograph agrees: figures, tables, and images (height, width): DN predicted, and
    residuals in sigmas.
    """

    shot: Shot
    number: int
    stars: list[StarRow]
    sources: list[SourceRow]
    rms_px: float
    rms_mag: float
    counted: int
    background_chi2: float
    star_chi2: float
    dim: list[str]
    dated: DatedBy | None
    fainter: "Fainter"
    expected: "Expected" = field(repr=False)
    predicted: FloatArray = field(repr=False)
    residual: FloatArray = field(repr=False)

    @property
    def unexplained(self) -> list[SourceRow]:
        """Sources of LISTED_SNR and more that nothing explains."""
        return [
            source
            for source in self.sources
            if not source.explained_by and source.snr >= LISTED_SNR
        ]

    @property
    def missing(self) -> list[StarRow]:
        """Stars that should be there."""
        return [star_row for star_row in self.stars if "missing" in star_row.flags]


@dataclass(frozen=True, slots=True)
class Fainter:
    """Stars that a photograph reaches beyond its catalogue: V to which that is complete and V of
    LISTED_SNR, and how many.
    """

    complete_v_mag: float
    reached_v_mag: float
    expected: float


@dataclass(frozen=True, slots=True)
class Expected:
    """Stars on an image: rows of its sky (n,), places, px, and DN."""

    star: IntArray
    x_px: FloatArray
    y_px: FloatArray
    dn: FloatArray


class Judge:
    """Photographs of a session against `simulate` with a tracker file. Free it with `close`."""

    def __init__(self, session: Session, tracker: Path) -> None:
        self.session = session
        file = read_bench_file(tracker)
        config = file.config
        dated = session.shots[0].sky  # each photograph's air is put before its stars below
        velocity = (0.0, 0.0, 0.0)
        if dated.velocity_km_s is not None:
            velocity = tuple(dated.velocity_km_s.tolist())
        sky = msgspec.structs.replace(
            config.sky,
            faintest_v_mag=ALL_STARS_MAG,
            epoch_utc=None,
            epoch_jyear=dated.epoch_jyear,
            observer_velocity_km_s=velocity,
            bodies=type(config.sky.bodies)(),
        )
        stars_alone = msgspec.structs.replace(
            config, sky=sky, background=type(config.background)(), site=None
        )
        self._simulator = Simulator(replace(file, config=stars_alone), refuse=False)
        self._stars = self._simulator.stars
        self._own_mag = dn_offset_mag(
            config.tracker.exposure_s, config.tracker.detector.gain_e_per_dn
        )
        above_sigmas = (self._above_sigmas(shot) for shot in session.shots)
        self.hot, self.dead = defects(above_sigmas, boresights_moved_px(session.camera) >= MOVED_PX)

    def close(self) -> None:
        """Free the simulator's context."""
        self._simulator.close()

    def _above_sigmas(self, shot: Shot) -> FloatArray:
        """A photograph above its background, in sigmas of its pixels' noise."""
        noise_dn = np.sqrt(self.session.pixels.variance_dn2(shot.level.level))
        return np.asarray(shot.above_dn / noise_dn)

    def of(self, number: int) -> Verdict:
        """The verdict on a photograph."""
        session = self.session
        shot = session.shots[number]
        light_dn = self._light_dn(number)
        level = shot.level.level
        variance = session.pixels.variance_dn2(level)
        gain_e_per_dn = session.pixels.gain_e_per_dn
        residual = in_sigmas(shot.above_dn - light_dn, light_dn, variance, gain_e_per_dn)
        expected = self._expected(number)
        rows = self._rows(number, expected)
        dim, is_dim = _dim_regions(rows, shot.photo.size_px)
        rows = flagged_dim(rows, is_dim)
        light_sigma = light_dn / np.sqrt(variance)
        sources = self._sources(number, light_sigma, expected)
        background = background_of(shot, light_sigma, self.hot, self.dead)
        background_chi2 = chi2_of(residual[background])
        star_chi2 = math.nan
        if shot.clean.any():
            star_chi2 = float(np.median(shot.found.chi2[shot.clean]))
        counted = [row for row in rows if row.counted]
        off_px = np.array([row.off_px for row in counted])
        off_mag = np.array([row.off_mag for row in counted])
        # a star of no positive light has a place and no magnitude
        has_light = np.isfinite(off_mag)
        return Verdict(
            shot=shot,
            number=number,
            stars=rows,
            sources=sources,
            rms_px=_rms(off_px.ravel()),
            rms_mag=_rms(off_mag[has_light]),
            counted=len(counted),
            background_chi2=background_chi2,
            star_chi2=star_chi2,
            dim=dim,
            dated=dated_by(shot, session.camera.pointings[number], session.camera),
            fainter=self._fainter(number, expected),
            expected=expected,
            predicted=level + light_dn,
            residual=residual,
        )

    def _light_dn(self, number: int) -> FloatArray:
        """The stars' light (height, width), DN, by `simulate`'s own code, behind the air of this
        photograph.
        """
        session = self.session
        stars = self._stars
        simulator = self._simulator
        shot = session.shots[number]
        pointing = session.camera.pointings[number]
        air = shot.sky.air
        rate = stars.electrons_per_s
        if air is not None and session.air is not None:
            altitude_rad = air.altitude_rad(stars.vectors)
            rate = rate * session.air.shares(stars.row, altitude_rad)[0]
        if session.light.colours.any() or shot.photo.plane:
            plane_mag = session.plane_mag(number, shot.sky.columns(stars.row))
            rate = rate * flux_ratio(plane_mag)
        # the simulator's stars are sorted by cell of the sky, a catalogue's are by row
        by_row = []
        for column in (pointing.seen(stars.vectors), stars.temperature_k, rate):
            ordered = np.empty_like(column)
            ordered[stars.row] = column
            by_row.append(ordered)
        simulator.stars = make_stars(stars.catalog, *by_row)
        view = simulator.view(pointing.q_icrs_to_cam, STILL)
        exposure = simulator.expose(view, None)
        # the file's quantum efficiency and exposure stand for one zero point, this photograph's air
        # for another
        file_mag = self._own_mag if session.fixed else None
        air_share = session.light.shares(file_mag)[number]
        return np.asarray(exposure.mean_e / session.pixels.gain_e_per_dn * air_share)

    def _expected(self, number: int) -> Expected:
        """Stars of the catalogue whose light is on the photograph."""
        session = self.session
        shot = session.shots[number]
        pointing = session.camera.pointings[number]
        x, y = pointing.places_px(session.camera.camera, shot.sky.vectors)
        star = np.flatnonzero(within_image(x, y, shot.photo.size_px, -EDGE_PX))
        x_px = x[star]
        y_px = y[star]
        return Expected(star, x_px, y_px, session.predicted_dn(number, star, x_px, y_px))

    def _rows(self, number: int, expected: Expected) -> list[StarRow]:
        """Rows of the stars that are seen, and of those that should be."""
        shot = self.session.shots[number]
        stars = shot.found
        place = _places_by_star(expected)
        flags = _flags(shot)
        rows = []
        for k, star in enumerate(shot.star.tolist()):
            if star in place:
                figures = (stars.x_px[k], stars.y_px[k], stars.dn[k], stars.sigma_dn[k])
                rows.append(_star_row(shot, expected, place[star], figures, flags[k]))
        for star in missing_stars(shot, expected, self._pixel_variance(shot)):
            figures = (math.nan,) * 4
            rows.append(_star_row(shot, expected, place[star], figures, ("missing",)))
        return rows

    def _pixel_variance(self, shot: Shot) -> float:
        """The variance of a background pixel, DN^2."""
        variance = self.session.pixels.variance_dn2(shot.level.level)
        return float(np.median(variance))

    def _sources(self, number: int, light_sigma: FloatArray, expected: Expected) -> list[SourceRow]:
        """Every source with its explanation: a planet, a trail, a star, the detector, or a
        bright star's light.
        """
        shot = self.session.shots[number]
        sources = shot.sources
        satellites = {}
        if sources.trail.any():
            satellites = self._satellites(number)
        hot = ndimage.binary_dilation(self.hot, EIGHT_NEIGHBOURS)
        camera = self.session.camera
        explanation = _Explanation(
            shot=shot,
            expected=expected,
            tree=_tree_of(expected),
            planets=planets_on(shot.photo.t_ns, camera.pointings[number], camera.camera),
            satellites=satellites,
            near_saturated=_saturated(shot),
            hot=hot,
            light_sigma=light_sigma,
            pixel_dn=math.sqrt(self._pixel_variance(shot)),
            focal_length_px=camera.camera.focal_length_px,
        )
        rows = []
        for k in range(len(sources)):
            x_px, y_px = sources.places_px[k].tolist()
            rows.append(SourceRow(x_px, y_px, float(sources.snr[k]), explanation.of(k)))
        return rows

    def _satellites(self, number: int) -> dict[str, tuple[float, float]]:
        """Places of satellites in the middle of the exposure, by the bench's list; none without
        a list, a site and a date.
        """
        file = self.session.file
        shot = self.session.shots[number]
        config = file.config
        camera = self.session.camera.camera
        if config.sky.bodies.satellites is None or config.site is None or shot.photo.t_ns is None:
            return {}
        sky = msgspec.structs.replace(
            config.sky, epoch_utc=utc_of(shot.photo.t_ns), epoch_jyear=shot.sky.epoch_jyear
        )
        moving = bench_moving(msgspec.structs.replace(config, sky=sky), file.folder)
        if moving is None or moving.satellites is None:
            return {}
        moving.air = self.session.air
        pointing = self.session.camera.pointings[number]
        exposure_s = shot.photo.exposure_s or 0.0
        field = Cone(pointing.boresight, camera.field_radius_rad(0.0), exposure_s)
        passing = moving.passing(field, 0)
        if passing is None:
            return {}
        directions = passing.directions(slice(None), np.zeros(len(passing)))
        x, y = camera.project(directions @ to_matrix(pointing.q_icrs_to_cam).T)
        places = {}
        for k, x_px, y_px in zip(passing.index, x.tolist(), y.tolist(), strict=True):
            places[moving.satellites.names[k]] = (x_px, y_px)
        return places

    def _fainter(self, number: int, expected: Expected) -> Fainter:
        """How many sources are stars beyond Hipparcos, by its own stars in the image and the
        slope of star counts.
        """
        shot = self.session.shots[number]
        pointing = self.session.camera.pointings[number]
        complete_mag = complete_v_mag(pointing.boresight)
        if not shot.clean.any():
            return Fainter(complete_mag, math.nan, 0.0)
        clean_places_px = shot.found.places_px[shot.clean]
        source = cKDTree(shot.sources.places_px).query(clean_places_px)[1]
        clean_v_mag = shot.sky.v_mag[shot.star[shot.clean]]
        depth_mag = clean_v_mag + 2.5 * np.log10(shot.sources.snr[source])
        reached_mag = float(np.median(depth_mag)) - 2.5 * math.log10(LISTED_SNR)
        if reached_mag <= complete_mag:
            return Fainter(complete_mag, reached_mag, 0.0)
        v_mag = shot.sky.v_mag[expected.star]
        slope = COUNTS_SLOPE[0] + COUNTS_SLOPE[1] * galactic_sine(pointing.boresight)
        expected_stars = stars_beyond(v_mag, complete_mag, reached_mag, slope)
        return Fainter(complete_mag, reached_mag, expected_stars)


def galactic_sine(direction: FloatArray) -> float:
    """The size of the sine of a direction's galactic latitude; direction (3,), ICRS, unit."""
    return abs(float(direction @ GALACTIC_POLE))


def complete_v_mag(direction: FloatArray) -> float:
    """V to which Hipparcos is complete about a direction (3,), ICRS, unit."""
    return COMPLETE_V_MAG[0] + COMPLETE_V_MAG[1] * galactic_sine(direction)


def boresights_moved_px(camera: CameraFit) -> float:
    """How far apart boresights of a camera's photographs are along an axis of the sky, px."""
    boresights = np.array([pointing.boresight for pointing in camera.pointings])
    spread = np.ptp(boresights, axis=0)
    return float(spread.max() * camera.camera.focal_length_px)


def planets_on(
    t_ns: int | None, pointing: Pointing, camera: Camera
) -> dict[str, tuple[float, float]]:
    """Places of planets by name, px, at a UTC, those beyond the image, too; none without a date."""
    if t_ns is None:
        return {}
    planets = planets_seen(t_ns)
    x, y = pointing.places_px(camera, np.array(list(planets.values())))
    places = {}
    for name, x_px, y_px in zip(planets, x.tolist(), y.tolist(), strict=True):
        if math.isfinite(x_px) and math.isfinite(y_px):
            places[name] = (x_px, y_px)
    return places


def missing_stars(shot: Shot, expected: Expected, variance_dn2: float) -> Iterator[int]:
    """Stars, rows of the sky, that should stand out of the noise of background pixels of a
    variance, DN^2, and where no light is.
    """
    place = _places_by_star(expected)
    identified = set(shot.star.tolist())
    near_saturated = _saturated(shot)
    source_tree = cKDTree(shot.sources.places_px)
    in_middle = within_image(expected.x_px, expected.y_px, shot.photo.size_px, 2 * MATCH_PX)
    noise_dn = math.sqrt(variance_dn2 * NEFF_PX)
    above_dn = shot.above_dn
    for star in expected.star[expected.dn > EXPECTED_SNR * noise_dn].tolist():
        k = place[star]
        x = expected.x_px[k]
        y = expected.y_px[k]
        if star in identified or not in_middle[k] or near_saturated(x, y):
            continue
        if source_tree.query([x, y])[0] <= 2 * MATCH_PX:
            continue
        # its light may be part of a larger source
        if light_at(above_dn, x, y) < expected.dn[k] / 2:
            yield star


def background_of(
    shot: Shot, light_sigma: FloatArray, hot: BoolArray, dead: BoolArray
) -> BoolArray:
    """Pixels (height, width) without light of stars and sources, and without defects."""
    lit = np.abs(light_sigma) > LIT_SIGMA
    lit |= source_mask(shot.sources, shot.level.above(shot.photo.dn), MASK_PX)
    return np.asarray(~(lit | hot | dead))


def dated_by(shot: Shot, pointing: Pointing, camera: CameraFit) -> DatedBy | None:
    """How far off a photograph's date is by the stars that move fastest over it; None without
    stars.
    """
    clean = np.flatnonzero(shot.clean)
    if not len(clean):
        return None
    star = shot.star[clean]
    catalog = shot.sky.catalog.taken(shot.sky.order[star])
    epoch_jyear = shot.sky.epoch_jyear
    now = unit_vectors_icrs(catalog, epoch_jyear)
    next_year = unit_vectors_icrs(catalog, epoch_jyear + 1)
    vectors = shot.sky.vectors[star]
    moved = vectors + (next_year - now)
    now_px = np.column_stack(pointing.places_px(camera.camera, vectors))
    next_year_px = np.column_stack(pointing.places_px(camera.camera, moved))
    off_px = shot.found.places_px[clean] - now_px
    floor_px = max(camera.floor_px, 0.02)
    sigma_px = np.hypot(shot.found.sigma_px[clean], floor_px)[:, None]
    motion = (next_year_px - now_px) / sigma_px
    information = max(float((motion**2).sum()), 1e-12)
    years = float((motion * off_px / sigma_px).sum()) / information
    return DatedBy(years, information**-0.5)


def dn_offset_mag(exposure_s: float, gain_e_per_dn: float) -> float:
    """Magnitude of the DN of an exposure less that of electrons per second."""
    return -2.5 * math.log10(max(exposure_s, 1e-12) / gain_e_per_dn)


def flagged_dim(rows: Sequence[StarRow], is_dim: Callable[[StarRow], bool]) -> list[StarRow]:
    """Rows of stars, with a flag on those that were seen in a dim region."""
    flagged = []
    for row in rows:
        if is_dim(row) and "missing" not in row.flags:
            flagged.append(replace(row, flags=(*row.flags, "dim region")))
        else:
            flagged.append(row)
    return flagged


def stars_beyond(v_mag: FloatArray, complete_mag: float, reached_mag: float, slope: float) -> float:
    """How many stars to V = `reached_mag` a catalogue of stars (n,) lacks that is complete to
    `complete_mag`, by star counts that grow by `slope` dex a magnitude.
    """
    growth = 10 ** (slope * (reached_mag - complete_mag))
    all_stars = float((v_mag <= complete_mag).sum()) * growth
    catalogued = float((v_mag <= reached_mag).sum())
    return max(all_stars - catalogued, 0.0)


def defects(photographs: Iterable[FloatArray], have_moved: bool) -> tuple[BoolArray, BoolArray]:
    """Pixels (height, width) that are bright, or dark, in nearly all of several photographs, each
    above its background in sigmas; `have_moved` is whether their stars are on other pixels in each.
    """
    # stars that did not move may have one pixel in each photograph, too: of these, pixels that
    # share nothing at all with their neighbours
    if have_moved:
        share, unsure = HOT_LIGHT, 3.0
    else:
        share, unsure = ALONE_LIGHT, 2.0
    bright_counts: IntArray = np.zeros(1, dtype=np.int64)
    dark_counts: IntArray = np.zeros(1, dtype=np.int64)
    count = 0
    for sigmas in photographs:
        count += 1
        # the sum of the eight neighbours: a star's light is there too
        around = ndimage.uniform_filter(sigmas, 3) * 9 - sigmas
        is_alone = around < share * np.abs(sigmas) + unsure * math.sqrt(8)
        bright_counts = bright_counts + ((sigmas > HOT_SIGMAS) & is_alone)
        dark_counts = dark_counts + (sigmas < -HOT_SIGMAS)
    minimum = max(1, math.ceil(HOT_SHARE * count))
    return bright_counts >= minimum, dark_counts >= minimum


def in_sigmas(
    off_dn: FloatArray, light_dn: FloatArray, variance_dn2: FloatArray, gain_e_per_dn: float
) -> FloatArray:
    """What a photograph has beyond its prediction (height, width), DN, in sigmas of the background
    and of the predicted light's own shot noise.
    """
    star_variance = np.maximum(light_dn, 0) / gain_e_per_dn
    return np.asarray(off_dn / np.sqrt(variance_dn2 + star_variance))


def chi2_of(sigmas: FloatArray) -> float:
    """The mean square of background pixels (n,), without those beyond MAX_CHI; NaN of none."""
    near = sigmas[np.abs(sigmas) < MAX_CHI]
    if len(near):
        return float((near**2).mean())
    return math.nan


def utc_of(t_ns: int) -> str:
    """A time, ns of UTC, as a bench file has it, to the millisecond."""
    return f"{np.datetime64(t_ns, 'ns').astype('datetime64[ms]')}Z"


def light_at(above_dn: FloatArray, x_px: float, y_px: float) -> float:
    """The light, DN, of the 5 x 5 pixels about a place in an image (height, width) above its
    background.
    """
    column = round(x_px)
    row = round(y_px)
    return float(above_dn[row - 2 : row + 3, column - 2 : column + 3].sum())


def _places_by_star(expected: Expected) -> dict[int, int]:
    """Numbers of expected stars by their rows of the sky."""
    return {star: k for k, star in enumerate(expected.star.tolist())}


def _flags(shot: Shot) -> list[tuple[str, ...]]:
    """What may spoil the figures of each star of a shot."""
    _, double, variable = shot.sky.within(shot.star)
    masks = {
        "saturated": shot.saturated,
        "blended": shot.blended,
        "double": double,
        "variable": variable,
    }
    flags = []
    for k in range(len(shot.star)):
        star_flags = [name for name, mask in masks.items() if mask is not None and mask[k]]
        flags.append(tuple(star_flags))
    return flags


def _star_row(
    shot: Shot, expected: Expected, k: int, figures: Iterable[float], flags: tuple[str, ...]
) -> StarRow:
    """The row of expected star `k`, with the `figures` that were measured: x and y, px, DN and its
    sigma.
    """
    star = int(expected.star[k])
    catalog = shot.sky.catalog
    row = int(shot.sky.order[star])
    x_px, y_px, dn, sigma_dn = (float(value) for value in figures)
    return StarRow(
        star=star,
        hip=int(catalog.hip[row]),
        name=shot.sky.name(star),
        x_px=x_px,
        y_px=y_px,
        x_predicted_px=float(expected.x_px[k]),
        y_predicted_px=float(expected.y_px[k]),
        dn=dn,
        sigma_dn=sigma_dn,
        dn_predicted=float(expected.dn[k]),
        v_mag=float(catalog.v_mag[row]),
        b_v_mag=float(catalog.bv_mag[row]),
        flags=flags,
    )


def _tree_of(expected: Expected) -> cKDTree | None:
    if len(expected.star):
        return cKDTree(np.column_stack([expected.x_px, expected.y_px]))
    return None


@dataclass(frozen=True, slots=True)
class _Explanation:
    """What a photograph's sources may be: `planets` and `satellites` by name, px, the expected
    stars and their `tree`, and hot pixels (height, width).
    """

    shot: Shot
    expected: Expected
    tree: cKDTree | None
    planets: dict[str, tuple[float, float]]
    satellites: dict[str, tuple[float, float]]
    near_saturated: Callable[[float, float], bool]
    hot: BoolArray
    light_sigma: FloatArray
    pixel_dn: float
    focal_length_px: float

    def of(self, k: int) -> str:
        """What source `k` is; empty where nothing explains it."""
        sources = self.shot.sources
        place = (float(sources.x_px[k]), float(sources.y_px[k]))
        planet = _named_near(self.planets, place, max(3.0, PLANET_RAD * self.focal_length_px))
        if planet:
            return planet
        length_px = sources.length_px[k]
        if sources.trail[k]:
            reach_px = length_px / 2 + SATELLITE_RAD * self.focal_length_px
            satellite = _named_near(self.satellites, place, reach_px) or "a trail"
            return f"{satellite}, {length_px:.0f} px long"
        star = self._brightest_star(k, place)
        if star is not None:
            return self.shot.sky.name(star)
        return self._artefact(k, place)

    def _artefact(self, k: int, place: tuple[float, float]) -> str:
        """What of the detector, or of a bright light beside it, source `k` is; empty if none."""
        x_px, y_px = place
        sources = self.shot.sources
        height, width = self.light_sigma.shape
        column = min(max(round(x_px), 0), width - 1)
        row = min(max(round(y_px), 0), height - 1)
        if self.hot[row, column]:
            return "a hot pixel"
        if sources.single[k]:
            return "one pixel: hot, or a cosmic ray"
        if self._beside_trail(place):
            return "beside a trail"
        if self.near_saturated(x_px, y_px) or self.light_sigma[row, column] > sources.snr[k] / 4:
            return "light of a bright star"
        return ""

    def _brightest_star(self, k: int, place: tuple[float, float]) -> int | None:
        """The brightest star at a source, a row of the sky; None where all stars there are too
        faint for its light.
        """
        if self.tree is None:
            return None
        sources = self.shot.sources
        radius_px = max(MATCH_PX + 0.5, sources.length_px[k] / 2)
        beside = self.tree.query_ball_point(place, radius_px)
        if not beside:
            return None
        minimum_dn = SAME_LIGHT * sources.snr[k] * self.pixel_dn * math.sqrt(NEFF_PX)
        stars_dn = self.expected.dn[beside]
        if stars_dn.sum() <= minimum_dn:
            return None
        return int(self.expected.star[beside[int(stars_dn.argmax())]])

    def _beside_trail(self, place: tuple[float, float]) -> bool:
        sources = self.shot.sources
        for k in np.flatnonzero(sources.trail):
            reach_px = sources.length_px[k] / 2 + MASK_PX
            if math.dist(place, sources.places_px[k]) < reach_px:
                return True
        return False


def _named_near(
    places: dict[str, tuple[float, float]], place: tuple[float, float], reach_px: float
) -> str:
    """The first name whose place is within a reach; empty without any."""
    for name, named_place in places.items():
        if math.dist(named_place, place) < reach_px:
            return name
    return ""


def _rms(values: FloatArray) -> float:
    if len(values):
        return math.sqrt(float((values**2).mean()))
    return math.nan


def _saturated(shot: Shot) -> Callable[[float, float], bool]:
    """Whether a place is near a saturated star."""
    mask = shot.saturated
    if mask is None:
        mask = np.zeros(len(shot.star), dtype=bool)
    star_x_px = shot.found.x_px[mask]
    star_y_px = shot.found.y_px[mask]

    def near(x_px: float, y_px: float) -> bool:
        distances_px = np.hypot(star_x_px - x_px, star_y_px - y_px)
        return bool((distances_px < HALO_PX).any())

    return near


@dataclass(frozen=True, slots=True)
class _CellStars:
    """Stars of a part of the image, how many of them are missing, and by how much the others are
    too faint, mag.
    """

    count: int
    missing: int
    off_mag: float


def _dim_regions(
    rows: Sequence[StarRow], size_px: tuple[int, int]
) -> tuple[list[str], Callable[[StarRow], bool]]:
    """Parts of the image whose stars are missing or dim, in words, and whether a star is in one
    of them.
    """
    trusted = [row for row in rows if _is_trusted(row)]
    off_mag = np.array([row.off_mag for row in trusted if row.dn > 0])
    spread_mag = 0.1
    if len(off_mag):
        spread_mag = MAD * float(np.median(np.abs(off_mag)))
    cells: dict[Cell, list[StarRow]] = {}
    for row in trusted:
        cells.setdefault(_cell(row, size_px), []).append(row)
    dim: dict[Cell, _CellStars] = {}
    for place, cell_rows in cells.items():
        stars, is_dim = _judged_cell(cell_rows, spread_mag)
        if is_dim:
            dim[place] = stars
    quarters: dict[str, list[_CellStars]] = {}
    for (down, across), stars in dim.items():
        vertical = ("upper", "lower")[2 * down >= CELLS]
        horizontal = ("left", "right")[2 * across >= CELLS]
        quarters.setdefault(f"{vertical} {horizontal}", []).append(stars)
    region_texts = [_region_text(name, stars) for name, stars in quarters.items()]
    faint_mag = max(DIM_MAG, DIM_SIGMAS * spread_mag)

    def in_dim(row: StarRow) -> bool:
        down, across = _cell(row, size_px)
        around = itertools.product((down - 1, down, down + 1), (across - 1, across, across + 1))
        return row.off_mag > faint_mag and not dim.keys().isdisjoint(around)

    return region_texts, in_dim


def _is_trusted(row: StarRow) -> bool:
    """Whether a star tells of its part of the image: missing, or bright and alone."""
    if "missing" in row.flags:
        return True
    return row.stands_alone and row.dn > EXPECTED_SNR * row.sigma_dn


def _cell(row: StarRow, size_px: tuple[int, int]) -> Cell:
    """Row and column of the cell of the image, of CELLS by CELLS, that has a star."""
    width, height = size_px
    down = int(CELLS * max(row.y_predicted_px / height, 0))
    across = int(CELLS * max(row.x_predicted_px / width, 0))
    return min(down, CELLS - 1), min(across, CELLS - 1)


def _judged_cell(rows: Sequence[StarRow], spread_mag: float) -> tuple[_CellStars, bool]:
    """The stars of a cell, and whether they are dim: half of them missing, or the rest fainter
    than their spread allows.
    """
    missing = sum("missing" in row.flags for row in rows)
    off_mag = np.array([row.off_mag for row in rows if row.dn > 0])
    middle_mag = math.nan
    is_faint = False
    if len(off_mag):
        middle_mag = float(np.median(off_mag))
        error_mag = spread_mag / math.sqrt(len(off_mag))
        is_faint = middle_mag > max(DIM_MAG, DIM_SIGMAS * error_mag)
    is_dim = len(rows) >= DIM_STARS and (2 * missing >= len(rows) or is_faint)
    return _CellStars(len(rows), missing, middle_mag), is_dim


def _region_text(name: str, cells: Sequence[_CellStars]) -> str:
    """A quarter of the image whose stars are missing or dim, in words."""
    missing = sum(stars.missing for stars in cells)
    count = sum(stars.count for stars in cells)
    depth_mag = [stars.off_mag for stars in cells if math.isfinite(stars.off_mag)]
    depth = ""
    if depth_mag:
        depth = f", those seen {np.median(depth_mag):.2f} mag too faint"
    return (
        f"{name}: {missing} of {count} stars are missing{depth}: cloud, an obstacle, or vignetting"
    )
