"""Stars of one frame of a screen that lights row by row, while the camera turns.

Row y of a screen lights up a part of a refresh period later than the first row, and holds its light
until it is written again. So a star is drawn where it is while its row is lit: on its path from the
moment when that row lights up until the row that it has reached by then is written again, as a
chain of sprites. Frame by frame the paths join to one streak. A star that runs with the scan meets
fewer frames in a second, and has more light in each: 1 % at 10 deg/s, which would else be missing.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import propagate, to_matrix
from hilstar.optics.camera import Camera
from hilstar.optics.paths import (
    Chords,
    Paths,
    ShortPaths,
    bend_px,
    node_counts,
    nodes_of,
    points_within,
    within_budget,
)
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight, brightest, max_stars, pack_sprites
from hilstar.sky.stars import Stars

# With ceil(0.6 r + 1) nodes on a path of r sigmas no pixel is off by more than 1e-3 of the star's
# flux (measured for sigma 0.5 to 2 px and r to 30; tests/unit/optics/test_frame_motion.py holds
# it): its flux and centroid are exact with any number.
NODES_PER_SIGMA = 0.6
# A path of this many sigmas is a point to 1e-3 of the star's flux.
POINT_SIGMA = 0.27
# A frame's work is bounded: beyond one sprite per star all paths together get EXTRA_SPRITES (of
# EXTRA_PX pixels), and no path is longer than MAX_TURN_FIELD of the field's radius. Beyond that,
# paths have fewer nodes or are those of a slower turn, and the stars are counted. With 1000 stars
# in view the longest frame then takes at most 1.8 times as long as a still one (python -m
# tests.benchmarks.bench_motion).
EXTRA_SPRITES = 1000
EXTRA_PX = 400_000
MAX_TURN_FIELD = 0.5
EVERY = slice(None)


@dataclass(frozen=True, slots=True)
class CameraTurn:
    """The attitude when the middle row lights up, and the rate of cam in icrs (3,), cam
    components, constant over the frame.
    """

    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray

    @property
    def speed_rad_s(self) -> float:
        """How fast the camera turns."""
        return float(np.linalg.norm(self.rate_cam_rad_s))


def swept_sprites(
    stars: Stars, turn: CameraTurn, scan: Scan, camera: Camera, psf: Psf
) -> FrameLight:
    """Sprites of each star on its path while its row is lit; the sprites of a star follow each
    other.

    `capped` counts the stars whose paths are coarser than NODES_PER_SIGMA, or shorter than the turn
    makes them.
    """
    turn, is_slower = slowed(turn, scan, camera)
    middle_q = propagate(turn.q_icrs_to_cam, turn.rate_cam_rad_s, scan.hold_s / 2)
    icrs_to_middle = camera.cam_to_image @ to_matrix(middle_q)
    footprint_px = psf.footprint_px
    margin_px = footprint_px / 2 + 1
    radius_rad, edges = camera.field(margin_px)
    reach_rad = turn.speed_rad_s * scan.whole_s / 2
    near = stars.near(icrs_to_middle[2], radius_rad, edges @ icrs_to_middle, reach_rad)
    icrs_to_first = camera.cam_to_image @ to_matrix(turn.q_icrs_to_cam)
    image_directions = (icrs_to_first @ stars.directions(near).T).T
    close = camera.in_view(image_directions, margin_px, turn.speed_rad_s * scan.longest_s)
    near = near[close]
    paths = _paths(image_directions[close], turn, scan, camera)
    late_s = _late_s(paths, scan, camera)
    begin_x, begin_y = paths.places_px(EVERY, late_s)
    end_x, end_y = paths.places_px(EVERY, late_s + scan.hold_s)
    chords = Chords(np.stack([begin_x, end_x]), np.stack([begin_y, end_y]))
    # An arc bulges from its chord, and a star runs unevenly along it, by less than the angle of the
    # turn.
    length_px = np.nan_to_num(chords.length_sigma((1.0, 1.0)))
    bulge_px = paths.speed_rad_s * scan.hold_s * length_px
    end_late_s = scan.late_s(end_x, end_y, camera.resolution_px)
    span_s = _span_s(end_late_s - late_s, scan.hold_s)
    if scan.hold_s:
        chords = chords.to(span_s / scan.hold_s)
    # the part of each path, 0 to 1
    first, last = chords.on_image(camera.resolution_px, margin_px + bulge_px)
    seen_sigma = chords.length_sigma(psf.width_px) * (last - first)
    wanted = node_counts(seen_sigma, NODES_PER_SIGMA, 1, POINT_SIGMA)
    wanted[last <= first] = 0  # the path misses the image
    chosen = _without_the_faintest(wanted, stars.electrons_per_s[near], footprint_px)
    counts = within_budget(chosen, min(EXTRA_SPRITES, EXTRA_PX // footprint_px**2))
    nodes = nodes_of(counts)
    begin = first[nodes.path]
    length = (last - first)[nodes.path]
    place = begin + length * (nodes.place + 1) / 2
    seconds = late_s[nodes.path] + place * span_s[nodes.path]
    x_px, y_px = paths.places_px(nodes.path, seconds)
    star = near[nodes.path]
    light = nodes.share * length * stars.electrons_per_s[star]
    if scan.hold_s:
        light *= span_s[nodes.path] / scan.hold_s
    sprites = pack_sprites(x_px, y_px, light, star, camera.resolution_px, footprint_px)
    coarser = (wanted > 0) if is_slower else (counts < wanted)
    return replace(sprites, per_star=int(counts.max(initial=1)), capped=int(coarser.sum()))


def _late_s(paths: Paths | ShortPaths, scan: Scan, camera: Camera) -> FloatArray:
    """How long after the middle row the row lights up in which each path begins."""
    late_s = np.zeros(len(paths))
    if not scan.scanout_s:
        return late_s
    # Each pass leaves an error of the share of the frame that the star crosses meanwhile: 1e-5 of
    # it for 5 px in 1080 rows.
    for _ in range(2):
        x_px, y_px = paths.places_px(EVERY, late_s)
        late_s = scan.late_s(x_px, y_px, camera.resolution_px)
    return np.where(np.isfinite(late_s), late_s, 0.0)


def _span_s(later_s: FloatArray, hold_s: float) -> FloatArray:
    """How long each star is lit: from the first light of the row where its path begins until the
    row where it ends, which lights up `later_s` after the first, is written again.

    A star that falls by a share s of the rows that the panel lights meanwhile is overtaken by the
    panel hold / (1 - s) after the first.
    """
    if not hold_s:
        return np.zeros(len(later_s))
    share = later_s / hold_s
    share = np.where(np.isfinite(share), share, 0.0)
    share = np.clip(share, -MAX_TURN_FIELD, MAX_TURN_FIELD)
    return np.asarray(hold_s / (1 - share))


def _without_the_faintest(
    wanted: IntArray, electrons_per_s: FloatArray, footprint_px: int
) -> IntArray:
    """The nodes (n,) that paths want, 0 for the faintest stars, for which a frame has no room."""
    wanting = np.flatnonzero(wanted)
    brightest_wanting = brightest(electrons_per_s[wanting], max_stars(footprint_px))
    if brightest_wanting is None:
        return wanted
    star = wanting[brightest_wanting]
    chosen = np.zeros_like(wanted)
    chosen[star] = wanted[star]
    return chosen


def _paths(seen: FloatArray, turn: CameraTurn, scan: Scan, camera: Camera) -> Paths | ShortPaths:
    """The stars' paths while their rows are lit, seconds from the middle row's first light."""
    exact = Paths(seen, camera.cam_to_image @ turn.rate_cam_rad_s, camera)
    # Where a pinhole has the star when the middle row lights up says to `wrong_px` which row is the
    # star's.
    wrong_px = bend_px(camera) + turn.speed_rad_s * scan.longest_s * camera.focal_length_px
    wrong_rows = min(1.0, wrong_px / min(camera.resolution_px))
    half_s = scan.hold_s / 2 + scan.scanout_s * wrong_rows
    points = points_within(camera, turn.speed_rad_s * half_s)
    if points is None:
        return exact
    pinhole = replace(camera, lens=None)
    x_px, y_px = exact.through(pinhole).all_places_px(np.zeros((1, 1)))
    late_s = scan.late_s(x_px[0], y_px[0], camera.resolution_px)
    return ShortPaths(exact, late_s + scan.hold_s / 2, half_s, points)


def slowed(turn: CameraTurn, scan: Scan, camera: Camera) -> tuple[CameraTurn, bool]:
    """The turn itself, or one about the same axis that takes no star farther than
    MAX_TURN_FIELD; and whether it is slower.
    """
    angle_rad = turn.speed_rad_s * scan.whole_s
    most_rad = MAX_TURN_FIELD * camera.field_radius_rad(0.0)
    if angle_rad <= most_rad:
        return turn, False
    slower_cam_rad_s = turn.rate_cam_rad_s * (most_rad / angle_rad)
    return CameraTurn(turn.q_icrs_to_cam, slower_cam_rad_s), True
