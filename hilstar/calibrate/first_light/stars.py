"""Stars on the screen against the sky: fields are shown, and each star's place and light in the tracker's image compared."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.bench.build import open_bench
from hilstar.bench.cameras import tracker_camera
from hilstar.bench.frame import Bench, Frame
from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.calibrate.first_light.rooms import MAX_FILL, Looked, Room
from hilstar.errors import InputError
from hilstar.monitor.quantise import shown_light
from hilstar.monitor.response import Codes
from hilstar.rotation import to_matrix
from hilstar.tracker.centroids import Centroids, CentroidSettings, find_stars, noisiest_background
from hilstar.units import MAG_PER_RELATIVE, magnitude

ATTITUDES, SEED = 40, 3  # random ones, of which the fields with the most stars are shown
FIELDS = 3
MIN_STARS = 5
REACH_PX = 3.0  # of the tracker, as `verify` looks for a star
ALONE_PX = 10.0
EDGE_PX = 12.0
THRESHOLD_SIGMA = 8.0
BRIGHT_SIGMAS = 60.0  # a star's peak over the noise of a pixel: its own noise is then under 0.02 px
WINDOW_SIGMA_PX, RADIUS_PX = 1.0, 4
WINDOW_PX = (2 * RADIUS_PX + 1) ** 2
SURE_MAG = 0.01  # the noise of a star whose light is judged
# Beside noise and codes: what the window's sum, the response and the map of uniformity leave on a bench that is measured right.
KNOWN_TO_MAG = 0.004
MOST = 0.5  # of the scatter's square: what explains so much is named as its cause
FAR = 3.0  # times their errors: stars that scatter by more do so for a reason


@dataclass(frozen=True, slots=True)
class Wanted:
    """Stars that are drawn whole and stand alone: places (n, 2), tracker px, and light (n,), e-/s.

    `screen` (n, 2) is where on the screen, from -1 to 1 along each axis; `codes_mag` (n,) how much too faint its codes are.
    """

    place_px: FloatArray
    e_per_s: FloatArray
    screen: FloatArray
    codes_mag: FloatArray


@dataclass(frozen=True, slots=True)
class StarsSeen:
    """Bright stars that stand alone: where the sky has them (n, 2), tracker px, and how far off they were seen (n, 2).

    `dn` is the light of each (n,), `e_per_s` what was asked for, `noise_mag` its error; infinite where the tracker saturated.
    `screen` (n, 2) is the place on the screen, -1 to 1; `codes_mag` (n,) how much too faint the codes are.
    """

    place_px: FloatArray
    residual_px: FloatArray
    dn: FloatArray
    e_per_s: FloatArray
    noise_mag: FloatArray
    screen: FloatArray
    codes_mag: FloatArray
    lost: int
    images: tuple[Path, ...]

    @property
    def sure(self) -> npt.NDArray[np.bool_]:
        """The stars whose light is known well enough to be judged (n,)."""
        return self.noise_mag < SURE_MAG

    def scatter(self, off_mag: FloatArray, used: npt.NDArray[np.bool_]) -> Scatter:
        """How the light of the stars in use, `off_mag` (used,) fainter than asked for, scatters beside its errors."""
        left = off_mag - self.codes_mag[used]
        left = left - np.median(left)
        error = np.sqrt(self.noise_mag[used] ** 2 + KNOWN_TO_MAG**2)
        x, y = self.screen[used].T
        return Scatter(
            rms_mag=float(np.sqrt((left**2).mean())),
            error_mag=float(np.sqrt((error**2).mean())),
            by_place=_explained(left, x, y, x**2 + y**2),
            by_light=_explained(left, np.log(self.e_per_s[used])),
        )


@dataclass(frozen=True, slots=True)
class Scatter:
    """How much stars differ in light, rms, beside what they are known to; codes and common zero point aside.

    `by_place` and `by_light` are the shares of its square that follow the place on the screen and the light asked for.
    """

    rms_mag: float
    error_mag: float
    by_place: float
    by_light: float

    @property
    def finding(self) -> str:
        """What is wrong where it is far above the errors, and what to do; "" where it is not."""
        if self.rms_mag <= FAR * self.error_mag:
            return ""
        told = f"the light of stars scatters by {self.rms_mag:.3f} mag rms where they are known to {self.error_mag:.3f}"
        if max(self.by_place, self.by_light) < MOST:
            why = "it follows neither place nor light: look at stray light, local dimming, and whether the light is steady"
        elif self.by_place > self.by_light:
            why = f"{self.by_place:.0%} of it follows the place on the screen: measure that (--again uniformity)"
        else:
            why = (
                f"{self.by_light:.0%} of it follows the light asked for: measure the response (--again photometry, --patches N)"
            )
        return f"{told}; {why}"


def _explained(off: FloatArray, *shapes: FloatArray) -> float:
    """The share of the variance of `off` (n,) that a sum of shapes (n,) explains, less what chance would explain."""
    design = np.stack([np.ones_like(off), *shapes], axis=1)
    free = len(off) - design.shape[1]
    total = float(((off - off.mean()) ** 2).sum())
    if free < 1 or not total:
        return 0.0
    left = off - design @ np.linalg.lstsq(design, off, rcond=None)[0]
    return float(1 - (left**2).sum() / free / (total / (len(off) - 1)))


def see_stars(room: Room) -> StarsSeen:
    """Show the bench's own fields of stars and measure them. Raises InputError where too few stars can be compared."""
    with open_bench(room.file) as bench:
        shown = []
        for frame in _fullest(bench):
            levels = _levels(bench, frame)
            codes = tuple(bench.code_values(each).astype(np.uint16) for each in levels)
            shown.append((codes, _alone(bench, room, frame, levels)))
    dark_path = room.dark()
    dark = room.read(dark_path)
    fields = [
        _compared(room, room.look(Pattern(f"stars_{number:03}", frames[0], frames[1:]), dark), wanted)
        for number, (frames, wanted) in enumerate(shown)
    ]
    seen = _together(fields, dark_path)
    if len(seen.dn) < MIN_STARS:
        raise InputError(
            f"{len(seen.dn)} bright stars are where the sky has them and {MIN_STARS} are needed; {seen.lost} bright ones are"
            " not there: expose longer, set a fainter [render] brightest_v_mag, or run the geometry again"
        )
    return seen


