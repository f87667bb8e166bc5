"""The comparison: each star that the twin sees against itself in the image of the sky, and the
geometry that explains the rest.

The smallest model that explains where stars are shown is fitted by least squares. A star of
direction d is drawn where the assumed lens has it, and seen at d', from where the true lens shows
that place. So d is a polynomial of d', in focal lengths from the middle of the detector: d = z d'
(1 + k1 r'^2 + ...) + shift for a true lens where an ideal one is assumed, whatever their size; the
screen's tilt (a, b) adds d' (a y' - b x') to first order. Stars too close for the tracker to
separate (blends) count as one, at the centroid of their light.
"""

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import magnitude
from hilstar.display.calibration import Calibration
from hilstar.instruments.simulate.bench_geometry import BenchGeometry, Mirror
from hilstar.instruments.simulate.star_finder import (
    WING_SIGMAS,
    Matched,
    StarFinder,
    crowded,
    faintest_e_per_s,
    inside_by,
    nearest,
    neighbours,
    shared,
    star_finder,
)
from hilstar.instruments.simulate.twin import Twin, TwinField, true_calibration
from hilstar.optics.camera import Camera
from hilstar.optics.psf import Psf
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.moving_sky import wide_bodies
from hilstar.server.bench.star_size import StarSize, star_size
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.centroids import (
    Centroids,
    estimate_background,
    find_stars,
    noisiest_background,
)

MIN_RESIDUALS = 3  # to an unknown
MIN_STARS = 6  # for a scale, a rotation and a shift: twelve residuals, four unknowns
# A model explains a field where no larger one leaves much less: a quarter, and a tenth of the
# limit, beyond the best.
ENOUGH, ENOUGH_OF_LIMIT = 1.25, 0.1
# a star that is off by more than 6 medians and the limit is left out: 1e-11 of Gaussian errors are
TRIMS, WILD = 3, 6.0
ALIGNED, LENS, TILT, HIGHER, DECENTRED = "aligned", "lens", "tilt", "higher", "decentred"
MODELS = (
    (ALIGNED,),
    (ALIGNED, LENS),
    (ALIGNED, TILT),
    (ALIGNED, TILT, LENS),
    (ALIGNED, TILT, LENS, HIGHER),
    (ALIGNED, TILT, LENS, HIGHER, DECENTRED),
)
# Two equal Gaussians have one peak up to 2 sigmas, and a faint one disappears beside a bright one
# farther out. The windowed centroid of a pair is off the centre of its light by 0.02 sigma at 1
# sigma, 0.06 at 1.4 (tests/unit/instruments/simulate/test_blends.py).
BLEND_SIGMAS = 1.5
# The glow that a missing black level adds is noticed at this share of the faintest drawn star's
# light, per pixel of its disc.
BLACK_SHARE = 0.1
MIRRORS: tuple[Mirror, ...] = ("x", "y", "swap")


@dataclass(frozen=True, slots=True)
class GeometryFit:
    """How the display's geometry is off, true minus assumed, by the smallest model that explains
    the stars' displacements.

    Scale, rotation about the detector's middle and shift; where the displacements ask for them also
    the screen's tilt about its x and y axes, and the lens, k1 of its tangents. `tilt_px` and
    `distortion_px` are the largest displacements by these two. `left` is the share of the mean
    square that the model does not explain, corrected for the number of unknowns; 95 % of the stars
    are within `left_px` of the model.
    """

    scale_error: float
    rotation_rad: float
    offset_px: tuple[float, float]
    tilt_rad: tuple[float, float]
    tilt_px: float
    k1: float
    distortion_px: float
    left: float
    left_px: float


