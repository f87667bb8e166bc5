"""From photographs to one camera: attitudes, stars by a PSF, geometry and light of all
photographs together.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import msgspec
import numpy as np
from msgspec import structs
from scipy.spatial import cKDTree

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import conjugate, rotate
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio, magnitude
from hilstar.instruments.confront.background import (
    FixedPattern,
    FoundSources,
    SkyLevel,
    find_sources,
    fixed_pattern,
    is_round,
    sky_level,
    source_mask,
)
from hilstar.instruments.confront.camera_fit import (
    CameraFit,
    Places,
    Pointing,
    fit_camera,
    k1_camera,
)
from hilstar.instruments.confront.images import Photograph, paged
from hilstar.instruments.confront.light import (
    NO_CORRECTION,
    Correction,
    LightFit,
    StarLight,
    fit_light,
    join_light,
    with_extinction,
)
from hilstar.instruments.confront.lost_in_space import (
    MAX_SOURCES,
    MIN_MATCHED,
    NEAR,
    SolvedField,
    SourceField,
    nearest_once,
    solve_lost,
)
from hilstar.instruments.confront.photographed_sky import DatedSky, dated_sky
from hilstar.instruments.confront.photon_transfer import (
    PixelFit,
    fit_pedestal,
    fit_pixels,
    transfer_points,
)
from hilstar.instruments.confront.star_psf import (
    HALF,
    MEAN_BV_MAG,
    Measured,
    Stamps,
    StarPsf,
    cut_stamps,
    fit_psf,
    join,
    measure,
)
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.sky import SiteSettings
from hilstar.server.bench.site import site_glow_e_per_s_sr
from hilstar.server.bench.star_light import site_air
from hilstar.server.bench.star_rates import bench_channels, bench_optics, channel_rates
from hilstar.sky.air import SiteAir, air_mass
from hilstar.sky.spectrum import Curve
from hilstar.tracker.settings import DetectorSettings

MATCH_PX = 2.5
FIRST_PX = 0.15  # error of a source's place before it is measured
# a match's radius: where it is continued, and while it grows so
BEYOND, FURTHER, MAX_ROUNDS = 1.25, 1.05, 12
# a neighbour so near, and not so much fainter, spoils a star's place and flux
BLEND_PX, BLEND_MAG = 6.0, 3.0
PSF_STARS = 60
TRAILED_RATIO, TRAILED_PX, WIDE_PX = 2.5, 8.0, 9.0
BRIGHTEST = 10  # sources that tell a photograph's focus and rest
SATURATED_SHARE = 0.97
TONE_ROUNDS = 6
PASSES = 2
APART_PX = 10.0  # by which photographs' skies are moved on the detector that tell its fixed pattern
SOURCE_PX = 4  # about a source whose pixels tell nothing of the background
SCATTER_SNR = 10.0
LINEAR_DONE = 0.004
MAX_TONE_STEP, MIN_POWER = 0.4, 0.1
PIVOT_NM = 550.0
KNOT_NM = 20.0
# done of a confrontation, percent, by its time: once photographs are open, and the camera is fitted
OPEN_PERCENT, FITTED_PERCENT = 8, 65
Advance = Callable[[int], None]


@dataclass(slots=True)
class Shot:
    """One photograph while the session is fitted: background, sources, sky, pointing and stars.

    `star` (n,) are rows of `sky`. `measured`, `saturated` and `blended` have a value for each of
    these stars, once it is identified and measured.
    """

    photo: Photograph
    level: SkyLevel
    sources: FoundSources
    sky: DatedSky
    pointing: Pointing
    focal_length_px: float
    matched: SolvedField
    star: IntArray
    stamps: Stamps | None = None
    measured: Measured | None = None
    saturated: BoolArray | None = None
    blended: BoolArray | None = None

    @property
    def clean(self) -> BoolArray:
        """Stars (n,) that count in fits: alone, and not saturated."""
        if self.saturated is None or self.blended is None:
            raise AssertionError("measured first")
        return ~self.saturated & ~self.blended

    @property
    def found(self) -> Measured:
        """Places and fluxes of the stars (n,), by the PSF."""
        if self.measured is None:
            raise AssertionError("measured first")
        return self.measured

    @property
    def above_dn(self) -> FloatArray:
        """The photograph above its background (height, width), DN."""
        return np.asarray(self.photo.dn - self.level.level)


@dataclass(frozen=True, slots=True)
class Session:
    """What all photographs together say: the camera, its PSF, its light and its pixels."""

    file: BenchFile
    shots: tuple[Shot, ...]
    camera: CameraFit
    psf: StarPsf
    light: LightFit
    stars: StarLight
    pixels: PixelFit
    power: float
    fixed: bool
    air: SiteAir | None = None

    def sky_mag(self) -> float:
        """Magnitude on the tracker of one square arcsecond of sky of V = 0, on the scale of
        `LightFit.mag`.
        """
        config = self.file.config
        folder = self.file.folder
        stated = bench_optics(config.tracker, folder)
        efficiency = corrected(stated.quantum_efficiency, self._correction)
        optics = replace(stated, quantum_efficiency=efficiency)
        site = config.site or SiteSettings(0.0, 0.0)
        bright_site = msgspec.structs.replace(site, sky_v_mag_arcsec2=0.0)
        bright_config = msgspec.structs.replace(config, site=bright_site)
        glow_e_per_s_sr = site_glow_e_per_s_sr(bright_config, folder, optics)
        glow_e_per_s_arcsec2 = np.array([glow_e_per_s_sr / ARCSEC_PER_RAD**2])
        return float(magnitude(glow_e_per_s_arcsec2)[0])

    @property
    def _correction(self) -> Correction:
        """The correction of the quantum efficiency; none of a fixed camera, whose file has it."""
        if self.fixed:
            return NO_CORRECTION
        return self.light.correction

    def plane_mag(self, number: int, columns: FloatArray) -> FloatArray:
        """By how much stars of V, B-V and V-I (3, n) are fainter to a plane of a mosaic than to
        the tracker as a whole, mag (n,).
        """
        bv_mag = np.nan_to_num(columns[1], nan=MEAN_BV_MAG)
        colour_mag = self.light.colours[number] * (bv_mag - MEAN_BV_MAG)
        plane = self.shots[number].photo.plane
        return np.asarray(colour_mag + _channel_mag(self.file, plane, columns))

    def predicted_dn(
        self, number: int, star: IntArray, x_px: FloatArray, y_px: FloatArray
    ) -> FloatArray:
        """DN of stars (n,), rows of the sky of photograph `number`, at their places on it."""
        sky = self.shots[number].sky
        light = self.light
        columns = sky.columns(sky.order[star])
        tracker_mag = _Magnitudes(self.file, columns)(self._correction)
        air_mag = extinct_mag(self.air, sky, star)
        mag = tracker_mag + self.plane_mag(number, columns) + air_mag
        radius2 = radius2_of(self.camera.camera, x_px, y_px)
        shade = light.illumination(radius2)
        dn = flux_ratio(mag + light.offsets_mag[number])
        return np.asarray(dn * shade)


def open_shot(file: BenchFile, photo: Photograph, base: Camera, start: FloatArray | None) -> Shot:
    """A photograph with its attitude. Raises InputError where it has none: what is seen, and
    what to do.
    """
    level = _level(photo, photo.step_dn)
    sources = find_sources(level.above(photo.dn))
    sky = dated_sky(file, photo.t_ns)
    points = ~sources.single & ~sources.trail
    field = _field(sources, points, photo)
    if len(field.places_px) >= MIN_MATCHED:
        solution = _solve(field, base, sky, start)
    else:
        solution = None
    if solution is None and is_round(photo.dn):
        raise InputError(
            f"{photo.path}: its light fills a circle between dark corners: an all-sky lens, of"
            " which hilstar has no model; give frames of a lens under 120 degrees, whose sky fills"
            " the image"
        )
    if len(field.places_px) < MIN_MATCHED:
        raise InputError(
            f"{photo.path}: {len(field.places_px)} sources stand out of its noise, and an attitude"
            f" takes {MIN_MATCHED}; expose longer, open the cap, or look at a sky without cloud"
        )
    if solution is None:
        raise InputError(f"{photo.path}: {_why_not(field, base, sky, sources, points, start)}")
    point_rows = np.flatnonzero(points)
    source = point_rows[solution.source]
    brightest = np.sort(source)[:BRIGHTEST]
    check_focus(photo, sources.fwhm_px[brightest])
    return Shot(
        photo=photo,
        level=level,
        sources=sources,
        sky=sky,
        pointing=Pointing(solution.q_icrs_to_cam, air=sky.air),
        focal_length_px=solution.focal_length_px,
        matched=replace(solution, source=source),
        star=np.empty(0, dtype=np.intp),
    )


def check_focus(photo: Photograph, fwhm_px: FloatArray) -> None:
    """Raises InputError for a photograph whose brightest stars (n,) are WIDE_PX wide and more."""
    wide_px = float(np.median(fwhm_px))
    if wide_px > WIDE_PX:
        raise InputError(
            f"{photo.path}: its stars are {wide_px:.0f} px wide; focus the lens, or give a frame in"
            " focus"
        )


def _field(sources: FoundSources, points: BoolArray, photo: Photograph) -> SourceField:
    """Places of the sources that are `points`, from the middle of the image, px."""
    width, height = photo.size_px
    x_px = sources.x_px - (width - 1) / 2
    y_px = sources.y_px - (height - 1) / 2
    places_px = np.column_stack([x_px, y_px])
    return SourceField(places_px[points], width, height)


def _solve(
    field: SourceField, base: Camera, sky: DatedSky, start: FloatArray | None
) -> SolvedField | None:
    """The attitude of a field near the boresight of `start`, else anywhere; None without one."""
    if start is not None:
        boresight = np.array([[0.0, 0.0, 1.0]])
        near = rotate(conjugate(start), boresight)[0]
        solution = solve_lost(field, base.focal_length_px, sky.vectors, near)
        if solution is not None:
            return solution
    return solve_lost(field, base.focal_length_px, sky.vectors)


def _why_not(
    field: SourceField,
    base: Camera,
    sky: DatedSky,
    sources: FoundSources,
    points: BoolArray,
    start: FloatArray | None,
) -> str:
    """Why a photograph has no attitude, and what to do: trails, focus, a mirrored image, or a
    wrong scale.
    """
    bright = np.flatnonzero(points)[:BRIGHTEST]
    length_px = np.median(sources.length_px[bright])
    width_px = np.median(sources.width_px[bright])
    has_trails = sources.trail.sum() >= MIN_MATCHED
    # short trails are points to `trail`: the bright ones are long together
    is_trailed = length_px > TRAILED_PX and length_px > TRAILED_RATIO * width_px
    if has_trails or is_trailed:
        trail_px = length_px
        if has_trails:
            trail_px = np.median(sources.length_px[sources.trail])
        return (
            f"its stars are trails of about {trail_px:.0f} px; give a frame of a camera at"
            " rest, or a shorter exposure"
        )
    wide_px = np.median(sources.fwhm_px[bright])
    if wide_px > WIDE_PX:
        return f"its sources are {wide_px:.0f} px wide; focus the lens, or give a frame in focus"
    mirrored = replace(field, places_px=field.places_px * [-1, 1])
    if _solve(mirrored, base, sky, start) is not None:
        return (
            "is mirrored: its stars fit the sky only with left and right exchanged; flip the image"
        )
    half_width_rad = math.atan(field.width_px / 2 / base.focal_length_px)
    width_deg = math.degrees(2 * half_width_rad)
    place = ""
    remedy = ", or give --radec RA,DEC,ROLL"
    if start is not None:
        place = " near --radec"
        remedy = ""
    return (
        f"has {len(field.places_px)} sources, and no part of the sky fits them{place} at"
        f" {width_deg:.3g} deg of width within 20 %; check focal_length_mm and"
        f" pixel_pitch_um{remedy}"
    )


def run_session(
    file: BenchFile,
    photos: Sequence[Photograph],
    base: Camera,
    start: FloatArray | None,
    *,
    fixed: "FixedCamera | None" = None,
    advance: Advance = lambda percent: None,
) -> Session:
    """Everything about photographs of one camera; with `fixed` that camera, to which only attitudes
    and offsets are fitted.

    `advance` is told what is done, percent, up to FITTED_PERCENT. Raises InputError for a
    photograph without an attitude.
    """
    shots = []
    for photo in photos:
        shots.append(open_shot(file, photo, base, start))
        advance(OPEN_PERCENT * len(shots) // len(photos))
    base = _first_camera(base, fixed, [shot.focal_length_px for shot in shots])
    if shots[0].sky.air is None:
        air = None
    else:
        air = site_air(file.config, file.folder, shots[0].sky.catalog)
    fit = partial(_fitted, file, base, fixed, air)
    session = fit(shots, advance=advance)
    linearity = session.light.linearity
    if fixed is not None or linearity < MIN_POWER:
        return session
    if session.light.is_linear:
        return session
    # Levels made linear by a power have a power of their own. The power to undo is where the
    # logarithm of that is 0: its root, by secants.
    log_undone = math.log(linearity)
    before = (0.0, log_undone)
    for _ in range(TONE_ROUNDS):
        power = math.exp(log_undone)
        linear_shots = []
        for shot, photo in zip(session.shots, photos, strict=True):
            linear_shots.append(_linear(shot, photo, power))
        trial = fit(linear_shots, power=power, before=session.camera)
        log_linearity = math.log(max(trial.light.linearity, 0.1))
        if abs(log_linearity) < LINEAR_DONE:
            return fit(trial.shots, power=power)
        at = (log_undone, log_linearity)
        log_undone += _tone_step(before, at)
        before = at
    return session  # no power makes it linear: its figures say so


def _tone_step(before: tuple[float, float], at: tuple[float, float]) -> float:
    """The step of the power's logarithm by two trials, each that logarithm and the one of the
    linearity that it left: at most MAX_TONE_STEP to either side.
    """
    log_undone, log_linearity = at
    slope = (log_linearity - before[1]) / (log_undone - before[0])
    if slope < 0:
        step = -log_linearity / slope
    else:
        # a secant that noise turned leads away from the root: by the first step's rule
        step = log_linearity
    return min(max(step, -MAX_TONE_STEP), MAX_TONE_STEP)


@dataclass(frozen=True, slots=True)
class FixedCamera:
    """A camera file's own optics and detector, for --fixed."""

    camera: Camera
    psf: StarPsf
    light: LightFit
    pixels: PixelFit


