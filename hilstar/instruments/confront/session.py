"""From photographs to one camera: attitudes, stars by a PSF, geometry and light of all
photographs together.
"""

import math
from collections.abc import Sequence
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
    NO_PATTERN,
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
    LINEAR_OFF,
    LINEAR_SIGMAS,
    NO_CORRECTION,
    Correction,
    LightFit,
    StarLight,
    fit_light,
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


@dataclass(slots=True)
class Shot:
    """One photograph on its way: its background and sources, its sky, its pointing, and the stars
    on it.

    `star` (n,) are rows of `sky`, with the `measured` figures of each and whether it is `clean`:
    alone, and not saturated.
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
        """Stars that count in fits."""
        if self.saturated is None or self.blended is None:
            raise AssertionError("measured first")
        return ~self.saturated & ~self.blended

    @property
    def found(self) -> Measured:
        """The stars' figures."""
        if self.measured is None:
            raise AssertionError("measured first")
        return self.measured


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
        """What the sky's light of V = 0 has on the tracker, mag, as stars have theirs (see
        `LightFit.mag`).
        """
        config = self.file.config
        folder = self.file.folder
        optics = bench_optics(config.tracker, folder)
        if self.fixed:
            corrected_by = NO_CORRECTION
        else:
            corrected_by = self.light.correction
        optics = replace(
            optics, quantum_efficiency=corrected(optics.quantum_efficiency, corrected_by)
        )
        site = msgspec.structs.replace(config.site or SiteSettings(0.0, 0.0), sky_v_mag_arcsec2=0.0)
        glow = site_glow_e_per_s_sr(msgspec.structs.replace(config, site=site), folder, optics)
        return float(magnitude(np.array([glow / ARCSEC_PER_RAD**2]))[0])

    def plane_mag(self, number: int, columns: FloatArray) -> FloatArray:
        """By how much stars of V, B-V and V-I (3, n) are fainter to a plane of a mosaic than to
        the tracker as a whole, mag.
        """
        colour = self.light.colours[number] * (
            np.nan_to_num(columns[1], nan=MEAN_BV_MAG) - MEAN_BV_MAG
        )
        return np.asarray(colour + _channel_mag(self.file, self.shots[number].photo.plane, columns))

    def predicted_dn(
        self, number: int, star: IntArray, x_px: FloatArray, y_px: FloatArray
    ) -> FloatArray:
        """DN of stars (n,), rows of the sky of photograph `number`, at their places on it."""
        sky = self.shots[number].sky
        light = self.light
        columns = sky.columns(sky.order[star])
        mag = _Magnitudes(self.file, columns)(NO_CORRECTION if self.fixed else light.correction)
        mag = mag + self.plane_mag(number, columns) + extinct_mag(self.air, sky, star)
        shade = light.illumination(radius2_of(self.camera.camera, x_px, y_px))
        return np.asarray(10 ** (-0.4 * (mag + light.offsets_mag[number])) * shade)


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
    matched = replace(solution, source=point_rows[solution.source])
    wide_px = float(np.median(sources.fwhm_px[np.sort(matched.source)[:BRIGHTEST]]))
    if wide_px > WIDE_PX:
        raise InputError(
            f"{photo.path}: its stars are {wide_px:.0f} px wide; focus the lens, or give a frame in"
            " focus"
        )
    return Shot(
        photo,
        level,
        sources,
        sky,
        Pointing(solution.q_icrs_to_cam, air=sky.air),
        solution.focal_length_px,
        matched,
        np.empty(0, dtype=np.intp),
    )


def _field(sources: FoundSources, points: BoolArray, photo: Photograph) -> SourceField:
    width, height = photo.size_px
    places = np.column_stack([sources.x_px - (width - 1) / 2, sources.y_px - (height - 1) / 2])[
        points
    ]
    return SourceField(places, width, height)