def fit_geometry(rows: FloatArray, tracker: Camera, limit_px: float) -> GeometryFit | None:
    """The smallest model by least squares of stars (n, 4); None with too few. `limit_px` is what a
    centroid is allowed.

    A row has a star's place on the detector, px, and how far from it, right and down, the display
    shows it.
    """
    if len(rows) < MIN_STARS:
        return None
    focal_px = tracker.focal_length_px
    shown_px = rows[:, :2] + rows[:, 2:]
    seen_tangents = (shown_px - tracker.principal_point_px) / focal_px
    back = -rows[:, 2:] / focal_px
    for _ in range(TRIMS):
        # Another star that was found near a star's place is none of these.
        largest_model = _fits(seen_tangents, back)[-1]
        off = _lengths(largest_model.rest)
        is_kept = off <= max(WILD * float(np.median(off)), limit_px / focal_px)
        if is_kept.sum() < MIN_STARS:
            break
        seen_tangents = seen_tangents[is_kept]
        back = back[is_kept]
    fits = _fits(seen_tangents, back)
    enough = ENOUGH * min(fit.noise for fit in fits) + ENOUGH_OF_LIMIT * limit_px / focal_px
    smallest = next(fit for fit in fits if fit.noise <= enough)
    return _summed_up(smallest, back.T.ravel(), focal_px)


def _fits(seen: FloatArray, back: FloatArray) -> "list[_MotionFit]":
    """Every model that so many stars (n, 2) can determine, the smallest first."""
    parts = _parts(*seen.T)
    wanted = back.T.ravel()
    fits = []
    for model in MODELS:
        model_parts = {name: parts[name] for name in model}
        fit = _MotionFit.of(model_parts, wanted)
        if MIN_RESIDUALS * fit.unknowns <= len(wanted):
            fits.append(fit)
    return fits


def _parts(x: FloatArray, y: FloatArray) -> dict[str, FloatArray]:
    """The displacements (2 n, unknowns), x then y, by a unit of each unknown of the parts."""
    ones = np.ones_like(x)
    none = np.zeros_like(x)
    r2 = x * x + y * y
    columns = {
        ALIGNED: [(x, y), (-y, x), (ones, none), (none, ones)],
        TILT: [(x * y, y * y), (-x * x, -x * y)],
        LENS: [(x * r2, y * r2)],
        HIGHER: [(x * r2**2, y * r2**2)],
        DECENTRED: [(2 * x * y, r2 + 2 * y * y), (r2 + 2 * x * x, 2 * x * y)],
    }
    parts = {}
    for name, displacements in columns.items():
        parts[name] = np.column_stack([np.concatenate(x_then_y) for x_then_y in displacements])
    return parts


@dataclass(frozen=True, slots=True)
class _MotionFit:
    """A least-squares fit of displacements: the values of its unknowns by part, the displacements
    (2 n,) that each part makes, and the rest (2 n,).
    """

    found: dict[str, FloatArray]
    moved: dict[str, FloatArray]
    rest: FloatArray
    unknowns: int

    @classmethod
    def of(cls, parts: dict[str, FloatArray], wanted: FloatArray) -> "_MotionFit":
        """The least-squares fit of parts (2 n, unknowns) to displacements (2 n,)."""
        design = np.hstack(list(parts.values()))
        values, *_ = np.linalg.lstsq(design, wanted, rcond=None)
        ends = np.cumsum([part.shape[1] for part in parts.values()])
        values_by_part = dict(zip(parts, np.split(values, ends[:-1]), strict=True))
        moved = {name: part @ values_by_part[name] for name, part in parts.items()}
        rest = wanted - design @ values
        return cls(values_by_part, moved, rest, design.shape[1])

    @property
    def noise(self) -> float:
        """One sigma of what is left, of a residual."""
        degrees_of_freedom = len(self.rest) - self.unknowns
        return math.sqrt(float(self.rest @ self.rest) / degrees_of_freedom)

    def largest(self, *names: str) -> float:
        """The largest displacement by some parts together."""
        together = np.zeros_like(self.rest)
        for name in names:
            if name in self.moved:
                together = together + self.moved[name]
        return float(_lengths(together).max())


def _lengths(residuals: FloatArray) -> FloatArray:
    """The distances (n,) of residuals (2 n,), those along x before those along y."""
    along_x, along_y = np.split(residuals, 2)
    return np.asarray(np.hypot(along_x, along_y))


