"""What a certificate or a check reads of a bench: patches of light, one pattern of dots, a
photodiode's edges; and by what.

`VirtualReader` takes the figures straight from a truth file, with the noise that its
`[certify.virtual]` states: it draws no image. `ImageReader` shows the patterns by a first-light
image source and measures the tracker's images.
"""

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate.first_light import image_sources
from hilstar.instruments.calibrate.first_light.context import StepContext
from hilstar.instruments.calibrate.first_light.focus import seen_sharpness
from hilstar.instruments.calibrate.first_light.photometer import (
    Assumed,
    LatticeRatio,
    Photometer,
    Readings,
)
from hilstar.instruments.calibrate.geometric.dots import DOT_PX, SeenScreen
from hilstar.instruments.calibrate.geometric.geometry_fit import dot_sigma_px, psf_sigma_of
from hilstar.instruments.calibrate.latency import pair, swap_to_square_ms
from hilstar.instruments.calibrate.plan import Patch
from hilstar.instruments.certify.bench_readings import (
    BesideRatio,
    DotReadings,
    LightReadings,
    code_of_light,
    geometry_of,
    grey_response,
    in_true_image,
)
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import full_scale_e_per_s
from hilstar.server.bench.cameras import tracker_psf
from hilstar.server.bench.monitor import bench_calibration
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background

# from dot to dot: a dot that moved by half of it would be taken for its neighbour
APART_TRACKER_PX = 12.0
EDGE_TRACKER_PX = 8.0
MAX_DOTS = 4000
MIN_DOTS = 60
PAIRS = 4  # of images, for each ratio of two lattices
BESIDE_PAIRS = 16  # of simulated readings: a third of a reading's noise, as what white has in all
DOT_LIGHT = 0.25  # relative to white: a dot of nine pixels at white could saturate the tracker
WATCHED_S = 5.0
DOT_REACH_SIGMAS = 5.0  # of a dot: its light is in a square of so many to each side
THRESHOLD_SIGMA, MIN_PIXELS = 8.0, 3
STEP_PX = 10.0  # of the screen, by which the mounting of a truth is compared


