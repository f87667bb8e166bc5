"""The virtual tracker: the sky straight onto its detector, in electrons and then in DN.

An exposure with faults is cut where a fault begins or ends; each piece has its own view and its own
faults.
"""

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import propagate, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.render.numpy_backend import headless_context, open_backend
from hilstar.display.render.target import Target
from hilstar.instruments.simulate.shutter import rolled
from hilstar.optics.camera import Camera, linear_shares
from hilstar.optics.exposure_motion import MIDDLE_S, own_row_s
from hilstar.optics.frame_motion import EVERY
from hilstar.optics.layers.bodies import disc_stars
from hilstar.optics.layers.fault_kinds import CosmicRays, Now
from hilstar.optics.layers.fault_light import FaultView
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.layers import light_of, seen_in, sky_layers
from hilstar.optics.layers.truth import (
    TRUTH_DTYPE,
    added_truth,
    truth_table,
    with_channels,
    with_errors,
    without_errors,
)
from hilstar.optics.layers.view import STILL, Canvas, View
from hilstar.optics.paths import Paths
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight, by_channel, join_sprites, shares_by_bv, without_stars
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import tracker_camera, tracker_psf
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.config.bench_config import sky_jd
from hilstar.server.bench.fault_views import tracker_view
from hilstar.server.bench.glass import say_once
from hilstar.server.bench.scenario import Scenario, Timetable
from hilstar.server.bench.star_glass import StarGlass, star_glass
from hilstar.server.bench.star_light import bench_sources, bench_stars, moved
from hilstar.server.bench.star_rates import bench_channels, bench_optics
from hilstar.sky.electrons import Optics, Photometry, zodiacal_electrons_per_s_arcsec2
from hilstar.sky.stars import Stars
from hilstar.sky.zodiacal import ZodiacalLight, sunward, tabled_light
from hilstar.tracker.detector import Detector
from hilstar.tracker.mosaic import in_pixels
from hilstar.tracker.settings import MAX_E, DetectorSettings

if TYPE_CHECKING:
    from hilstar.display.render.context import Context
    from hilstar.sky.bodies.moving import MovingSky

log = logging.getLogger(__name__)

# The attitude at a time of the run, ns.
AttitudeAt = Callable[[int], FloatArray]
# places along each side of a detector at which zodiacal light is computed; it is linear between
# them
LATTICE = 17
# A row of TRUTH_DTYPE, and the place of its light, px, and its illumination, as the tracker's
# optics make them.
EXPOSURE_DTYPE = np.dtype(
    [
        *TRUTH_DTYPE.descr,
        ("x_centroid_px", "f8"),
        ("y_centroid_px", "f8"),
        ("relative_illumination", "f8"),
    ]
)
CLIPPED_PX = 3  # a side of the square about a star with pixels of every colour beside its own
NO_MOSAIC = (
    "quantum_efficiency_r, _g and _b without a mosaic: each pixel adds them up; write"
    ' [tracker.detector] bayer = "rggb"'
)
BODY_MAX_E = 0.5 * MAX_E  # room for dark current and cosmic rays
Noise = Literal["full", "none"]


@dataclass(frozen=True, slots=True)
class FrameNoise:
    """Noise of frames: "full", or "none" for the mean signal through the ADC; and its seed."""

    kind: Noise = "full"
    seed: int = 0

    def rng(self, *number: int) -> np.random.Generator | None:
        """The generator of a frame, or of frame `number` of several; None without noise."""
        if self.kind == "full":
            return np.random.default_rng((self.seed, *number) if number else self.seed)
        return None