def _summed_up(fit: _MotionFit, wanted: FloatArray, focal_px: float) -> GeometryFit:
    """The figures of a fit. A fit leads from the display back to the sky, and its figures the other
    way.
    """
    scale, rotation, right, down = fit.found[ALIGNED].tolist()
    backwards = complex(1.0 + scale, rotation)
    forwards = 1.0 / backwards
    shift = -complex(right, down) / backwards
    a, b = fit.found.get(TILT, np.zeros(2)).tolist()
    k1 = float(fit.found.get(LENS, np.zeros(1))[0]) / abs(backwards)
    total = float(wanted @ wanted)
    left_share = fit.noise**2 * len(wanted) / total if total else 0.0
    left_95 = float(np.percentile(_lengths(fit.rest), 95))
    return GeometryFit(
        scale_error=forwards.real - 1.0,
        rotation_rad=forwards.imag,
        offset_px=(shift.real * focal_px, shift.imag * focal_px),
        tilt_rad=(a, b),
        tilt_px=focal_px * fit.largest(TILT),
        k1=k1,
        distortion_px=focal_px * fit.largest(LENS, HIGHER, DECENTRED),
        left=left_share,
        left_px=focal_px * left_95,
    )


@dataclass(frozen=True, slots=True)
class Star:
    """One star at its place on the tracker, px, and the errors of the display there.

    `flux_mag` is positive where the star is too faint, `dx_px` and `dy_px` are right and down.
    `codes_mag`, `codes_px` are what the codes alone would cost on the monitor that the bench
    assumes, NaN where that star would be lost. `floor_mag`, `floor_px` are the estimator's own
    errors: of the linear image against catalogue and sky. A body has a `name`, and 0 for `hip`.
    """

    hip: int
    v_mag: float
    x_px: float
    y_px: float
    flux_mag: float
    dx_px: float
    dy_px: float
    codes_mag: float
    codes_px: float
    floor_mag: float
    floor_px: float
    name: str = ""


@dataclass(slots=True)
class MatchTally:
    """Stars by what became of them, over all fields.

    `summed` stars are part of a brighter one from which the tracker cannot tell them. `displaced`
    has the rows (`fit_geometry`) of all stars that the display shows, however far off. `vanished`
    is how many fewer are found than the sky has; `mirrored` counts, by mirror, those found where a
    screen so mirrored would show them. `noisy_mag`, `noisy_px` are the errors with all of the
    detector's noise. `off_px` has how far off each kind of centroider finds each of `stars`.
    `channels_mag` has how much too faint each channel is, of stars whose colour the primaries have;
    `out_of_gamut` counts the others.
    """

    stars: list[Star] = field(default_factory=list)
    lost: list[Star] = field(default_factory=list)
    displaced: list[FloatArray] = field(default_factory=list)
    blended: int = 0
    summed: int = 0
    clipped: int = 0
    not_shown: int = 0
    at_edge: int = 0
    vanished: int = 0
    mirrored: Counter[Mirror] = field(default_factory=Counter)
    noisy_mag: list[float] = field(default_factory=list)
    noisy_px: list[float] = field(default_factory=list)
    channels_mag: list[list[float]] = field(default_factory=list)
    out_of_gamut: int = 0
    off_px: dict[Centroider, list[float]] = field(
        default_factory=lambda: {kind: [] for kind in FAMILY}
    )


@dataclass(frozen=True, slots=True)
class GlowFit:
    """The light of the screen's black level in a tracker pixel, electrons per second: as
    assumed, as seen, and their limit.
    """

    assumed_e_per_s_px: float
    seen_e_per_s_px: float
    limit_e_per_s_px: float


@dataclass(frozen=True, slots=True)
class Measured:
    """All fields, and what a verdict has to know of the bench; `wide_bodies` says which bodies are
    drawn as discs.

    `stars_a_field` is how many stars of the bench are in the tracker's field on average.
    `calibration` is the one that the bench assumes; `true_calibration` is the monitor's own, where
    it is another.
    """

    field_count: int
    tally: MatchTally
    config: BenchConfig
    camera: Camera
    glow: GlowFit
    calibration: Calibration
    true_calibration: Calibration | None
    gl_renderer: str
    wide_bodies: list[str]
    star: StarSize
    stars_a_field: float
    glass: "GlassEffect | None" = None


