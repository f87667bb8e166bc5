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

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
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
    (0, 1, 1, 0): (
        "swapped, columns for rows: add 90 to [monitor] rotate_deg and set flip_x the other way"
    ),
    (0, -1, -1, 0): (
        "swapped, columns for rows: add 270 to [monitor] rotate_deg and set flip_x the other way"
    ),
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
    group = _groups(plan, seen)
    pattern = _blinked(plan, seen, group)
    if len(plan) < 2 or not len(pattern):
        no_dot = np.zeros(0, dtype=np.intp)
        return Decoded(no_dot, np.zeros(0), np.zeros(0))
    far = _differing_frames(pattern, plan.lit)
    order = np.argsort(far, axis=1, kind="stable")
    rows = np.arange(len(far))
    best = far[rows, order[:, 0]]
    next_best = far[rows, order[:, 1]]
    is_clear = (best <= MAX_CODE_ERRORS) & (next_best >= best + CODE_LEAD)
    # Where several places blink one dot's code, the one with the fewest errors is taken.
    group_of: dict[int, int] = {}
    for k in np.flatnonzero(is_clear | (best == 0)).tolist():
        dot = int(order[k, 0])
        if dot not in group_of or far[k, dot] < far[group_of[dot], dot]:
            group_of[dot] = k
    dots = sorted(group_of)
    x_px = []
    y_px = []
    for dot in dots:
        is_dot = group == group_of[dot]
        x_px.append(seen.x_px[is_dot].mean())
        y_px.append(seen.y_px[is_dot].mean())
    return Decoded(np.array(dots, dtype=np.intp), np.array(x_px), np.array(y_px))


def _groups(plan: DotPlan, seen: Observed) -> IntArray:
    """The group (n,) of each centroid: those close to each other are one dot's, and share one."""
    places = np.column_stack([seen.x_px, seen.y_px])
    area_px2 = 0.0
    if len(places):
        area_px2 = float(np.prod(np.ptp(places, axis=0)))
    dot_distance_px = np.sqrt(area_px2 / max(len(plan), 1))
    link_px = min(MAX_LINK_PX, LINK_SHARE * dot_distance_px)
    first, second = cKDTree(places).query_pairs(link_px, output_type="ndarray").T
    ones = np.ones(len(first))
    linked = coo_matrix((ones, (first, second)), shape=(len(places), len(places)))
    _, group = connected_components(linked, directed=False)
    return np.asarray(group, dtype=np.intp)


def _blinked(plan: DotPlan, seen: Observed, group: IntArray) -> BoolArray:
    """In which frames each group has a centroid (groups, frames): its code."""
    groups = 0
    if len(group):
        groups = int(group.max()) + 1
    pattern = np.zeros((groups, plan.frames), dtype=bool)
    inside = seen.frame < plan.frames
    pattern[group[inside], seen.frame[inside]] = True
    return pattern


def _differing_frames(pattern: BoolArray, lit: BoolArray) -> IntArray:
    """In how many frames each code (groups, frames) differs from each dot's (dots, frames):
    (groups, dots).
    """
    seen_dark = pattern.astype(np.int32) @ (~lit).T.astype(np.int32)
    unseen_lit = (~pattern).astype(np.int32) @ lit.T.astype(np.int32)
    return np.asarray(seen_dark + unseen_lit)