@dataclass(frozen=True)
class Exposure:
    """One frame of the virtual tracker: DN (height, width), the electrons expected in it, and its
    stars.

    DN and electrons are those of the raw mosaic where the tracker has one. `rows` are those of
    EXPOSURE_DTYPE, and of three channels CHANNEL_COLUMNS: what a star gives where all pixels have
    that colour. Places are those at the middle of the exposure (NaN behind the camera), and
    `clipped` stars reach full well or the ADC's last code. `capped` stars have paths coarser than
    they should be. `truth` is `rows` with the errors of the stars, which `errors` reads when they
    are first asked for, or when the exposure is pickled: no centroid asks for them.
    """

    view: View
    dn: npt.NDArray[np.uint16]
    mean_e: FloatArray
    rows: npt.NDArray[np.void]
    capped: int = 0
    faults: tuple[str, ...] = ()
    errors: Callable[[npt.NDArray[np.void]], npt.NDArray[np.void]] = without_errors

    @cached_property
    def truth(self) -> npt.NDArray[np.void]:
        """The stars of the exposure, as `hilstar simulate` writes them, brightest first."""
        return self.errors(self.rows)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"truth": self.truth, "errors": without_errors}

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[Any]:
        """The DN."""
        return np.array(self.dn, dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        height, width = self.dn.shape
        return (
            f"<hilstar exposure: {len(self.rows)} stars, DN {self.dn.min()} to {self.dn.max()},"
            f" {width} x {height} px>"
        )


class Simulator(Closing):
    """A bench's tracker looking at the sky itself, drawn in a GL context of its own or in another
    renderer's.

    Free it with `close`, or use it as a context manager; one in another's context ends with that.
    One that does not `refuse` views goes on near the Sun (see `TrackerBackground`). `psf` stands
    for the bench's own.
    """

    def __init__(
        self,
        file: BenchFile,
        context: "Context | None" = None,
        *,
        refuse: bool = True,
        psf: Psf | None = None,
    ) -> None:
        self.file = file
        self._refuse = refuse
        self._psf = psf
        self.config = file.config
        self._load_sky()
        self._load_tracker()
        self._layers = sky_layers(self.canvas, self.sources)
        target = Target(self.config.tracker.resolution_px, self.canvas.psf)
        self.renderer = open_backend(target, context or headless_context(self.config.render.gpu))

    def _load_sky(self) -> None:
        self.sources = bench_sources(self.config, self.file.folder)
        self.stars = moved(bench_stars(self.config, self.file.folder, self.moving), self.moving)

    def _load_tracker(self) -> None:
        tracker = self.config.tracker
        self.camera = tracker_camera(tracker, self.file.folder)
        self.canvas = detector_canvas(self.file, self.camera, self._psf)
        psf = self.canvas.psf
        self.glass = star_glass(self.file, psf)
        self._glasses = [self.glass]
        if (bayer := tracker.detector.bayer) is not None:
            channels = bench_channels(tracker, self.file.folder)
            self._glasses = [star_glass(self.file, psf, optics) for optics in channels]
        elif len(tracker.quantum_efficiencies) > 1:
            say_once(NO_MOSAIC, "[tracker]")
        self._bayer = bayer
        self._background = TrackerBackground(
            self.config, self.file.folder, self.camera, refuse=self._refuse, moving=self.moving
        )
        self.background_e = self._background.steady_e
        self.detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)

    def change(self, file: BenchFile) -> None:
        """Switch to another bench file of the same folder, rebuilding only what changed.

        The simulator must have a GL context of its own. Raises what the simulator itself does;
        close it then.
        """
        if file.config == self.config and file.sha256 == self.file.sha256:
            return
        before = self.config
        self.file = file
        self.config = file.config
        if self.moving is not None or _sky_keys(before) != _sky_keys(self.config):
            self._load_sky()
        if _tracker_keys(before) != _tracker_keys(self.config):
            self._load_tracker()
        self._layers = sky_layers(self.canvas, self.sources)
        target = Target(self.config.tracker.resolution_px, self.canvas.psf)
        drawn = self.renderer.target
        # not the targets: a comparison of their arrays is no truth value
        if (target.resolution_px, target.psf) != (drawn.resolution_px, drawn.psf):
            self.renderer.close()
            self.renderer = open_backend(target, headless_context(self.config.render.gpu))

    @property
    def moving(self) -> "MovingSky | None":
        """The bodies, the satellites and the observer; None where the sky stands still."""
        return self.sources.moving

    @property
    def gl_renderer(self) -> str:
        """The name of the GL renderer, as the driver gives it."""
        return self.renderer.gl_renderer

    def view(
        self,
        q_icrs_to_cam: FloatArray,
        rate_cam_rad_s: FloatArray,
        t_ns: int | None = None,
        velocity_km_s: FloatArray | None = None,
        place_km: FloatArray | None = None,
    ) -> View:
        """An exposure of this tracker, by the attitude in its middle (unit quaternion) and a
        constant rate (see `View`).
        """
        return View.exposure(
            q_icrs_to_cam,
            rate_cam_rad_s,
            self.config.tracker.exposure_s,
            t_ns,
            velocity_km_s,
            place_km,
        )

    def expose(
        self, view: View, rng: np.random.Generator | None, faults: "FaultyExposure | None" = None
    ) -> Exposure:
        """One frame; without a generator, without noise. Raises InputError for what a detector
        cannot take.
        """
        exposure_s = self.config.tracker.exposure_s
        canvas = self.canvas
        view = rolled(view, self.config.tracker)
        stars = seen_in(view, self.stars, self.moving)
        # without a generator there is no noise, and stars do not twinkle
        if self.moving is not None and self.moving.air is not None and rng is not None:
            stars = self.moving.air.twinkling(stars, self.moving.utc_ns(view.t_ns), exposure_s, rng)
        layers = self._layers
        if faults is None:
            light = light_of(canvas, layers, stars, view)
            mean_e = self._exposed_e(light, stars, exposure_s)
            mean_e += self._background.of_view_e(view)
        else:

            def light_with_faults(part: View, layer: FaultLayer) -> FrameLight:
                return light_of(canvas, (*layers, layer), stars, rolled(part, self.config.tracker))

            def exposed_e(light: FrameLight, seconds: float) -> FloatArray:
                return self._exposed_e(light, stars, seconds)

            mean_e, open_s = faults.light_e(light_with_faults, exposed_e)
            middle = faults.pieces[len(faults.pieces) // 2]
            mean_e += self._background.of_view_e(middle.view) * (open_s / exposure_s)
            light = faults.sprites()
        # the Sun has more than a detector can be asked for; its wells are full long before
        if self.moving is not None:
            mean_e = np.minimum(mean_e, BODY_MAX_E)
        if self.glass is not None:  # a measured PSF may be negative somewhere
            np.maximum(mean_e, 0.0, out=mean_e)
        dn = self._digitised(mean_e, rng)
        truth = exposure_truth(canvas, view, stars, light, mean_e, self.glass)
        epoch_jyear = self.config.sky.epoch_jyear
        errors = partial(with_errors, catalog=stars.catalog, epoch_jyear=epoch_jyear)
        if faults is None:
            return Exposure(view, dn, mean_e, truth, light.capped, errors=errors)
        added = _exposed(faults.added_truth())
        by_bv = stars.colours_by_bv
        added_shares = None if by_bv is None else shares_by_bv(by_bv, added["bv"])
        added = with_channels(added, added_shares)
        truth = np.concatenate([truth, added])
        return Exposure(view, dn, mean_e, truth, light.capped, faults.names, errors)

    def _digitised(
        self, mean_e: FloatArray, rng: np.random.Generator | None
    ) -> npt.NDArray[np.uint16]:
        """The DN of mean electrons (h, w), with noise by a generator or without."""
        exposure_s = self.config.tracker.exposure_s
        if rng is None:
            return self.detector.expose_noiseless(mean_e, exposure_s)
        return self.detector.expose(mean_e, exposure_s, rng)

    def _exposed_e(self, sprites: FrameLight, stars: Stars, seconds: float) -> FloatArray:
        """Electrons of each pixel (h, w) by sprites of `stars` in some time."""
        if self._bayer is None:
            channels = [sprites]
        else:
            channels = by_channel(sprites, stars)
        images = (
            self._image(light, stars, glass)
            for light, glass in zip(channels, self._glasses, strict=True)
        )
        return np.multiply(in_pixels(images, self._bayer), seconds, dtype=np.float64)

    def _image(self, sprites: FrameLight, stars: Stars, glass: StarGlass | None) -> Float32Array:
        """Electrons per second of each pixel (h, w) of one colour, in memory that the next image
        takes.
        """
        if glass is None:
            self.renderer.draw(sprites)
            return self.renderer.linear()
        shares = glass.shares(stars, sprites.star)
        rates = sprites.data["electrons_per_s"]
        size_px = self.config.tracker.resolution_px
        image = glass.psf.image(sprites.x_px, sprites.y_px, shares, rates, size_px)
        if sprites.extended:
            self.renderer.draw(without_stars(sprites))
            image += self.renderer.linear()
        return image

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()


@dataclass(frozen=True, slots=True)
class ExposurePiece:
    """A part of an exposure in which the same faults are on: its own view, and what is on when
    it begins.
    """

    view: View
    now: tuple[Now, ...]


def pieces_of(
    view: View, run_ns: int, timetable: Timetable, attitude_at: AttitudeAt | None = None
) -> tuple[ExposurePiece, ...]:
    """The pieces of an exposure whose middle is at `run_ns` of a scenario.

    `attitude_at` gives the attitude at which a display that stands still has stopped; by default it
    had the exposure's rate.
    """
    rate = view.turn.rate_cam_rad_s

    def at_constant_rate(t_ns: int) -> FloatArray:
        if t_ns == run_ns:
            return view.q_icrs_to_cam
        return propagate(view.q_icrs_to_cam, rate, (t_ns - run_ns) / NS_PER_S)

    where = attitude_at or at_constant_rate
    half_ns = round(view.exposure_s * NS_PER_S / 2)
    edges = timetable.edges_ns(run_ns - half_ns, run_ns + half_ns)
    pieces = []
    for begin_ns, end_ns in itertools.pairwise(edges):
        middle_ns = (begin_ns + end_ns) // 2
        now = timetable.on(middle_ns, begin_ns)
        q_icrs_to_cam = at_constant_rate(middle_ns)
        piece_rate = rate
        stopped_ns = timetable.stands_since_ns(middle_ns)
        if stopped_ns is not None:
            q_icrs_to_cam = where(stopped_ns)
            piece_rate = STILL
        t_ns = None
        if view.t_ns is not None:
            t_ns = view.t_ns + middle_ns - run_ns
        part = replace(
            view,
            q_icrs_to_cam=q_icrs_to_cam,
            rate_cam_rad_s=piece_rate,
            t_ns=t_ns,
            scan=Scan(hold_s=(end_ns - begin_ns) / NS_PER_S),
        )
        pieces.append(ExposurePiece(part, now))
    return tuple(pieces)


def joined(parts: Sequence[FrameLight]) -> FrameLight:
    """The light of an exposure's pieces, end to end: each disc once, and capped stars of all."""
    whole = join_sprites(parts, parts[0].footprint_px)
    discs: dict[str, None] = {}
    for part in parts:
        discs |= dict.fromkeys(part.discs)
    capped = sum(part.capped for part in parts)
    return replace(whole, capped=capped, discs=tuple(discs))


class FaultyExposure:
    """One exposure with its faults, as `Simulator.expose` draws it, piece by piece."""

    def __init__(self, view: FaultView, pieces: Sequence[ExposurePiece]) -> None:
        self._view = view
        self.pieces = pieces
        self._seen: list[FrameLight] = []
        self._rows: list[tuple[npt.NDArray[np.void], float]] = []

    def light_e(
        self,
        light_of: Callable[[View, FaultLayer], FrameLight],
        exposed_e: Callable[[FrameLight, float], FloatArray],
    ) -> tuple[FloatArray, float]:
        """Electrons (h, w) of the whole exposure, and the seconds of it in which the field is not
        blank.

        `light_of` makes the light of a view with faults, `exposed_e` the electrons of its image in
        some seconds.
        """
        total: FloatArray | None = None
        open_s = 0.0
        exposure_s = sum(piece.view.exposure_s for piece in self.pieces)
        for piece in self.pieces:
            layer = FaultLayer(self._view, piece.now)
            piece_s = piece.view.exposure_s
            sprites = light_of(layer.turned(piece.view), layer)
            light = exposed_e(sprites, piece_s)
            total = light if total is None else total + light
            if not layer.blank:
                open_s += piece_s
            self._note(sprites, piece_s / exposure_s)
        if total is None:
            raise AssertionError("an exposure has a piece")
        return total, open_s

    def _note(self, sprites: FrameLight, share: float) -> None:
        self._seen.append(sprites)
        if sprites.added:
            unclipped = np.zeros(len(sprites), dtype=bool)
            self._rows.append((added_truth(sprites, unclipped), share))

    @property
    def names(self) -> tuple[str, ...]:
        """The faults that are on in it."""
        return tuple(dict.fromkeys(active.fault.name for active in self._active()))

    def _active(self) -> Iterator[Now]:
        """The faults that are on in each piece, piece after piece."""
        for piece in self.pieces:
            yield from piece.now

    def sprites(self) -> FrameLight:
        """The sprites of the bench's own stars and discs in any of its pieces, end to end."""
        return joined([_own(sprites) for sprites in self._seen])

    def added_truth(self) -> npt.NDArray[np.void]:
        """Rows of TRUTH_DTYPE for what faults added: in electrons per second of the whole
        exposure, at the mean place.
        """
        tracks = set()
        for active in self._active():
            if isinstance(active.fault, CosmicRays):
                tracks.add(active.fault.name)
        points: dict[str, npt.NDArray[np.void]] = {}
        tables: list[npt.NDArray[np.void]] = []
        for rows, share in self._rows:
            rows["electrons_per_s"] *= share
            for row in rows:
                name = str(row["name"])
                if name in tracks:
                    tables.append(row)
                elif name in points:
                    _merge(points[name], row)
                else:
                    points[name] = row.copy()
        made = np.zeros(len(points) + len(tables), dtype=TRUTH_DTYPE)
        for k, row in enumerate([*points.values(), *tables]):
            made[k] = row
        return made


def _merge(into: npt.NDArray[np.void], row: npt.NDArray[np.void]) -> None:
    """Add the light of the same point in another piece of the exposure."""
    before = float(into["electrons_per_s"])
    more = float(row["electrons_per_s"])
    for place in ("x_px", "y_px"):
        into[place] = (into[place] * before + row[place] * more) / (before + more)
    into["electrons_per_s"] = before + more


def _own(sprites: FrameLight) -> FrameLight:
    """Sprites without light that a fault adds."""
    if not sprites.added:
        return sprites
    is_star = sprites.star >= 0
    x_px = sprites.x_px[is_star]
    y_px = sprites.y_px[is_star]
    return replace(
        sprites,
        data=sprites.data[is_star],
        star=sprites.star[is_star],
        x_px=x_px,
        y_px=y_px,
        added=(),
    )


def simulator_view(simulator: Simulator, scenario: Scenario) -> FaultView:
    """The faults of a scenario as a simulator's tracker sees them."""
    return tracker_view(
        simulator.file, simulator.canvas, simulator.stars, simulator.moving, scenario
    )


def detector_canvas(file: BenchFile, camera: Camera, psf: Psf | None = None) -> Canvas:
    """The detector of a bench's tracker as layers draw on it, by its own PSF or `psf`. Raises
    InputError as `tracker_psf`.
    """
    tracker = file.config.tracker
    return Canvas(camera, psf or tracker_psf(tracker, file.folder), full_e=full_e(tracker.detector))


def exposure_truth(
    canvas: Canvas,
    view: View,
    stars: Stars,
    light: FrameLight,
    mean_e: FloatArray,
    glass: StarGlass | None = None,
) -> npt.NDArray[np.void]:
    """The truth of an exposure (see `Exposure`): a row for each of `stars` that has a sprite in its
    light, and for discs.

    Behind a rolling shutter each is in the middle of its own row's exposure. With a `glass`
    centroids and illumination are those of each star's light through it.
    """
    star = np.append(np.unique(light.star), disc_stars(stars, light.discs))
    icrs_to_image = view.motion.icrs_to_image(MIDDLE_S, canvas.camera)[0]
    image_directions = stars.directions(star) @ icrs_to_image.T
    x_px, y_px = canvas.camera.project(image_directions)
    if view.scan.scanout_s and view.turns:
        rate_image_rad_s = canvas.camera.cam_to_image @ view.turn.rate_cam_rad_s
        paths = Paths(image_directions, rate_image_rad_s, canvas.camera)
        row_s, _ = own_row_s(paths, EVERY, np.zeros(len(star)), view.scan)
        x_px, y_px = paths.places_px(EVERY, row_s)
    truth = _exposed(truth_table(stars, star, x_px, y_px))
    height, width = mean_e.shape
    column, row = np.rint(x_px), np.rint(y_px)
    inside = np.isfinite(x_px) & (column >= 0) & (column < width)
    inside &= (row >= 0) & (row < height)
    place = row[inside].astype(np.intp), column[inside].astype(np.intp)
    # of other colours, the brightest pixel may be a neighbour of the star's own
    if stars.colours is not None:
        from scipy.ndimage import maximum_filter

        mean_e = maximum_filter(mean_e, CLIPPED_PX)
    truth["clipped"][inside] = mean_e[place] > canvas.full_e
    if glass is not None:
        shares = glass.shares(stars, star[inside])
        x, y, illumination = glass.psf.centroids_px(x_px[inside], y_px[inside], shares)
        truth["x_centroid_px"][inside] = x
        truth["y_centroid_px"][inside] = y
        truth["relative_illumination"][inside] = illumination
    truth["clipped"] |= np.isin(truth["name"], light.over_white)
    colours = None if stars.colours is None else stars.colours[star]
    truth = with_channels(truth, colours)
    return truth[np.argsort(truth["v_mag"], kind="stable")]


def _exposed(truth: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """Rows of EXPOSURE_DTYPE, of TRUTH_DTYPE: all light at its place, and no vignetting."""
    exposed = np.zeros(len(truth), dtype=EXPOSURE_DTYPE)
    for name in TRUTH_DTYPE.names or ():
        exposed[name] = truth[name]
    exposed["x_centroid_px"] = truth["x_px"]
    exposed["y_centroid_px"] = truth["y_px"]
    exposed["relative_illumination"] = 1.0
    return exposed


def full_e(detector: DetectorSettings) -> float:
    """The electrons of a pixel that is full, or at the ADC's last code."""
    last_code_e = (2**detector.bits - 1 - detector.offset_dn) * detector.gain_e_per_dn
    return float(min(detector.full_well_e, last_code_e))


def _sky_keys(config: BenchConfig) -> tuple[object, ...]:
    """All by which the rates and directions of stars are made, where no body moves among them."""
    tracker = config.tracker
    gathers = (
        tracker.aperture_mm,
        tracker.quantum_efficiencies,
        tracker.transmission,
        tracker.detector.fill_factor,
    )
    return config.sky, config.spacecraft, config.site, gathers


def _tracker_keys(config: BenchConfig) -> tuple[object, ...]:
    """All by which a tracker and its background are made."""
    return config.tracker, config.background, config.sky, config.site


def gathered(glow: FloatArray, bayer: str | None) -> FloatArray:
    """The glow (channels, n) that pixels gather: by channel under a mosaic, else all (1, n)."""
    if bayer is None:
        return np.asarray(glow.sum(axis=0, keepdims=True))
    return glow


class TrackerBackground:
    """Light between the stars on a bench's detector: what is the same in every view, zodiacal light
    by direction, sky glow.

    Pixels of a mosaic have their own channel's, of a tracker without one that of all channels.
    Zodiacal light and glow are computed at LATTICE places along each side of the detector, each
    with its pixel's solid angle. Where the table of zodiacal light is blank, near the Sun, a field
    is refused (InputError); without `refuse` the nearest tabled light is drawn, and a warning says
    so once until the field has left that part of the sky.
    """

    def __init__(
        self,
        config: BenchConfig,
        folder: Path,
        camera: Camera,
        *,
        refuse: bool = True,
        moving: "MovingSky | None" = None,
    ) -> None:
        tracker = config.tracker
        self._bayer = tracker.detector.bayer
        if self._bayer is None:
            channels: tuple[Optics, ...] = (bench_optics(tracker, folder),)
        else:
            channels = bench_channels(tracker, folder)
        places = camera.grid_px(LATTICE)
        self._sr = camera.pixel_sr(*places)
        width, height = camera.resolution_px
        self._across = linear_shares(width, LATTICE)
        self._down = linear_shares(height, LATTICE)
        pixel_sr = self._over_pixels(self._sr)
        steady = (background_e(config, optics, pixel_sr) for optics in channels)
        self.steady_e = in_pixels(steady, self._bayer)
        self._config = config
        self._refuse = refuse
        self._beyond = False
        self._moving = None
        if moving is not None and moving.air is not None and moving.air.glow_e_per_s_sr.any():
            self._moving = moving
        self._lights: list[ZodiacalLight] = []
        if config.background.zodiacal is not None:
            self._lights = [ZodiacalLight.through(optics) for optics in channels]
        if not self._lights and self._moving is None:
            return
        rays = camera.rays(*places)
        self._rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def of_view_e(self, view: View) -> FloatArray:
        """Electrons per exposure (height, width) in a view. Raises InputError near the Sun."""
        if not self._lights and self._moving is None:
            return self.steady_e
        directions = self._rays @ to_matrix(view.q_icrs_to_cam)
        rates: list[FloatArray] = []
        if self._lights:
            sun_angles = sunward(directions, sky_jd(self._config, view.t_ns))
            zodiacal = tabled_light(sun_angles)
            self._say(float(sun_angles.elongation_deg.min()), beyond=not zodiacal.tabled.all())
            rates = [light.electrons_per_s_sr(sun_angles, zodiacal) for light in self._lights]
        if self._moving is not None and self._moving.air is not None:
            of_channels = self._moving.air.glow_at(directions, self._moving.utc_ns(view.t_ns))
            glow = gathered(of_channels, self._bayer)
            if rates:
                rates = [rate + more for rate, more in zip(rates, glow, strict=True)]
            else:
                rates = list(glow)
        by_place = self._sr * self._config.tracker.exposure_s
        images = (self._over_pixels(rate * by_place) for rate in rates)
        return np.asarray(self.steady_e + in_pixels(images, self._bayer))

    def _over_pixels(self, values: FloatArray) -> FloatArray:
        """Values at the lattice's places (n,) as an image (height, width)."""
        lattice = values.reshape(LATTICE, LATTICE)
        return np.asarray(self._down @ lattice @ self._across.T)

    def _say(self, nearest_deg: float, *, beyond: bool) -> None:
        """Refuse a field beyond the table, or warn of it where it follows one that was not."""
        what = (
            f"[background] zodiacal: the field comes within {nearest_deg:.1f} deg of the Sun, where"
            " Leinert's table is blank"
        )
        if beyond and self._refuse:
            raise InputError(f"{what}; look farther from it, or write zodiacal_v_mag_arcsec2")
        if beyond and not self._beyond:
            log.warning("%s; the nearest tabled light is drawn", what)
        self._beyond = beyond


def background_e(config: BenchConfig, optics: Optics, pixel_sr: FloatArray) -> FloatArray:
    """Electrons per exposure in every view, (height, width), by a channel's optics: level, plus a
    gradient, 0 in the middle.

    Zodiacal light is V mag/arcsec^2 through the tracker's optics, times each pixel's solid angle,
    `pixel_sr` (height, width) (thesis eq. 4.10 and 4.11, which gives all pixels the middle one's).
    """
    tracker = config.tracker
    background = config.background
    width, height = tracker.resolution_px
    level_e = np.full((height, width), background.electrons_per_px or 0.0)
    if background.zodiacal_v_mag_arcsec2 is not None:
        photometry = Photometry(config.sky.zero_point, config.sky.passband_weighting)
        v_mag_arcsec2 = background.zodiacal_v_mag_arcsec2
        rate = zodiacal_electrons_per_s_arcsec2(v_mag_arcsec2, optics, photometry)
        level_e = rate * ARCSEC_PER_RAD**2 * tracker.exposure_s * pixel_sr
    across_e, down_e = background.gradient_electrons_across
    ramp_across_e = across_e * np.linspace(-0.5, 0.5, width)
    ramp_down_e = down_e * np.linspace(-0.5, 0.5, height)
    ramp_e = ramp_across_e + ramp_down_e[:, None]
    total_e: FloatArray = level_e + ramp_e
    if total_e.min() < 0:
        raise InputError(
            f"[background] gradient_electrons_across = {[across_e, down_e]}: takes the darkest"
            f" corner to {total_e.min():.4g} electrons; write a larger background or a smaller"
            " gradient"
        )
    return total_e