class GlassEffect(NamedTuple):
    """What the file of a tracker's PSF does to stars, at 95 %: px from chief ray to centroid,
    and mag of vignetting.
    """

    px: float
    mag: float


def glass_effect(psf: Psf, stars: list[Star]) -> GlassEffect | None:
    """The effect of a glass on stars where they are; None for a PSF that is the same everywhere,
    and without a star.
    """
    if not psf.by_colour or not stars:
        return None
    x, y = np.array([(star.x_px, star.y_px) for star in stars]).T
    to_x, to_y, light = psf.centroids_px(x, y, psf.mean_shares)
    fainter_mag = np.abs(magnitude(light[light > 0]))
    px = float(np.percentile(np.hypot(to_x - x, to_y - y), 95))
    mag = float(np.percentile(fainter_mag, 95)) if len(fainter_mag) else 0.0
    return GlassEffect(px, mag)


def with_blends_as_one(seen: TwinField, psf: Psf) -> TwinField:
    """The field with each star that stands within BLEND_SIGMAS of a brighter one (of `psf`, the
    tracker's) added to that.

    The brighter one keeps its name; its light, magnitude and places become those of the sum.
    """
    light = seen.truth["electrons_per_s"]
    places_px = np.column_stack([seen.x_px, seen.y_px])
    owner = _owners(places_px / psf.width_px, light)
    itself = np.arange(len(owner))
    if np.array_equal(owner, itself):
        return seen
    total = np.bincount(owner, light, len(owner))
    stars = np.flatnonzero(owner == itself)

    def centre(places_px: FloatArray) -> FloatArray:
        moment = np.bincount(owner, light * (places_px - places_px[owner]), len(owner))
        return np.asarray(places_px[stars] + moment[stars] / total[stars])

    truth = seen.truth[stars].copy()
    truth["x_px"] = centre(seen.truth["x_px"])
    truth["y_px"] = centre(seen.truth["y_px"])
    truth["electrons_per_s"] = total[stars]
    truth["v_mag"] += magnitude(np.asarray(total[stars] / light[stars]))
    clipped_count = np.bincount(owner, seen.truth["clipped"], len(owner))
    truth["clipped"] = clipped_count[stars] > 0
    return replace(seen, truth=truth, x_px=centre(seen.x_px), y_px=centre(seen.y_px))


def _owners(places: FloatArray, light: FloatArray) -> IntArray:
    """For each star (n,) at places (n, 2), in sigmas, the one that it is added to: itself, or a
    brighter one.
    """
    owner = np.arange(len(light))
    near = defaultdict[int, list[int]](list)
    a, b, _ = neighbours(places, places, BLEND_SIGMAS)
    pairs = np.stack([a, b], axis=1)[a != b]
    for star, other in pairs.tolist():
        near[star].append(other)
    brightest_first = sorted(near, key=lambda star: (-light[star], star))
    for star in brightest_first:
        if owner[star] != star:
            continue
        for other in near[star]:
            is_fainter = (light[other], -other) < (light[star], -star)
            if owner[other] == other and is_fainter:
                owner[other] = star
    return owner


