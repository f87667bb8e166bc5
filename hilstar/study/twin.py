"""The digital twin: what the tracker would measure of the stars that the monitor shows, against the sky.

The bench, as it believes itself to be, draws codes. The monitor, as it is, makes light of them; collimator and tracker make
an image; a centroider measures it. The same centroider on the tracker's image of the sky itself (with the sprites' width)
gives the estimator's own errors, blends included, and those are taken out: what is left is the display's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.quaternion import to_matrix
from hilstar.bench.assembly import Bench, bench_camera
from hilstar.bench.config import BenchConfig, detector_settings
from hilstar.bench.simulation import ARCSEC_PER_RAD, NO_ALIGNMENT, background_e
from hilstar.monitor.calibration import BUILT_IN, load_calibration
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.photometry import Response, table_response
from hilstar.monitor.quantise import Panel, shown_light
from hilstar.scene.camera import Camera
from hilstar.scene.psf import peak_share
from hilstar.study.twin_optics import Mounting, TwinOptics
from hilstar.study.twin_verdict import Star, Verdict, judge
from hilstar.tracker.centroids import Background, Centroids, CentroidSettings, find_stars
from hilstar.tracker.detector import Detector

MATCH_PX = 3.0
CROWDED_SHARE = 0.02  # of a neighbour in the window: 0.02 mag, and a fifth of a pixel from its edge
FAINTEST_PEAK = 0.2  # a blob begins at this share of the faintest drawn star's peak
# The glow that a missing black level adds is noticed at this share of the faintest drawn star's light, per pixel of its disc.
BLACK_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Field:
    """One attitude: mean electrons of the stars shown and of those in the sky, (h, w) each, and which stars they are."""

    shown_e: FloatArray
    sky_e: FloatArray
    truth: npt.NDArray[np.void]
    x_px: FloatArray
    y_px: FloatArray


@dataclass(slots=True)
class Tally:
    """Stars by what became of them."""

    stars: list[Star] = field(default_factory=list)
    lost: int = 0
    blended: int = 0
    clipped: int = 0
    not_shown: int = 0
    noisy_mag: list[float] = field(default_factory=list)
    noisy_px: list[float] = field(default_factory=list)


class Twin:
    """A bench's twin. Free it with `close`. Raises InputError for a bench file or a true calibration that is wrong."""

    def __init__(self, path: Path) -> None:
        self.bench = Bench(path)
        self.config = self.bench.config
        tracker = self.config.tracker
        self.camera = monitor_camera(tracker.resolution_px, tracker.pixel_pitch_um, tracker.focal_length_mm, NO_ALIGNMENT)
        self.panel = true_panel(self.bench, path.parent)
        assumed = Mounting(self.bench.camera, self.camera)
        self.true_optics = TwinOptics(true_mounting(self.config, self.camera), tracker.psf_sigma_px)
        self.sky_optics = TwinOptics(assumed, tracker.psf_sigma_px)
        self.glow_e_per_s = self.true_optics.glow_e_per_s(self.panel)
        believed = Panel(self.bench.calibration.response, self.bench.flux_at_white_e_per_s, self.bench.uniformity)
        self.seen_glow_e_per_s_px = float(np.median(self.glow_e_per_s))
        self.assumed_glow_e_per_s_px = float(np.median(self.sky_optics.glow_e_per_s(believed)))
        self.background_e = background_e(self.config, path.parent)
        self.detector = Detector(detector_settings(tracker), tracker.resolution_px)
        self.settings = centroid_settings(self.config, assumed)

    @property
    def arcsec_per_px(self) -> float:
        """Of the tracker, in the middle of its field."""
        return ARCSEC_PER_RAD / self.camera.focal_length_px

    def field(self, q_icrs_to_cam: FloatArray, first_frame: int) -> Field:
        """Show one attitude for one exposure, from a frame of the run on."""
        config = self.config
        frame = self.bench.frame(q_icrs_to_cam, first_frame)
        light = shown_light(frame.levels, self.panel)
        count = max(1, round(config.tracker.exposure_s * config.monitor.refresh_hz))
        if config.render.quantisation == "temporal":
            for number in range(first_frame + 1, first_frame + count):
                light += shown_light(self.bench.draw(frame.q_icrs_to_cam, number).levels, self.panel)
            light /= count
        exposure_s = config.tracker.exposure_s
        shown = self.true_optics.image_e_per_s(light) * exposure_s
        sky = self.sky_optics.image_e_per_s(frame.linear.astype(np.float64)) * exposure_s
        vectors = self._vectors(frame.truth["hip"])
        x_px, y_px = self.camera.project(vectors @ to_matrix(frame.q_icrs_to_cam).T)
        return Field(shown, sky, frame.truth, x_px, y_px)

    def _vectors(self, hip: npt.NDArray[np.int32]) -> FloatArray:
        stars = self.bench.stars
        order = np.argsort(stars.hip)
        return np.asarray(stars.vectors[order[np.searchsorted(stars.hip, hip, sorter=order)]])

    def measure(self, seen: Field, tally: Tally, rng: np.random.Generator) -> None:
        """Measure one field into `tally`."""
        exposure_s, faintest = self.config.tracker.exposure_s, self.faintest_e_per_s()
        threshold_e = FAINTEST_PEAK * faintest * exposure_s * peak_share(self._seen_sigma_px())
        # A tracker takes the glow of the screen away star by star, from what is around each: here it is taken away whole.
        under = Background(0.0, threshold_e / self.settings.threshold_sigma)
        shown, sky = (find_stars(image, self.settings, under) for image in (seen.shown_e, seen.sky_e))
        inside = self._inside(seen)
        found_sky, found = nearest(sky, seen.x_px, seen.y_px), nearest(shown, seen.x_px, seen.y_px)
        alone = only_once(found_sky) & ~crowded(seen, self.settings.radius_px)
        for k in np.flatnonzero(inside):
            row = seen.truth[k]
            if not row["drawn"]:
                tally.not_shown += 1
            elif row["clipped"]:
                tally.clipped += 1
            elif not alone[k]:
                tally.blended += 1
            elif found[k] < 0:
                tally.lost += 1
            else:
                tally.stars.append(self._star(seen, int(k), (sky, int(found_sky[k])), (shown, int(found[k]))))
        self._measure_noisy(seen, inside & alone & seen.truth["drawn"] & ~seen.truth["clipped"], tally, rng)

    def _star(self, seen: Field, k: int, sky: tuple[Centroids, int], shown: tuple[Centroids, int]) -> Star:
        row, exposure_s = seen.truth[k], self.config.tracker.exposure_s
        (by_sky, i), (by_codes, j) = sky, shown
        return Star(
            hip=int(row["hip"]),
            v_mag=float(row["v_mag"]),
            x_px=float(seen.x_px[k]),
            y_px=float(seen.y_px[k]),
            flux_mag=magnitude(by_codes.flux[j] / by_sky.flux[i]),
            dx_px=float(by_codes.x_px[j] - by_sky.x_px[i]),
            dy_px=float(by_codes.y_px[j] - by_sky.y_px[i]),
            floor_mag=magnitude(by_sky.flux[i] / (row["electrons_per_s"] * exposure_s)),
            floor_px=math.hypot(by_sky.x_px[i] - seen.x_px[k], by_sky.y_px[i] - seen.y_px[k]),
        )

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
        width, height = self.camera.resolution_px
        inside = (seen.x_px >= margin) & (seen.x_px < width - 1 - margin) & (seen.y_px >= margin)
        inside &= seen.y_px < height - 1 - margin
        reach = self.bench.renderer.footprint_px / 2 + margin * self._scale()
        width, height = self.bench.camera.resolution_px
        x, y = seen.truth["x_px"], seen.truth["y_px"]
        return np.asarray(inside & (x >= reach) & (x < width - 1 - reach) & (y >= reach) & (y < height - 1 - reach))

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