def _first_camera(base: Camera, fixed: FixedCamera | None, focal_px: Sequence[float]) -> Camera:
    """The camera that a fit begins with: the fixed one, else that of the bench file with the median
    of the photographs' focal lengths.
    """
    if fixed is not None:
        return fixed.camera
    return replace(base, focal_length_px=float(np.median(focal_px)))


def _linear(shot: Shot, photo: Photograph, power: float) -> Shot:
    """The shot with levels that go as light: those of the file to the power 1 / `power`, full
    scale as it is.
    """
    full_dn = photo.full_dn
    share = np.maximum(photo.dn, 0) / full_dn
    dn = full_dn * share ** (1 / power)
    # a step of the file has another height at each level: that of the sky's counts
    middle = float(np.median(photo.dn)) / full_dn
    sky_share = max(middle, photo.step_dn / full_dn)
    step_dn = photo.step_dn / power * sky_share ** (1 / power - 1)
    if isinstance(photo.dn, np.memmap):
        dn = paged(dn)
    linear = replace(photo, dn=dn, step_dn=step_dn)
    return replace(shot, photo=linear, level=_level(linear, step_dn))


def _level(photo: Photograph, step_dn: float) -> SkyLevel:
    """The background of a photograph; in a file where the photograph itself is in one."""
    level = sky_level(photo.dn, step_dn)
    if isinstance(photo.dn, np.memmap):
        level = replace(level, level=paged(level.level), noise=paged(level.noise))
    return level