class Comparison:
    """The stars of a twin's fields, compared one field after the other."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.finder: StarFinder = star_finder(twin.bench, twin.monitor_px_per_px)
        self.tally = MatchTally()
        self.field_count = 0

    def add(self, seen: TwinField, rng: np.random.Generator) -> None:
        """Compare the stars of one field; the generator is for the detector's noise."""
        self.field_count += 1
        tally = self.tally
        stars_listed = len(seen.truth)
        seen = with_blends_as_one(seen, self.finder.psf)
        tally.summed += stars_listed - len(seen.truth)
        windowed_sky = self.finder.find(seen.sky_e, seen.x_px, seen.y_px)
        windowed_shown = self.finder.find(seen.shown_e, seen.x_px, seen.y_px)
        true_px = (seen.x_px, seen.y_px)
        images_by_kind = {}
        for kind in dict.fromkeys([*FAMILY, self.finder.centroider]):
            in_sky = self.finder.placed(windowed_sky, seen.sky_e, true_px, kind)
            in_shown = self.finder.placed(windowed_shown, seen.shown_e, true_px, kind)
            images_by_kind[kind] = in_sky, in_shown
        sky, shown = images_by_kind[self.finder.centroider]
        assumed = shown
        if seen.assumed_e is not seen.shown_e:
            assumed = self.finder.match(seen.assumed_e, seen.x_px, seen.y_px)
        inside = self._inside(seen)
        drawn = seen.truth["drawn"]
        clipped = seen.truth["clipped"]
        tally.at_edge += int((self._on_detector(seen, 0.0) & ~inside).sum())
        tally.not_shown += int((inside & ~drawn).sum())
        tally.clipped += int((inside & drawn & clipped).sum())
        whole = inside & drawn & ~clipped
        blended = self._blended(seen, sky)
        tally.blended += int((whole & blended).sum())
        wanted = whole & ~blended
        is_matched = wanted & (sky.index >= 0) & (shown.index >= 0)
        listed = np.flatnonzero(wanted)
        both = np.flatnonzero(is_matched)
        rows = self._stars(seen, listed, (sky, shown, assumed))
        for k, star in zip(listed, rows, strict=True):
            (tally.stars if is_matched[k] else tally.lost).append(star)
        for kind, (in_sky, in_shown) in images_by_kind.items():
            difference = in_shown.against(in_sky, both)
            off_px = np.hypot(difference.x_px, difference.y_px)
            tally.off_px.setdefault(kind, []).extend(off_px.tolist())
        if seen.by_channel:
            tally.out_of_gamut += int((is_matched & ~seen.truth["in_gamut"]).sum())
            inside_gamut = np.flatnonzero(is_matched & seen.truth["in_gamut"])
            self._compare_channels(seen, inside_gamut)
        tally.vanished += len(sky.found) - len(shown.found)
        self._follow(seen, shown.found, wanted)
        self._count_mirrored(seen, shown.found, wanted)
        self._measure_noisy(seen, self.twin.detected_dn(seen, rng), wanted)

    def _compare_channels(self, seen: TwinField, stars: IntArray) -> None:
        tally = self.tally
        tally.channels_mag = tally.channels_mag or [[] for _ in seen.by_channel]
        reach_px = math.ceil(self.finder.settings.radius_px)
        off_mag = channel_errors_mag(seen.by_channel, seen.x_px[stars], seen.y_px[stars], reach_px)
        for errors_mag, field_mag in zip(tally.channels_mag, off_mag, strict=True):
            errors_mag += field_mag

    def measured(self) -> Measured:
        """All that was measured so far, with what a verdict has to know of the bench. Raises
        InputError (see `true_panel`).
        """
        bench = self.twin.bench
        name = self.twin.config.verify.true_calibration
        return Measured(
            field_count=self.field_count,
            tally=self.tally,
            config=self.twin.config,
            camera=self.twin.camera,
            glow=self._glow(),
            calibration=bench.calibration,
            true_calibration=None if name is None else true_calibration(bench, name),
            gl_renderer=bench.renderer.gl_renderer,
            wide_bodies=wide_bodies(bench.moving, bench.camera),
            star=star_size(self.twin.config, bench.file.folder, self.twin.true_camera),
            stars_a_field=self._stars_a_field(),
            glass=glass_effect(bench.tracker_psf, self.tally.stars),
        )

    def _stars_a_field(self) -> float:
        """The bench's stars over the whole sky by the solid angle of the tracker's field."""
        camera = self.twin.camera
        width, height = camera.resolution_px
        right = width / 2 / camera.focal_length_px
        down = height / 2 / camera.focal_length_px
        field_sr = 4 * math.atan(right * down / math.sqrt(1 + right**2 + down**2))
        return len(self.twin.bench.stars) * field_sr / (4 * math.pi)

    def _glow(self) -> GlowFit:
        """The glow of the screen's black as assumed and as seen, and what it may be off."""
        limit_e_per_s_px = self.twin.config.verify.black_e_per_s_px
        if limit_e_per_s_px is None:
            sigma_x, sigma_y = self.finder.psf.width_px
            disc_px = 4 * math.pi * sigma_x * sigma_y
            limit_e_per_s_px = BLACK_SHARE * faintest_e_per_s(self.twin.bench) / disc_px
        return GlowFit(
            assumed_e_per_s_px=on_screen_median(self.twin.assumed_glow_e_per_s),
            seen_e_per_s_px=on_screen_median(self.twin.glow_e_per_s),
            limit_e_per_s_px=limit_e_per_s_px,
        )

    def _stars(
        self, seen: TwinField, k: IntArray, images: tuple[Matched, Matched, Matched]
    ) -> list[Star]:
        """Rows of the stars `k` (n,), from the images of the sky, of the display, and of one
        that is as assumed.
        """
        sky, shown, assumed = images
        display = shown.against(sky, k)
        codes = assumed.against(sky, k)
        floor = sky.against(self._catalogue(seen), k)
        rows = seen.truth[k]
        columns = (
            *(rows["hip"], rows["v_mag"], seen.x_px[k], seen.y_px[k]),
            *(display.flux_mag, display.x_px, display.y_px),
            *(codes.flux_mag, np.hypot(codes.x_px, codes.y_px)),
            *(floor.flux_mag, np.hypot(floor.x_px, floor.y_px)),
            rows["name"],
        )
        values = [column.tolist() for column in columns]
        return list(itertools.starmap(Star, zip(*values, strict=True)))

    def _catalogue(self, seen: TwinField) -> Matched:
        """The catalogue as if it had been found in an image."""
        flux_e = seen.truth["electrons_per_s"] * self.twin.config.tracker.exposure_s
        count = len(seen.truth)
        pixels = np.ones(count, dtype=np.intp)
        at_edge = np.zeros(count, dtype=bool)
        catalogue = Centroids(seen.x_px, seen.y_px, flux_e, flux_e, pixels, at_edge)
        return Matched(catalogue, np.arange(count, dtype=np.intp))

    def _blended(self, seen: TwinField, sky: Matched) -> npt.NDArray[np.bool_]:
        """True for stars (n,) with another's light in their window, or a disc's."""
        flux = seen.truth["electrons_per_s"]
        psf = self.finder.psf
        radius_px = self.finder.settings.radius_px
        is_crowded = crowded(seen.x_px, seen.y_px, flux, radius_px, psf)
        by_disc = seen.near_disc(self.twin.camera, radius_px + WING_SIGMAS * max(psf.width_px))
        return np.asarray(shared(sky.index) | is_crowded | by_disc)

    def _follow(self, seen: TwinField, shown: Centroids, wanted: npt.NDArray[np.bool_]) -> None:
        """Find each star where the true lens shows it, and note how far that is from where the
        sky has it.
        """
        geometry = BenchGeometry(self.twin.true_camera, self.twin.camera)
        places_px = geometry.to_tracker(seen.truth["x_px"], seen.truth["y_px"])
        match = nearest(shown, *places_px)
        k = np.flatnonzero(wanted & (match >= 0) & ~shared(match))
        x_px = seen.x_px[k]
        y_px = seen.y_px[k]
        right_px = shown.x_px[match[k]] - x_px
        down_px = shown.y_px[match[k]] - y_px
        self.tally.displaced.append(np.column_stack([x_px, y_px, right_px, down_px]))

    def _count_mirrored(
        self, seen: TwinField, shown: Centroids, wanted: npt.NDArray[np.bool_]
    ) -> None:
        """Count the stars that are where a mirrored screen would have them."""
        if not self.twin.differs:
            return
        for mirror in MIRRORS:
            geometry = BenchGeometry(self.twin.true_camera, self.twin.camera, mirror)
            places_px = geometry.to_tracker(seen.truth["x_px"], seen.truth["y_px"])
            is_there = wanted & (nearest(shown, *places_px) >= 0)
            self.tally.mirrored[mirror] += int(is_there.sum())

    def _measure_noisy(
        self, seen: TwinField, dn: npt.NDArray[Any], wanted: npt.NDArray[np.bool_]
    ) -> None:
        """Measure the same stars in a noisy exposure (h, w), DN: their errors are those of the
        tracker itself.
        """
        under = estimate_background(dn, 1.0)
        # rounding's: most of the image may be clipped at 0 DN, beside a glow
        if under.noise <= 1 / math.sqrt(12):
            under = noisiest_background(dn)
        windowed = find_stars(dn, self.finder.settings, under)
        match = nearest(windowed, seen.x_px, seen.y_px)
        true_px = (seen.x_px, seen.y_px)
        matched = Matched(windowed, match)
        placed = self.finder.placed(matched, dn, true_px, self.finder.centroider, under.level).found
        tracker = self.twin.config.tracker
        dn_s_per_e = tracker.exposure_s / tracker.detector.gain_e_per_dn
        expected_dn = seen.truth["electrons_per_s"] * dn_s_per_e
        k = np.flatnonzero(wanted & (match >= 0))
        k = k[placed.flux[match[k]] > 0]
        source = match[k]
        self.tally.noisy_mag += magnitude(placed.flux[source] / expected_dn[k]).tolist()
        right_px = placed.x_px[source] - seen.x_px[k]
        down_px = placed.y_px[source] - seen.y_px[k]
        self.tally.noisy_px += np.hypot(right_px, down_px).tolist()

    def _inside(self, seen: TwinField) -> npt.NDArray[np.bool_]:
        """Stars whose window is whole on the detector and whose sprite is whole on the monitor."""
        margin = self.finder.settings.radius_px + 1.5
        bench = self.twin.bench
        reach = bench.psf.footprint_px / 2 + margin * self.twin.monitor_px_per_px
        sprites_px = seen.truth["x_px"], seen.truth["y_px"]
        inside = inside_by(reach, *sprites_px, bench.camera.resolution_px)
        return np.asarray(inside & self._on_detector(seen, margin))

    def _on_detector(self, seen: TwinField, margin_px: float) -> npt.NDArray[np.bool_]:
        """Stars on the detector, `margin_px` or farther from its edge; one at NaN is not on it."""
        return on_detector(seen.x_px, seen.y_px, self.twin.camera.resolution_px, margin_px)