def true_mounting(config: BenchConfig, tracker: Camera) -> Mounting:
    """How monitor and collimator really stand."""
    verify, collimator, monitor = config.verify, config.collimator, config.monitor
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


def only_once(match: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """True for places whose match is nobody else's."""
    used, counts = np.unique(match, return_counts=True)
    return np.asarray((match >= 0) & (counts[np.searchsorted(used, match)] == 1))


def crowded(seen: Field, radius_px: float) -> npt.NDArray[np.bool_]:
    """True for stars that have another of more than CROWDED_SHARE of their light within a window's reach."""
    from scipy.spatial import KDTree

    places = np.nan_to_num(np.stack([seen.x_px, seen.y_px], axis=1), nan=-1e9)
    flux = seen.truth["electrons_per_s"]
    close = KDTree(places).query_pairs(math.sqrt(2) * radius_px, output_type="ndarray")
    result = np.zeros(len(flux), dtype=np.bool_)
    for a, b in (close.T, close.T[::-1]):
        result[a[flux[b] > CROWDED_SHARE * flux[a]]] = True
    return result


def magnitude(ratio: float) -> float:
    """Magnitudes by which a flux is fainter than it should be."""
    return -2.5 * math.log10(ratio) if ratio > 0 else math.inf


def verify(
    path: Path, fields: int, rng: np.random.Generator, on_field: Callable[[int], None] = lambda done: None
) -> tuple[Verdict, dict[str, Any]]:
    """Run the twin over random attitudes; the verdict with its stars, and the summary of `hilstar verify --json`."""
    tally = Tally()
    twin = Twin(path)
    try:
        for number in range(fields):
            q = rng.normal(size=4)
            first = int(rng.integers(0, 4096))
            twin.measure(twin.field(q / np.linalg.norm(q), first), tally, rng)
            on_field(number + 1)
        verdict = judge(twin, tally)
        return verdict, verdict.summary(fields, tally, twin)
    finally:
        twin.close()