def dot_places(geometry: BenchGeometry) -> tuple[IntArray, IntArray]:
    """Monitor pixels (n,) of a lattice of dots that the tracker sees whole. Raises InputError
    where it sees too few.
    """
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    width, height = geometry.monitor.resolution_px
    wide, high = geometry.tracker.resolution_px
    seen_px2 = min(ratio * width, wide) * min(ratio * height, high)
    apart_px = max(APART_TRACKER_PX, math.sqrt(seen_px2 / MAX_DOTS))
    step = max(math.ceil(apart_px / ratio), 2 * DOT_PX)
    along = np.arange(step // 2, width - DOT_PX, step)
    down = np.arange(step // 2, height - DOT_PX, step)
    grid_x, grid_y = np.meshgrid(along, down)
    x = grid_x.ravel()
    y = grid_y.ravel()
    at_x, at_y = geometry.to_tracker(x.astype(np.float64), y.astype(np.float64))
    last_x = wide - 1 - EDGE_TRACKER_PX
    last_y = high - 1 - EDGE_TRACKER_PX
    with np.errstate(invalid="ignore"):
        visible = (at_x > EDGE_TRACKER_PX) & (at_x < last_x)
        visible &= (at_y > EDGE_TRACKER_PX) & (at_y < last_y)
    if visible.sum() < MIN_DOTS:
        raise InputError(
            f"the tracker sees {int(visible.sum())} dots of the screen and {MIN_DOTS} are needed;"
            " look at [collimator]"
        )
    return x[visible], y[visible]


def delays_of(recording: image_sources.DiodeRecording | None, file: BenchFile) -> FloatArray:
    """Delays (n,) from the swap to the first row's light, ms, by a photodiode's recording.
    Raises InputError.
    """
    if recording is None:
        return np.zeros(0)
    monitor = file.config.monitor
    paired = pair(recording.seen, recording.shown, NS_PER_S / monitor.refresh_hz)
    return np.asarray(paired.latency_ns / NS_PER_MS - swap_to_square_ms(monitor))


class VirtualReader:
    """Readings of a virtual bench by its truth file, drawing no image; each `turn` has its own
    noise. Raises InputError.

    `identity` says it in words.
    """

    monitor: MonitorIdentity | None = None

    def __init__(self, file: BenchFile, truth: BenchFile, seed: int, turn: int = 0) -> None:
        image_sources.refuse_other_bench(file, truth)
        if not _is_mounted_alike(file, truth):
            raise InputError(
                f"{truth.path}: its screen is mounted otherwise; run the orientation first (hilstar"
                " first-light)"
            )
        self.file = file
        self.truth = truth
        self._rng = np.random.default_rng((seed, 0xCE27, turn))
        self._beside_rng = np.random.default_rng((seed, 0xBE51, turn))
        self.identity = f"virtual: {truth.path.name}, sha256 {truth.sha256}, seed {seed}"
        self._noise = truth.config.certify.virtual
        self._t_s = 0.0
        monitor = truth.config.monitor
        self._response = grey_response(truth)
        self._uniformity = bench_calibration(truth.config, truth.folder).uniformity_map(
            monitor.resolution_px
        )
        self._white_e_per_s = full_scale_e_per_s(truth)

    def now_ns(self) -> int:
        """The simulated clock."""
        return round(self._t_s * NS_PER_S)

    def wait(self, seconds: float) -> None:
        """Let simulated time pass."""
        self._t_s += seconds

    def light(self, codes: IntArray) -> LightReadings:
        """The truth's light at the middle of the screen, with drift and noise."""
        noise = self._noise
        rng = self._rng
        t_s = self._t_s + noise.seconds_a_reading * np.arange(len(codes), dtype=np.float64)
        self._t_s += noise.seconds_a_reading * len(codes)
        width, height = self.truth.config.monitor.resolution_px
        if self._uniformity is None:
            here = 1.0
        else:
            here = float(self._uniformity[height // 2, width // 2])
        warmth = 1 + noise.drift_percent_per_h / 100 * t_s / 3600
        cooling = np.exp(-t_s / (60 * noise.warm_up_min))
        cold = noise.cold_percent / 100 * cooling
        white = self._white_e_per_s * here * (1 + noise.instrument_error)
        share = self._response.light[codes] + self._response.black
        wanted = share * white * (warmth - cold)
        read: FloatArray = wanted * (1 + noise.reading_noise * rng.standard_normal(len(codes)))
        return LightReadings(codes, read, t_s, beside=self._beside())

    def _beside(self) -> BesideRatio:
        """A truth file's pixels leave each other's light as it is; the mean of pairs has noise."""
        error = self._noise.reading_noise * math.sqrt(2 / BESIDE_PAIRS)
        return BesideRatio(1 + error * float(self._beside_rng.standard_normal()), error)

    def dots(self, x_px: IntArray, y_px: IntArray, images: int) -> DotReadings:
        """The dots' places by the truth's lens, with noise."""
        x = x_px.astype(np.float64)
        y = y_px.astype(np.float64)
        true_x, true_y = in_true_image(self.file, self.truth, x, y)
        less = 1 / math.sqrt(images)
        seen_px = geometry_of(self.truth).to_tracker(true_x, true_y)
        light = np.ones(len(x))
        if self._uniformity is not None:
            row = true_y.astype(np.intp)
            column = true_x.astype(np.intp)
            light = self._uniformity[row, column].astype(np.float64)
        light_noise = less * self._noise.reading_noise
        light *= 1 + light_noise * self._rng.standard_normal(len(x))
        noise_px = less * self._noise.dot_noise_px
        seen_x, seen_y = (part + noise_px * self._rng.standard_normal(len(x)) for part in seen_px)
        is_visible = np.isfinite(seen_x) & np.isfinite(seen_y)
        psf_u = less * self._noise.reading_noise
        widths = tracker_psf(self.truth.config.tracker, self.truth.folder).width_px
        psf = float(np.hypot(*widths)) / math.sqrt(2)
        noisy = psf * (1 + psf_u * float(self._rng.standard_normal()))
        columns = np.stack([x, y, seen_x, seen_y, light])[:, is_visible]
        x, y, seen_x, seen_y, light = columns
        return DotReadings(x, y, seen_x, seen_y, light, noisy, psf * psf_u)

    def delays_ms(self) -> FloatArray:
        """A simulated photodiode."""
        if not self.file.config.monitor.photodiode_px:
            return np.zeros(0)
        return delays_of(
            image_sources.virtual_diode(self.file, self.truth, WATCHED_S, self._rng), self.file
        )


def _is_mounted_alike(file: BenchFile, truth: BenchFile) -> bool:
    """Whether steps right and down the image go the same way in the tracker by both files, to 45
    degrees, as they do after the step `orientation`.
    """
    width, height = file.config.monitor.resolution_px
    x_px = np.array([0.0, STEP_PX, 0.0]) + (width - 1) / 2
    y_px = np.array([0.0, 0.0, STEP_PX]) + (height - 1) / 2
    stated = np.stack(geometry_of(file).to_tracker(x_px, y_px))
    true_px = in_true_image(file, truth, x_px, y_px)
    true = np.stack(geometry_of(truth).to_tracker(*true_px))
    steps = stated[:, 1:] - stated[:, :1]
    true_steps = true[:, 1:] - true[:, :1]
    lengths = np.linalg.norm(steps, axis=0) * np.linalg.norm(true_steps, axis=0)
    cosines = (steps * true_steps).sum(axis=0) / lengths
    return bool((cosines > math.cos(math.pi / 4)).all())


def dot_settings(file: BenchFile) -> CentroidSettings:
    """How dots are measured in the tracker's image: in a window no narrower than they are.
    Raises InputError.
    """
    default = CentroidSettings(THRESHOLD_SIGMA, MIN_PIXELS)
    return replace(default, window_sigma_px=max(default.window_sigma_px, dot_sigma_px(file)))


@dataclass
class ImageReader:
    """Readings by the tracker's images of an image source, which go to `folder`."""

    file: BenchFile
    source: image_sources.ImageSource
    folder: Path
    truth: BenchFile | None = None
    _context: StepContext = field(init=False)

    def __post_init__(self) -> None:
        self.identity, self.monitor = self.source.identity, self.source.monitor
        self._context = StepContext(self.file, self.folder, self.folder, self.source, {}, {}, 0)

    def now_ns(self) -> int:
        """This machine's monotonic clock."""
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(seconds)

    def light(self, codes: IntArray) -> LightReadings:
        """Lattices of dots that do not saturate the tracker, read by the tracker as a
        photometer.
        """
        sigma_px = float(np.mean(self._context.tracker_psf.width_px))
        grey = grey_response(self.file)
        meter = Photometer(self._context, sigma_px, Assumed({"w": grey.light}, grey.black), PAIRS)
        gain = self.file.config.tracker.detector.gain_e_per_dn
        start_ns = self.now_ns()
        readings = meter.read([Patch(int(code), "w") for code in codes])
        seconds = (self.now_ns() - start_ns) / NS_PER_S
        # Patches take the same time each.
        t_s = np.linspace(0.0, seconds, len(codes))
        level = readings.light[codes == 0].mean()
        field = meter.field
        return LightReadings(
            codes,
            (readings.above_black + level) * gain,
            t_s,
            square_px=(field.left, field.top, field.side),
            common=_common(readings) * gain,
            noise=readings.sigma * gain,
            beside=_beside(readings.links),
        )

    def dots(self, x_px: IntArray, y_px: IntArray, images: int) -> DotReadings:
        """One image of dots, each found near where the bench file has it."""
        image = self._image_of_dots(x_px, y_px, images)
        stars = find_stars(image, dot_settings(self.file), noisiest_background(image))
        if len(stars) < MIN_DOTS:
            raise InputError(
                f"{len(stars)} dots are in the image and {MIN_DOTS} are needed; look at the focus"
                " and the exposure"
            )
        from scipy.spatial import cKDTree

        geometry = geometry_of(self.file)
        x = x_px.astype(np.float64)
        y = y_px.astype(np.float64)
        expected = np.stack(geometry.to_tracker(x, y), axis=1)
        places = np.stack([stars.x_px, stars.y_px], axis=1)
        far, near = (np.asarray(part) for part in cKDTree(places).query(expected))
        seen = (far < APART_TRACKER_PX / 2) & ~stars.at_edge[near]
        if seen.sum() < MIN_DOTS:
            raise InputError(
                f"{int(seen.sum())} dots are where the bench file has them; run the geometry again"
                " (first-light)"
            )
        sigma_px = psf_sigma_of(self._context.file)
        screen = SeenScreen(geometry.monitor, geometry.tracker, is_sure=True, psf_sigma_px=sigma_px)
        sharp = seen_sharpness(image, screen, self.file.config.tracker.detector, images)
        seen_px = stars.x_px[near[seen]], stars.y_px[near[seen]]
        apart = np.asarray(cKDTree(expected).query(expected, k=2)[0])
        half_apart = int(apart[:, 1].min()) // 2
        reach = math.ceil(DOT_REACH_SIGMAS * dot_sigma_px(self.file))
        light = light_in_squares(image, *seen_px, min(reach, half_apart))
        psf = sharp.psf_sigma_px, sharp.psf_sigma_error_px
        return DotReadings(x[seen], y[seen], *seen_px, light, *psf)

    def _image_of_dots(self, x_px: IntArray, y_px: IntArray, images: int) -> FloatArray:
        """The mean of some images of dots, DN above the dark, in a code that does not saturate the
        tracker.
        """
        context = self._context
        dark = context.read(context.dark())
        code = code_of_light(self.file, DOT_LIGHT)
        while True:
            codes = image_sources.black(context.resolution_px)
            half = DOT_PX // 2
            first_y, first_x = y_px - half, x_px - half
            for down, right in np.ndindex(DOT_PX, DOT_PX):
                codes[first_y + down, first_x + right] = code
            looked = []
            for number in range(images):
                pattern = image_sources.Pattern(f"dots_{code:05}_{number}", codes)
                looked.append(context.look(pattern, dark))
            if not context.is_too_bright(looked[0]):
                return np.asarray(np.mean([look.image for look in looked], axis=0))
            code = context.darker(code)

    def delays_ms(self) -> FloatArray:
        """The photodiode's edges, where there is one."""
        if not self.file.config.monitor.photodiode_px:
            return np.zeros(0)
        return delays_of(self.source.diode(self.file, WATCHED_S), self.file)


def light_in_squares(
    image: FloatArray, x_px: FloatArray, y_px: FloatArray, reach: int
) -> FloatArray:
    """The sums (n,) of an image (h, w) over squares of 2 `reach` + 1 pixels about places (n,); 0
    beyond its edge.

    All of a dot's light is in its square. That of the pixels above a threshold is a smaller share
    of fainter dots, by 0.0006 mag towards the edge of an uneven screen.
    """
    padded = np.pad(image, reach)
    side = 2 * reach + 1
    sums = np.zeros(len(x_px))
    row = np.rint(y_px).astype(np.intp)
    column = np.rint(x_px).astype(np.intp)
    for down, right in np.ndindex(side, side):
        sums += padded[row + down, column + right]
    return sums


def _beside(links: list[LatticeRatio]) -> BesideRatio | None:
    """The densest lattice against the sparsest, by the ratios between them; None where no lattice
    has neighbours lit.
    """
    if not links or links[0].dense > 1:
        return None
    ratio = math.prod(link.ratio for link in links)
    relative = [link.error / link.ratio for link in links]
    return BesideRatio(ratio, ratio * math.hypot(*relative))


def _common(readings: Readings) -> FloatArray:
    """What readings share, DN/s: (n, causes), one standard error of each."""
    is_black = np.array([patch.code == 0 for patch in readings.patches])
    # What shifts black as well shifts no light above it.
    above = readings.common - readings.common[is_black].mean(axis=0)
    above[is_black] = 0.0
    return np.asarray(above)


Reader = VirtualReader | ImageReader
