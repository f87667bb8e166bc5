"""The digital twin: what the tracker would measure of the stars that the monitor shows, against the sky.

The bench, as it believes itself to be, draws codes. The monitor, as it is, makes light of them; collimator and tracker make
an image; a centroider measures it. The same centroider on the tracker's image of the sky itself (with the sprites' width)
gives the estimator's own errors, and those are taken out: what is left is the display's. Where the bench differs from what
it assumes, the codes are also looked at as if it did not: what they cost by themselves is told from what is wrong.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import bench_camera, open_bench
from hilstar.bench.config import BenchConfig, Verify
from hilstar.bench.frame import Bench, Frame
from hilstar.errors import InputError
from hilstar.monitor.calibration import BUILT_IN, load_calibration
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.quantise import MAX_CYCLE_FRAMES, Panel, shown_light
from hilstar.monitor.response import Response, table_response
from hilstar.rotation import to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.psf import peak_share
from hilstar.tracker.centroids import Background, Centroids, CentroidSettings, find_stars
from hilstar.tracker.detector import Detector
from hilstar.twin.optics import Mirror, Mounting, TwinOptics
from hilstar.twin.simulator import NO_ALIGNMENT, background_e
from hilstar.twin.verdict import Star, Verdict, judge
from hilstar.units import ARCSEC_PER_RAD

MATCH_PX = 3.0
# Of a star's light, that which others bring into its window. Both images have it, so what it leaves is a second order:
# at 0.02, a neighbour 0.1 mag off adds 0.002 mag.
CROWDED_SHARE = 0.02
WING_SIGMAS = 6.0  # how far a neighbour's light reaches: 1e-9 of it, and Sirius is 4e3 times a star of the seventh magnitude
FAINTEST_PEAK = 0.2  # a blob begins at this share of the faintest drawn star's peak
# The glow that a missing black level adds is noticed at this share of the faintest drawn star's light, per pixel of its disc.
BLACK_SHARE = 0.1
MIRRORS: tuple[Mirror, ...] = ("x", "y", "swap")


@dataclass(frozen=True, slots=True)
class Field:
    """One attitude: mean electrons, (h, w) each, and its stars at their places (n,) in tracker pixels, as the sky has them.

    `shown_e` is what the monitor as it is makes, `believed_e` what it would make were everything as assumed (the same array
    where nothing differs), and `sky_e` that of the stars themselves.
    """

    shown_e: FloatArray
    believed_e: FloatArray
    sky_e: FloatArray
    truth: npt.NDArray[np.void]
    x_px: FloatArray
    y_px: FloatArray


@dataclass(frozen=True, slots=True)
class Matched:
    """What was found in an image, and which of it each star (n,) is; -1 for none."""

    found: Centroids
    index: npt.NDArray[np.intp]

    def against(self, other: Matched, k: int) -> tuple[float, float, float]:
        """Star `k` against itself in another image: magnitudes too faint, pixels to the right and down; NaN where not found."""
        i, j = self.index[k], other.index[k]
        if i < 0 or j < 0:
            return math.nan, math.nan, math.nan
        a, b = self.found, other.found
        return magnitude(a.flux[i] / b.flux[j]), float(a.x_px[i] - b.x_px[j]), float(a.y_px[i] - b.y_px[j])


@dataclass(slots=True)
class Tally:
    """Stars by what became of them.

    Of all that the sky has, `vanished` counts how many fewer are seen, and `mirrored` those found where a screen so mirrored
    would show them.
    """

    stars: list[Star] = field(default_factory=list)
    lost: list[Star] = field(default_factory=list)
    blended: int = 0
    clipped: int = 0
    not_shown: int = 0
    at_edge: int = 0
    vanished: int = 0
    mirrored: Counter[Mirror] = field(default_factory=Counter)
    noisy_mag: list[float] = field(default_factory=list)
    noisy_px: list[float] = field(default_factory=list)


class Twin:
    """A bench's twin. Free it with `close`. Raises InputError for a bench file or a true calibration that is wrong."""

    def __init__(self, file: BenchFile) -> None:
        self.bench = open_bench(file)
        self.config = self.bench.config
        tracker = self.config.tracker
        self.camera = monitor_camera(tracker.resolution_px, tracker.pixel_pitch_um, tracker.focal_length_mm, NO_ALIGNMENT)
        self.differs = any(name.startswith("true_") for name in changed(self.config.verify))
        self.panel = true_panel(self.bench, file.folder)
        self.believed = self.bench.panel
        true, self.assumed = true_mounting(self.bench, self.camera), Mounting(self.bench.camera, self.camera)
        self.background_e = background_e(self.config, file.folder)
        self.detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)
        self.settings = centroid_settings(self.config, self.assumed)
        self.true_optics = TwinOptics(true, tracker.psf_sigma_px)
        self.sky_optics = TwinOptics(self.assumed, tracker.psf_sigma_px)
        self.glow_e_per_s = self.true_optics.glow_e_per_s(self.panel)
        self.seen_glow_e_per_s_px = on_screen_median(self.glow_e_per_s)
        self.assumed_glow_e_per_s_px = on_screen_median(self.sky_optics.glow_e_per_s(self.believed))

    @property
    def arcsec_per_px(self) -> float:
        """Of the tracker, in the middle of its field."""
        return ARCSEC_PER_RAD / self.camera.focal_length_px

    def field(self, q_icrs_to_cam: FloatArray, first_frame: int) -> Field:
        """Show one attitude (unit quaternion) for one exposure, from frame `first_frame` of the run on."""
        frame = self.bench.frame(q_icrs_to_cam, first_frame)
        exposure_s = self.config.tracker.exposure_s
        sky = self.sky_optics.image_e_per_s(frame.linear.astype(np.float64)) * exposure_s
        lights = self._lights(frame, first_frame)
        shown = self.true_optics.image_e_per_s(lights[0]) * exposure_s
        believed = self.sky_optics.image_e_per_s(lights[1]) * exposure_s if self.differs else shown
        x_px, y_px = self.camera.project(self._vectors(frame.truth["hip"]) @ to_matrix(frame.q_icrs_to_cam).T)
        return Field(shown, believed, sky, frame.truth, x_px, y_px)

    def _lights(self, frame: Frame, first_frame: int) -> list[FloatArray]:
        """The mean light of an exposure (H, W), of the monitor as it is and, where that differs, as it is assumed."""
        panels = [self.panel, self.believed] if self.differs else [self.panel]
        lights = [shown_light(frame.levels, panel) for panel in panels]
        if self.config.render.quantisation == "temporal":
            count = max(1, round(self.config.tracker.exposure_s * self.config.monitor.refresh_hz))
            for number in range(first_frame + 1, first_frame + count):
                levels = self.bench.draw(frame.q_icrs_to_cam, number).levels
                for light, panel in zip(lights, panels, strict=True):
                    light += shown_light(levels, panel)
            for light in lights:
                light /= count
        return lights

    def _vectors(self, hip: npt.NDArray[np.int32]) -> FloatArray:
        stars = self.bench.stars
        order = np.argsort(stars.hip)
        return np.asarray(stars.vectors[order[np.searchsorted(stars.hip, hip, sorter=order)]])

    def measure(self, seen: Field, tally: Tally, rng: np.random.Generator) -> None:
        """Measure one field into `tally`; the generator is for the detector's noise."""
        sky, shown = self._match(seen.sky_e, seen), self._match(seen.shown_e, seen)
        believed = shown if seen.believed_e is seen.shown_e else self._match(seen.believed_e, seen)
        blended = shared(sky.index) | crowded(seen, self.settings.radius_px, self._seen_sigma_px())
        inside, drawn, clipped = self._inside(seen), seen.truth["drawn"], seen.truth["clipped"]
        tally.at_edge += int((self._on_detector(seen.x_px, seen.y_px, 0.0) & ~inside).sum())
        tally.not_shown += int((inside & ~drawn).sum())
        tally.clipped += int((inside & drawn & clipped).sum())
        whole = inside & drawn & ~clipped
        tally.blended += int((whole & blended).sum())
        wanted = whole & ~blended
        found = wanted & (sky.index >= 0) & (shown.index >= 0)
        for k in np.flatnonzero(wanted):
            (tally.stars if found[k] else tally.lost).append(self._star(seen, int(k), sky, shown, believed))
        tally.vanished += len(sky.found) - len(shown.found)
        self._look_mirrored(seen, shown.found, wanted, tally)
        self._measure_noisy(seen, wanted, tally, rng)

    def _match(self, image_e: FloatArray, seen: Field) -> Matched:
        """The stars of a noiseless image. A tracker takes the screen's glow away around each star: here it is not added."""
        peak_e = self.faintest_e_per_s() * self.config.tracker.exposure_s * peak_share(self._seen_sigma_px())
        under = Background(0.0, FAINTEST_PEAK * peak_e / self.settings.threshold_sigma)
        found = find_stars(image_e, self.settings, under)
        return Matched(found, nearest(found, seen.x_px, seen.y_px))

    def _star(self, seen: Field, k: int, sky: Matched, shown: Matched, believed: Matched) -> Star:
        row, truth = seen.truth[k], self._truth(seen)
        flux_mag, dx_px, dy_px = shown.against(sky, k)
        codes_mag, *codes_px = believed.against(sky, k)
        floor_mag, *floor_px = sky.against(truth, k)
        return Star(
            hip=int(row["hip"]),
            v_mag=float(row["v_mag"]),
            x_px=float(seen.x_px[k]),
            y_px=float(seen.y_px[k]),
            flux_mag=flux_mag,
            dx_px=dx_px,
            dy_px=dy_px,
            codes_mag=codes_mag,
            codes_px=math.hypot(*codes_px),
            floor_mag=floor_mag,
            floor_px=math.hypot(*floor_px),
        )

    def _truth(self, seen: Field) -> Matched:
        """The catalogue as if it had been found in an image."""
        flux_e, count = seen.truth["electrons_per_s"] * self.config.tracker.exposure_s, len(seen.truth)
        ones = np.ones(count, dtype=np.intp)
        return Matched(Centroids(seen.x_px, seen.y_px, flux_e, flux_e, ones, ones < 1), np.arange(count, dtype=np.intp))

    def _look_mirrored(self, seen: Field, shown: Centroids, wanted: npt.NDArray[np.bool_], tally: Tally) -> None:
        """Count the stars that are where a mirrored screen would have them."""
        for mirror in MIRRORS if self.differs else ():
            mounting = Mounting(self.assumed.monitor, self.camera, mirror)
            places = mounting.to_tracker(seen.truth["x_px"], seen.truth["y_px"])
            tally.mirrored[mirror] += int((wanted & (nearest(shown, *places) >= 0)).sum())

    def _measure_noisy(self, seen: Field, wanted: npt.NDArray[np.bool_], tally: Tally, rng: np.random.Generator) -> None:
        """The same with all of the detector's noise: what the tracker itself adds."""
        detector = self.config.tracker.detector
        exposure_s = self.config.tracker.exposure_s
        under_e = self.glow_e_per_s * exposure_s + self.background_e
        dn = self.detector.expose(seen.shown_e + under_e, exposure_s, rng)
        found = find_stars(dn * detector.gain_e_per_dn - under_e, self.settings)
        match = nearest(found, seen.x_px, seen.y_px)
        for k in np.flatnonzero(wanted & (match >= 0)):
            flux_e = float(found.flux[match[k]])
            if flux_e > 0:
                tally.noisy_mag.append(magnitude(flux_e / (seen.truth["electrons_per_s"][k] * exposure_s)))
                tally.noisy_px.append(math.hypot(found.x_px[match[k]] - seen.x_px[k], found.y_px[match[k]] - seen.y_px[k]))

    def _inside(self, seen: Field) -> npt.NDArray[np.bool_]:
        """Stars whose window is whole on the detector and whose sprite is whole on the monitor."""
        margin = self.settings.radius_px + 1.5
        reach = self.bench.renderer.footprint_px / 2 + margin * self._scale()
        width, height = self.bench.camera.resolution_px
        x, y = seen.truth["x_px"], seen.truth["y_px"]
        inside = (x >= reach) & (x < width - 1 - reach) & (y >= reach) & (y < height - 1 - reach)
        return np.asarray(inside & self._on_detector(seen.x_px, seen.y_px, margin))

    def _on_detector(self, x_px: FloatArray, y_px: FloatArray, margin_px: float) -> npt.NDArray[np.bool_]:
        """Places on the detector, so far from its edge or farther; NaN is not on it."""
        width, height = self.camera.resolution_px
        inside = (x_px >= margin_px - 0.5) & (x_px < width - 0.5 - margin_px)
        return np.asarray(inside & (y_px >= margin_px - 0.5) & (y_px < height - 0.5 - margin_px))

    def _scale(self) -> float:
        """Monitor pixels to a tracker pixel."""
        return self.bench.camera.focal_length_px / self.camera.focal_length_px

    def _seen_sigma_px(self) -> tuple[float, float]:
        return seen_sigma_px(self.config, self._scale())

    def faintest_e_per_s(self) -> float:
        """The rate of the faintest star that the bench draws."""
        stars = self.bench.shown_stars
        return float(stars.electrons_per_s.min()) if len(stars) else 1.0

    def black_limit_e_per_s_px(self) -> float:
        """How far the glow may be from the one assumed: as the file says, else a tenth of the faintest star's disc."""
        given = self.config.verify.black_e_per_s_px
        sigma_x, sigma_y = self._seen_sigma_px()
        return given if given is not None else BLACK_SHARE * self.faintest_e_per_s() / (4 * math.pi * sigma_x * sigma_y)

    def close(self) -> None:
        """Free the GL contexts."""
        for part in (self.bench, self.true_optics, self.sky_optics):
            part.close()