def _fitted(
    file: BenchFile,
    base: Camera,
    fixed: FixedCamera | None,
    air: SiteAir | None,
    shots: Sequence[Shot],
    *,
    power: float = 1.0,
    before: CameraFit | None = None,
    advance: Advance = lambda percent: None,
) -> Session:
    """The session of shots whose levels were made linear by a power; with the camera `before`,
    of their light alone.
    """
    if fixed is None:
        pixels = _pixels(shots, file.config.tracker.detector)
    else:
        pixels = fixed.pixels
    if before is None:
        camera, psf = _geometry(base, fixed, shots, pixels.gain_e_per_dn, advance)
    else:
        camera = before
        psf = _measured(shots, camera, fixed, pixels.gain_e_per_dn)
    stars = _star_light(shots, camera.camera)
    light = _light(file, shots, stars, air, fixed)
    masses = []
    for shot, pointing in zip(shots, camera.pointings, strict=True):
        masses.append(_masses(shot.sky, pointing))
    light = with_extinction(light, stars, masses, known=air is not None)
    return Session(
        file=file,
        shots=tuple(shots),
        camera=camera,
        psf=psf,
        light=light,
        stars=stars,
        pixels=pixels,
        power=power,
        fixed=fixed is not None,
        air=air,
    )


def _geometry(
    base: Camera,
    fixed: FixedCamera | None,
    shots: Sequence[Shot],
    gain: float,
    advance: Advance,
) -> tuple[CameraFit, StarPsf]:
    """The camera and the PSF of shots, whose stars are identified and measured by them, and whose
    pointings are set.
    """
    is_fixed = fixed is not None
    pointings = [shot.pointing for shot in shots]
    places = [_seen_at(shot, shot.matched.star, shot.matched.source) for shot in shots]
    if not is_fixed:
        places, pointings = _outward(base, pointings, shots, places)
    camera = fit_camera(base, pointings, places, fixed=is_fixed, last=False)
    pass_percent = (FITTED_PERCENT - OPEN_PERCENT) // (PASSES + 1)
    for number in range(PASSES):
        advance(OPEN_PERCENT + (number + 1) * pass_percent)
        psf = _measured(shots, camera, fixed, gain)
        places = [_places(shot) for shot in shots]
        is_last = number == PASSES - 1
        camera = fit_camera(base, camera.pointings, places, fixed=is_fixed, last=is_last)
        for shot, pointing in zip(shots, camera.pointings, strict=True):
            shot.pointing = pointing
    advance(FITTED_PERCENT)
    return camera, psf


