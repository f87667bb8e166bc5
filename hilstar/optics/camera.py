"""From directions to pixels and back, in float64: a pinhole (thesis eq. 4.1, 4.2), or one with a
real lens and a tilted screen.

A direction (u, v, 1) in image axes is bent by Brown's polynomials (Brown 1966, eq. 13, in Conrady's
form), meets a plane that is tilted about the foot of the axis, and is moved by a smooth residual
field over the pixels. All three are closed forms from direction to pixel, which every frame uses;
`Camera.tangents` is the inverse. The renderer's rays are a pinhole's in closed form plus the lens's
shift on a coarse grid.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError

# in half images: beyond it the residual field is held constant, because its polynomials diverge
FIELD_EDGE = 1.1

ANY_TANGENT = (-1e9, 1e9)  # finite, so that products stay finite
# Between nodes the shift is linear. A lens that shifts the corner of 1920 x 1080 px by 50 px,
# growing with the cube of the radius, bends by 3e-4 px per px squared there: 8^2 / 8 of that is
# 0.002 px.
NODE_STEP_PX = 8
SPEED_PLACES = 9  # along each side of the image: a speed's components are quadratic in the place
BORDER_PLACES = 33  # along each side of the image
# margin around all sides: twice the sag of a parabola between two places, whatever its curvature
BOW = 1 / BORDER_PLACES**2
FOLD_PLACES = 41  # across the disc in which a lens must not fold
NEWTON_ROUNDS, STEPS_A_ROUND = 10, 5  # slopes are found once a round: a mild lens needs one
# In focal lengths, 1e-8 px on any screen; slopes by differences of SLOPE_STEP are right to 1e-10,
# which is enough.
NEWTON_DONE = 1e-13
# tangents to either side of a direction, for its slopes; Newton's last step is under it
SLOPE_STEP = 1e-6
BEYOND_BORDER = 1 + 1e-9  # the farthest corner is within the lens
WITHIN = 1 - 1e-12  # the lens, whatever rounding does
MAX_TANGENT = 1e3  # a longer step has diverged


@dataclass(frozen=True, slots=True, eq=False)
class ResidualField:
    """A smooth shift of pixels: sums of Chebyshev polynomials over the image, `x` and `y` (n, n)
    coefficients in px.

    Entry (i, j) belongs to T_i of the column and T_j of the row, both from -1 to 1 over the image.
    """

    x: FloatArray
    y: FloatArray
    resolution_px: tuple[int, int]

    @classmethod
    def of_terms(
        cls, x: FloatArray, y: FloatArray, degree: int, resolution_px: tuple[int, int]
    ) -> "ResidualField":
        """The field of coefficients (terms,) in the order of `field_terms`."""
        squares = np.zeros((2, degree + 1, degree + 1))
        i, j = _exponents(degree)
        squares[0, i, j] = x
        squares[1, i, j] = y
        return cls(squares[0], squares[1], resolution_px)

    def at(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The shift at pixels (k,), px."""
        columns, rows = _polynomials(x_px, y_px, self.resolution_px, len(self.x) - 1)
        dx_px = np.einsum("ik,ik->k", self.x.T @ columns, rows)
        dy_px = np.einsum("ik,ik->k", self.y.T @ columns, rows)
        return dx_px, dy_px


def field_terms(
    x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], degree: int
) -> FloatArray:
    """The polynomials T_i T_j of total degree up to `degree` at pixels (k,): (k, terms)."""
    columns, rows = _polynomials(x_px, y_px, resolution_px, degree)
    i, j = _exponents(degree)
    return np.asarray((columns[i] * rows[j]).T)


def _exponents(degree: int) -> tuple[IntArray, IntArray]:
    """The degrees along columns and rows of the terms of a field, (terms,) each."""
    i, j = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    is_within_degree = i + j <= degree
    return i[is_within_degree], j[is_within_degree]