def changed(verify: Verify) -> list[str]:
    """The names of the keys of [verify] that are not at their defaults."""
    default = Verify()
    return [name for name in verify.__struct_fields__ if getattr(verify, name) != getattr(default, name)]


def true_panel(bench: Bench, folder: Path) -> Panel:
    """What really turns the bench's levels into light. Raises InputError."""
    config, assumed = bench.config, bench.calibration
    white = config.verify.true_flux_at_white_e_per_s or bench.flux_at_white_e_per_s
    name = config.verify.true_calibration
    if name is None:
        return Panel(assumed.response, white, bench.uniformity)
    source = name if name in BUILT_IN else folder / name
    true = load_calibration(source, config.monitor.bits, bit_stealing=config.render.bit_stealing)
    response = levels_of(assumed.response, true.response)
    return Panel(response, white, true.uniformity_map(config.monitor.resolution_px))


def levels_of(assumed: Response, true: Response) -> Response:
    """The true light of the assumed levels: with bit stealing another monitor's triples stand in another order."""
    if assumed.rgb is None or true.rgb is None:
        return true
    light = {tuple(triple): value for triple, value in zip(true.rgb.tolist(), true.light, strict=True)}
    known = np.array([light.get(tuple(triple), np.nan) for triple in assumed.rgb.tolist()])
    # A triple that the true monitor cannot tell from its neighbour has that one's light.
    places = np.arange(len(known))
    known = np.interp(places, places[np.isfinite(known)], known[np.isfinite(known)])
    return Response(assumed.bits, known, table_response(assumed.bits, known).threshold, true.black, assumed.rgb)