def _measured(
    shots: Sequence[Shot], camera: CameraFit, fixed: FixedCamera | None, gain: float
) -> StarPsf:
    """Identify and measure the stars of shots by a camera; the PSF of them, or the fixed one."""
    for shot, pointing in zip(shots, camera.pointings, strict=True):
        _identify(shot, camera.camera, pointing)
    if fixed is None:
        psf = _psf(shots, gain)
    else:
        psf = fixed.psf
    for shot in shots:
        _measure(shot, psf, gain)
    return psf


def _light(
    file: BenchFile,
    shots: Sequence[Shot],
    stars: StarLight,
    air: SiteAir | None,
    fixed: FixedCamera | None,
) -> LightFit:
    """The fit of the light of all stars; with a `fixed` camera, of its photographs' offsets."""
    columns = []
    dimming_mag = []
    for shot in shots:
        shot_columns = shot.sky.columns(shot.sky.order[shot.star])
        air_mag = extinct_mag(air, shot.sky, shot.star)
        columns.append(shot_columns)
        dimming_mag.append(air_mag + _channel_mag(file, shot.photo.plane, shot_columns))
    magnitudes = _Magnitudes(file, np.concatenate(columns, axis=1))
    dimmed_mag = np.concatenate(dimming_mag)
    fixed_light = None
    if fixed is not None:
        fixed_light = fixed.light

    def predicted_mag(correction: Correction) -> FloatArray:
        return magnitudes(correction) + dimmed_mag

    return fit_light(stars, len(shots), predicted_mag, fixed_light)


