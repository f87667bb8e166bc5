"""The virtual tracker before a display that runs: light of its frames over an exposure, DN,
found stars, an attitude.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.shown_frames import ShownFrame
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.closing import Closing
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    propagate,
    rate_between_rad_s,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.units import NS_PER_S
from hilstar.display.quantise import LitLight
from hilstar.instruments.simulate.optics import DisplayColours, TwinOptics, seen_primaries
from hilstar.instruments.simulate.simulator import TrackerBackground, detector_canvas
from hilstar.instruments.simulate.twin import true_geometry, true_panel
from hilstar.optics.layers.view import View
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.light_times import FrameLight, lit_times_ns, on_screen
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import tracker_camera
from hilstar.sky.stars import split_by_rate
from hilstar.tracker.centroids import (
    CentroidSettings,
    LocalBackground,
    estimate_background,
    find_stars,
    noisiest_background,
    star_widths,
)
from hilstar.tracker.detector import Detector
from hilstar.tracker.identify import MIN_STARS, FoundStars, Identified, identify
from hilstar.tracker.mosaic import software_image, software_psf_px, uneven_dark_dn

TRACKING, LOST, TOO_FEW, BLINDED = "tracking", "lost in space", "too few stars", "blinded"
KEPT_NS = 10 * NS_PER_S  # frames that an exposure may still be of
SEEN_SIGMAS = 3.0  # in a pixel's noise: fainter stars are not expected in an image
MAX_EXPECTED = 300  # brightest stars that are
MAX_REPORTED = 30  # stars
BLINDED_SHARE = 0.05  # detector pixels at the last code
STREAK_PX = 0.5  # from this streak on, the window is as wide as it, and no S-curve is removed
MAX_WINDOW_PX = 6.0
# an attitude older than this predicts no other; two further apart than that tell no rate
STALE_S, TURN_S = 5.0, 1.0


@dataclass(frozen=True, slots=True)
class Exposed:
    """What an exposure had of the display: lit pixels (n,), their mean light (n, primaries), e-/s,
    and the mean attitude.

    `span_ns` are its begin and end; `frames` it had, and the share of it in which the field was not
    blank.
    """

    span_ns: tuple[int, int]
    lit: IntArray
    light_e_per_s: FloatArray
    q_icrs_to_cam: FloatArray | None
    frames: int
    shown_share: float

    @property
    def middle_ns(self) -> int:
        """The middle of the exposure."""
        return sum(self.span_ns) // 2


class WatchedFrames:
    """The newest frames of a display, each lit as `light_times` has it; `light_of` gives a
    frame's pixels' light (n, primaries).
    """

    def __init__(self, light_of: Callable[[ShownFrame], FloatArray]) -> None:
        self.received = self.missing = 0
        self._light_of = light_of
        self._frames: deque[ShownFrame] = deque()

    def add(self, frame: ShownFrame) -> None:
        """Take a frame. One that is older than the last begins a new run."""
        last = self._frames[-1].head if self._frames else None
        head = frame.head
        if last is not None and (head.lit_ns <= last.lit_ns or head.frame <= last.frame):
            self._frames.clear()
        elif last is not None:
            self.missing += head.frame - last.frame - 1
        self.received += 1
        self._frames.append(frame)
        # the frame that the oldest exposure still to be asked for begins in stays
        oldest_ns = head.lit_ns - KEPT_NS
        while len(self._frames) > 1 and self._frames[1].head.lit_ns < oldest_ns:
            self._frames.popleft()

    @property
    def newest_ns(self) -> int:
        """When the newest frame's light is whole; 0 before any."""
        if self._frames:
            return frame_light(self._frames[-1]).whole_ns
        return 0

    def exposed(self, begin_ns: int, end_ns: int) -> Exposed | None:
        """The mean of what was lit in a span; None where its beginning is not known."""
        frames = list(self._frames)
        frame_lights = [frame_light(frame) for frame in frames]
        if not frames or frame_lights[0].whole_ns > begin_ns:
            return None
        shares = lit_times_ns(frame_lights, begin_ns, end_ns, end_ns) / (end_ns - begin_ns)
        places: list[npt.NDArray[np.uint32]] = []
        lights: list[FloatArray] = []
        turns: list[tuple[FloatArray, float]] = []
        for frame, share in zip(frames, shares.tolist(), strict=True):
            if share <= 0:
                continue
            places.append(frame.lit)
            lights.append(self._light_of(frame) * share)
            if (q := frame.q_icrs_to_cam) is not None:
                turns.append((q, share))
        lit, first = np.unique(np.concatenate(places), return_inverse=True)
        sums = []
        for primary_light in np.concatenate(lights).T:
            sums.append(np.bincount(first, primary_light, minlength=len(lit)))
        return Exposed(
            span_ns=(begin_ns, end_ns),
            lit=lit.astype(np.intp),
            light_e_per_s=np.array(sums, dtype=np.float64).T,
            q_icrs_to_cam=_mean(turns),
            frames=len(places),
            shown_share=sum((share for _, share in turns), 0.0),
        )


