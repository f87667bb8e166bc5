"""Stars seen by a camera that turns during its exposure: each star's path as a chain of sprites.

The mean of a star's light over the exposure is an integral over time; Gauss-Legendre quadrature
turns it into a sum of sprites whose light adds up to the star's. It is exact in the limit, so each
star gets only the sprites that its path needs.

Where rows are exposed one after the other, time on a path is that of the row on which the star is.
A star that runs with the rows is exposed for longer, by 1 / (1 - the rows that it crosses while one
is read). Its PSF is as wide as at one moment.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_matrix
from hilstar.optics.camera import Camera
from hilstar.optics.paths import MAX_NODES, Chords, Paths, node_counts, nodes_of
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight, join_sprites, make_sprites, pack_sprites
from hilstar.sky.stars import Stars

# With ceil(1.02 r + 3) nodes on a path of r sigmas no pixel is off by more than 1e-6 of the star's
# flux (measured for sigma 0.3 to 3 px and r up to 300; tests/unit/optics/test_exposure_motion.py
# holds it). A path under 0.005 sigma is a point to 1e-6. results/tradeoff.csv, smear: evenly spaced
# sprites are slower and worse.
NODES_PER_SIGMA = 1.02
NODES_AT_REST = 3
MIN_PATH_SIGMA = 0.005
# A longer turn is cut into pieces of this angle, so that each is short compared with the field and
# has enough nodes.
MAX_PIECE_RAD = 0.05
# the longest piece that MAX_NODES can draw
MAX_PIECE_SIGMA = (MAX_NODES - NODES_AT_REST - 1) / NODES_PER_SIGMA
# An exposure's work is bounded: more pieces are refused, and more sprites are thinned out by nodes
# farther apart.
MAX_PIECES = 20_000
MAX_SPRITES = 2_000_000
COARSER = 0.25  # of the nodes to a sigma, from one attempt to the next
MIN_COARSENESS = COARSER**3  # after it a turn has too many sprites
MIDDLE_S = np.zeros(1)
AT_ONCE = Scan()
MAX_ROWS_A_ROW = 0.5  # rows that a star may cross while one is read
ROUNDS, SETTLED_S = 40, 1e-10  # a round leaves up to MAX_ROWS_A_ROW of the error: 40 leave 1e-12


@dataclass(frozen=True, slots=True)
class Motion:
    """An exposure: the attitude in its middle, the rate of cam in icrs (3,) in cam components, how
    long it lasts, and when.

    `t_ns` is the time of its middle, None where it has none.
    """

    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray
    exposure_s: float
    t_ns: int | None = None

    def icrs_to_image(self, seconds: FloatArray, camera: Camera) -> FloatArray:
        """Matrices (k, 3, 3) from ICRS to image axes at `seconds` (k,) after the middle of the
        exposure.

        A constant rate turns about one axis: Rodrigues' formula on the attitude in the middle.
        """
        speed = float(np.linalg.norm(self.rate_cam_rad_s))
        x, y, z = self.rate_cam_rad_s / (speed or 1.0)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = -speed * seconds[:, None, None]
        # `cross` squared is what Rodrigues' formula has of the axis
        squared = cross @ cross
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * squared
        return np.asarray(camera.cam_to_image @ turn @ to_matrix(self.q_icrs_to_cam))


def own_row_s(
    paths: Paths, star: IntArray | slice, seconds: FloatArray, scan: Scan
) -> tuple[FloatArray, FloatArray]:
    """Times (k,) at which stars are `seconds` (k,) from the middle of their own rows' exposures,
    and the rate (k,) at which these times grow with `seconds`.

    Times count from the middle of the middle row's exposure. A star that moves along the scan stays
    in lit rows longer: its rate is above 1.
    """
    size_px = paths.camera.resolution_px
    row_s = seconds
    step_s = 0.01 * scan.scanout_s

    def late_s(at_s: FloatArray) -> FloatArray:
        return np.nan_to_num(scan.late_s(*paths.places_px(star, at_s), size_px))

    for _ in range(ROUNDS):
        before = row_s
        row_s = seconds + late_s(row_s)
        if not len(row_s) or np.abs(row_s - before).max() < SETTLED_S:
            break
    late_change_s = late_s(row_s + step_s) - late_s(row_s - step_s)
    share = late_change_s / (2 * step_s)
    return row_s, 1 / (1 - np.clip(share, -MAX_ROWS_A_ROW, MAX_ROWS_A_ROW))


def smeared_sprites(
    stars: Stars, motion: Motion, camera: Camera, psf: Psf, scan: Scan = AT_ONCE
) -> FrameLight:
    """Sprites whose sum is each star's mean light over the exposure; a star at rest is one sprite.

    `scan` says over how long rows begin, and in which direction. `capped` stars are drawn coarser
    than NODES_PER_SIGMA where all would be more than MAX_SPRITES. Raises InputError for a turn too
    long to be drawn at all.
    """
    if not motion.rate_cam_rad_s.any() or not motion.exposure_s:
        icrs_to_image = motion.icrs_to_image(MIDDLE_S, camera)[0]
        return make_sprites(stars, icrs_to_image, camera, psf.footprint_px)
    speed_rad_s = np.linalg.norm(motion.rate_cam_rad_s)
    degrees = np.degrees(speed_rad_s) * motion.exposure_s
    turn = f"an exposure in which the camera turns by {degrees:.4g} deg"
    fastest_px_s = camera.fastest_px_s(camera.cam_to_image @ motion.rate_cam_rad_s)
    row_s = scan.scanout_s / camera.resolution_px[1]
    if fastest_px_s * row_s > MAX_ROWS_A_ROW:
        raise InputError(
            f"the camera turns by {fastest_px_s * row_s:.3g} px while a row is read; shorten"
            " row_time_us or turn more slowly"
        )
    # Each piece of the turn is short compared with the field and, anywhere on the image, with its
    # nodes.
    angle_rad = float(speed_rad_s) * motion.exposure_s
    path_sigma = fastest_px_s * motion.exposure_s / min(psf.width_px)
    needed = max(angle_rad / MAX_PIECE_RAD, path_sigma / MAX_PIECE_SIGMA)
    if needed > MAX_PIECES:
        max_deg = np.degrees(angle_rad / needed * MAX_PIECES)
        raise InputError(
            f"{turn} is too long; at most {max_deg:.4g} deg can be drawn here: write a shorter"
            " exposure_s or a slower rate"
        )
    pieces = int(np.ceil(needed))
    edges_s = np.linspace(-0.5, 0.5, pieces + 1) * motion.exposure_s
    fineness = 1.0
    while fineness >= MIN_COARSENESS:
        smear = _Smear(stars, camera, psf, NODES_PER_SIGMA * fineness, scan)
        chain: list[FrameLight] = []
        total = 0
        for begin_s, end_s in itertools.pairwise(edges_s.tolist()):
            piece = smear.piece(motion, begin_s, end_s, 1.0 / pieces)
            chain.append(piece)
            total += len(piece)
            if total > MAX_SPRITES:
                break
        else:
            sprites = join_sprites(chain, psf.footprint_px)
            if fineness == 1.0:
                return sprites
            return replace(sprites, capped=len(np.unique(sprites.star)))
        fineness *= COARSER
    raise InputError(
        f"{turn} needs more than {MAX_SPRITES} sprites; write a shorter exposure_s, a slower rate"
        " or fewer stars"
    )


@dataclass(frozen=True, slots=True)
class _Smear:
    """How stars are smeared on an image: its camera and PSF, the nodes to a sigma of their paths,
    and how its rows are exposed.
    """

    stars: Stars
    camera: Camera
    psf: Psf
    nodes_per_sigma: float
    scan: Scan

    def piece(self, motion: Motion, begin_s: float, end_s: float, part: float) -> FrameLight:
        """The sprites of a piece of an exposure that is `part` of it."""
        camera = self.camera
        stars = self.stars
        footprint_px = self.psf.footprint_px
        rate_image_rad_s = camera.cam_to_image @ motion.rate_cam_rad_s
        whole_s = end_s - begin_s + self.scan.scanout_s
        angle_rad = float(np.linalg.norm(motion.rate_cam_rad_s)) * whole_s
        middle = motion.icrs_to_image(np.array([(begin_s + end_s) / 2]), camera)[0]
        radius_rad, edges = camera.field(footprint_px / 2 + 1)
        near = stars.near(middle[2], radius_rad, edges @ middle, angle_rad)
        paths = Paths(stars.directions(near) @ middle.T, rate_image_rad_s, camera)
        half_s = (end_s - begin_s) / 2
        thrice_s = np.array([[-half_s], [0.0], [half_s]])
        if self.scan.scanout_s:
            star = np.tile(np.arange(len(paths)), 3)
            row_s, _ = own_row_s(paths, star, np.repeat(thrice_s, len(paths)), self.scan)
            thrice_s = row_s.reshape(3, -1)
        x_px, y_px = paths.all_places_px(thrice_s)
        # The mean over a path in two chords: an arc's length to (angle / 4)^2 / 6 of it.
        first_half = Chords(x_px[:2], y_px[:2])
        second_half = Chords(x_px[1:], y_px[1:])
        length = first_half.length_sigma(self.psf.width_px)
        length = length + second_half.length_sigma(self.psf.width_px)
        whole = Chords(x_px[::2], y_px[::2])
        bulge_px = 2 * half_s * paths.speed_rad_s * np.nan_to_num(whole.length_sigma((1.0, 1.0)))
        margin_px = footprint_px / 2 + 1 + bulge_px
        begin, end = whole.on_image(camera.resolution_px, margin_px)
        seen_sigma = length * (end - begin)
        counts = node_counts(seen_sigma, self.nodes_per_sigma, NODES_AT_REST, MIN_PATH_SIGMA)
        counts[end <= begin] = 0  # the path misses the image
        nodes = nodes_of(np.minimum(counts, MAX_NODES))
        seen_part = (end - begin)[nodes.path]
        share = begin[nodes.path] + seen_part * (nodes.place + 1) / 2
        seconds = (2 * share - 1) * half_s
        star = near[nodes.path]
        light = nodes.share * seen_part * part * stars.electrons_per_s[star]
        if self.scan.scanout_s:
            seconds, longer = own_row_s(paths, nodes.path, seconds, self.scan)
            light = light * longer
        x_px, y_px = paths.places_px(nodes.path, seconds)
        return pack_sprites(x_px, y_px, light, star, camera.resolution_px, footprint_px)