def _solve(
    field: SourceField, base: Camera, sky: DatedSky, start: FloatArray | None
) -> SolvedField | None:
    if start is not None:
        near = rotate(conjugate(start), np.array([[0.0, 0.0, 1.0]]))[0]
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
    """What is seen of a photograph without an attitude, and what to do."""
    bright = np.flatnonzero(points)[:BRIGHTEST]
    length = np.median(sources.length_px[bright])
    width = np.median(sources.width_px[bright])
    if sources.trail.sum() >= MIN_MATCHED or (
        length > TRAILED_PX and length > TRAILED_RATIO * width
    ):
        if sources.trail.sum() >= MIN_MATCHED:
            trails = sources.length_px[sources.trail]
        else:
            trails = np.array([length])
        return (
            f"its stars are trails of about {np.median(trails):.0f} px; give a frame of a camera at"
            " rest, or a shorter exposure"
        )
    if (wide := np.median(sources.fwhm_px[bright])) > WIDE_PX:
        return f"its sources are {wide:.0f} px wide; focus the lens, or give a frame in focus"
    mirrored = replace(field, places_px=field.places_px * [-1, 1])
    if _solve(mirrored, base, sky, start) is not None:
        return (
            "is mirrored: its stars fit the sky only with left and right exchanged; flip the image"
        )
    reason = f"has {len(field.places_px)} sources, and no part of the sky fits them"
    degrees = math.degrees(2 * math.atan(field.width_px / 2 / base.focal_length_px))
    asked = " near --radec" if start is not None else ""
    return (
        f"{reason}{asked} at {degrees:.3g} deg of width within 20 %; check focal_length_mm and"
        " pixel_pitch_um" + ("" if start is not None else ", or give --radec RA,DEC,ROLL")
    )


def run_session(
    file: BenchFile,
    photos: Sequence[Photograph],
    base: Camera,
    start: FloatArray | None,
    *,
    fixed: "FixedCamera | None" = None,
) -> Session:
    """Everything about photographs of one camera; with `fixed` that camera, to which only attitudes
    and offsets are fitted.

    Raises InputError for a photograph without an attitude.
    """
    shots = [open_shot(file, photo, base, start) for photo in photos]
    focal = float(np.median([shot.focal_length_px for shot in shots]))
    if fixed is None:
        base = replace(base, focal_length_px=focal)
    else:
        base = fixed.camera
    if shots[0].sky.air is None:
        air = None
    else:
        air = site_air(file.config, file.folder, shots[0].sky.catalog)
    fit = partial(_fitted, file, base, fixed, air)
    session = fit(shots)
    off = abs(session.light.linearity - 1)
    if (
        fixed is not None
        or session.light.linearity < MIN_POWER
        or off < max(LINEAR_OFF, LINEAR_SIGMAS * session.light.sigma["linearity"])
    ):
        return session
    # the root of the logarithm of a session's power over that of the power undone, by secants
    before = (0.0, math.log(session.light.linearity))
    undone = math.log(session.light.linearity)
    for _ in range(TONE_ROUNDS):
        power = math.exp(undone)
        linear = [
            _linear(shot, photo, power) for shot, photo in zip(session.shots, photos, strict=True)
        ]
        trial = fit(linear, power=power, before=session.camera)
        log_linearity = math.log(max(trial.light.linearity, 0.1))
        if abs(log_linearity) < LINEAR_DONE:
            return fit(trial.shots, power=power)
        slope = (log_linearity - before[1]) / (undone - before[0])
        step = -log_linearity / slope if slope < 0 else log_linearity
        before = (undone, log_linearity)
        undone = undone + min(max(step, -MAX_TONE_STEP), MAX_TONE_STEP)
    return session  # no power makes it linear: its figures say so


@dataclass(frozen=True, slots=True)
class FixedCamera:
    """A camera file's own optics and detector, for --fixed."""

    camera: Camera
    psf: StarPsf
    light: LightFit
    pixels: PixelFit


def _linear(shot: Shot, photo: Photograph, power: float) -> Shot:
    """The shot with levels that go as light: those of the file to the power 1 / `power`, full
    scale as it is.
    """
    full = photo.full_dn
    dn = full * (np.maximum(photo.dn, 0) / full) ** (1 / power)
    middle = float(np.median(photo.dn)) / full
    step = photo.step_dn / power * max(middle, photo.step_dn / full) ** (1 / power - 1)
    linear = replace(photo, dn=paged(dn) if isinstance(photo.dn, np.memmap) else dn, step_dn=step)
    return replace(shot, photo=linear, level=_level(linear, step))