def frame_light(frame: ShownFrame) -> FrameLight:
    """When a frame is lit, as its message says."""
    head = frame.head
    if head.moment_ns is None:
        return on_screen(head.lit_ns)
    return FrameLight(head.lit_ns, head.moment_ns, head.fades)


def _mean(turns: list[tuple[FloatArray, float]]) -> FloatArray | None:
    """The mean rotation of attitudes with weights: of small turns from the first."""
    if not turns:
        return None
    first, _ = turns[0]
    total = sum(share for _, share in turns)
    weighted = []
    for q, share in turns:
        turn_rad = to_rotation_vector(multiply(q, conjugate(first)))
        weighted.append(share / total * turn_rad)
    mean_rad = np.sum(weighted, axis=0)
    return normalise(multiply(from_rotation_vector(mean_rad), first))


@dataclass(frozen=True, slots=True)
class Solved:
    """An exposure's answer before anything is planted: its attitude (None: none was found), the
    stars that it rests on.

    `mode` is one of the four words above; LOST is "lost in space", solved or not.
    """

    exposed: Exposed
    mode: str
    found: FoundStars
    identified: Identified | None = None


Solve = Callable[[FoundStars, npt.NDArray[np.uint16]], FloatArray | None]


class LiveTracker(Closing):
    """A bench's virtual tracker, as a watcher of its display's frames. Free it with `close`.

    `lost_in_space` gives an attitude of stars or of an image when none is expected; None: each
    exposure's true one is taken. Raises InputError as the bench does.
    """

    lost_in_space: Solve | None = None

    def __init__(self, file: BenchFile, rng: np.random.Generator) -> None:
        self.file = file
        self.config = file.config
        self._rng = rng
        tracker = self.config.tracker
        self.exposure_s = tracker.exposure_s
        self.camera = tracker_camera(tracker, file.folder)
        self.canvas = detector_canvas(file, self.camera)
        self._detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)
        with open_bench(file) as bench:
            self._bench = bench  # its light; its renderer is closed
            self._size_px = bench.camera.resolution_px
            self._bits = self.config.monitor.bits
            self._panel = true_panel(bench)
            self._rgb = bench.calibration.response.rgb
            self._primaries = seen_primaries(bench)
            self._colours = DisplayColours.of(bench)
            self._optics = TwinOptics(true_geometry(bench, self.camera), bench.tracker_psf)
            glow_e_per_s = self._optics.glow_e_per_s(self._panel)
            glow_e = np.median(glow_e_per_s) * self.exposure_s
            noise_e = float(np.sqrt(tracker.detector.noise(glow_e, self.exposure_s).total_e2))
            detected_e = SEEN_SIGMAS * noise_e / self.canvas.psf.peak_share
            faintest_e_per_s = max(detected_e / self.exposure_s, bench.faintest_shown_e_per_s)
            self.stars, _ = split_by_rate(bench.stars, faintest_e_per_s)
        background = TrackerBackground(self.config, file.folder, self.camera, refuse=False)
        pixels_glow_e = self._colours.grey(glow_e_per_s) * self.exposure_s
        self._under_e = pixels_glow_e + background.of_view_e(View(np.array([1.0, 0, 0, 0])))
        self._gain_db = 0.0
        # As the bench file has them: what a client sets is worked out from these.
        self._bench_exposure_s = self.exposure_s
        self._bench_under_e = self._under_e
        self._dark_dn = uneven_dark_dn(self._under_e, tracker.detector)
        self._radius_rad = self.camera.field_radius_rad(0.0)
        self._before: tuple[int, FloatArray] | None = None
        self._last: tuple[int, FloatArray] | None = None
        self.refused = 0
        self.frames = WatchedFrames(self._light)

    def _light(self, frame: ShownFrame) -> FloatArray:
        """The light (n, primaries) of a frame's lit pixels, e-/s."""
        levels = frame.codes if self._rgb is None else _levels_of(frame.codes, self._rgb)
        panels = self._panel.primaries or (self._panel,)
        by_channel = levels.reshape(len(levels), math.prod(levels.shape[1:])).T
        lights = []
        for panel, channel_levels in zip(panels, by_channel, strict=True):
            relative = panel.response.light[channel_levels]
            lights.append(relative * panel.flux_at_white_e_per_s)
        light = np.stack(lights, axis=1)
        if self._panel.uniformity is not None:
            light = light * self._panel.uniformity.ravel()[frame.lit, None]
        return np.asarray(light)

    def take(self, frame: ShownFrame) -> None:
        """Take a frame. Raises InputError for one of another display."""
        head = frame.head
        kind = head.width, head.height, head.bits, head.channels
        channels = 1 if self._rgb is None and not self._panel.primaries else 3
        bench_kind = *self._size_px, self._bits, channels
        if kind != bench_kind:
            form = "{} x {} pixels of {} bits in {} channels"
            shown, wanted = form.format(*kind), form.format(*bench_kind)
            raise InputError(
                f"frames of {shown}, the bench file has {wanted}; give the bench file of serve"
            )
        self.frames.add(frame)

    def adjust(self, exposure_s: float, gain_db: float) -> None:
        """Expose for `exposure_s`, with a gain over the bench file's, as a camera's client asks."""
        if (exposure_s, gain_db) == (self.exposure_s, self._gain_db):
            return
        self._under_e = self._bench_under_e * (exposure_s / self._bench_exposure_s)
        self.exposure_s = exposure_s
        self._gain_db = gain_db
        tracker = self.config.tracker
        gain_e_per_dn = tracker.detector.gain_e_per_dn / 10 ** (gain_db / 20)
        settings = msgspec.structs.replace(tracker.detector, gain_e_per_dn=gain_e_per_dn)
        self._detector = Detector(settings, tracker.resolution_px, tracker.pixel_pitch_um)
        self._dark_dn = uneven_dark_dn(self._under_e, settings)

    def expose(self, exposed: Exposed) -> npt.NDArray[np.uint16]:
        """The DN of an exposure."""
        lights = (LitLight(exposed.lit, light) for light in exposed.light_e_per_s.T)
        images = self._optics.images_e_per_s(lights, self._primaries)
        light = self._colours.shown(images) * self.exposure_s
        light += self._under_e
        return self._detector.expose(light, self.exposure_s, self._rng)

    def solve(self, exposed: Exposed, dn: npt.NDArray[np.uint16]) -> Solved:
        """The attitude of an exposure, whose image is `dn`."""
        expected = self._expected(exposed)
        stars = self._found(dn, exposed, expected)
        settings = self.config.tracker.detector
        last_code = 2**settings.bits - 1
        if np.count_nonzero(dn == last_code) > BLINDED_SHARE * dn.size:
            return self._answered(Solved(exposed, BLINDED, stars))
        identified = None
        if expected is not None:
            identified = identify(stars, expected, self._near, self._place)
        mode = TRACKING
        if identified is None and self.lost_in_space is not None and len(stars):
            mode = LOST
            guess = self.lost_in_space(stars, dn)
            if guess is not None:
                identified = identify(stars, guess, self._near, self._place)
        if identified is None:
            mode = TOO_FEW if len(stars) < MIN_STARS else LOST
        return self._answered(Solved(exposed, mode, stars, identified))

    def _answered(self, solved: Solved) -> Solved:
        """The same answer, noted as the last one where it has an attitude."""
        if solved.identified is not None:
            at_ns = solved.exposed.middle_ns
            self._before = self._last
            self._last = (at_ns, solved.identified.q_icrs_to_cam)
        return solved

    def _expected(self, exposed: Exposed) -> FloatArray | None:
        """The attitude that the last two lead to, or the true one; None where none is known."""
        if self.lost_in_space is None:
            return exposed.q_icrs_to_cam
        if self._last is None:
            return None
        last_ns, last_q = self._last
        since_ns = exposed.middle_ns - last_ns
        if since_ns > STALE_S * NS_PER_S:
            return None
        return propagate(last_q, self.rate_cam_rad_s(), since_ns / NS_PER_S)

    def rate_cam_rad_s(self) -> FloatArray:
        """The turn between the last two attitudes (3,), cam; 0 where there are none of the last
        second, and where both are of one moment.
        """
        if self._before is None or self._last is None:
            return np.zeros(3)
        before_ns, before_q = self._before
        last_ns, last_q = self._last
        apart_s = (last_ns - before_ns) / NS_PER_S
        if not 0 < apart_s <= TURN_S:
            return np.zeros(3)
        return rate_between_rad_s(before_q, last_q, apart_s)

    def _found(
        self, dn: npt.NDArray[np.uint16], exposed: Exposed, expected: FloatArray | None
    ) -> FoundStars:
        """The stars that the tracker's software finds in an image, by a window as wide as they are
        smeared.
        """
        psf_px = software_psf_px(self.canvas.psf.width_px, self.config.tracker.detector)
        focal_px = self.camera.focal_length_px
        smeared_px = streak_px(self.rate_cam_rad_s(), self.exposure_s, focal_px)
        settings = smeared_settings(smeared_px, psf_px)
        image = software_image(dn, self.config.tracker.detector)
        background: LocalBackground | None = None
        if self._dark_dn is not None:
            image = image - self._dark_dn
            background = noisiest_background(image)
        stars = find_stars(image, settings, background)
        good = ~stars.at_edge
        x_px = stars.x_px[good]
        y_px = stars.y_px[good]
        flux_e = stars.flux[good] * self._detector.settings.gain_e_per_dn
        rays = normalise(self.camera.rays(x_px, y_px))
        under = background or estimate_background(image)
        widths_px = star_widths(image, under.level, x_px[:MAX_REPORTED], y_px[:MAX_REPORTED])
        return FoundStars(x_px, y_px, flux_e, rays, widths_px)

    def reported_stars(self, solved: Solved) -> tuple[ReportedStar, ...]:
        """The brightest stars of an exposure, as a tracker reports them."""
        stars = solved.found
        pairs = solved.identified
        gain = self._detector.settings.gain_e_per_dn
        hip = {}
        if pairs is not None:
            hip = dict(zip(pairs.found.tolist(), self.stars.hip[pairs.star].tolist(), strict=True))
        reported: list[ReportedStar] = []
        for k in range(min(len(stars), MAX_REPORTED)):
            x_px, y_px = float(stars.x_px[k]), float(stars.y_px[k])
            flux_dn = float(stars.flux_e[k]) / gain
            width_px = float(stars.width_px[k])
            reported.append(
                ReportedStar(
                    x_px,
                    y_px,
                    flux_dn,
                    hip=hip.get(k) or None,
                    width_px=width_px if math.isfinite(width_px) else None,
                )
            )
        return tuple(reported)

    def _near(self, q_icrs_to_cam: FloatArray) -> tuple[IntArray, FloatArray]:
        """The brightest stars (n,) of a field, and their unit vectors (n, 3), ICRS."""
        boresight = to_matrix(q_icrs_to_cam)[2]
        near = self.stars.near(boresight, self._radius_rad)
        brightest_first = np.argsort(-self.stars.electrons_per_s[near], kind="stable")
        near = near[brightest_first[:MAX_EXPECTED]]
        return near, self.stars.directions(near)

    def _place(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tracker pixels (n,) of rays (n, 3), cam."""
        return self.camera.project(rays @ self.camera.cam_to_image.T)

    def close(self) -> None:
        """Free the GL context."""
        self._optics.close()


def streak_px(rate_cam_rad_s: FloatArray, exposure_s: float, focal_length_px: float) -> float:
    """How far a star about the boresight moves in an exposure at a rate (3,)."""
    across_rad_s = float(np.linalg.norm(rate_cam_rad_s[:2]))
    return across_rad_s * exposure_s * focal_length_px


def smeared_settings(smeared_px: float, psf_px: tuple[float, float]) -> CentroidSettings:
    """How stars are found that are smeared so far beside their PSF's sigmas."""
    window_px = max(1.0, *psf_px)
    if smeared_px <= STREAK_PX:
        return CentroidSettings(window_sigma_px=window_px, psf_sigma_px=psf_px)
    # the standard deviation of an even streak along itself
    window_px = max(window_px, min(smeared_px / np.sqrt(12), MAX_WINDOW_PX))
    return CentroidSettings(window_sigma_px=window_px, psf_sigma_px=None)


def _levels_of(codes: npt.NDArray[np.unsignedinteger], rgb: npt.NDArray[np.uint16]) -> IntArray:
    """The levels (n,) of triples of codes (n, 3); the darkest where a triple is none of the
    response's.
    """
    weights = [1 << 32, 1 << 16, 1]
    numbers = rgb.astype(np.int64) @ weights
    asked = codes.astype(np.int64) @ weights
    order = np.argsort(numbers)
    at_or_after = np.searchsorted(numbers[order], asked)
    place = order[np.minimum(at_or_after, len(order) - 1)]
    return np.where(numbers[place] == asked, place, 0)