def _levels(bench: Bench, frame: Frame) -> tuple[Codes, ...]:
    """The levels of an attitude: one frame, or with `temporal` those of an exposure."""
    if bench.config.render.quantisation != "temporal":
        return (frame.levels,)
    return tuple(bench.draw(frame.q_icrs_to_cam, k).levels.copy() for k in range(bench.config.exposure_frames))


def _together(fields: list[StarsSeen], dark: Path) -> StarsSeen:
    return StarsSeen(
        place_px=np.concatenate([each.place_px for each in fields]),
        residual_px=np.concatenate([each.residual_px for each in fields]),
        dn=np.concatenate([each.dn for each in fields]),
        e_per_s=np.concatenate([each.e_per_s for each in fields]),
        noise_mag=np.concatenate([each.noise_mag for each in fields]),
        screen=np.concatenate([each.screen for each in fields]),
        codes_mag=np.concatenate([each.codes_mag for each in fields]),
        lost=sum(each.lost for each in fields),
        images=(dark, *(path for each in fields for path in each.images)),
    )


def _fullest(bench: Bench) -> list[Frame]:
    """Of some random attitudes those with the most stars on the screen."""
    rng = np.random.default_rng(SEED)
    attitudes = [q / np.linalg.norm(q) for q in rng.normal(size=(ATTITUDES, 4))]
    fullest = sorted(attitudes, key=lambda q: -len(bench.sprites(q)))[:FIELDS]
    return [bench.frame(q) for q in fullest]


def _alone(bench: Bench, room: Room, frame: Frame, levels: tuple[Codes, ...]) -> Wanted:
    """The stars of a frame that are drawn whole and stand alone, where the tracker should see them."""
    camera = tracker_camera(room.file.config.tracker, room.file.folder)
    truth, vectors = frame.truth, bench.stars.directions(frame.star)
    place = np.stack(camera.project(vectors @ to_matrix(frame.q_icrs_to_cam).T), axis=1)
    width, height = camera.resolution_px
    screen = np.stack([truth["x_px"], truth["y_px"]], axis=1)
    limits = np.array(room.resolution_px) - 1 - EDGE_PX
    # Not by a planet: its light is known to 0.05 mag, and its disc may be wide.
    kept = truth["drawn"] & ~truth["clipped"] & np.isfinite(place).all(axis=1)
    kept &= bench.stars.row[frame.star] >= 0
    kept &= (place > EDGE_PX).all(axis=1) & (place < np.array([width, height]) - 1 - EDGE_PX).all(axis=1)
    kept &= (screen > EDGE_PX).all(axis=1) & (screen < limits).all(axis=1)
    finite = np.where(np.isfinite(place), place, -1e6)
    near = cKDTree(finite).query_ball_point(finite, ALONE_PX, return_length=True)
    kept &= near == 1
    middle = (np.array(room.resolution_px) - 1) / 2
    return Wanted(
        place_px=place[kept],
        e_per_s=truth["electrons_per_s"][kept],
        screen=(screen[kept] - middle) / middle,
        codes_mag=_codes_mag(bench, room, frame, levels, screen[kept]),
    )