def _level(photo: Photograph, step_dn: float) -> SkyLevel:
    """The background, in a file where the photograph is in one."""
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
) -> Session:
    """The session of shots whose levels were made linear by a power; with the camera `before`,
    of their light alone.
    """
    if before is None:
        pointings = [shot.pointing for shot in shots]
    else:
        pointings = list(before.pointings)
    first = [_seen_at(s, s.matched.star, s.matched.source) for s in shots]
    if before is None and fixed is None:
        first, pointings = _outward(base, pointings, shots, first)
    camera = before or fit_camera(base, pointings, first, fixed=fixed is not None, last=False)
    if fixed is None:
        pixels = _pixels(shots, file.config.tracker.detector)
    else:
        pixels = fixed.pixels
    gain = pixels.gain_e_per_dn
    passes = PASSES if before is None else 1
    for number in range(passes):
        for shot, pointing in zip(shots, camera.pointings, strict=True):
            _identify(shot, camera.camera, pointing)
        psf = _psf(shots, gain) if fixed is None else fixed.psf
        for shot in shots:
            _measure(shot, psf, gain)
        if before is not None:
            continue
        places = [_places(shot) for shot in shots]
        camera = fit_camera(
            base, camera.pointings, places, fixed=fixed is not None, last=number == passes - 1
        )
        for shot, pointing in zip(shots, camera.pointings, strict=True):
            shot.pointing = pointing
    stars = _star_light(shots, camera.camera)
    columns = [s.sky.columns(s.sky.order[s.star]) for s in shots]
    magnitudes = _Magnitudes(file, np.concatenate(columns, axis=1))
    extinct = np.concatenate(
        [
            extinct_mag(air, s.sky, s.star) + _channel_mag(file, s.photo.plane, own_column)
            for s, own_column in zip(shots, columns, strict=True)
        ]
    )
    light = fit_light(
        stars,
        len(shots),
        lambda corrected: magnitudes(corrected) + extinct,
        None if fixed is None else fixed.light,
    )
    masses = [
        _masses(shot.sky, pointing) for shot, pointing in zip(shots, camera.pointings, strict=True)
    ]
    light = with_extinction(light, stars, masses, known=air is not None)
    return Session(
        file, tuple(shots), camera, psf, light, stars, pixels, power, fixed is not None, air
    )


def _seen_at(shot: Shot, star: IntArray, source: IntArray) -> Places:
    """Stars (n,) at their sources, before those are measured."""
    x_px = shot.sources.x_px[source]
    y_px = shot.sources.y_px[source]
    return Places(x_px, y_px, np.full(len(star), FIRST_PX), shot.sky.vectors[star])


def _outward(
    base: Camera, pointings: list[Pointing], shots: Sequence[Shot], first: list[Places]
) -> tuple[list[Places], list[Pointing]]:
    """First places and pointings, further from the middle than a pinhole's first match where the
    lens has a strong distortion.

    Stars are matched a little further out by the k1 of those matched before, until no more are
    found.
    """
    places = first
    now = list(pointings)
    for _ in range(MAX_ROUNDS):
        camera, turned = k1_camera(base, now, places)
        matches = [
            _beyond(shot, camera, *pose_and_places)
            for shot, pose_and_places in zip(shots, zip(turned, places, strict=True), strict=True)
        ]
        if max(_reach_px(camera, pose_and_places) for pose_and_places in matches) < FURTHER * max(
            _reach_px(camera, pose_and_places) for pose_and_places in places
        ):
            break
        places = matches
        now = turned
    if places is first:
        return (first, list(pointings))
    return (places, turned)


def _reach_px(camera: Camera, places: Places) -> float:
    """The radius about the principal point that holds 95 % of places."""
    cx, cy = camera.principal_point_px
    if len(places.x_px):
        return float(np.quantile(np.hypot(places.x_px - cx, places.y_px - cy), 0.95))
    return 0.0


def _beyond(shot: Shot, camera: Camera, pointing: Pointing, matched: Places) -> Places:
    """The bright stars at sources up to BEYOND times the radius of those that are `matched`."""
    (cx, cy), (width, height), sources = camera.principal_point_px, shot.photo.size_px, shot.sources
    reach_px = BEYOND * _reach_px(camera, matched)
    points = np.flatnonzero(~sources.single & ~sources.trail)[:MAX_SOURCES]
    points = points[np.hypot(sources.x_px[points] - cx, sources.y_px[points] - cy) < reach_px]
    x, y = pointing.places_px(camera, shot.sky.vectors)
    with np.errstate(invalid="ignore"):
        inside = (
            (x > 0)
            & (x < width - 1)
            & (y > 0)
            & (y < height - 1)
            & (np.hypot(x - cx, y - cy) < reach_px)
        )
    star = np.flatnonzero(inside)[: len(points)]
    tree = cKDTree(np.column_stack([sources.x_px[points], sources.y_px[points]]))
    star_index, source = nearest_once(
        tree, np.column_stack([x[star], y[star]]), NEAR * math.hypot(width, height)
    )
    return _seen_at(shot, star[star_index], points[source])