def true_mounting(bench: Bench, tracker: Camera) -> Mounting:
    """How monitor and collimator really stand. Raises InputError for a rotation that is not unit within 1e-3."""
    config = bench.config
    verify, collimator, monitor = config.verify, config.collimator, config.monitor
    norm = math.hypot(*(verify.true_q_cam_to_mon or collimator.q_cam_to_mon))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise InputError(
            f"{bench.file.path}: [verify] true_q_cam_to_mon: its norm is {norm:.6g}; write a unit quaternion w, x, y, z"
        )
    camera = monitor_camera(
        monitor.resolution_px,
        verify.true_pixel_pitch_um or monitor.pixel_pitch_um,
        verify.true_focal_length_mm or collimator.focal_length_mm,
        np.array(verify.true_q_cam_to_mon or collimator.q_cam_to_mon),
        bench_camera(config).principal_point_px,
    )
    return Mounting(camera, tracker, verify.true_mirror)


def seen_sigma_px(config: BenchConfig, monitor_px_per_px: float) -> tuple[float, float]:
    """A star's sigma on the tracker, its pixels: sprite, monitor pixel and the tracker's own PSF."""
    sprite, psf = config.render.sprite_sigma_px, config.tracker.psf_sigma_px
    spread = [(s**2 + 1 / 6) / monitor_px_per_px**2 for s in sprite]  # two squares: sampled, and shown
    return math.sqrt(spread[0] + psf[0] ** 2), math.sqrt(spread[1] + psf[1] ** 2)