def _polynomials(
    x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int], degree: int
) -> tuple[FloatArray, FloatArray]:
    """Chebyshev's polynomials T_0 to T_degree of columns and of rows, (degree + 1, k) each."""
    place = np.empty((2, len(x_px)))
    for row, at, size in zip(place, (x_px, y_px), resolution_px, strict=True):
        np.multiply(at, 2 / size, out=row)
        row -= (size - 1) / size
    np.clip(place, -FIELD_EDGE, FIELD_EDGE, out=place)
    # Chebyshev's T_0 to T_degree in few and large operations: a frame has 0.3 ms for its lens
    terms = np.empty((degree + 1, *place.shape))
    terms[0] = 1.0
    if degree:
        terms[1] = place
    twice = 2 * place
    for k in range(2, degree + 1):
        np.multiply(twice, terms[k - 1], out=terms[k])
        terms[k] -= terms[k - 2]
    return terms[:, 0], terms[:, 1]


@dataclass(frozen=True, slots=True)
class Lens:
    """Distortion k1 to k3 and p1, p2 (of tangents of field angles), the plane's tilt about its x
    and y axes, and the field.

    `max_tangent` bounds the directions that it is used for: the largest radius of (u, v) that
    reaches the image, or that was calibrated. Farther out the polynomials turn back, and would show
    stars that are not in view. `box` bounds u and v.
    """

    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    field: ResidualField | None = None
    max_tangent: float = np.inf
    box: tuple[tuple[float, float], tuple[float, float]] = (ANY_TANGENT, ANY_TANGENT)

    def bent(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places on the tilted plane, in focal lengths from the foot of the axis, of directions
        (u, v, 1); NaN beyond.
        """
        k1, k2, k3 = self.radial
        p1, p2 = self.tangential
        r2 = u * u + v * v
        gain = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        gain[~(r2 <= self.max_tangent**2)] = np.nan
        if p1 or p2:
            gain += 2 * (p1 * v + p2 * u)
        rays = np.ones((3, len(u)))
        np.multiply(u, gain, out=rays[0])
        np.multiply(v, gain, out=rays[1])
        if p1 or p2:
            rays[0] += p2 * r2
            rays[1] += p1 * r2
        if self.tilt_rad == (0.0, 0.0):
            return rays[0], rays[1]
        right, down, normal = _onto_plane(self.tilt_rad) @ rays
        normal[~(normal > 0)] = np.nan
        return right / normal, down / normal


@lru_cache(maxsize=16)
def _onto_plane(tilt_rad: tuple[float, float]) -> FloatArray:
    """The matrix (3, 3) that maps rays to homogeneous places on a plane through (0, 0, 1),
    turned about x and then about y.
    """
    a, b = tilt_rad
    cos_a, sin_a = np.cos(a), np.sin(a)
    cos_b, sin_b = np.cos(b), np.sin(b)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_a, -sin_a], [0.0, sin_a, cos_a]])
    about_y = np.array([[cos_b, 0.0, sin_b], [0.0, 1.0, 0.0], [-sin_b, 0.0, cos_b]])
    axes = about_y @ about_x
    right, down, normal = axes.T
    foot = axes[2]
    to_right = foot[2] * right - foot[0] * normal
    to_down = foot[2] * down - foot[1] * normal
    return np.array([to_right, to_down, normal])


def ray_shifts(camera: "Camera") -> Float32Array:
    """The difference between a lens and a pinhole: tangents (u, v), float32 (rows, columns, 2), at
    nodes over the image.

    The first and the last node of a row lie on the image's edges, -0.5 and width - 0.5; a column's
    likewise. Where the lens has no direction the shift is 0.
    """
    width, height = camera.resolution_px
    columns = math.ceil(width / NODE_STEP_PX) + 1
    rows = math.ceil(height / NODE_STEP_PX) + 1
    x_px, y_px = camera.grid_px((columns, rows))
    u, v = camera.tangents(x_px, y_px)
    plain_u, plain_v = replace(camera, lens=None).tangents(x_px, y_px)
    shifts = np.stack([u - plain_u, v - plain_v], axis=-1)
    by_node = shifts.reshape(rows, columns, 2)
    return np.nan_to_num(by_node).astype(np.float32)


class Slopes(NamedTuple):
    """dx/du, dx/dv, dy/du and dy/dv of pixels by tangents, px, (n,) each."""

    x_by_u: FloatArray
    x_by_v: FloatArray
    y_by_u: FloatArray
    y_by_v: FloatArray

    @property
    def areas(self) -> FloatArray:
        """How much of the image, px^2, an area of tangents covers, (n,); negative where it is
        turned round.
        """
        a, b, c, d = self
        return a * d - b * c


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A mapping of cam directions to pixels: (0, 0) is the centre of the top-left pixel, x right, y
    down.

    `cam_to_image` (3, 3) turns cam components into those of the image's own axes (z along its
    normal). A `lens` of None is the ideal pinhole.
    """

    resolution_px: tuple[int, int]
    focal_length_px: float
    principal_point_px: tuple[float, float]
    cam_to_image: FloatArray
    lens: Lens | None = None

    def project(self, image_vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of directions (n, 3) in image axes; NaN for those not in front of the
        camera.
        """
        z = image_vectors[:, 2]
        if self.lens is None:
            scale = _over(self.focal_length_px, z)
            x = image_vectors[:, 0] * scale
            y = image_vectors[:, 1] * scale
            x += self.principal_point_px[0]
            y += self.principal_point_px[1]
            return x, y
        near = _over(1.0, z)
        u = image_vectors[:, 0] * near
        v = image_vectors[:, 1] * near
        return self.places_px(u, v)

    def project_outward(self, image_vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `project`, but beyond the lens on straight lines away from the image: a path may
        begin and end there.
        """
        if self.lens is None:
            return self.project(image_vectors)
        near = _over(1.0, image_vectors[:, 2])
        u = image_vectors[:, 0] * near
        v = image_vectors[:, 1] * near
        return self.places_outward_px(u, v)

    def places_outward_px(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `places_px`, but beyond the lens on straight lines away from the image."""
        limit = np.inf
        if self.lens is not None:
            limit = self.lens.max_tangent * WITHIN
        radius2 = u * u + v * v
        beyond = np.flatnonzero(radius2 > limit**2)
        if not len(beyond):
            return self.places_px(u, v)
        times = np.hypot(u[beyond], v[beyond]) / limit
        u = u.copy()
        v = v.copy()
        u[beyond] /= times
        v[beyond] /= times
        x_px, y_px = self.places_px(u, v)
        centre_x, centre_y = self.principal_point_px
        from_centre_x = x_px[beyond] - centre_x
        from_centre_y = y_px[beyond] - centre_y
        x_px[beyond] = centre_x + from_centre_x * times
        y_px[beyond] = centre_y + from_centre_y * times
        return x_px, y_px

    @property
    def boresight_px(self) -> tuple[float, float]:
        """The pixel of cam's +z; the principal point where that is behind the image."""
        x_px, y_px = self.project_outward(self.cam_to_image[:, 2][None])
        if np.isfinite(x_px[0]):
            return (float(x_px[0]), float(y_px[0]))
        return self.principal_point_px

    def places_px(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of directions (u, v, 1) in image axes, (n,) each; NaN beyond the lens."""
        cx, cy = self.principal_point_px
        if self.lens is None:
            return self.focal_length_px * u + cx, self.focal_length_px * v + cy
        u, v = self.lens.bent(u, v)
        x_px = self.focal_length_px * u + cx
        y_px = self.focal_length_px * v + cy
        if self.lens.field is None:
            return x_px, y_px
        dx_px, dy_px = self.lens.field.at(x_px, y_px)
        return x_px + dx_px, y_px + dy_px

    def tangents(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction (u, v, 1) in image axes of each pixel, (n,) each: the inverse of
        `places_px`, to 1e-8 px.

        By Newton's method; NaN where it finds none, and beyond the lens.
        """
        x_px = np.asarray(x_px, dtype=np.float64)
        y_px = np.asarray(y_px, dtype=np.float64)
        cx, cy = self.principal_point_px
        u = (x_px - cx) / self.focal_length_px
        v = (y_px - cy) / self.focal_length_px
        if self.lens is None:
            return u, v
        # a step may go beyond the bound
        free = replace(self, lens=replace(self.lens, max_tangent=np.inf))
        size = np.full_like(u, np.inf)
        for _ in range(NEWTON_ROUNDS):
            if not (size > NEWTON_DONE).any():
                break
            slopes = free.slopes(u, v)
            a, b, c, d = slopes
            area = slopes.areas
            for _ in range(STEPS_A_ROUND):
                x, y = free.places_px(u, v)
                off_x = x - x_px
                off_y = y - y_px
                with np.errstate(divide="ignore", invalid="ignore"):
                    step_u = (d * off_x - b * off_y) / area
                    step_v = (a * off_y - c * off_x) / area
                size = np.hypot(step_u, step_v)
                wild = ~(size < MAX_TANGENT)
                u = np.where(wild, np.nan, u - step_u)
                v = np.where(wild, np.nan, v - step_v)
                if not (size > NEWTON_DONE).any():
                    break
        is_within = np.hypot(u, v) <= self.lens.max_tangent
        converged = (size < SLOPE_STEP) & is_within
        return np.where(converged, u, np.nan), np.where(converged, v, np.nan)

    def slopes(self, u: FloatArray, v: FloatArray) -> Slopes:
        """How fast pixels change with the direction (u, v, 1), (n,) each."""
        x_right, y_right = self.places_px(u + SLOPE_STEP, v)
        x_left, y_left = self.places_px(u - SLOPE_STEP, v)
        x_below, y_below = self.places_px(u, v + SLOPE_STEP)
        x_above, y_above = self.places_px(u, v - SLOPE_STEP)
        step = 2 * SLOPE_STEP
        return Slopes(
            x_by_u=(x_right - x_left) / step,
            x_by_v=(x_below - x_above) / step,
            y_by_u=(y_right - y_left) / step,
            y_by_v=(y_below - y_above) / step,
        )

    def rays(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Directions (n, 3) in cam, z in image axes 1, of pixels (n,)."""
        u, v = self.tangents(x_px, y_px)
        image_rays = np.stack([u, v, np.ones_like(u)], axis=-1)
        return np.asarray(image_rays @ self.cam_to_image)

    def pixel_sr(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The solid angles (n,), sr, of pixels (n,)."""
        u, v = self.tangents(x_px, y_px)
        px2_per_tangent2 = self.slopes(u, v).areas
        length2 = 1 + u * u + v * v
        return np.asarray(1 / (px2_per_tangent2 * length2**1.5))

    def fastest_px_s(self, rate_image_rad_s: FloatArray) -> float:
        """The fastest that a direction crosses the image at a rate (3,) of the camera in image
        axes, px/s; within 2 %.
        """
        u, v = self.tangents(*self.grid_px(SPEED_PLACES))
        rays = np.stack([u, v, np.ones_like(u)], axis=-1)
        step_x, step_y, step_z = -np.cross(rate_image_rad_s, rays).T
        du = step_x - u * step_z
        dv = step_y - v * step_z
        if self.lens is None:
            return float(self.focal_length_px * np.hypot(du, dv).max())
        a, b, c, d = self.slopes(u, v)
        dx_px = a * du + b * dv
        dy_px = c * du + d * dv
        speed_px_s = np.hypot(dx_px, dy_px)
        return float(np.nanmax(speed_px_s))

    def scales_px_rad(self) -> tuple[float, float]:
        """The smallest and the largest number of pixels to a radian anywhere on the image; a
        pinhole's are both its axis's.
        """
        if self.lens is None:
            return self.focal_length_px, self.focal_length_px
        u, v = self.tangents(*self.grid_px(SPEED_PLACES))
        a, b, c, d = self.slopes(u, v)
        # A tangent's step (du, dv) is an angle by the metric of the sphere, whose inverse is (1 +
        # r^2) (1 + w w^T), w = (u, v).
        along_x = a * u + b * v
        along_y = c * u + d * v
        wide = 1 + u * u + v * v
        plain_xx = a * a + b * b
        plain_yy = c * c + d * d
        plain_xy = a * c + b * d
        xx = wide * (plain_xx + along_x**2)
        yy = wide * (plain_yy + along_y**2)
        xy = wide * (plain_xy + along_x * along_y)
        middle = (xx + yy) / 2
        spread = np.hypot((xx - yy) / 2, xy)
        smallest = float(np.sqrt(np.nanmin(middle - spread)))
        largest = float(np.sqrt(np.nanmax(middle + spread)))
        return smallest, largest

    def grid_px(self, count: int | tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Places over the whole image, its edges among them: `count` to a row and a column, or
        (columns, rows).
        """
        if isinstance(count, int):
            count = (count, count)
        columns, rows = count
        width, height = self.resolution_px
        across = np.linspace(-0.5, width - 0.5, columns)
        down = np.linspace(-0.5, height - 0.5, rows)
        x, y = np.meshgrid(across, down)
        return x.ravel(), y.ravel()

    def pixels_from(
        self, other: "Camera", x_px: FloatArray, y_px: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """This camera's pixels at pixels (n,) of another; NaN behind this camera, and beyond a
        lens.
        """
        if other is self:
            return np.asarray(x_px, dtype=np.float64), np.asarray(y_px, dtype=np.float64)
        return self.project(other.rays(x_px, y_px) @ self.cam_to_image.T)

    def contains_px(self, x_px: FloatArray, y_px: FloatArray) -> BoolArray:
        """Whether places in pixels are on the image; not so at NaN."""
        width, height = self.resolution_px
        with np.errstate(invalid="ignore"):
            off_x = np.abs(x_px - (width - 1) / 2)
            off_y = np.abs(y_px - (height - 1) / 2)
            across = off_x <= width / 2
            down = off_y <= height / 2
        return np.asarray(across & down)

    def in_view(self, seen: FloatArray, margin_px: float, reach_rad: float) -> IntArray:
        """Positions of the directions (n, 3) in image axes that can come within `margin_px` of the
        image, and some more.

        A direction comes there if one within `reach_rad` of it is there (with a lens, within its
        own margin).
        """
        radius = float(np.tan(self.field_radius_rad(margin_px)))
        angle_rad = np.arctan(radius) + reach_rad
        if angle_rad >= np.pi / 2:
            return np.arange(len(seen))
        reach = float(np.tan(angle_rad)) - radius  # tangents grow fastest at the rim, and outward
        x, y, z = seen.T
        inside = z > 0
        box = self._box(margin_px)
        for along, (low, high) in zip((x, y), box, strict=True):
            inside &= along >= (low - reach) * z
            inside &= along <= (high + reach) * z
        return np.flatnonzero(inside)

    def _box(self, margin_px: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """The smallest and the largest u, and v, of directions (u, v, 1) within `margin_px` of
        the image.
        """
        if self.lens is not None:
            return self.lens.box
        cx, cy = self.principal_point_px
        width, height = self.resolution_px
        focal_px = self.focal_length_px
        left = (-0.5 - margin_px - cx) / focal_px
        right = (width - 0.5 + margin_px - cx) / focal_px
        top = (-0.5 - margin_px - cy) / focal_px
        bottom = (height - 0.5 + margin_px - cy) / focal_px
        return (left, right), (top, bottom)

    def edges(self, margin_px: float) -> FloatArray:
        """The planes of the image's sides, `margin_px` outside it: their inward unit normals (4, 3)
        in image axes.

        With a lens they are those of the box around its directions.
        """
        (left, right), (top, bottom) = self._box(margin_px)
        normals = np.array(
            [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
        )
        length2 = (normals * normals).sum(axis=1, keepdims=True)
        return np.asarray(normals / np.sqrt(length2))

    def field(self, margin_px: float) -> tuple[float, FloatArray]:
        """`field_radius_rad` and `edges`, which are the same for every frame, of the last few
        margins.
        """
        return _field(self, margin_px)

    def field_radius_rad(self, margin_px: float) -> float:
        """The angle from the image's normal to its farthest corner, `margin_px` outside it (with
        a lens, its own margin).
        """
        if self.lens is not None:
            return float(np.arctan(self.lens.max_tangent))
        width, height = self.resolution_px
        cx, cy = self.principal_point_px
        reach_x = max(cx, width - 1 - cx) + 0.5 + margin_px
        reach_y = max(cy, height - 1 - cy) + 0.5 + margin_px
        return float(np.arctan(np.hypot(reach_x, reach_y) / self.focal_length_px))


def linear_shares(size: int, count: int) -> FloatArray:
    """The share (size, count) of each place of `grid_px` in each pixel of a row: linear between
    neighbours.
    """
    middles = np.arange(size) + 0.5
    at = middles * (count - 1) / size
    distance = np.abs(at[:, None] - np.arange(count))
    return np.asarray(np.maximum(0.0, 1 - distance))


@lru_cache(maxsize=16)
def _field(camera: Camera, margin_px: float) -> tuple[float, FloatArray]:
    """As `Camera.field`, by the camera itself: it is its own key, and its edges are read only."""
    edges = camera.edges(margin_px)
    edges.flags.writeable = False
    return camera.field_radius_rad(margin_px), edges


def _over(size: float, z: FloatArray) -> FloatArray:
    """`size` / z; NaN for what is not in front of the camera."""
    if len(z) and z.min() > 0:  # a masked division is several times slower
        return size / z
    return np.divide(size, z, out=np.full_like(z, np.nan), where=z > 0)


def bounded(camera: Camera, margin_px: float) -> Camera:
    """The camera with its lens bounded to what reaches the image, `margin_px` around it included,
    and to what it is known for.

    Raises InputError for a lens that folds within those directions: two of them would share a
    pixel.
    """
    lens = camera.lens
    if lens is None:
        return camera
    free = replace(camera, lens=replace(lens, max_tangent=np.inf))
    width, height = camera.resolution_px
    first = -0.5 - margin_px
    right = width - 0.5 + margin_px
    bottom = height - 0.5 + margin_px
    across = np.linspace(first, right, BORDER_PLACES)
    down = np.linspace(first, bottom, BORDER_PLACES)
    at_first = np.full(BORDER_PLACES, first)
    at_right = np.full(BORDER_PLACES, right)
    at_bottom = np.full(BORDER_PLACES, bottom)
    border_x = np.concatenate([across, across, at_first, at_right])
    border_y = np.concatenate([at_first, at_bottom, down, down])
    u, v = free.tangents(border_x, border_y)
    farthest = np.nan_to_num(np.hypot(u, v), nan=np.inf).max()
    reach = min(float(farthest), lens.max_tangent)
    box = (_wide(u), _wide(v))
    if not np.isfinite(reach) or _folds(free, reach):
        raise InputError(
            "its distortion folds within the screen: two directions share a pixel; fit it again,"
            " with fewer terms"
        )
    return replace(camera, lens=replace(lens, max_tangent=reach * BEYOND_BORDER, box=box))


def _folds(camera: Camera, reach: float) -> bool:
    """Whether a lens turns its image round anywhere within a radius of (u, v)."""
    side = np.linspace(-reach, reach, FOLD_PLACES)
    columns, rows = np.meshgrid(side, side)
    inside = np.hypot(columns, rows) <= reach
    slopes = camera.slopes(columns[inside], rows[inside])
    return not (slopes.areas > 0).all()


def _wide(tangents: FloatArray) -> tuple[float, float]:
    """The range of tangents along the image's border, widened by BOW of itself, as a side may bow
    between two of its places.

    ANY_TANGENT where the tangent of a place is not known (NaN).
    """
    low = float(tangents.min())
    high = float(tangents.max())
    if np.isfinite(low):
        bow = BOW * (high - low)
        return low - bow, high + bow
    return ANY_TANGENT
