"""Matches centroids to dots by the codes that the dots blink, without a guess of where they should
be.

A dot stands still, so centroids of different frames at one place are one dot, and the frames it was
seen in are its code. Codes that match one dot clearly give a first map; by that map every centroid
is matched to the nearest lit dot. An image that is mirrored, turned, or moved between frames is
refused, with the cure.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_matrix, to_matrix
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.calibrate.geometric.dots import DotPlan
from hilstar.instruments.calibrate.geometric.fit import (
    Geometry,
    MatchedDots,
    Nominal,
    directions_in_cam,
)
from hilstar.instruments.calibrate.geometric.observed import Observed

MAX_LINK_PX = 3.0  # a dot's centroids lie closer together than this in the tracker's image
LINK_SHARE = 0.2  # relative to the distance between dots, if that is less
CODE_LEAD = 2  # by how many frames the next code must be farther than the best
MAX_CODE_ERRORS = 3
TRIALS = 600  # samples of four dots each
# Four places along each side of the dots' part, from a fifth to four fifths of it: (2, 4) weights
# of its two ends.
MIDDLE = np.stack([np.linspace(0.8, 0.2, 4), np.linspace(0.2, 0.8, 4)])
INLIER_SHARE = 0.03  # relative to the extent of the dots: a lens may bend a homography by this
MIN_DECODED = 6
FIRST_REACH = 0.03  # relative to the extent of the dots; the first map knows no lens
# a turn that the fit finds by itself: beyond 45 deg another way round is nearer, within noise
MAX_TURN_DEG = 60.0
MIN_MOTION_PX = 0.05  # tracker px
POLISH_ROUNDS = 10
# sigmas of a frame's mean: the largest of some 30 differences of medians, with room
MAX_CHANCE = 12.0
MOTION_NOISE = 3.0  # times a centroid's noise: less does not matter, since every frame has many
ORIENTATIONS = {
    (1, 0, 0, 1): None,
    (-1, 0, 0, 1): "mirrored left to right: set [monitor] flip_x the other way",
    (1, 0, 0, -1): "mirrored top to bottom: set [monitor] flip_y the other way",
    (-1, 0, 0, -1): "upside down: add 180 to [monitor] rotate_deg",
    (0, 1, -1, 0): "turned by 90 degrees: add 270 to [monitor] rotate_deg, or turn the tracker",
    (0, -1, 1, 0): "turned by 270 degrees: add 90 to [monitor] rotate_deg, or turn the tracker",
    (
        0,
        1,
        1,
        0,
    ): "swapped, columns for rows: add 90 to [monitor] rotate_deg and set flip_x the other way",
    (
        0,
        -1,
        -1,
        0,
    ): "swapped, columns for rows: add 270 to [monitor] rotate_deg and set flip_x the other way",
}
ORDERS: dict[str, Callable[[IntArray, int], IntArray]] = {
    "in reverse order": lambda frame, frames: frames - 1 - frame,
    "numbered from 1": lambda frame, frames: frame - 1,
    "one frame late": lambda frame, frames: (frame - 1) % frames,
    "one frame early": lambda frame, frames: (frame + 1) % frames,
}


@dataclass(frozen=True, slots=True)
class Decoded:
    """Dots of one pose that were recognised by their codes: the dot, and the mean of its
    centroids, (n,) each.
    """

    dot: IntArray
    x_px: FloatArray
    y_px: FloatArray


def decode(plan: DotPlan, seen: Observed) -> Decoded:
    """The dots of one pose whose code is close to one dot's and clearly farther from every
    other's; each dot once.
    """
    # Centroids close to each other are one dot's, and share a group.
    places = np.column_stack([seen.x_px, seen.y_px])
    if len(places):
        area = float(np.prod(np.ptp(places, axis=0)))
    else:
        area = 0.0
    link_px = min(MAX_LINK_PX, LINK_SHARE * np.sqrt(area / max(len(plan), 1)))
    pairs = cKDTree(places).query_pairs(link_px, output_type="ndarray")
    linked = coo_matrix(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places))
    )
    group = np.asarray(connected_components(linked, directed=False)[1], dtype=np.intp)
    pattern = np.zeros((int(group.max()) + 1 if len(group) else 0, plan.frames), dtype=bool)
    inside = seen.frame < plan.frames
    pattern[group[inside], seen.frame[inside]] = True
    far = pattern.astype(np.int32) @ (~plan.lit).T.astype(np.int32) + (~pattern).astype(
        np.int32
    ) @ plan.lit.T.astype(np.int32)
    if far.shape[1] < 2 or not len(far):
        return Decoded(*(np.zeros(0, dtype=kind) for kind in (np.intp, float, float)))
    order = np.argsort(far, axis=1, kind="stable")
    rows = np.arange(len(far))
    best = far[rows, order[:, 0]]
    next_best = far[rows, order[:, 1]]
    sure = np.flatnonzero((best <= MAX_CODE_ERRORS) & (next_best >= best + CODE_LEAD) | (best == 0))
    # Where several places blink one dot's code, the one with the fewest errors is taken.
    by_dot: dict[int, list[int]] = {}
    for k in sure:
        by_dot.setdefault(int(order[k, 0]), []).append(int(k))
    chosen = {dot: min(places, key=lambda k: far[k, dot]) for dot, places in by_dot.items()}
    chosen_dots = sorted(chosen.items())
    means = [(seen.x_px[group == k].mean(), seen.y_px[group == k].mean()) for _, k in chosen_dots]
    x_px, y_px = np.array(means).reshape(-1, 2).T
    return Decoded(np.array([dot for dot, _ in chosen_dots], dtype=np.intp), x_px, y_px)


def homography(u: FloatArray, v: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """The projective maps (..., 3, 3) from (u, v) to (x, y), (..., n) each (Hartley and
    Zisserman 2004, 4.1, normalised).
    """
    into = _normal(u, v)
    out = _normal(x, y)
    zero = np.zeros_like(u)
    ones = np.ones_like(u)
    a, b, _ = np.moveaxis(into @ np.stack([u, v, ones], axis=-2), -2, 0)
    c, d, _ = np.moveaxis(out @ np.stack([x, y, ones], axis=-2), -2, 0)
    rows = np.concatenate(
        [
            np.stack([a, b, ones, zero, zero, zero, -c * a, -c * b, -c], axis=-1),
            np.stack([zero, zero, zero, a, b, ones, -d * a, -d * b, -d], axis=-1),
        ],
        axis=-2,
    )
    solution = np.linalg.svd(rows)[2][..., -1, :].reshape(into.shape)
    matrix = np.linalg.inv(out) @ solution @ into
    return np.asarray(matrix / matrix[..., 2:, 2:])


def _normal(x: FloatArray, y: FloatArray) -> FloatArray:
    """A similarity (..., 3, 3) that centres points (..., n) on the origin with a mean square
    distance of 2.
    """
    scale = np.sqrt(2.0) / np.maximum(np.sqrt(x.var(axis=-1) + y.var(axis=-1)), 1e-300)
    zero = np.zeros_like(scale)
    ones = np.ones_like(scale)
    rows = [
        [scale, zero, -scale * x.mean(axis=-1)],
        [zero, scale, -scale * y.mean(axis=-1)],
        [zero, zero, ones],
    ]
    return np.asarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def mapped(matrix: FloatArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(u, v) through a projective map (3, 3)."""
    x, y, w = matrix @ np.stack([u, v, np.ones_like(u)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return x / w, y / w


@dataclass(frozen=True, slots=True)
class FirstLook:
    """The result of the codes alone: each pose's map from tracker tangents to monitor px, and
    its rotation (poses, 4).
    """

    maps: tuple[FloatArray, ...]
    q_poses: FloatArray


def first_look(
    plan: DotPlan, nominal: Nominal, seen: Observed, rng: np.random.Generator
) -> FirstLook:
    """The maps of all poses. Raises InputError for codes that match nothing, and for an image
    that is mirrored or turned.
    """
    maps = []
    for pose in range(int(seen.pose.max()) + 1):
        part = seen.at(np.flatnonzero(seen.pose == pose))
        frame_map = _map_of(plan, nominal, part, rng)
        if frame_map is None:
            raise InputError(_why_no_map(plan, nominal, part, pose, rng))
        maps.append(frame_map)
    _refuse_orientation(nominal, maps[0])
    x_px, y_px = _middle_places(plan)
    rays = [_rays_of(matrix, x_px, y_px) for matrix in maps]
    turns = [Rotation.align_vectors(pose_rays, rays[0])[0] for pose_rays in rays]
    return FirstLook(tuple(maps), np.array([from_matrix(turn.as_matrix()) for turn in turns]))


def _middle_places(plan: DotPlan) -> tuple[FloatArray, FloatArray]:
    """Places (n,) on the monitor, px, over the middle of the part that the dots stand on."""
    along_x, along_y = (np.quantile(part, [0.0, 1.0]) @ MIDDLE for part in (plan.x_px, plan.y_px))
    x_px, y_px = np.meshgrid(along_x, along_y)
    return x_px.ravel(), y_px.ravel()


def _rays_of(matrix: FloatArray, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Unit directions (n, 3) in the tracker's axes of monitor pixels (n,), by a first map (3,
    3).
    """
    u, v = mapped(np.asarray(np.linalg.inv(matrix), dtype=np.float64), x_px, y_px)
    rays = np.column_stack([u, v, np.ones_like(u)])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def turned(plan: DotPlan, nominal: Nominal, look: FirstLook) -> Nominal:
    """The bench file's geometry with the rotation of the first map: where a fit starts, whatever
    the screen is turned by.
    """
    x_px, y_px = _middle_places(plan)
    monitor = nominal.monitor
    tangent_rays = np.column_stack((*monitor.tangents(x_px, y_px), np.ones_like(x_px)))
    tangent_rays /= np.linalg.norm(tangent_rays, axis=1, keepdims=True)
    turn, _ = Rotation.align_vectors(tangent_rays, _rays_of(look.maps[0], x_px, y_px))
    q_cam_to_mon = from_matrix(turn.as_matrix())
    return Nominal(
        replace(monitor, cam_to_image=to_matrix(q_cam_to_mon)), q_cam_to_mon, nominal.tracker
    )


def _map_of(
    plan: DotPlan, nominal: Nominal, seen: Observed, rng: np.random.Generator
) -> FloatArray | None:
    """The projective map (3, 3) from tracker tangents to monitor px that most decoded dots fit;
    None where few fit any.

    RANSAC with samples of four (Fischler and Bolles 1981).
    """
    decoded = decode(plan, seen)
    u, v = nominal.tracker.tangents(decoded.x_px, decoded.y_px)
    x = plan.x_px[decoded.dot]
    y = plan.y_px[decoded.dot]
    best = np.zeros(len(u), dtype=bool)
    trials = TRIALS if len(u) >= MIN_DECODED else 0
    fours = np.array([rng.choice(len(u), 4, replace=False) for _ in range(trials)], dtype=int)
    fours = fours[np.isfinite((u + v)[fours]).all(axis=-1)].reshape(-1, 4)
    for trial in homography(u[fours], v[fours], x[fours], y[fours]):
        seen_x, seen_y = mapped(trial, u, v)
        with np.errstate(invalid="ignore"):
            inlier = np.hypot(seen_x - x, seen_y - y) < INLIER_SHARE * plan.extent_px
        if inlier.sum() > best.sum():
            best = inlier
    if best.sum() < max(MIN_DECODED, len(u) / 3):
        return None
    return homography(u[best], v[best], x[best], y[best])


def _why_no_map(
    plan: DotPlan, nominal: Nominal, seen: Observed, pose: int, rng: np.random.Generator
) -> str:
    where = f"pose {pose}: " if pose else ""
    for words, reorder in ORDERS.items():
        frame = reorder(seen.frame, plan.frames)
        inside = np.flatnonzero((frame >= 0) & (frame < plan.frames))
        if _map_of(plan, nominal, replace(seen, frame=frame).at(inside), rng) is not None:
            return (
                f"{where}the frames are {words}: the codes match so; number the frames from 0 as"
                " plan.csv does"
            )
    return (
        f"{where}the codes that were seen match no dots of the plan; give all frames of this plan,"
        " numbered from 0, with at least 12 dots in view"
    )


def _refuse_orientation(nominal: Nominal, matrix: FloatArray) -> None:
    """Refuse (InputError) an image that is mirrored, swapped or turned by a right angle against
    what the bench file says.
    """
    u = np.array([0.0, 1e-4, 0.0])
    v = np.array([0.0, 0.0, 1e-4])
    rays = np.column_stack([u, v, np.ones_like(u)]) @ nominal.monitor.cam_to_image.T
    seen_px = np.stack(mapped(matrix, u, v))
    stated_px = np.stack(nominal.monitor.project(rays))
    relative = (seen_px[:, 1:] - seen_px[:, :1]) @ np.linalg.inv(
        stated_px[:, 1:] - stated_px[:, :1]
    )
    relative /= np.sqrt(abs(np.linalg.det(relative)))
    turn_deg = float(
        np.degrees(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
    )
    if np.linalg.det(relative) > 0 and abs(turn_deg) < MAX_TURN_DEG:
        return
    nearest = max(ORIENTATIONS, key=lambda o: float(np.dot(o, relative.ravel())))
    way_text = ORIENTATIONS[nearest]
    if way_text is not None:
        raise InputError(
            f"the tracker sees the monitor {way_text}, show the dots again, and take new frames"
        )


def match_by_maps(plan: DotPlan, nominal: Nominal, seen: Observed, look: FirstLook) -> MatchedDots:
    """Match each centroid to the lit dot nearest to it by the first maps, within what a lens may
    bend.
    """
    x_px = np.full(len(seen), np.nan)
    y_px = np.full(len(seen), np.nan)
    u, v = nominal.tracker.tangents(seen.x_px, seen.y_px)
    for pose, matrix in enumerate(look.maps):
        here = seen.pose == pose
        x_px[here], y_px[here] = mapped(matrix, u[here], v[here])
    return _nearest(plan, seen, x_px, y_px, FIRST_REACH * plan.extent_px)


def match_by_geometry(
    plan: DotPlan, seen: Observed, geometry: Geometry, reach_px: float
) -> MatchedDots:
    """Match each centroid to the lit dot nearest to it by a fitted geometry, within `reach_px`
    on the monitor.
    """
    directions = directions_in_cam(geometry, seen.pose, seen.x_px, seen.y_px)
    x_px, y_px = geometry.monitor.project(directions @ geometry.monitor.cam_to_image.T)
    return _nearest(plan, seen, x_px, y_px, reach_px)


def _nearest(
    plan: DotPlan, seen: Observed, x_px: FloatArray, y_px: FloatArray, reach_px: float
) -> MatchedDots:
    dot: IntArray = np.full(len(seen), -1, dtype=np.intp)
    for pose in range(int(seen.pose.max()) + 1):
        for frame in range(plan.frames):
            here = np.flatnonzero(
                (seen.frame == frame) & (seen.pose == pose) & np.isfinite(x_px + y_px)
            )
            lit = np.flatnonzero(plan.lit[:, frame])
            if not len(here) or not len(lit):
                continue
            far = np.hypot(x_px[here, None] - plan.x_px[lit], y_px[here, None] - plan.y_px[lit])
            best = far.argmin(axis=1)
            nearest = far.argmin(axis=0)
            mutual = nearest[best] == np.arange(len(here))
            near = mutual & (far[np.arange(len(here)), best] < reach_px)
            dot[here[near]] = lit[best[near]]
    matched = np.flatnonzero(dot >= 0)
    return MatchedDots(seen.at(matched), dot[matched])


def refuse_motion(data: MatchedDots) -> None:
    """Refuse (InputError) frames between which the whole image moved."""
    for pose in np.unique(data.seen.pose):
        here = data.at(np.flatnonzero(data.seen.pose == pose))
        for axis, places in (("x", here.seen.x_px), ("y", here.seen.y_px)):
            frames, shift, noise = frame_shifts(here, places)
            # the median of few dots scatters by itself
            by_chance = MAX_CHANCE * noise / np.sqrt(len(here) / len(frames))
            if np.ptp(shift) > max(MIN_MOTION_PX, MOTION_NOISE * noise, by_chance):
                first, last = sorted((frames[shift.argmin()], frames[shift.argmax()]))
                raise InputError(
                    f"the image moved by {np.ptp(shift):.2f} px in {axis} between frames {first}"
                    f" and {last}: fix the tracker and the screen, and take new frames"
                )


class FrameShifts(NamedTuple):
    """Frames (n,), how far the image of each stands from the others' (n,), and the noise of what
    is left; tracker px.
    """

    frames: IntArray
    shift: FloatArray
    noise: float


def frame_shifts(data: MatchedDots, places: FloatArray) -> FrameShifts:
    """The shift of each frame along one axis, by Tukey's median polish over frames and dots."""
    frames, frame = np.unique(data.seen.frame, return_inverse=True)
    dots, dot = np.unique(data.dot, return_inverse=True)
    shift = np.zeros(len(frames))
    middle = np.zeros(len(dots))
    by_dot = [np.flatnonzero(dot == k) for k in range(len(dots))]
    by_frame = [np.flatnonzero(frame == k) for k in range(len(frames))]
    for _ in range(POLISH_ROUNDS):
        middle = np.array(
            [np.median(places[dot_rows] - shift[frame[dot_rows]]) for dot_rows in by_dot]
        )
        shift = np.array(
            [np.median(places[dot_rows] - middle[dot[dot_rows]]) for dot_rows in by_frame]
        )
        shift -= np.median(shift)
    residual_px = np.abs(places - middle[dot] - shift[frame])
    return FrameShifts(frames, shift, MAD_TO_SIGMA * float(np.median(residual_px)))