def centroid_settings(config: BenchConfig, assumed: Mounting) -> CentroidSettings:
    """A window as wide as the stars."""
    scale = assumed.monitor.focal_length_px / assumed.tracker.focal_length_px
    return CentroidSettings(window_sigma_px=max(1.0, *seen_sigma_px(config, scale)))


def nearest(found: Centroids, x_px: FloatArray, y_px: FloatArray) -> npt.NDArray[np.intp]:
    """For each place the star found nearest within MATCH_PX, -1 for none."""
    from scipy.spatial import KDTree

    if not len(found):
        return np.full(len(x_px), -1, dtype=np.intp)
    places = np.nan_to_num(np.stack([x_px, y_px], axis=1), nan=-1e9)
    distance, index = KDTree(np.stack([found.x_px, found.y_px], axis=1)).query(places)
    return np.asarray(np.where(distance <= MATCH_PX, index, -1), dtype=np.intp)


def shared(match: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """True for places whose match is somebody else's too."""
    used, counts = np.unique(match, return_counts=True)
    return np.asarray((match >= 0) & (counts[np.searchsorted(used, match)] > 1))


def crowded(seen: Field, radius_px: int, sigma_px: tuple[float, float]) -> npt.NDArray[np.bool_]:
    """True for stars into whose window any other brings more than CROWDED_SHARE of their own light."""
    from scipy.spatial import KDTree
    from scipy.special import ndtr

    places = np.nan_to_num(np.stack([seen.x_px, seen.y_px], axis=1), nan=-1e9)
    flux, half = seen.truth["electrons_per_s"], radius_px + 0.5
    close = KDTree(places).query_pairs(math.sqrt(2) * half + WING_SIGMAS * max(sigma_px), output_type="ndarray")
    result = np.zeros(len(flux), dtype=np.bool_)
    for a, b in (close.T, close.T[::-1]):
        offset = places[b] - np.rint(places[a])
        share = (ndtr((offset + half) / sigma_px) - ndtr((offset - half) / sigma_px)).prod(axis=1)
        result[a[flux[b] * share > CROWDED_SHARE * flux[a]]] = True
    return result


def on_screen_median(glow_e_per_s: FloatArray) -> float:
    """The median over the detector's pixels that see the screen; 0 where the screen's black has no light."""
    lit = glow_e_per_s[glow_e_per_s > 0]
    return float(np.median(lit)) if len(lit) else 0.0


def magnitude(ratio: float) -> float:
    """Magnitudes by which a flux is fainter than it should be."""
    return -2.5 * math.log10(ratio) if ratio > 0 else math.inf


def verify(
    file: BenchFile, fields: int, rng: np.random.Generator, on_field: Callable[[int], None] = lambda done: None
) -> tuple[Verdict, dict[str, Any]]:
    """Run the twin over random attitudes; the verdict with its stars, and the summary of `hilstar verify --json`."""
    # Streams apart: the noise draws as many numbers as it has electrons, and all benches shall see the same fields.
    attitudes, noise = rng.spawn(2)
    tally = Tally()
    twin = Twin(file)
    try:
        for number in range(fields):
            q = attitudes.normal(size=4)
            first = int(attitudes.integers(0, MAX_CYCLE_FRAMES))
            twin.measure(twin.field(q / np.linalg.norm(q), first), tally, noise)
            on_field(number + 1)
        verdict = judge(twin, tally)
        return verdict, verdict.summary(fields, tally, twin)
    finally:
        twin.close()