def _seen_at(shot: Shot, star: IntArray, source: IntArray) -> Places:
    """Stars (n,) at their sources, before those are measured."""
    x_px = shot.sources.x_px[source]
    y_px = shot.sources.y_px[source]
    sigma_px = np.full(len(star), FIRST_PX)
    return Places(x_px, y_px, sigma_px, shot.sky.vectors[star])


def _outward(
    base: Camera, pointings: list[Pointing], shots: Sequence[Shot], first: list[Places]
) -> tuple[list[Places], list[Pointing]]:
    """First places and pointings, further from the middle than a pinhole's first match where the
    lens has a strong distortion.

    Stars are matched a little further out by the k1 of those matched before, until no more are
    found.
    """
    places = first
    latest = list(pointings)
    for _ in range(MAX_ROUNDS):
        camera, turned = k1_camera(base, latest, places)
        matches = []
        for shot, pointing, shot_places in zip(shots, turned, places, strict=True):
            matches.append(_beyond(shot, camera, pointing, shot_places))
        if _largest_reach_px(camera, matches) < FURTHER * _largest_reach_px(camera, places):
            break
        places = matches
        latest = turned
    if places is first:
        return (first, list(pointings))
    return (places, turned)


def _largest_reach_px(camera: Camera, places: Sequence[Places]) -> float:
    return max(_reach_px(camera, shot_places) for shot_places in places)


def _reach_px(camera: Camera, places: Places) -> float:
    """The radius about the principal point that holds 95 % of places."""
    cx, cy = camera.principal_point_px
    if not len(places.x_px):
        return 0.0
    radius_px = np.hypot(places.x_px - cx, places.y_px - cy)
    return float(np.quantile(radius_px, 0.95))


