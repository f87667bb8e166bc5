"""Stars on the screen against the sky: a field is shown, and each star's place in the tracker's image compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray
from hilstar.bench.build import open_bench
from hilstar.bench.cameras import tracker_camera
from hilstar.bench.frame import Bench, Frame
from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.calibrate.first_light.rooms import Looked, Room
from hilstar.errors import InputError
from hilstar.rotation import to_matrix
from hilstar.tracker.centroids import CentroidSettings, find_stars
from hilstar.units import MAD_TO_SIGMA

ATTITUDES, SEED = 12, 3  # random ones, of which the field with the most stars is shown
MIN_STARS = 5
REACH_PX = 3.0  # of the tracker, as `verify` looks for a star
ALONE_PX = 10.0
EDGE_PX = 12.0
THRESHOLD_SIGMA = 8.0
BRIGHT_SIGMAS = 60.0  # a star's peak over the noise of a pixel: its own noise is then under 0.02 px
WINDOW_SIGMA_PX = 1.0


@dataclass(frozen=True, slots=True)
class StarsSeen:
    """Bright stars that stand alone: where the sky has them (n, 2), tracker px, and how far off they were seen (n, 2)."""

    place_px: FloatArray
    residual_px: FloatArray
    lost: int
    looked: Looked


def see_stars(room: Room) -> StarsSeen:
    """Show the bench's own field of stars and measure it. Raises InputError where too few stars can be compared."""
    with open_bench(room.file) as bench:
        if bench.calibration.response.rgb is not None:
            raise InputError("a frame with [render] bit_stealing cannot be shown here; leave it out, or verify with `serve`")
        frame = _fullest(bench)
        place, rate = _alone(bench, room, frame)
    looked = room.look(Pattern("stars_000", frame.codes.astype(np.uint16)), room.read(room.dark()))
    return _compared(room, looked, place, rate)


def _fullest(bench: Bench) -> Frame:
    """Of a few random attitudes that with the most stars on the screen."""
    rng = np.random.default_rng(SEED)
    attitudes = [q / np.linalg.norm(q) for q in rng.normal(size=(ATTITUDES, 4))]
    return bench.frame(max(attitudes, key=lambda q: len(bench.sprites(q))))


def _alone(bench: Bench, room: Room, frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Where the tracker should see the stars of a frame that are drawn whole and stand alone (n, 2), and their light (n,)."""
    camera = tracker_camera(room.file.config.tracker, room.file.folder)
    truth, stars = frame.truth, bench.stars
    order = np.argsort(stars.hip)
    vectors = stars.vectors[order[np.searchsorted(stars.hip, truth["hip"], sorter=order)]]
    place = np.stack(camera.project(vectors @ to_matrix(frame.q_icrs_to_cam).T), axis=1)
    width, height = camera.resolution_px
    screen = np.stack([truth["x_px"], truth["y_px"]], axis=1)
    limits = np.array(room.resolution_px) - 1 - EDGE_PX
    kept = truth["drawn"] & ~truth["clipped"] & np.isfinite(place).all(axis=1)
    kept &= (place > EDGE_PX).all(axis=1) & (place < np.array([width, height]) - 1 - EDGE_PX).all(axis=1)
    kept &= (screen > EDGE_PX).all(axis=1) & (screen < limits).all(axis=1)
    finite = np.where(np.isfinite(place), place, -1e6)
    near = cKDTree(finite).query_ball_point(finite, ALONE_PX, return_length=True)
    kept &= near == 1
    return place[kept], truth["electrons_per_s"][kept]


def _compared(room: Room, looked: Looked, place: FloatArray, rate: FloatArray) -> StarsSeen:
    geometry = room.geometry()
    ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
    sprite = room.file.config.render.sprite_sigma_px
    psf = tuple(float(np.hypot(a, ratio * b)) for a, b in zip(room.file.config.tracker.psf_sigma_px, sprite, strict=True))
    settings = CentroidSettings(THRESHOLD_SIGMA, 2, window_sigma_px=WINDOW_SIGMA_PX, psf_sigma_px=(psf[0], psf[1]))
    found = find_stars(looked.image, settings)
    noise = float(MAD_TO_SIGMA * np.median(np.abs(looked.image - np.median(looked.image)))) or 1.0
    bright = found.peak > BRIGHT_SIGMAS * noise
    if not len(found) or bright.sum() < MIN_STARS or not len(place):
        raise InputError(
            f"{int(bright.sum())} bright stars are in the image and {MIN_STARS} are needed; expose longer, or set a fainter"
            " [render] brightest_v_mag"
        )
    seen = np.stack([found.x_px, found.y_px], axis=1)
    far, nearest = (np.asarray(part) for part in cKDTree(seen).query(place))
    matched = (far < REACH_PX) & bright[nearest]
    # A star as bright as those that were found bright has to be there.
    faintest = np.median(rate[matched]) if matched.any() else 0.0
    lost = int(((far >= REACH_PX) & (rate >= faintest)).sum())
    if matched.sum() < MIN_STARS:
        raise InputError(
            f"{int(matched.sum())} stars are where the sky has them and {MIN_STARS} are needed; {lost} bright ones are not:"
            " run the geometry again"
        )
    return StarsSeen(place[matched], seen[nearest[matched]] - place[matched], lost, looked)
