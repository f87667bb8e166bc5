"""Stars on the screen against the sky: fields are shown, and each star's place and light in the tracker's image compared."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.bench.build import open_bench
from hilstar.bench.cameras import tracker_camera
from hilstar.bench.frame import Bench, Frame
from hilstar.calibrate.first_light.patterns import CodeImage, Pattern
from hilstar.calibrate.first_light.rooms import MAX_FILL, Looked, Room
from hilstar.errors import InputError
from hilstar.rotation import to_matrix
from hilstar.tracker.centroids import Centroids, CentroidSettings, find_stars, noisiest_background
from hilstar.units import MAG_PER_RELATIVE

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


@dataclass(frozen=True, slots=True)
class Wanted:
    """Stars that are drawn whole and stand alone: places (n, 2), tracker px, and light (n,), e-/s."""

    place_px: FloatArray
    e_per_s: FloatArray


@dataclass(frozen=True, slots=True)
class StarsSeen:
    """Bright stars that stand alone: where the sky has them (n, 2), tracker px, and how far off they were seen (n, 2).

    `dn` is the light of each (n,), `e_per_s` what was asked for, `noise_mag` its error; infinite where the tracker saturated.
    """

    place_px: FloatArray
    residual_px: FloatArray
    dn: FloatArray
    e_per_s: FloatArray
    noise_mag: FloatArray
    lost: int
    images: tuple[Path, ...]

    @property
    def sure(self) -> npt.NDArray[np.bool_]:
        """The stars whose light is known well enough to be judged (n,)."""
        return self.noise_mag < SURE_MAG


def see_stars(room: Room) -> StarsSeen:
    """Show the bench's own fields of stars and measure them. Raises InputError where too few stars can be compared."""
    with open_bench(room.file) as bench:
        shown = [(_frames(bench, frame), _alone(bench, room, frame)) for frame in _fullest(bench)]
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


def _frames(bench: Bench, frame: Frame) -> tuple[CodeImage, ...]:
    """The codes of an attitude: one frame, or with `temporal` those of an exposure."""
    if bench.config.render.quantisation != "temporal":
        return (frame.codes.astype(np.uint16),)
    numbers = range(bench.config.exposure_frames)
    return tuple(bench.code_values(bench.draw(frame.q_icrs_to_cam, k).levels).astype(np.uint16) for k in numbers)


def _together(fields: list[StarsSeen], dark: Path) -> StarsSeen:
    return StarsSeen(
        place_px=np.concatenate([each.place_px for each in fields]),
        residual_px=np.concatenate([each.residual_px for each in fields]),
        dn=np.concatenate([each.dn for each in fields]),
        e_per_s=np.concatenate([each.e_per_s for each in fields]),
        noise_mag=np.concatenate([each.noise_mag for each in fields]),
        lost=sum(each.lost for each in fields),
        images=(dark, *(path for each in fields for path in each.images)),
    )


def _fullest(bench: Bench) -> list[Frame]:
    """Of some random attitudes those with the most stars on the screen."""
    rng = np.random.default_rng(SEED)
    attitudes = [q / np.linalg.norm(q) for q in rng.normal(size=(ATTITUDES, 4))]
    fullest = sorted(attitudes, key=lambda q: -len(bench.sprites(q)))[:FIELDS]
    return [bench.frame(q) for q in fullest]


def _alone(bench: Bench, room: Room, frame: Frame) -> Wanted:
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
    return Wanted(place[kept], truth["electrons_per_s"][kept])


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
    saturated = found.peak[chosen] > MAX_FILL * room.full_dn - looked.floor_dn
    return StarsSeen(
        place_px=wanted.place_px[matched],
        residual_px=seen[chosen] - wanted.place_px[matched],
        dn=dn,
        e_per_s=wanted.e_per_s[matched],
        noise_mag=np.where(saturated, np.inf, MAG_PER_RELATIVE * noise),
        lost=int((~near & (wanted.e_per_s >= faintest)).sum()),
        images=(looked.path,),
    )


def _found(room: Room, image: FloatArray) -> tuple[Centroids, float]:
    """The stars of an image (h, w), and the noise of its pixels, DN."""
    geometry = room.geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sprite = room.file.config.render.sprite_sigma_px
    psf = tuple(float(np.hypot(a, ratio * b)) for a, b in zip(room.file.config.tracker.psf_sigma_px, sprite, strict=True))
    settings = CentroidSettings(
        THRESHOLD_SIGMA, 2, window_sigma_px=WINDOW_SIGMA_PX, window_radius_px=RADIUS_PX, psf_sigma_px=(psf[0], psf[1])
    )
    background = noisiest_background(image)
    return find_stars(image, settings, background), background.noise