def _beyond(shot: Shot, camera: Camera, pointing: Pointing, matched: Places) -> Places:
    """The bright stars at sources up to BEYOND times the radius of those that are `matched`."""
    cx, cy = camera.principal_point_px
    sources = shot.sources
    reach_px = BEYOND * _reach_px(camera, matched)
    points = np.flatnonzero(~sources.single & ~sources.trail)[:MAX_SOURCES]
    radius_px = np.hypot(sources.x_px[points] - cx, sources.y_px[points] - cy)
    points = points[radius_px < reach_px]
    x, y = pointing.places_px(camera, shot.sky.vectors)
    with np.errstate(invalid="ignore"):
        near_middle = np.hypot(x - cx, y - cy) < reach_px
    near_middle &= within_image(x, y, shot.photo.size_px, 0)
    star = np.flatnonzero(near_middle)[: len(points)]
    tree = cKDTree(sources.places_px[points])
    star_places_px = np.column_stack([x[star], y[star]])
    match_px = NEAR * math.hypot(*shot.photo.size_px)
    star_index, source = nearest_once(tree, star_places_px, match_px)
    return _seen_at(shot, star[star_index], points[source])


def within_image(
    x_px: FloatArray, y_px: FloatArray, size_px: tuple[int, int], margin_px: float
) -> BoolArray:
    """Whether places (n,) are over `margin_px` within the outermost pixels' centres; NaN is not."""
    width, height = size_px
    with np.errstate(invalid="ignore"):
        across = (x_px > margin_px) & (x_px < width - 1 - margin_px)
        down = (y_px > margin_px) & (y_px < height - 1 - margin_px)
    return np.asarray(across & down)


def _channel_mag(file: BenchFile, plane: str, columns: FloatArray) -> FloatArray:
    """Magnitude of stars of V, B-V and V-I (3, n) in the channel of a plane (r, g1, g2, b) less
    that in the whole tracker, (n,); 0 where the bench has one channel.
    """
    tracker = file.config.tracker
    channels = bench_channels(tracker, file.folder)
    if not plane or len(channels) < 3:
        return np.zeros(columns.shape[1])
    channel_rate = channel_rates(file.config.sky, channels["rgb".index(plane[0])])
    whole_rate = channel_rates(file.config.sky, bench_optics(tracker, file.folder))
    channel_mag = magnitude(channel_rate(*columns))
    whole_mag = magnitude(whole_rate(*columns))
    return np.asarray(channel_mag - whole_mag)


def extinct_mag(air: SiteAir | None, sky: DatedSky, star: IntArray) -> FloatArray:
    """By how much the air over `[site]` dims stars (n,), mag; 0 without a site or a date."""
    if air is None or sky.air is None:
        return np.zeros(len(star))
    altitude_rad = sky.air.altitude_rad(sky.vectors[star])
    share = air.shares(sky.order[star], altitude_rad)[0]
    return np.asarray(magnitude(share))


def _masses(sky: DatedSky, pointing: Pointing) -> float | None:
    """Air masses before the boresight, by the site or by a fitted zenith."""
    if sky.air is not None:
        return sky.masses(pointing.boresight)
    altitude = pointing.altitude_deg
    if altitude is None:
        return None
    return float(air_mass(np.radians([altitude]))[0])


def _pixels(shots: Sequence[Shot], assumed: DetectorSettings) -> PixelFit:
    """The detector by the background of all photographs."""
    masks = []
    points = []
    for shot in shots:
        mask = source_mask(shot.sources, shot.level.above(shot.photo.dn), SOURCE_PX)
        masks.append(mask)
        points.append(transfer_points(shot.photo.dn, shot.level.level, mask))
    pedestal = _pedestal(shots)
    if pedestal is None:
        zero_dn = assumed.offset_dn
    else:
        zero_dn = pedestal[0]

    def photographs() -> Iterator[tuple[FloatArray, FloatArray, BoolArray]]:
        for number in _apart(shots):
            shot = shots[number]
            yield shot.above_dn, shot.level.level - zero_dn, ~masks[number]

    pattern = fixed_pattern(photographs()) or FixedPattern()
    exposure_s = shots[0].photo.exposure_s or 0.0
    dsnu_e = math.hypot(assumed.dsnu_e, assumed.dsnu_e_per_s * exposure_s)
    exposed = structs.replace(assumed, dsnu_e=dsnu_e)
    step_dn = max(shot.photo.step_dn for shot in shots)
    return fit_pixels(np.concatenate(points), step_dn, pedestal, exposed, pattern)


