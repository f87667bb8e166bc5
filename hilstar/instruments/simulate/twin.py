"""From codes to light: the monitor as it is, and as the bench assumes it.

The twin of a bench: from an attitude to what falls on the tracker's detector, and what that reads
out.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import to_matrix
from hilstar.display.calibration import BUILT_IN, Calibration, load_calibration
from hilstar.display.geometry import monitor_camera
from hilstar.display.panel import Panel
from hilstar.display.quantise import LitLight, lit_light, primary_levels
from hilstar.display.response import Levels, Response, table_response
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.optics import DisplayColours, TwinOptics, seen_primaries
from hilstar.instruments.simulate.shutter import rolled, rolling_light
from hilstar.instruments.simulate.simulator import TrackerBackground
from hilstar.optics.camera import Camera
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.view import STILL, View
from hilstar.optics.sprites import shares_at
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import ideal_monitor, real_monitor, tracker_camera
from hilstar.server.bench.config import Tracker, Verify
from hilstar.server.bench.frame import Bench, Frame
from hilstar.server.bench.primary_panels import primary_panels
from hilstar.tracker.detector import Detector
from hilstar.tracker.mosaic import CHANNELS, in_pixels, software_image

GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples fill a period most evenly
PHASES = 4  # frames of a sequence with which an exposure may begin


def free_phase(number: int) -> float:
    """The share of a refresh period at which exposure `number` of a free tracker begins: however
    many follow one another, they fill the period evenly.
    """
    return number * GOLDEN % 1.0


def exposure_phase_s(tracker: Tracker, refresh_hz: float, first_frame: int) -> float:
    """When the screen begins a frame after the middle of an exposure: of a free tracker each
    exposure at another moment.
    """
    if tracker.trigger != "free":
        return -tracker.exposure_s / 2
    return free_phase(first_frame) / refresh_hz


def exposure_lights(
    bench: Bench,
    frame: Frame,
    first_frame: int,
    panels: Sequence[Panel],
    faults: FaultLayer | None = None,
) -> list[list[LitLight]]:
    """The mean light of each primary, electrons per second, of each panel over an exposure from
    frame `first_frame` on.

    There is one light of all primaries where they are not driven apart.

    With `temporal` that is one of the first PHASES frames of a sequence, which `frame` is the first
    of.
    """
    config = bench.config
    count = max(1, round(config.tracker.exposure_s * config.monitor.refresh_hz))
    exposed = bench.quantiser.exposure(first_frame % PHASES, count)
    size = frame.levels.shape[:2]
    total: list[list[FloatArray]] = []  # by panel and primary, over the frames
    for number in range(exposed.stop):
        levels = frame.levels
        if number:
            view = bench.view(frame.q_icrs_to_cam, None, frame.t_ns)
            sprites = bench.light(view, faults)
            levels = bench.draw_sprites(sprites, first_frame + number).levels
        if number not in exposed:
            continue
        lit = [_primaries_lit(levels, panel) for panel in panels]
        if len(exposed) == 1:
            return lit
        if not total:
            total = [_dark_images(len(primaries), size) for primaries in lit]
        for primaries, lights in zip(total, lit, strict=True):
            for whole, light in zip(primaries, lights, strict=True):
                whole.ravel()[light.place] += light.e_per_s
    return [_mean_lights(primaries, len(exposed)) for primaries in total]


def _dark_images(count: int, shape: tuple[int, ...]) -> list[FloatArray]:
    return [np.zeros(shape) for _ in range(count)]


def _primaries_lit(levels: Levels, panel: Panel) -> list[LitLight]:
    """The light of each primary of a panel at levels."""
    lights: list[LitLight] = []
    for primary_level, primary in primary_levels(levels, panel):
        lights.append(lit_light(primary_level, primary))
    return lights


def _mean_lights(totals: Sequence[FloatArray], frames: int) -> list[LitLight]:
    """The mean light of each primary, of its sum over frames (height, width)."""
    return [LitLight.of(total / frames) for total in totals]


def true_panel(bench: Bench) -> Panel:
    """The true panel, which turns the bench's levels into light. Raises InputError for an
    unusable true calibration.
    """
    verify = bench.config.verify
    white = verify.true_flux_at_white_e_per_s or bench.flux_at_white_e_per_s
    if verify.true_calibration is None:
        scale = white / bench.flux_at_white_e_per_s
        primaries = []
        for primary in bench.panel.primaries:
            primary_white = scale * primary.flux_at_white_e_per_s
            primaries.append(replace(primary, flux_at_white_e_per_s=primary_white))
        return Panel(bench.calibration.response, white, bench.uniformity, tuple(primaries))
    bit_stealing = bench.config.render.bit_stealing
    true = true_calibration(bench, verify.true_calibration, bit_stealing=bit_stealing)
    response = levels_of(bench.calibration.response, true.response)
    uniformity = true.uniformity_map(bench.config.monitor.resolution_px)
    colours = bench.colours
    parts: tuple[Panel, ...] = ()
    if colours is not None:
        parts = primary_panels(bench.file, colours, white, uniformity, verify.true_calibration)
    return Panel(response, white, uniformity, parts)


def true_calibration(bench: Bench, name: str, *, bit_stealing: bool = False) -> Calibration:
    """The calibration that [verify] true_calibration names. Raises InputError."""
    source: str | Path = name if name in BUILT_IN else bench.file.folder / name
    return load_calibration(source, bench.config.monitor.bits, bit_stealing=bit_stealing)


def levels_of(assumed: Response, true: Response) -> Response:
    """The true light of the assumed levels: with bit stealing another monitor orders its triples
    differently.
    """
    if assumed.rgb is None or true.rgb is None:
        return true
    light = {}
    for triple, value in zip(true.rgb.tolist(), true.light, strict=True):
        light[tuple(triple)] = value
    levels = np.array([light.get(tuple(triple), np.nan) for triple in assumed.rgb.tolist()])
    # A triple that the true monitor cannot tell from its neighbour has that one's light.
    places = np.arange(len(levels))
    known = np.isfinite(levels)
    levels = np.interp(places, places[known], levels[known])
    threshold = table_response(assumed.bits, levels).threshold
    return Response(assumed.bits, levels, threshold, true.black, assumed.rgb)


@dataclass(frozen=True, slots=True)
class TwinField:
    """One attitude: mean electrons, (h, w) each, and its stars at their places (n,) in tracker
    pixels, as the sky has them.

    Images are those in which the tracker's software finds stars: of a mosaic its superpixels, or
    itself, and stars have the electrons of an average pixel of it. `pixels_e` are the detector's
    own of what is shown. `shown_e` is what the monitor as it is makes, `assumed_e` what it would
    make if everything were as assumed (the same array where nothing differs), and `sky_e` what the
    stars themselves make. `by_channel` has shown and sky of each channel, where primaries are
    driven apart for several. `under_e` lies under them all. `truth` has the rows of TRUTH_DTYPE of
    stars and points, and `discs` those bodies' directions (3,), cam, and radii, rad, which are more
    than points.
    """

    shown_e: FloatArray
    assumed_e: FloatArray
    sky_e: FloatArray
    truth: npt.NDArray[np.void]
    x_px: FloatArray
    y_px: FloatArray
    pixels_e: FloatArray
    discs: tuple[tuple[FloatArray, float], ...] = ()
    under_e: FloatArray | float = 0.0
    by_channel: tuple[tuple[FloatArray, FloatArray], ...] = ()

    def near_disc(self, camera: Camera, margin_px: float) -> npt.NDArray[np.bool_]:
        """True for stars (n,) within `margin_px` of a disc's limb, or before it."""
        near = np.zeros(len(self.truth), dtype=bool)
        rays = camera.rays(self.x_px, self.y_px)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        margin_rad = margin_px / camera.focal_length_px
        for direction, radius_rad in self.discs:
            within_rad = min(radius_rad + margin_rad, math.pi)
            near |= rays @ direction > math.cos(within_rad)
        return near