def on_detector(
    x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], margin_px: float
) -> npt.NDArray[np.bool_]:
    """Which places (n,) are on a detector, `margin_px` or farther from its outermost pixels' edges;
    NaN is not on it.
    """
    width, height = resolution_px
    first_px = margin_px - 0.5
    across = (x_px >= first_px) & (x_px < width - 0.5 - margin_px)
    down = (y_px >= first_px) & (y_px < height - 0.5 - margin_px)
    return np.asarray(across & down)


def channel_errors_mag(
    by_channel: Sequence[tuple[FloatArray, FloatArray]],
    x_px: FloatArray,
    y_px: FloatArray,
    reach_px: int,
) -> list[list[float]]:
    """How far the light shown in each channel is off the sky's, mag without a sign, in squares of
    `reach_px` to each side about stars (n,). Images are pairs of shown and sky, electrons.
    """
    squares = []
    for x, y in np.rint([x_px, y_px]).T.astype(int).tolist():
        rows = slice(max(y - reach_px, 0), y + reach_px + 1)
        columns = slice(max(x - reach_px, 0), x + reach_px + 1)
        squares.append((rows, columns))
    errors_mag = []
    for shown_e, sky_e in by_channel:
        ratios = [float(shown_e[square].sum() / sky_e[square].sum()) for square in squares]
        errors_mag.append([abs(magnitude(ratio)) for ratio in ratios])
    return errors_mag


def on_screen_median(glow_e_per_s: FloatArray) -> float:
    """The median over the detector's pixels that see the screen; 0 where the screen's black has
    no light.
    """
    lit = glow_e_per_s[glow_e_per_s > 0]
    if not len(lit):
        return 0.0
    return float(np.median(lit))