def _codes_mag(bench: Bench, room: Room, frame: Frame, levels: tuple[Codes, ...], screen_px: FloatArray) -> FloatArray:
    """How much fainter than wanted the codes are (n,), magnitudes, in what the tracker's window sees of the screen."""
    shown = np.mean([shown_light(each, bench.panel) for each in levels], axis=0)
    geometry = room.geometry()
    reach = math.ceil((RADIUS_PX + 0.5) * geometry.monitor.focal_length_px / geometry.tracker.focal_length_px)
    off = []
    for x, y in np.rint(screen_px).astype(np.intp):
        part = slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1)
        wanted = float(frame.linear[part].sum(dtype=np.float64))
        off.append(magnitude(float(shown[part].sum()) / wanted) if wanted > 0 else 0.0)
    return np.asarray(np.nan_to_num(np.array(off), posinf=0.0))  # nothing of it is shown: it will not be found either


def _compared(room: Room, looked: Looked, wanted: Wanted) -> StarsSeen:
    found, noise_dn = _found(room, looked.image)
    seen = np.stack([found.x_px, found.y_px], axis=1)
    count = len(wanted.e_per_s)
    far, nearest = np.full(count, np.inf), np.zeros(count, dtype=np.intp)
    if len(seen) and count:
        far, nearest = (np.asarray(part) for part in cKDTree(seen).query(wanted.place_px))
    near = far < REACH_PX
    matched = near.copy()
    matched[near] = found.peak[nearest[near]] > BRIGHT_SIGMAS * noise_dn
    # A star as bright as those that were found bright has to be there.
    faintest = np.median(wanted.e_per_s[matched]) if matched.any() else 0.0
    chosen = nearest[matched]
    dn, gain = found.flux[chosen], room.file.config.tracker.detector.gain_e_per_dn
    noise = np.sqrt(np.maximum(dn, 0.0) / gain + WINDOW_PX * noise_dn**2) / np.maximum(dn, 1e-9)
    # Of a gain that changes from pixel to pixel a star has the mean over its own.
    prnu = room.file.config.tracker.detector.prnu / math.sqrt(4 * math.pi * math.prod(_spot_sigma_px(room)))
    noise = np.hypot(noise, prnu)
    saturated = found.peak[chosen] > MAX_FILL * room.full_dn - looked.floor_dn
    return StarsSeen(
        place_px=wanted.place_px[matched],
        residual_px=seen[chosen] - wanted.place_px[matched],
        dn=dn,
        e_per_s=wanted.e_per_s[matched],
        noise_mag=np.where(saturated, np.inf, MAG_PER_RELATIVE * noise),
        screen=wanted.screen[matched],
        codes_mag=wanted.codes_mag[matched],
        lost=int((~near & (wanted.e_per_s >= faintest)).sum()),
        images=(looked.path,),
    )


def _found(room: Room, image: FloatArray) -> tuple[Centroids, float]:
    """The stars of an image (h, w), and the noise of its pixels, DN."""
    settings = CentroidSettings(
        THRESHOLD_SIGMA, 2, window_sigma_px=WINDOW_SIGMA_PX, window_radius_px=RADIUS_PX, psf_sigma_px=_spot_sigma_px(room)
    )
    background = noisiest_background(image)
    return find_stars(image, settings, background), background.noise


def _spot_sigma_px(room: Room) -> tuple[float, float]:
    """The sigma of a star in the tracker's image: its own and the sprite's, (x, y)."""
    geometry = room.geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sprite = room.file.config.render.sprite_sigma_px
    x, y = (math.hypot(a, ratio * b) for a, b in zip(room.file.config.tracker.psf_sigma_px, sprite, strict=True))
    return x, y