def _channel_mag(file: BenchFile, plane: str, columns: FloatArray) -> FloatArray:
    """What stars have to the channel of a plane (r, g1, g2, b) more than to all, mag; 0 where
    the bench has one channel.
    """
    channels = bench_channels(file.config.tracker, file.folder)
    if not plane or len(channels) < 3:
        return np.zeros(columns.shape[1])
    both = channels["rgb".index(plane[0])], bench_optics(file.config.tracker, file.folder)
    own_mag, every = (
        magnitude(channel_rates(file.config.sky, optics)(*columns)) for optics in both
    )
    return np.asarray(own_mag - every)


def extinct_mag(air: SiteAir | None, sky: DatedSky, star: IntArray) -> FloatArray:
    """What the air over `[site]` takes of stars (n,), mag; nothing without a site or a date."""
    if air is None or sky.air is None:
        return np.zeros(len(star))
    return np.asarray(
        magnitude(air.shares(sky.order[star], sky.air.altitude_rad(sky.vectors[star]))[0])
    )


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
    masks = [source_mask(s.sources, s.level.above(s.photo.dn), SOURCE_PX) for s in shots]
    points = [
        transfer_points(s.photo.dn, s.level.level, mask)
        for s, mask in zip(shots, masks, strict=True)
    ]
    height, width = shots[0].photo.dn.shape
    side = shots[0].level.block_px
    y, x = np.mgrid[side // 2 : height : side, side // 2 : width : side]
    places = np.column_stack([x.ravel() / width, y.ravel() / height]) - 0.5
    pedestal = fit_pedestal([s.level.level[y, x].ravel() for s in shots], places)
    # stars too faint to be seen are pixels' own where two photographs have one part of the sky
    apart: list[int] = []
    for k, shot in enumerate(shots):
        moved = []
        for j in apart:
            moved.append(
                np.linalg.norm(shot.pointing.boresight - shots[j].pointing.boresight)
                * shot.focal_length_px
            )
        if all(px > APART_PX for px in moved):
            apart.append(k)
    if pedestal is None:
        zero = assumed.offset_dn
    else:
        zero = pedestal[0]
    pattern = fixed_pattern(
        (s.photo.dn - s.level.level, s.level.level - zero, ~masks[k])
        for k, s in enumerate(shots)
        if k in apart
    )
    exposure_s = shots[0].photo.exposure_s or 0.0
    dsnu_e = math.hypot(assumed.dsnu_e, assumed.dsnu_e_per_s * exposure_s)
    exposed = structs.replace(assumed, dsnu_e=dsnu_e)
    step_dn = max(s.photo.step_dn for s in shots)
    return fit_pixels(np.concatenate(points), step_dn, pedestal, exposed, pattern or NO_PATTERN)


def _identify(shot: Shot, camera: Camera, pointing: Pointing) -> None:
    """Which stars of the catalogue are sources of the shot, and which of them stand alone and
    are not saturated.
    """
    width, height = shot.photo.size_px
    x, y = pointing.places_px(camera, shot.sky.vectors)
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(
            (x > HALF) & (x < width - 1 - HALF) & (y > HALF) & (y < height - 1 - HALF)
        )
    tree = cKDTree(np.column_stack([shot.sources.x_px, shot.sources.y_px]))
    star_index, source = nearest_once(tree, np.column_stack([x[inside], y[inside]]), MATCH_PX)
    star = inside[star_index]
    every = cKDTree(np.column_stack([x[inside], y[inside]]))
    v = shot.sky.v_mag
    blended = np.zeros(len(star), dtype=bool)
    for k, star_index in enumerate(star):
        beside = inside[every.query_ball_point([x[star_index], y[star_index]], BLEND_PX)]
        beside = beside[beside != star_index]
        blended[k] = bool((v[beside] < v[star_index] + BLEND_MAG).any())
    if len(shot.sources) > 1:
        snr = shot.sources.snr
        apart, other = (np.asarray(part)[:, -1] for part in tree.query(tree.data[source], k=2))
        blended |= (apart < BLEND_PX) & (snr[other] > flux_ratio(BLEND_MAG) * snr[source])
    shot.star = star
    above = shot.photo.dn - shot.level.level
    variance = shot.level.noise**2
    shot.stamps = cut_stamps(
        above, variance, shot.sources.x_px[source], shot.sources.y_px[source], shot.sky.bv_mag[star]
    )
    top = cut_stamps(
        shot.photo.dn,
        variance,
        shot.sources.x_px[source],
        shot.sources.y_px[source],
        shot.sky.bv_mag[star],
    )
    middle = top.values[:, HALF - 3 : HALF + 4, HALF - 3 : HALF + 4]
    shot.saturated = middle.max(axis=(1, 2)) >= SATURATED_SHARE * shot.photo.full_dn
    shot.blended = blended


def _psf(shots: Sequence[Shot], gain: float) -> StarPsf:
    """The PSF by the brightest clean stars of all shots."""
    clean = [shot.clean for shot in shots]
    stamps = join(
        [
            shot.stamps.at(mask)
            for shot, mask in zip(shots, clean, strict=True)
            if shot.stamps is not None
        ]
    )
    if len(stamps) < 3:
        stamps = join([shot.stamps for shot in shots if shot.stamps is not None])
    light = stamps.values[:, 2:-2, 2:-2].sum(axis=(1, 2)) / np.sqrt(
        np.median(stamps.variance, axis=(1, 2))
    )
    best = np.zeros(len(stamps), dtype=bool)
    best[np.argsort(-light)[:PSF_STARS]] = True
    stamps = stamps.at(best)
    return fit_psf(stamps, *_middles(stamps), shots[0].photo.size_px, gain)


def _middles(stamps: Stamps) -> tuple[FloatArray, FloatArray]:
    """First places: centres of gravity of the 5 x 5 middle pixels."""
    part = np.maximum(stamps.values[:, HALF - 2 : HALF + 3, HALF - 2 : HALF + 3], 0)
    total = np.maximum(part.sum(axis=(1, 2)), 1e-9)
    reach = np.arange(-2, 3)
    return (
        stamps.column + part.sum(axis=1) @ reach / total,
        stamps.row + part.sum(axis=2) @ reach / total,
    )


def _measure(shot: Shot, psf: StarPsf, gain: float) -> None:
    if shot.stamps is None:
        raise AssertionError("identified first")
    shot.measured = measure(shot.stamps, psf, *_middles(shot.stamps), gain)


def _places(shot: Shot) -> Places:
    """Places that count in a fit of the geometry: those of clean stars."""
    use = shot.clean & (shot.found.dn > SCATTER_SNR * shot.found.sigma_dn)
    if use.sum() < MIN_MATCHED:
        use = shot.clean
    if use.sum() < 3:
        use = np.ones(len(shot.star), dtype=bool)
    sources = shot.found
    return Places(
        sources.x_px[use],
        sources.y_px[use],
        sources.sigma_px[use],
        shot.sky.vectors[shot.star[use]],
    )


def radius2_of(camera: Camera, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Squares of radii from the principal point, in half diagonals."""
    (cx, cy), (width, height) = camera.principal_point_px, camera.resolution_px
    return np.asarray(((x_px - cx) ** 2 + (y_px - cy) ** 2) / ((width**2 + height**2) / 4))


def _star_light(shots: Sequence[Shot], camera: Camera) -> StarLight:
    parts = []
    for k, shot in enumerate(shots):
        sources = shot.found
        radius2 = radius2_of(camera, sources.x_px, sources.y_px)
        sky = shot.sky
        parts.append(
            (
                np.full(len(shot.star), k),
                sources.dn,
                sources.sigma_dn,
                sky.v_mag[shot.star],
                sky.bv_mag[shot.star],
                radius2,
                shot.clean,
                np.full(len(shot.star), " rgb".index(shot.photo.plane[:1] or " ")),
            )
        )
    return StarLight(*(np.concatenate(part) for part in zip(*parts, strict=True)))


class _Magnitudes:
    """Magnitudes of the session's stars by hilstar's own spectra, through a corrected quantum
    efficiency.
    """

    def __init__(self, file: BenchFile, columns: FloatArray) -> None:
        self._file = file
        self._columns = list(columns)
        self._kept: dict[Correction, FloatArray] = {}

    def __call__(self, correction: Correction) -> FloatArray:
        if correction not in self._kept:
            optics = bench_optics(self._file.config.tracker, self._file.folder)
            optics = replace(
                optics, quantum_efficiency=corrected(optics.quantum_efficiency, correction)
            )
            rates = channel_rates(self._file.config.sky, optics)
            self._kept[correction] = magnitude(rates(*self._columns))
        return self._kept[correction]


def corrected(curve: Curve, correction: Correction) -> Curve:
    """A quantum efficiency times exp(tilt x + bow x^2), x = ln(wavelength / 550 nm), at most 1."""
    if correction == NO_CORRECTION:
        return curve
    ends = curve.wavelength_nm[[0, -1]]
    nm = np.union1d(
        curve.wavelength_nm,
        np.linspace(ends[0], ends[-1], max(2, round(float(np.ptp(ends)) / KNOT_NM))),
    )
    nm = np.unique(np.round(nm, 2))  # as it is written
    x = np.log(nm / PIVOT_NM)
    value = curve(nm) * np.exp(correction[0] * x + correction[1] * x * x)
    return Curve(nm, value / max(1.0, float(value.max())))
