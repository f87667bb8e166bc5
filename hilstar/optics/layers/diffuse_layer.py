"""Light that stands on the sky, as `[sky.diffuse]` has it: a map of it for each view, where it is
bright enough to be seen.

The image is divided into cells. What the map has in a cell decides whether it is drawn; each group
of cells that touch becomes a map of light. Places in the map are exact at the cells' corners and
linear between them. A pixel has the map's value in its middle, spread by a round Gaussian of the
PSF's variance, times its solid angle. The camera's turn within a frame, which changes smooth light
little, is left out.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.basics.rotation import normalise, to_matrix
from hilstar.optics.camera import linear_shares
from hilstar.optics.extended import LightMap
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.sprites import FrameLight
from hilstar.sky.diffuse import TangentImage
from hilstar.sky.stars import Stars

CELL_PX = 16
ON_EDGE_PX = 0.01
MOVED_PX = 0.25  # at most, by taking one attitude for a cell of them


class DiffuseLayer:
    """The light of tangent images in electrons/s/sr; of a monitor only cells that pass its first
    step in a pixel.
    """

    def __init__(self, images: tuple[TangentImage, ...], canvas: Canvas) -> None:
        self._camera = canvas.camera
        self._faintest = canvas.first_step_e_per_s
        camera = canvas.camera
        finest_rad, coarsest_rad = (1 / scale for scale in reversed(camera.scales_px_rad()))
        width, height = camera.resolution_px
        self._counts = -(-width // CELL_PX) + 1, -(-height // CELL_PX) + 1
        self._across, self._down = map(linear_shares, camera.resolution_px, self._counts)
        places = camera.grid_px(self._counts)
        shape = self._counts[::-1]
        rays = camera.rays(*places).reshape(*shape, 3)
        self._rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        self._sr = np.nan_to_num(camera.pixel_sr(*places)).reshape(shape)
        least = self._faintest / self._sr.max()
        sigma_px = math.sqrt(math.fsum(canvas.psf.variance_px2) / 2)
        smoothed = [sky_image.seen_by(finest_rad, sigma_px) for sky_image in images]
        self._brightest = max(
            (float(sky_image.image.max() * self._sr.max()) for sky_image in smoothed), default=0.0
        )
        self._faces = [
            _Face(sky_image, coarsest_rad, least)
            for sky_image in smoothed
            if sky_image.image.max() > least
        ]
        self._middles = np.array([face.middle for face in self._faces]).reshape(-1, 3)
        reach_rad = math.acos(float(np.nanmin(self._rays[..., 2])))
        radii_rad = np.arccos([face.cos_radius for face in self._faces])
        self._cos_reach = np.cos(np.minimum(radii_rad + reach_rad, np.pi))
        # Half a step of each component turns by twice that, and moves the image's farthest pixel.
        lever_px = math.hypot(*camera.resolution_px, camera.focal_length_px)
        self._cell_q = MOVED_PX / (2 * lever_px) if self._faintest else 0.0
        self._kept: tuple[FloatArray, tuple[LightMap, ...]] | None = None

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light before, and the map's; a screen's is that of its attitude's cell, and the
        same objects within a cell.
        """
        cell = view.q_icrs_to_cam
        if self._cell_q:
            cell = (
                np.rint(cell * np.sign(cell[np.argmax(np.abs(cell))]) / self._cell_q) * self._cell_q
            )
        if self._kept is None or not np.array_equal(cell, self._kept[0]):
            icrs_to_cam = to_matrix(normalise(cell))
            near = []
            for k in np.flatnonzero(self._middles @ icrs_to_cam[2] >= self._cos_reach):
                near.append(self._faces[k])
            faces_of_cube = sum(face.is_of_cube for face in near)
            if faces_of_cube > 1:
                taken = np.zeros(self._camera.resolution_px[::-1], dtype=bool)
            else:
                taken = None
            maps: list[LightMap] = []
            for face in near:
                maps.extend(self._lit(face, icrs_to_cam, taken if face.is_of_cube else None))
            self._kept = cell, tuple(maps)
        _, lights = self._kept
        if lights:
            return replace(light, extended=(*light.extended, *lights))
        return light

    def line(self) -> str:
        """How bright it is on a monitor."""
        steps = self._brightest / (self._faintest or math.inf)
        if steps > 1:
            drawn = "is drawn where it passes one"
        else:
            drawn = "is not drawn; the virtual tracker has it"
        return (
            f"[sky.diffuse] map: its brightest pixel has {steps:.3g} of the light of the screen's"
            f" first step; it {drawn}"
        )

    def _lit(
        self, face: "_Face", icrs_to_cam: FloatArray, taken: BoolArray | None
    ) -> list[LightMap]:
        """The map of each group of cells that have light at an attitude.

        Pixels (h, w) that another face has `taken` are left out, and those of this one are noted.
        """
        from scipy.ndimage import find_objects, label, map_coordinates

        near = self._rays @ (icrs_to_cam @ face.middle) >= face.cos_radius
        lit = [np.flatnonzero(near.any(axis=axis)) for axis in (1, 0)]
        # no whole cell: its light is two cells and more beside the image
        if min(map(len, lit)) < 2:
            return []
        around = tuple(slice(int(lit_places[0]), int(lit_places[-1]) + 1) for lit_places in lit)
        x_px, y_px = face.image.places_px(self._rays[around] @ icrs_to_cam)
        bright = face.most_at(x_px, y_px) * self._sr[around] > self._faintest
        cells = bright[:-1, :-1] | bright[1:, :-1] | bright[:-1, 1:] | bright[1:, 1:]
        groups, _ = label(cells)
        parts = []
        for number, box in enumerate(find_objects(groups), start=1):
            part = self._part(box, around, groups[box] == number)
            x, y, sr = (part.spread(of) for of in (x_px, y_px, self._sr[around]))
            if taken is not None:
                part.keep(face.holds(x, y), taken)
            image = map_coordinates(
                face.image.image, [y, x], order=1, mode="grid-constant", output=np.float32
            )
            parts.append(LightMap(image * sr * part.own, part.corner_px, bv_mag=face.image.bv_mag))
        return parts

    def _part(self, box: tuple[slice, ...], around: tuple[slice, ...], own: BoolArray) -> "_Part":
        """The pixels of a box of cells, counted from the first ones `around`, of which some are
        `own`.
        """
        first = [part.start + whole.start for part, whole in zip(box, around, strict=True)]
        across, down = self._counts
        width, height = self._camera.resolution_px
        rows = _first_pixels(first[0], box[0].stop - box[0].start, height, down)
        columns = _first_pixels(first[1], box[1].stop - box[1].start, width, across)
        return _Part(
            (int(columns[0]), int(rows[0])),
            tuple(slice(part.start, part.stop + 1) for part in box),
            self._down[rows[0] : rows[-1], first[0] : first[0] + len(rows)].astype(np.float32),
            self._across[columns[0] : columns[-1], first[1] : first[1] + len(columns)].astype(
                np.float32
            ),
            np.repeat(np.repeat(own, np.diff(rows), axis=0), np.diff(columns), axis=1),
        )