class Twin(Closing):
    """A bench's twin. Free it with `close`, or use it as a context manager.

    Raises InputError for a bench file or a true calibration that is wrong.
    """

    def __init__(self, file: BenchFile) -> None:
        self.bench = open_bench(file)
        self.config = self.bench.config
        tracker = self.config.tracker
        self.camera = tracker_camera(tracker, file.folder)
        self.differs = any(name.startswith("true_") for name in changed_keys(self.config.verify))
        self.true_panel = true_panel(self.bench)
        self.assumed_geometry = BenchGeometry(self.bench.camera, self.camera)
        true = true_geometry(self.bench, self.camera)
        self.true_camera = true.monitor
        self.detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)
        self.true_optics = TwinOptics(true, self.bench.tracker_psf)
        self.glow_e_per_s = self.true_optics.glow_e_per_s(self.true_panel)
        self.assumed_glow_e_per_s = self.glow_e_per_s
        self.sky_optics = self.true_optics
        if self.differs:
            self.sky_optics = TwinOptics(self.assumed_geometry, self.bench.tracker_psf)
            self.assumed_glow_e_per_s = self.sky_optics.glow_e_per_s(self.bench.panel)
        self.primaries = seen_primaries(self.bench)
        self._mosaic = DisplayColours.of(self.bench)
        self._background = TrackerBackground(
            self.config, file.folder, self.camera, refuse=False, moving=self.bench.moving
        )

    def field(self, q_icrs_to_cam: FloatArray, first_frame: int) -> TwinField:
        """Show one attitude (unit quaternion) for one exposure, from frame `first_frame` of the
        run on.
        """
        frame = self.bench.frame(q_icrs_to_cam, first_frame)
        exposure_s = self.config.tracker.exposure_s
        skies = [self.sky_optics.image_e_per_s(light) * exposure_s for light in frame.light]
        panels = [self.true_panel]
        if self.differs:
            panels.append(self.bench.panel)
        lights, glow_share = self._lights(frame, first_frame, panels)
        glow_e = self._mosaic.grey(self.glow_e_per_s) * exposure_s * glow_share
        by_primary = self.true_optics.images_e_per_s(lights[0], self.primaries) * exposure_s
        pixels_e = self._mosaic.shown(by_primary)
        bayer = self._mosaic.bayer
        if bayer is None:
            sky_e = sum(skies[1:], start=skies[0])
        else:
            sky_e = in_pixels(skies, bayer)
        sky = self._found_in(sky_e)
        shown = assumed = self._found_in(pixels_e)
        if self.differs:
            as_assumed = self.sky_optics.images_e_per_s(lights[1], self.primaries) * exposure_s
            assumed = self._found_in(self._mosaic.shown(as_assumed))
        icrs_to_cam = to_matrix(frame.q_icrs_to_cam)
        view = self.bench.view(frame.q_icrs_to_cam)
        discs = self.bench.discs(view)
        under_e = glow_e + self._background.of_view_e(view)
        points = ~np.isin(frame.rows["name"], [disc.name for disc in discs])
        point_stars = frame.star[points]
        stars = self.bench.stars
        x_px, y_px = self.camera.project(stars.directions(point_stars) @ icrs_to_cam.T)
        hidden_cones = []
        for disc in discs:
            hidden_cones.append((icrs_to_cam @ disc.direction, disc.radius_rad))
        truth = frame.rows[points]
        if bayer is not None and stars.colours is not None:
            pattern = [bayer.count(channel) / len(bayer) for channel in CHANNELS]
            truth["electrons_per_s"] *= shares_at(stars.colours, stars, point_stars) @ pattern
        return TwinField(
            shown_e=shown,
            assumed_e=assumed,
            sky_e=sky,
            truth=truth,
            x_px=x_px,
            y_px=y_px,
            pixels_e=pixels_e,
            discs=tuple(hidden_cones),
            under_e=under_e,
            by_channel=self._by_channel(by_primary, skies),
        )

    def _lights(
        self, frame: Frame, first_frame: int, panels: Sequence[Panel]
    ) -> tuple[Sequence[Iterable[FloatArray | LitLight]], FloatArray | float]:
        """What each of `panels` lights during an exposure, and the share of the screen's glow that
        reaches each row of the detector.
        """
        view = rolled(self._exposure_at(frame), self.config.tracker)
        if not view.scan.scanout_s or not self.config.tracker.exposure_s:
            return exposure_lights(self.bench, frame, first_frame, panels), 1.0
        phase_s = exposure_phase_s(self.config.tracker, self.config.monitor.refresh_hz, first_frame)
        parts = []
        for optics, panel in zip((self.true_optics, self.sky_optics), panels, strict=False):
            parts.append(rolling_light(self.bench, optics.geometry, panel, view, phase_s))
        lights = [light for light, _ in parts]
        _, glow_share = parts[0]
        return lights, glow_share

    def _by_channel(
        self, by_primary: FloatArray, skies: Sequence[FloatArray]
    ) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """The display's image and the sky's of each channel of a tracker in colour; () of grey."""
        colours = self.bench.colours
        if colours is None or colours.mono:
            return ()
        shown_by_channel = np.tensordot(colours.by_primary, by_primary, 1)
        return tuple(zip(shown_by_channel, skies, strict=True))

    def _found_in(self, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The image in which the tracker's software finds stars, of the detector's pixels."""
        return software_image(pixels, self.config.tracker.detector)

    def _exposure_at(self, frame: Frame) -> View:
        return View.exposure(frame.q_icrs_to_cam, STILL, self.config.tracker.exposure_s, frame.t_ns)

    def detected_dn(self, seen: TwinField, rng: np.random.Generator) -> npt.NDArray[Any]:
        """One noisy exposure (h, w), DN, the mean of glow and background subtracted unless all
        pixels have the same.

        A frame transfer's smear is in these alone: in images without noise, sky and display would
        have the same.
        """
        exposure_s = self.config.tracker.exposure_s
        under_e = np.broadcast_to(seen.under_e, seen.pixels_e.shape)
        # As the detector takes it. Of 16 million pixels each image of float64 is 0.13 GB.
        mean_e = np.add(seen.pixels_e, under_e, dtype=np.float32)
        dn: npt.NDArray[Any] = self.detector.expose(mean_e, exposure_s, rng)
        del mean_e
        collected_e = self.detector.collected_e(under_e, exposure_s)
        if collected_e.min() != collected_e.max():
            mean_dn = collected_e / self.config.tracker.detector.gain_e_per_dn
            dn = np.subtract(dn, mean_dn, out=mean_dn)
        return self._found_in(dn)

    @property
    def monitor_px_per_px(self) -> float:
        """Monitor pixels to a tracker pixel, along a side."""
        return self.bench.camera.focal_length_px / self.camera.focal_length_px

    def close(self) -> None:
        """Free the GL contexts."""
        self.bench.close()
        for optics in {self.true_optics, self.sky_optics}:
            optics.close()


def changed_keys(verify: Verify) -> list[str]:
    """The names of the keys of [verify] that are not at their defaults."""
    default = Verify()
    changed = []
    for name in verify.__struct_fields__:
        if getattr(verify, name) != getattr(default, name):
            changed.append(name)
    return changed


def true_geometry(bench: Bench, tracker: Camera) -> BenchGeometry:
    """How monitor and collimator really stand: as the bench assumes, by a geometry file, or an
    ideal lens by keys of [verify].

    Raises InputError for a rotation that is not unit within 1e-3, and for a geometry file that
    cannot be used.
    """
    config = bench.config
    verify = config.verify
    collimator = config.collimator
    monitor = config.monitor
    if verify.true_geometry is not None:
        camera = real_monitor(config, bench.file.folder, verify.true_geometry)
        return BenchGeometry(camera, tracker, verify.true_mirror)
    lens = (verify.true_q_cam_to_mon, verify.true_pixel_pitch_um, verify.true_focal_length_mm)
    if lens == (None, None, None):
        return BenchGeometry(bench.camera, tracker, verify.true_mirror)
    q_cam_to_mon = verify.true_q_cam_to_mon or collimator.q_cam_to_mon
    norm = math.hypot(*q_cam_to_mon)
    if abs(norm - 1) > NORM_TOLERANCE:
        raise InputError(
            f"{bench.file.path}: [verify] true_q_cam_to_mon: its norm is {norm:.6g}; write a unit"
            " quaternion w, x, y, z"
        )
    camera = monitor_camera(
        monitor.resolution_px,
        verify.true_pixel_pitch_um or monitor.pixel_pitch_um,
        verify.true_focal_length_mm or collimator.focal_length_mm,
        np.array(q_cam_to_mon),
        ideal_monitor(config).principal_point_px,
    )
    return BenchGeometry(camera, tracker, verify.true_mirror)