def homography(u: FloatArray, v: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """The projective maps (..., 3, 3) from (u, v) to (x, y), (..., n) each (Hartley and
    Zisserman 2004, 4.1, normalised).
    """
    into = _normal(u, v)
    out = _normal(x, y)
    zero = np.zeros_like(u)
    ones = np.ones_like(u)
    from_points = into @ np.stack([u, v, ones], axis=-2)
    to_points = out @ np.stack([x, y, ones], axis=-2)
    a, b, _ = np.moveaxis(from_points, -2, 0)
    c, d, _ = np.moveaxis(to_points, -2, 0)
    x_rows = np.stack([a, b, ones, zero, zero, zero, -c * a, -c * b, -c], axis=-1)
    y_rows = np.stack([zero, zero, zero, a, b, ones, -d * a, -d * b, -d], axis=-1)
    rows = np.concatenate([x_rows, y_rows], axis=-2)
    # the null space: the singular vector of the smallest singular value
    _, _, vectors = np.linalg.svd(rows)
    solution = vectors[..., -1, :].reshape(into.shape)
    matrix = np.linalg.inv(out) @ solution @ into
    return np.asarray(matrix / matrix[..., 2:, 2:])


def _normal(x: FloatArray, y: FloatArray) -> FloatArray:
    """A similarity (..., 3, 3) that centres points (..., n) on the origin with a mean square
    distance of 2.
    """
    deviation = np.sqrt(x.var(axis=-1) + y.var(axis=-1))
    scale = np.sqrt(2.0) / np.maximum(deviation, 1e-300)
    zero = np.zeros_like(scale)
    ones = np.ones_like(scale)
    shift_x = -scale * x.mean(axis=-1)
    shift_y = -scale * y.mean(axis=-1)
    rows = [[scale, zero, shift_x], [zero, scale, shift_y], [zero, zero, ones]]
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
    first_rays = _rays_of(maps[0], x_px, y_px)
    q_poses = []
    for matrix in maps:
        turn, _ = Rotation.align_vectors(_rays_of(matrix, x_px, y_px), first_rays)
        q_poses.append(from_matrix(turn.as_matrix()))
    return FirstLook(tuple(maps), np.array(q_poses))


def _middle_places(plan: DotPlan) -> tuple[FloatArray, FloatArray]:
    """Places (n,) on the monitor, px, over the middle of the part that the dots stand on."""
    columns = np.quantile(plan.x_px, [0.0, 1.0]) @ MIDDLE
    rows = np.quantile(plan.y_px, [0.0, 1.0]) @ MIDDLE
    x_px, y_px = np.meshgrid(columns, rows)
    return x_px.ravel(), y_px.ravel()


def _rays_of(matrix: FloatArray, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Unit directions (n, 3) in the tracker's axes of monitor pixels (n,), by a first map (3,
    3).
    """
    to_tangents = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    u, v = mapped(to_tangents, x_px, y_px)
    return _unit_rays(u, v)


def _unit_rays(u: FloatArray, v: FloatArray) -> FloatArray:
    """Unit directions (n, 3) of tangents (n,)."""
    rays = np.column_stack([u, v, np.ones_like(u)])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def turned(plan: DotPlan, nominal: Nominal, look: FirstLook) -> Nominal:
    """The bench file's geometry with the rotation of the first map: where a fit starts, whatever
    the screen is turned by.
    """
    x_px, y_px = _middle_places(plan)
    monitor = nominal.monitor
    stated_rays = _unit_rays(*monitor.tangents(x_px, y_px))
    turn, _ = Rotation.align_vectors(stated_rays, _rays_of(look.maps[0], x_px, y_px))
    q_cam_to_mon = from_matrix(turn.as_matrix())
    turned_monitor = replace(monitor, cam_to_image=to_matrix(q_cam_to_mon))
    return Nominal(turned_monitor, q_cam_to_mon, nominal.tracker)


def _map_of(
    plan: DotPlan, nominal: Nominal, seen: Observed, rng: np.random.Generator
) -> FloatArray | None:
    """The projective map (3, 3) from tracker tangents to monitor px that most decoded dots fit;
    None where few fit any.
    """
    decoded = decode(plan, seen)
    tangents = np.stack(nominal.tracker.tangents(decoded.x_px, decoded.y_px))
    places_px = np.stack([plan.x_px[decoded.dot], plan.y_px[decoded.dot]])
    return fitting_map(tangents, places_px, INLIER_SHARE * plan.extent_px, rng)


def fitting_map(
    tangents: FloatArray, places_px: FloatArray, near_px: float, rng: np.random.Generator
) -> FloatArray | None:
    """The projective map (3, 3) that takes most tangents (2, n) near their places (2, n); None
    where few fit any.

    RANSAC with samples of four (Fischler and Bolles 1981).
    """
    u, v = tangents
    x, y = places_px
    best = np.zeros(len(u), dtype=bool)
    fours = np.empty((0, 4), dtype=int)
    if len(u) >= MIN_DECODED:
        samples = [rng.choice(len(u), 4, replace=False) for _ in range(TRIALS)]
        fours = np.array(samples, dtype=int)
    # a lens has no tangents for places far outside
    fours = fours[np.isfinite((u + v)[fours]).all(axis=-1)]
    for trial in homography(u[fours], v[fours], x[fours], y[fours]):
        mapped_x, mapped_y = mapped(trial, u, v)
        with np.errstate(invalid="ignore"):
            distance_px = np.hypot(mapped_x - x, mapped_y - y)
            inlier = distance_px < near_px
        if inlier.sum() > best.sum():
            best = inlier
    if best.sum() < max(MIN_DECODED, len(u) / 3):
        return None
    return homography(u[best], v[best], x[best], y[best])


def _why_no_map(
    plan: DotPlan, nominal: Nominal, seen: Observed, pose: int, rng: np.random.Generator
) -> str:
    """Why codes match nothing: the frames are numbered otherwise, or they are another plan's."""
    where = ""
    if pose:
        where = f"pose {pose}: "
    for order, reorder in ORDERS.items():
        frame = reorder(seen.frame, plan.frames)
        inside = np.flatnonzero((frame >= 0) & (frame < plan.frames))
        reordered = replace(seen, frame=frame).at(inside)
        if _map_of(plan, nominal, reordered, rng) is not None:
            return (
                f"{where}the frames are {order}: the codes match so; number the frames from 0 as"
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
    # the middle of the field, and steps along each axis from it
    u = np.array([0.0, 1e-4, 0.0])
    v = np.array([0.0, 0.0, 1e-4])
    rays = np.column_stack([u, v, np.ones_like(u)]) @ nominal.monitor.cam_to_image.T
    seen_steps = _steps(*mapped(matrix, u, v))
    stated_steps = _steps(*nominal.monitor.project(rays))
    relative = seen_steps @ np.linalg.inv(stated_steps)
    relative /= np.sqrt(abs(np.linalg.det(relative)))
    sine = relative[1, 0] - relative[0, 1]
    cosine = relative[0, 0] + relative[1, 1]
    turn_deg = float(np.degrees(np.arctan2(sine, cosine)))
    if np.linalg.det(relative) > 0 and abs(turn_deg) < MAX_TURN_DEG:
        return
    nearest = max(ORIENTATIONS, key=lambda matrix: float(np.dot(matrix, relative.ravel())))
    orientation = ORIENTATIONS[nearest]
    if orientation is not None:
        raise InputError(
            f"the tracker sees the monitor {orientation}, show the dots again, and take new frames"
        )


def _steps(x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Places (3,) less the first of them, as columns (2, 2)."""
    places = np.stack([x_px, y_px])
    return np.asarray(places[:, 1:] - places[:, :1])


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
    """Match each centroid that looks at (x_px, y_px) to the lit dot nearest to it, where it is that
    dot's nearest, too, and within `reach_px`; the others are left out.
    """
    dot: IntArray = np.full(len(seen), -1, dtype=np.intp)
    is_on_screen = np.isfinite(x_px + y_px)
    for pose in range(int(seen.pose.max()) + 1):
        for frame in range(plan.frames):
            is_here = (seen.frame == frame) & (seen.pose == pose) & is_on_screen
            here = np.flatnonzero(is_here)
            lit = np.flatnonzero(plan.lit[:, frame])
            if not len(here) or not len(lit):
                continue
            dx_px = x_px[here, None] - plan.x_px[lit]
            dy_px = y_px[here, None] - plan.y_px[lit]
            distance_px = np.hypot(dx_px, dy_px)
            best = distance_px.argmin(axis=1)
            nearest = distance_px.argmin(axis=0)
            rows = np.arange(len(here))
            is_mutual = nearest[best] == rows
            is_near = is_mutual & (distance_px[rows, best] < reach_px)
            dot[here[is_near]] = lit[best[is_near]]
    matched = np.flatnonzero(dot >= 0)
    return MatchedDots(seen.at(matched), dot[matched])


def refuse_motion(data: MatchedDots) -> None:
    """Refuse (InputError) frames between which the whole image moved."""
    for pose in np.unique(data.centroids.pose):
        here = data.at(np.flatnonzero(data.centroids.pose == pose))
        for axis, places in (("x", here.centroids.x_px), ("y", here.centroids.y_px)):
            frames, shift, noise = frame_shifts(here, places)
            motion_px = np.ptp(shift)
            if motion_px > motion_limit_px(noise, len(here) / len(frames)):
                first, last = sorted((frames[shift.argmin()], frames[shift.argmax()]))
                raise InputError(
                    f"the image moved by {motion_px:.2f} px in {axis} between frames {first}"
                    f" and {last}: fix the tracker and the screen, and take new frames"
                )


def motion_limit_px(noise: float, dots_a_frame: float) -> float:
    """The motion between frames that dots with a noise, px, may show at rest."""
    # the median of few dots scatters by itself
    by_chance = MAX_CHANCE * noise / np.sqrt(dots_a_frame)
    return float(max(MIN_MOTION_PX, MOTION_NOISE * noise, by_chance))


class FrameShifts(NamedTuple):
    """Frames (n,), how far the image of each stands from the others' (n,), and the noise of what
    is left; tracker px.
    """

    frames: IntArray
    shift: FloatArray
    noise: float


def frame_shifts(data: MatchedDots, places: FloatArray) -> FrameShifts:
    """The shift of each frame along one axis, by Tukey's median polish over frames and dots."""
    frames, frame = np.unique(data.centroids.frame, return_inverse=True)
    dots, dot = np.unique(data.dot, return_inverse=True)
    shift = np.zeros(len(frames))
    middle = np.zeros(len(dots))
    rows_of_dot = [np.flatnonzero(dot == k) for k in range(len(dots))]
    rows_of_frame = [np.flatnonzero(frame == k) for k in range(len(frames))]
    for _ in range(POLISH_ROUNDS):
        for k in range(len(dots)):
            rows = rows_of_dot[k]
            middle[k] = np.median(places[rows] - shift[frame[rows]])
        for k in range(len(frames)):
            rows = rows_of_frame[k]
            shift[k] = np.median(places[rows] - middle[dot[rows]])
        shift -= np.median(shift)
    residual_px = np.abs(places - middle[dot] - shift[frame])
    noise_px = MAD_TO_SIGMA * float(np.median(residual_px))
    return FrameShifts(frames, shift, noise_px)