def _first_pixels(first_cell: int, cells: int, size_px: int, corners: int) -> IntArray:
    """The first pixel of each of `cells` cells along an axis, and that behind the last one."""
    corner = np.arange(first_cell, first_cell + cells + 1)
    return np.ceil(corner * size_px / (corners - 1) - 0.5).astype(np.intp)


@dataclass(slots=True)
class _Part:
    """A rectangle of an image: its first pixel, its cells' corners, their shares in its rows and
    columns, which are its own.
    """

    corner_px: tuple[int, int]
    nodes: tuple[slice, ...]
    down: Float32Array
    across: Float32Array
    own: BoolArray

    def spread(self, at_corners: FloatArray) -> Float32Array:
        """Values at all cells' corners, interpolated to this part's pixels."""
        return np.asarray(
            self.down @ np.nan_to_num(at_corners[self.nodes]).astype(np.float32) @ self.across.T
        )

    def keep(self, held: BoolArray, taken: BoolArray) -> None:
        """Leave pixels that are not `held` here or `taken` before, and take the others, in an
        image's `taken` (h, w).
        """
        (left, top), (rows, columns) = self.corner_px, self.own.shape
        here = taken[top : top + rows, left : left + columns]
        self.own &= held & ~here
        here |= self.own


class _Face:
    """A tangent image, and the most light that any place has within a cell of it.

    What has more light than `least` is within a radius of the direction `middle` (3,), ICRS, cells
    that touch it included.
    """

    def __init__(self, image: TangentImage, px_rad: float, least: float) -> None:
        from scipy.ndimage import maximum_filter

        self.image = image
        self.middle_px = (len(image.image) - 1) / 2
        self.is_of_cube = math.isfinite(image.max_tangent)
        # From a corner to the far end of its cells, on a plane whose scale grows by 3 at a cube's
        # corner
        self._reach_px = math.ceil(CELL_PX * px_rad * image.px_per_tangent * 3 * math.sqrt(2)) + 1
        rows, columns = np.nonzero(image.image > least)
        lit = np.stack(
            [
                columns - self.middle_px,
                rows - self.middle_px,
                np.full(len(rows), image.px_per_tangent),
            ],
            axis=-1,
        )
        lit = (lit / np.linalg.norm(lit, axis=1, keepdims=True)) @ image.axes
        self.middle = lit.mean(axis=0)
        self.middle /= np.linalg.norm(self.middle)
        radius_rad = math.acos(np.clip((lit @ self.middle).min(), -1.0, 1.0)) + 3 * CELL_PX * px_rad
        self.cos_radius = math.cos(min(radius_rad, math.pi))
        self.most = maximum_filter(
            np.pad(image.image, self._reach_px), 2 * self._reach_px + 1, mode="constant"
        )

    def most_at(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The most light near places; none at NaN."""
        size = len(self.most)
        x, y = (np.nan_to_num(np.rint(at) + self._reach_px, nan=-1.0) for at in (x_px, y_px))
        inside = (x >= 0) & (y >= 0) & (x < size) & (y < size)
        return np.where(
            inside, self.most[(y * inside).astype(np.intp), (x * inside).astype(np.intp)], 0.0
        )

    def holds(self, x_px: Float32Array, y_px: Float32Array) -> BoolArray:
        """Which places are not beyond its edge, or hardly: two faces both hold a place on their
        edge.
        """
        half_px = self.image.max_tangent * self.image.px_per_tangent + ON_EDGE_PX
        return np.asarray(
            (np.abs(x_px - self.middle_px) <= half_px) & (np.abs(y_px - self.middle_px) <= half_px)
        )
