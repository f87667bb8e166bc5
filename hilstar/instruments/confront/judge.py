"""Photographs against what `simulate` predicts of them with the fitted camera: pixels, sources,
stars that are missing.
"""

import math
from collections.abc import Callable, Iterable, Sequence
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
from hilstar.instruments.confront.light import BRIGHT_V_MAG
from hilstar.instruments.confront.photographed_sky import planets_seen
from hilstar.instruments.confront.session import MATCH_PX, Session, Shot
from hilstar.instruments.simulate.simulator import Simulator
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
HOT_SIGMAS, HOT_SHARE, HOT_LIGHT = 6.0, 0.75, 0.5
MOVED_PX = 5.0  # by which stars move between photographs that tell them from hot pixels
# Hipparcos is complete to 7.3 + 1.1 |sin b| for late types (ESA SP-1200 vol. 1, 1.1). Over the last
# magnitude before it, its own stars grow by 0.477, 0.458 and 0.434 dex a magnitude for |sin b|
# under 0.2, 0.2 to 0.5 and 0.5 to 1.
GALACTIC_POLE = np.array([-0.867666, -0.198076, 0.455984])
COMPLETE_V_MAG, COUNTS_SLOPE = (7.3, 1.1), (0.484, -0.067)
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
        return self.v_mag <= BRIGHT_V_MAG and not NOT_COUNTED & set(self.flags) and self.dn > 0

    @property
    def figures(self) -> tuple[float, ...]:
        """Those of a row of stars.csv, in its order."""
        seen_px = (self.x_px, self.y_px)
        predicted = (self.x_predicted_px, self.y_predicted_px)
        return *seen_px, *predicted, self.dn, self.dn_predicted, self.v_mag, self.b_v_mag

    @property
    def off_mag(self) -> float:
        """Seen less predicted, mag."""
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
        if dated.velocity_km_s is None:
            velocity = (0.0, 0.0, 0.0)
        else:
            velocity = tuple(dated.velocity_km_s.tolist())
        sky = msgspec.structs.replace(
            config.sky,
            faintest_v_mag=ALL_STARS_MAG,
            epoch_utc=None,
            epoch_jyear=dated.epoch_jyear,
            observer_velocity_km_s=velocity,
            bodies=type(config.sky.bodies)(),
        )
        config = msgspec.structs.replace(
            config, sky=sky, background=type(config.background)(), site=None
        )
        self._simulator = Simulator(replace(file, config=config), refuse=False)
        self._stars = self._simulator.stars
        tracker_keys = config.tracker
        self._own_mag = -2.5 * math.log10(
            max(tracker_keys.exposure_s, 1e-12) / tracker_keys.detector.gain_e_per_dn
        )
        self.hot, self.dead = self._defects()

    def close(self) -> None:
        """Free the simulator's context."""
        self._simulator.close()

    def _defects(self) -> tuple[BoolArray, BoolArray]:
        """Pixels (height, width) that are bright, or dark, in nearly all of several photographs
        whose stars moved.
        """
        session = self.session
        shape = session.shots[0].photo.dn.shape
        counts = np.zeros((2, *shape), dtype=np.int16)
        for shot in session.shots:
            off = (shot.photo.dn - shot.level.level) / np.sqrt(
                session.pixels.variance_dn2(shot.level.level)
            )
            # what the eight about it have: a star's light is there too
            around = ndimage.uniform_filter(off, 3) * 9 - off
            alone = around < HOT_LIGHT * np.abs(off) + 3 * math.sqrt(8)
            counts[0] += (off > HOT_SIGMAS) & alone
            counts[1] += off < -HOT_SIGMAS
        least = max(1, math.ceil(HOT_SHARE * len(session.shots)))
        axes = np.array(
            [to_matrix(pointing.q_icrs_to_cam)[2] for pointing in session.camera.pointings]
        )
        moved_px = np.ptp(axes, axis=0).max() * session.camera.camera.focal_length_px
        # stars too may have one pixel, in each photograph: what no neighbour shares at all
        if moved_px < MOVED_PX:
            counts[0] *= around < 0.1 * np.abs(off) + 2 * math.sqrt(8)
        return counts[0] >= least, counts[1] >= least

    def of(self, number: int) -> Verdict:
        """The verdict on a photograph."""
        session = self.session
        shot = self.session.shots[number]
        light_dn = self._light_dn(number)
        level = shot.level.level
        variance = session.pixels.variance_dn2(level)
        noise = np.sqrt(variance + np.maximum(light_dn, 0) / session.pixels.gain_e_per_dn)
        residual = (shot.photo.dn - level - light_dn) / noise
        expected = self._expected(number)
        rows = self._rows(number, expected)
        dim, cells = _dim_regions(rows, shot.photo.size_px)
        rows = [
            (
                replace(row, flags=(*row.flags, "dim region"))
                if cells(row) and "missing" not in row.flags
                else row
            )
            for row in rows
        ]
        light_sigma = light_dn / np.sqrt(variance)
        chi = residual[self._background(shot, light_sigma)]
        chi = chi[np.abs(chi) < MAX_CHI]
        counted = [row for row in rows if row.counted]
        off = np.array(
            [(row.x_px - row.x_predicted_px, row.y_px - row.y_predicted_px) for row in counted]
        ).reshape(-1, 2)
        mag = np.array([row.off_mag for row in counted])
        return Verdict(
            shot=shot,
            number=number,
            stars=rows,
            sources=self._sources(number, light_sigma, expected),
            rms_px=_rms(off.ravel()),
            rms_mag=_rms(mag[np.isfinite(mag)]),
            counted=len(counted),
            background_chi2=float((chi**2).mean()) if len(chi) else math.nan,
            star_chi2=(
                float(np.median(shot.found.chi2[shot.clean])) if shot.clean.any() else math.nan
            ),
            dim=dim,
            dated=self._dated(number),
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
        shot = self.session.shots[number]
        pointing = session.camera.pointings[number]
        air = shot.sky.air
        rate = stars.electrons_per_s
        if air is not None and session.air is not None:
            rate = rate * session.air.shares(stars.row, air.altitude_rad(stars.vectors))[0]
        if session.light.colours.any() or shot.photo.plane:
            rate = rate * flux_ratio(session.plane_mag(number, shot.sky.columns(stars.row)))
        columns = (pointing.seen(stars.vectors), stars.temperature_k, rate)
        by_row = [np.empty_like(column) for column in columns]
        for ordered, column in zip(by_row, columns, strict=True):
            ordered[stars.row] = column
        simulator.stars = make_stars(stars.catalog, *by_row)
        exposure = simulator.expose(simulator.view(pointing.q_icrs_to_cam, STILL), None)
        # the file's quantum efficiency and exposure stand for one zero point, this photograph's air
        # for another
        offsets = session.light.offsets_mag
        air_mag = offsets[number] - (self._own_mag if session.fixed else offsets.mean())
        return np.asarray(exposure.mean_e / session.pixels.gain_e_per_dn * 10 ** (-0.4 * air_mag))

    def _expected(self, number: int) -> Expected:
        session = self.session
        shot = self.session.shots[number]
        width, height = shot.photo.size_px
        x, y = session.camera.pointings[number].places_px(session.camera.camera, shot.sky.vectors)
        with np.errstate(invalid="ignore"):
            star = np.flatnonzero(
                (x > -EDGE_PX)
                & (x < width - 1 + EDGE_PX)
                & (y > -EDGE_PX)
                & (y < height - 1 + EDGE_PX)
            )
        return Expected(
            star, x[star], y[star], session.predicted_dn(number, star, x[star], y[star])
        )

    def _rows(self, number: int, expected: Expected) -> list[StarRow]:
        """Rows of the stars that are seen, and of those that should be."""
        shot = self.session.shots[number]
        sky = shot.sky
        found = shot.found
        _, double, variable = sky.within(shot.star)
        place = {star: k for k, star in enumerate(expected.star.tolist())}
        v_mag = sky.v_mag
        bv_mag = sky.bv_mag
        hip = sky.hip
        kinds = {
            "saturated": shot.saturated,
            "blended": shot.blended,
            "double": double,
            "variable": variable,
        }

        def row(star: int, seen: Iterable[float], flags: tuple[str, ...]) -> StarRow:
            x, y, dn, sigma = (float(value) for value in seen)
            k = place[star]
            predicted = float(expected.x_px[k]), float(expected.y_px[k])
            light = float(expected.dn[k])
            v = float(v_mag[star])
            bv = float(bv_mag[star])
            return StarRow(
                star,
                int(hip[star]),
                sky.name(star),
                x,
                y,
                *predicted,
                dn,
                sigma,
                light,
                v,
                bv,
                flags,
            )

        rows = []
        for k, star in enumerate(shot.star.tolist()):
            flags = tuple(name for name, which in kinds.items() if which is not None and which[k])
            if star in place:
                rows.append(
                    row(star, (found.x_px[k], found.y_px[k], found.dn[k], found.sigma_dn[k]), flags)
                )
        noise = math.sqrt(
            float(np.median(self.session.pixels.variance_dn2(shot.level.level))) * NEFF_PX
        )
        width, height = shot.photo.size_px
        near = _saturated(shot)
        sources = cKDTree(np.column_stack([shot.sources.x_px, shot.sources.y_px]))
        seen = set(shot.star.tolist())
        for star in expected.star[expected.dn > EXPECTED_SNR * noise].tolist():
            x = expected.x_px[place[star]]
            y = expected.y_px[place[star]]
            inside = (
                2 * MATCH_PX < x < width - 1 - 2 * MATCH_PX
                and 2 * MATCH_PX < y < height - 1 - 2 * MATCH_PX
            )
            if star in seen or not inside or near(x, y) or sources.query([x, y])[0] <= 2 * MATCH_PX:
                continue
            # its light may be part of a larger source
            box = np.s_[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3]
            if (shot.photo.dn[box] - shot.level.level[box]).sum() < expected.dn[place[star]] / 2:
                rows.append(row(star, (math.nan,) * 4, ("missing",)))
        return rows

    def _sources(self, number: int, light_sigma: FloatArray, expected: Expected) -> list[SourceRow]:
        """Every source with its explanation: a planet, a trail, a star, the detector, or a
        bright star's light.
        """
        session = self.session
        shot = self.session.shots[number]
        sources = shot.sources
        sky = shot.sky
        if len(expected.star):
            tree = cKDTree(np.column_stack([expected.x_px, expected.y_px]))
        else:
            tree = None
        planets = self._planets(number)
        satellites = self._satellites(number) if sources.trail.any() else {}
        pixel_dn = math.sqrt(float(np.median(session.pixels.variance_dn2(shot.level.level))))
        near = _saturated(shot)
        hot = ndimage.binary_dilation(self.hot, EIGHT_NEIGHBOURS)
        height, width = light_sigma.shape
        trails = [
            (sources.x_px[k], sources.y_px[k], sources.length_px[k] / 2 + MASK_PX)
            for k in np.flatnonzero(sources.trail)
        ]
        reach = max(3.0, PLANET_RAD * session.camera.camera.focal_length_px)

        def why(k: int) -> str:
            at = float(sources.x_px[k]), float(sources.y_px[k])
            planet = next(
                (name for name, place in planets.items() if math.dist(place, at) < reach), ""
            )
            if planet or sources.trail[k]:
                reach_px = (
                    sources.length_px[k] / 2 + SATELLITE_RAD * session.camera.camera.focal_length_px
                )
                name = next(
                    (name for name, place in satellites.items() if math.dist(place, at) < reach_px),
                    "a trail",
                )
                return planet or f"{name}, {sources.length_px[k]:.0f} px long"
            light_dn = SAME_LIGHT * sources.snr[k] * pixel_dn * math.sqrt(NEFF_PX)
            beside = (
                []
                if tree is None
                else tree.query_ball_point(at, max(MATCH_PX + 0.5, sources.length_px[k] / 2))
            )
            if beside and expected.dn[beside].sum() > light_dn:
                return sky.name(int(expected.star[max(beside, key=lambda j: expected.dn[j])]))
            column, row = (
                min(max(round(at[0]), 0), width - 1),
                min(max(round(at[1]), 0), height - 1),
            )
            if hot[row, column] or sources.single[k]:
                return "a hot pixel" if hot[row, column] else "one pixel: hot, or a cosmic ray"
            if any(math.dist(at, (x, y)) < half for x, y, half in trails):
                return "beside a trail"
            return (
                "light of a bright star"
                if near(*at) or light_sigma[row, column] > sources.snr[k] / 4
                else ""
            )

        return [
            SourceRow(float(sources.x_px[k]), float(sources.y_px[k]), float(sources.snr[k]), why(k))
            for k in range(len(sources))
        ]

    def _planets(self, number: int) -> dict[str, tuple[float, float]]:
        shot = self.session.shots[number]
        if shot.photo.t_ns is None:
            return {}
        planets = planets_seen(shot.photo.t_ns)
        camera = self.session.camera
        x, y = camera.pointings[number].places_px(camera.camera, np.array(list(planets.values())))
        return {
            n: (float(a), float(b))
            for n, a, b in zip(planets, x, y, strict=True)
            if math.isfinite(a) and math.isfinite(b)
        }

    def _satellites(self, number: int) -> dict[str, tuple[float, float]]:
        """Places of satellites in the middle of the exposure, by the bench's list; none without
        a list, a site and a date.
        """
        file = self.session.file
        photo = self.session.shots[number].photo
        config = file.config
        camera = self.session.camera
        if config.sky.bodies.satellites is None or config.site is None or photo.t_ns is None:
            return {}
        utc = f"{np.datetime64(photo.t_ns, 'ns').astype('datetime64[ms]')}Z"
        sky = msgspec.structs.replace(
            config.sky, epoch_utc=utc, epoch_jyear=self.session.shots[number].sky.epoch_jyear
        )
        moving = bench_moving(msgspec.structs.replace(config, sky=sky), file.folder)
        pointing = camera.pointings[number]
        if moving is None or moving.satellites is None:
            return {}
        moving.air = self.session.air
        passing = moving.passing(
            Cone(pointing.boresight, camera.camera.field_radius_rad(0.0), photo.exposure_s or 0.0),
            0,
        )
        if passing is None:
            return {}
        directions = passing.directions(slice(None), np.zeros(len(passing)))
        x, y = camera.camera.project(directions @ to_matrix(pointing.q_icrs_to_cam).T)
        return {
            moving.satellites.names[k]: (float(a), float(b))
            for k, a, b in zip(passing.index, x, y, strict=True)
        }

    def _background(self, shot: Shot, light_sigma: FloatArray) -> BoolArray:
        """Pixels without light of stars and sources."""
        lit = np.abs(light_sigma) > LIT_SIGMA
        lit |= source_mask(shot.sources, shot.level.above(shot.photo.dn), MASK_PX)
        return np.asarray(~(lit | self.hot | self.dead))

    def _fainter(self, number: int, expected: Expected) -> Fainter:
        """How many sources are stars beyond Hipparcos, by its own stars in the image and the
        slope of star counts.
        """
        shot = self.session.shots[number]
        sine = abs(float(self.session.camera.pointings[number].boresight @ GALACTIC_POLE))
        complete = COMPLETE_V_MAG[0] + COMPLETE_V_MAG[1] * sine
        if not shot.clean.any():
            return Fainter(complete, math.nan, 0.0)
        places = np.column_stack([shot.found.x_px, shot.found.y_px])[shot.clean]
        near = cKDTree(np.column_stack([shot.sources.x_px, shot.sources.y_px])).query(places)[1]
        depth = shot.sky.v_mag[shot.star[shot.clean]] + 2.5 * np.log10(shot.sources.snr[near])
        reached = float(np.median(depth)) - 2.5 * math.log10(LISTED_SNR)
        v_mag = shot.sky.v_mag[expected.star]
        every = float((v_mag <= complete).sum()) * 10 ** (
            (COUNTS_SLOPE[0] + COUNTS_SLOPE[1] * sine) * (reached - complete)
        )
        return Fainter(
            complete,
            reached,
            max(every - float((v_mag <= reached).sum()), 0.0) if reached > complete else 0.0,
        )

    def _dated(self, number: int) -> DatedBy | None:
        """How far off the date is by the stars that move fastest over the image; None without
        stars.
        """
        shot = self.session.shots[number]
        session = self.session
        use = np.flatnonzero(shot.clean)
        if not len(use):
            return None
        star = shot.star[use]
        some = shot.sky.catalog.taken(shot.sky.order[star])
        later = unit_vectors_icrs(some, shot.sky.epoch_jyear + 1) - unit_vectors_icrs(
            some, shot.sky.epoch_jyear
        )
        pointing = session.camera.pointings[number]
        camera = session.camera.camera
        vectors = shot.sky.vectors[star]
        here, there = (
            np.column_stack(pointing.places_px(camera, part)) for part in (vectors, vectors + later)
        )
        off = np.column_stack([shot.found.x_px[use], shot.found.y_px[use]]) - here
        sigma = np.hypot(shot.found.sigma_px[use], max(session.camera.floor_px, 0.02))[:, None]
        motion = (there - here) / sigma
        information = float((motion**2).sum())
        return DatedBy(
            float((motion * off / sigma).sum()) / max(information, 1e-12),
            max(information, 1e-12) ** -0.5,
        )


def _rms(values: FloatArray) -> float:
    if len(values):
        return math.sqrt(float((values**2).mean()))
    return math.nan


def _saturated(shot: Shot) -> Callable[[float, float], bool]:
    """Whether a place is near a saturated star."""
    if shot.saturated is None:
        mask = np.zeros(0, dtype=bool)
    else:
        mask = shot.saturated
    x = shot.found.x_px[mask]
    y = shot.found.y_px[mask]
    return lambda a, b: bool((np.hypot(x - a, y - b) < HALO_PX).any())


def _dim_regions(
    rows: Sequence[StarRow], size_px: tuple[int, int]
) -> tuple[list[str], Callable[[StarRow], bool]]:
    """Parts of the image whose stars are missing or dim, in words, and whether a star is in one
    of them.
    """
    width, height = size_px
    cells: dict[tuple[int, int], list[StarRow]] = {}

    def cell(row: StarRow) -> tuple[int, int]:
        across = row.x_predicted_px / width
        down = row.y_predicted_px / height
        return min(int(CELLS * max(down, 0)), CELLS - 1), min(
            int(CELLS * max(across, 0)), CELLS - 1
        )

    trusted = [
        r
        for r in rows
        if "missing" in r.flags
        or (not NOT_COUNTED & set(r.flags) and r.dn > EXPECTED_SNR * r.sigma_dn)
    ]
    for row in trusted:
        cells.setdefault(cell(row), []).append(row)
    dim: dict[tuple[int, int], tuple[int, int, float]] = {}
    if len(every := np.array([r.off_mag for r in trusted if r.dn > 0])):
        spread = MAD * float(np.median(np.abs(every)))
    else:
        spread = 0.1
    for place, some in cells.items():
        lost = sum("missing" in r.flags for r in some)
        off = np.array([r.off_mag for r in some if r.dn > 0])
        middle = float(np.median(off)) if len(off) else math.nan
        if len(some) >= DIM_STARS and (
            2 * lost >= len(some)
            or middle > max(DIM_MAG, DIM_SIGMAS * spread / math.sqrt(len(off)))
        ):
            dim[place] = lost, len(some), middle
    parts: dict[str, list[tuple[int, int, float]]] = {}
    for (down, across), found in dim.items():
        name = f"{('upper', 'lower')[2 * down >= CELLS]} {('left', 'right')[2 * across >= CELLS]}"
        parts.setdefault(name, []).append(found)
    region_texts = []
    for name, every_cell in parts.items():
        lost = sum(cell_counts[0] for cell_counts in every_cell)
        count = sum(cell_counts[1] for cell_counts in every_cell)
        depth = [cell_counts[2] for cell_counts in every_cell if math.isfinite(cell_counts[2])]
        if depth:
            deep = f", those seen {np.median(depth):.2f} mag too faint"
        else:
            deep = ""
        region_texts.append(
            f"{name}: {lost} of {count} stars are missing{deep}: cloud, an obstacle, or vignetting"
        )
    faint = max(DIM_MAG, DIM_SIGMAS * spread)

    def in_dim(row: StarRow) -> bool:
        down, across = cell(row)
        beside = any((down + a, across + b) in dim for a in (-1, 0, 1) for b in (-1, 0, 1))
        return beside and row.off_mag > faint

    return region_texts, in_dim