def _pedestal(shots: Sequence[Shot]) -> tuple[float, float] | None:
    """The level without light and its sigma, DN, by the photographs' skies at one place of each
    block; None where these do not tell it.
    """
    height, width = shots[0].photo.dn.shape
    side = shots[0].level.block_px
    y, x = np.mgrid[side // 2 : height : side, side // 2 : width : side]
    places = np.column_stack([x.ravel() / width, y.ravel() / height]) - 0.5
    levels = [shot.level.level[y, x].ravel() for shot in shots]
    return fit_pedestal(levels, places)


def _apart(shots: Sequence[Shot]) -> list[int]:
    """Numbers of shots whose skies are apart by APART_PX on the detector.

    Two photographs of one sky have the faintest stars in common, which would count as the pixels'
    own pattern.
    """
    apart: list[int] = []
    for number, shot in enumerate(shots):
        boresight = shot.pointing.boresight
        distances_px = []
        for other in apart:
            turn_rad = np.linalg.norm(boresight - shots[other].pointing.boresight)
            distances_px.append(turn_rad * shot.focal_length_px)
        if all(distance_px > APART_PX for distance_px in distances_px):
            apart.append(number)
    return apart


def _identify(shot: Shot, camera: Camera, pointing: Pointing) -> None:
    """Find which stars of the catalogue are sources of the shot, and which of them are blended or
    saturated; cut their stamps.
    """
    sources = shot.sources
    x, y = pointing.places_px(camera, shot.sky.vectors)
    inside = np.flatnonzero(within_image(x, y, shot.photo.size_px, HALF))
    source_tree = cKDTree(sources.places_px)
    star_places_px = np.column_stack([x[inside], y[inside]])
    matched, source = nearest_once(source_tree, star_places_px, MATCH_PX)
    star = inside[matched]
    star_tree = cKDTree(star_places_px)
    v_mag = shot.sky.v_mag
    blended = np.zeros(len(star), dtype=bool)
    for k, row in enumerate(star):
        neighbours = inside[star_tree.query_ball_point([x[row], y[row]], BLEND_PX)]
        neighbours = neighbours[neighbours != row]
        is_bright = v_mag[neighbours] < v_mag[row] + BLEND_MAG
        blended[k] = bool(is_bright.any())
    if len(sources) > 1:
        # the second of the nearest two: the first is the source itself
        distances_px, nearest = source_tree.query(source_tree.data[source], k=2)
        distance_px = np.asarray(distances_px)[:, -1]
        neighbour = np.asarray(nearest)[:, -1]
        least_snr = flux_ratio(BLEND_MAG) * sources.snr[source]
        blended |= (distance_px < BLEND_PX) & (sources.snr[neighbour] > least_snr)
    shot.star = star
    shot.blended = blended
    variance = shot.level.noise**2
    x_px = sources.x_px[source]
    y_px = sources.y_px[source]
    bv_mag = shot.sky.bv_mag[star]
    shot.stamps = cut_stamps(shot.above_dn, variance, x_px, y_px, bv_mag)
    # a pixel saturates by all of its DN, the background's too
    total = cut_stamps(shot.photo.dn, variance, x_px, y_px, bv_mag)
    highest_dn = total.middle(3).max(axis=(1, 2))
    shot.saturated = highest_dn >= SATURATED_SHARE * shot.photo.full_dn


def _psf(shots: Sequence[Shot], gain: float) -> StarPsf:
    """The PSF by the brightest clean stars of all shots."""
    clean_stamps = []
    all_stamps = []
    for shot in shots:
        if shot.stamps is not None:
            clean_stamps.append(shot.stamps.at(shot.clean))
            all_stamps.append(shot.stamps)
    stamps = join(clean_stamps)
    if len(stamps) < 3:
        stamps = join(all_stamps)
    light_dn = stamps.values[:, 2:-2, 2:-2].sum(axis=(1, 2))
    noise_dn = np.sqrt(np.median(stamps.variance, axis=(1, 2)))
    brightest = np.argsort(-(light_dn / noise_dn))[:PSF_STARS]
    is_bright = np.zeros(len(stamps), dtype=bool)
    is_bright[brightest] = True
    stamps = stamps.at(is_bright)
    return fit_psf(stamps, *_middles(stamps), shots[0].photo.size_px, gain)


def _middles(stamps: Stamps) -> tuple[FloatArray, FloatArray]:
    """First places (n,) of stars, x and y: centres of gravity of their stamps' 5 x 5 middle
    pixels.
    """
    light = np.maximum(stamps.middle(2), 0)
    total = np.maximum(light.sum(axis=(1, 2)), 1e-9)
    reach = np.arange(-2, 3)
    x_px = stamps.column + light.sum(axis=1) @ reach / total
    y_px = stamps.row + light.sum(axis=2) @ reach / total
    return x_px, y_px


def _measure(shot: Shot, psf: StarPsf, gain: float) -> None:
    """Measure the stars of a shot by the PSF."""
    if shot.stamps is None:
        raise AssertionError("identified first")
    x_px, y_px = _middles(shot.stamps)
    shot.measured = measure(shot.stamps, psf, x_px, y_px, gain)


def _places(shot: Shot) -> Places:
    """Places that count in a fit of the geometry: those of clean stars."""
    stars = shot.found
    use = shot.clean & (stars.dn > SCATTER_SNR * stars.sigma_dn)
    if use.sum() < MIN_MATCHED:
        use = shot.clean
    if use.sum() < 3:
        use = np.ones(len(shot.star), dtype=bool)
    vectors = shot.sky.vectors[shot.star[use]]
    return Places(stars.x_px[use], stars.y_px[use], stars.sigma_px[use], vectors)


def radius2_of(camera: Camera, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Squares of radii (n,) from the principal point, in half diagonals."""
    cx, cy = camera.principal_point_px
    width, height = camera.resolution_px
    radius2_px2 = (x_px - cx) ** 2 + (y_px - cy) ** 2
    half_diagonal2_px2 = (width**2 + height**2) / 4
    return np.asarray(radius2_px2 / half_diagonal2_px2)


def _star_light(shots: Sequence[Shot], camera: Camera) -> StarLight:
    """Light of the stars of all shots, in one row of each quantity."""
    parts = []
    for number, shot in enumerate(shots):
        stars = shot.found
        sky = shot.sky
        colour = " rgb".index(shot.photo.plane[:1] or " ")
        count = len(shot.star)
        part = StarLight(
            image=np.full(count, number),
            dn=stars.dn,
            sigma_dn=stars.sigma_dn,
            v_mag=sky.v_mag[shot.star],
            bv_mag=sky.bv_mag[shot.star],
            radius2=radius2_of(camera, stars.x_px, stars.y_px),
            clean=shot.clean,
            plane=np.full(count, colour),
        )
        parts.append(part)
    return join_light(parts)


class _Magnitudes:
    """Magnitudes of the session's stars by hilstar's own spectra, through a corrected quantum
    efficiency.
    """

    def __init__(self, file: BenchFile, columns: FloatArray) -> None:
        self._file = file
        self._columns = list(columns)
        self._by_correction: dict[Correction, FloatArray] = {}

    def __call__(self, correction: Correction) -> FloatArray:
        if correction not in self._by_correction:
            stated = bench_optics(self._file.config.tracker, self._file.folder)
            efficiency = corrected(stated.quantum_efficiency, correction)
            optics = replace(stated, quantum_efficiency=efficiency)
            rates = channel_rates(self._file.config.sky, optics)
            self._by_correction[correction] = magnitude(rates(*self._columns))
        return self._by_correction[correction]


def corrected(curve: Curve, correction: Correction) -> Curve:
    """A quantum efficiency times exp(tilt x + bow x^2), x = ln(wavelength / 550 nm), at most 1."""
    if correction == NO_CORRECTION:
        return curve
    first_nm, last_nm = curve.wavelength_nm[[0, -1]]
    knots = max(2, round(float(last_nm - first_nm) / KNOT_NM))
    nm = np.union1d(curve.wavelength_nm, np.linspace(first_nm, last_nm, knots))
    nm = np.unique(np.round(nm, 2))  # as it is written
    x = np.log(nm / PIVOT_NM)
    tilt, bow = correction
    value = curve(nm) * np.exp(tilt * x + bow * x * x)
    largest = max(1.0, float(value.max()))
    return Curve(nm, value / largest)
