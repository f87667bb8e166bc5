"""Light that stands on the sky, as `[sky.diffuse]` has it: a map of it for each view, where it is
bright enough to be seen.

The image is divided into cells. What the map has in a cell decides whether it is drawn; each group
of cells that touch becomes a map of light. Places in the map are exact at the cells' corners and
linear between them. A pixel has the map's value in its middle, spread by a round Gaussian of the
PSF's variance, times its solid angle. The camera's turn within a frame, which changes smooth light
little, is left out.
"""

import itertools
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

CELL_PX = 16  # side of cells: places are computed at their corners, and linear between these
ON_EDGE_PX = 0.01  # of a tangent image: two faces of a cube both hold their common edge
MOVED_PX = 0.25  # at most, by taking one attitude for a cell of them


class DiffuseLayer:
    """Diffuse light of the sky, from tangent images in electrons/s/sr. A monitor is given only the
    cells of its image in which a pixel passes its first step.
    """

    def __init__(self, images: tuple[TangentImage, ...], canvas: Canvas) -> None:
        self._camera = canvas.camera
        self._faintest = canvas.first_step_e_per_s
        camera = canvas.camera
        smallest_px_rad, largest_px_rad = camera.scales_px_rad()
        finest_rad = 1 / largest_px_rad
        coarsest_rad = 1 / smallest_px_rad
        width, height = camera.resolution_px
        columns = math.ceil(width / CELL_PX) + 1
        rows = math.ceil(height / CELL_PX) + 1
        self._counts = (columns, rows)
        self._across = linear_shares(width, columns)
        self._down = linear_shares(height, rows)
        places = camera.grid_px(self._counts)
        rays = camera.rays(*places).reshape(rows, columns, 3)
        self._rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        pixel_sr = np.nan_to_num(camera.pixel_sr(*places))
        self._sr = pixel_sr.reshape(rows, columns)
        largest_sr = self._sr.max()
        least = self._faintest / largest_sr
        sigma_px = math.sqrt(math.fsum(canvas.psf.variance_px2) / 2)
        self._brightest = 0.0
        self._faces = []
        for sky_image in images:
            smoothed = sky_image.seen_by(finest_rad, sigma_px)
            brightest = smoothed.image.max()
            self._brightest = max(self._brightest, float(brightest * largest_sr))
            if brightest > least:
                self._faces.append(_Face(smoothed, coarsest_rad, least))
        middles = [face.middle for face in self._faces]
        self._middles = np.array(middles).reshape(-1, 3)
        smallest_cosine = float(np.nanmin(self._rays[..., 2]))
        reach_rad = math.acos(smallest_cosine)
        radii_rad = np.arccos([face.cos_radius for face in self._faces])
        self._cos_reach = np.cos(np.minimum(radii_rad + reach_rad, np.pi))
        # Half a step of each component turns by twice that, and moves the image's farthest pixel.
        lever_px = math.hypot(*camera.resolution_px, camera.focal_length_px)
        self._cell_q = MOVED_PX / (2 * lever_px) if self._faintest else 0.0
        self._kept: tuple[FloatArray, tuple[LightMap, ...]] | None = None

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light before, and the map's. On a screen that is the map of the attitude's cell:
        within a cell it is the same objects, which are uploaded once.
        """
        cell = view.q_icrs_to_cam
        if self._cell_q:
            largest = cell[np.argmax(np.abs(cell))]
            steps = np.rint(cell * np.sign(largest) / self._cell_q)
            cell = steps * self._cell_q
        if self._kept is None or not np.array_equal(cell, self._kept[0]):
            icrs_to_cam = to_matrix(normalise(cell))
            boresight_cosines = self._middles @ icrs_to_cam[2]
            is_near = boresight_cosines >= self._cos_reach
            near = list(itertools.compress(self._faces, is_near))
            taken = None
            if sum(face.is_of_cube for face in near) > 1:
                taken = np.zeros(self._camera.resolution_px[::-1], dtype=bool)
            maps: list[LightMap] = []
            for face in near:
                face_taken = taken if face.is_of_cube else None
                maps.extend(self._lit(face, icrs_to_cam, face_taken))
            self._kept = (cell, tuple(maps))
        _, lights = self._kept
        if lights:
            return replace(light, extended=(*light.extended, *lights))
        return light

    def line(self) -> str:
        """How bright it is on a monitor."""
        steps = self._brightest / (self._faintest or math.inf)
        drawn = "is not drawn; the virtual tracker has it"
        if steps > 1:
            drawn = "is drawn where it passes one"
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
        lit_rows = np.flatnonzero(near.any(axis=1))
        lit_columns = np.flatnonzero(near.any(axis=0))
        # no whole cell: its light is two cells and more beside the image
        if min(len(lit_rows), len(lit_columns)) < 2:
            return []
        around = (_span(lit_rows), _span(lit_columns))
        x_px, y_px = face.image.places_px(self._rays[around] @ icrs_to_cam)
        sr = self._sr[around]
        bright = face.most_at(x_px, y_px) * sr > self._faintest
        above = bright[:-1]
        below = bright[1:]
        either = above | below
        cells = either[:, :-1] | either[:, 1:]
        groups, _ = label(cells)
        maps = []
        for number, box in enumerate(find_objects(groups), start=1):
            part = self._part(box, around, groups[box] == number)
            x = part.spread(x_px)
            y = part.spread(y_px)
            if taken is not None:
                part.keep(face.holds(x, y), taken)
            source = face.image.image
            image = map_coordinates(
                source, [y, x], order=1, mode="grid-constant", output=np.float32
            )
            light = image * part.spread(sr) * part.own
            maps.append(LightMap(light, part.corner_px, bv_mag=face.image.bv_mag))
        return maps

    def _part(self, box: tuple[slice, ...], around: tuple[slice, ...], own: BoolArray) -> "_Part":
        """The pixels of a box of cells, counted from the first ones `around`, of which some are
        `own`.
        """
        row_box, column_box = box
        first_row = row_box.start + around[0].start
        first_column = column_box.start + around[1].start
        columns, rows = self._counts
        width, height = self._camera.resolution_px
        y_px = _first_pixels(first_row, row_box.stop - row_box.start, height, rows)
        x_px = _first_pixels(first_column, column_box.stop - column_box.start, width, columns)
        top = int(y_px[0])
        left = int(x_px[0])
        down = self._down[top : y_px[-1], first_row : first_row + len(y_px)]
        across = self._across[left : x_px[-1], first_column : first_column + len(x_px)]
        own_rows = np.repeat(own, np.diff(y_px), axis=0)
        own_pixels = np.repeat(own_rows, np.diff(x_px), axis=1)
        return _Part(
            corner_px=(left, top),
            nodes=tuple(slice(part.start, part.stop + 1) for part in box),
            down=down.astype(np.float32),
            across=across.astype(np.float32),
            own=own_pixels,
        )


def _span(places: IntArray) -> slice:
    """From the first to the last of places, which rise."""
    return slice(int(places[0]), int(places[-1]) + 1)


def _first_pixels(first_cell: int, cells: int, size_px: int, corners: int) -> IntArray:
    """The first pixel of each of `cells` cells along an axis, and that behind the last one."""
    corner = np.arange(first_cell, first_cell + cells + 1)
    first = corner * size_px / (corners - 1) - 0.5
    return np.ceil(first).astype(np.intp)


@dataclass(slots=True)
class _Part:
    """A rectangle of an image: its first pixel (x, y), the corners of its cells, the shares of
    these corners in its rows and columns, and which pixels are its own.
    """

    corner_px: tuple[int, int]
    nodes: tuple[slice, ...]
    down: Float32Array
    across: Float32Array
    own: BoolArray

    def spread(self, at_corners: FloatArray) -> Float32Array:
        """Values at all cells' corners, interpolated to this part's pixels."""
        corners = np.nan_to_num(at_corners[self.nodes]).astype(np.float32)
        return np.asarray(self.down @ corners @ self.across.T)

    def keep(self, held: BoolArray, taken: BoolArray) -> None:
        """Give up the pixels that are not `held` or that another face has in `taken` (h, w), and
        note the others there.
        """
        left, top = self.corner_px
        rows, columns = self.own.shape
        here = taken[top : top + rows, left : left + columns]
        self.own &= held & ~here
        here |= self.own


class _Face:
    """A tangent image prepared for a camera: `most` is the largest light within a cell of any
    place.

    All that has more light than `least` is within a radius of the direction `middle` (3,), ICRS,
    with the cells that it touches.
    """

    def __init__(self, image: TangentImage, px_rad: float, least: float) -> None:
        from scipy.ndimage import maximum_filter

        self.image = image
        self.middle_px = (len(image.image) - 1) / 2
        self.is_of_cube = math.isfinite(image.max_tangent)
        # From a corner to the far end of its cells, on a plane whose scale grows by 3 at a cube's
        # corner
        cell_px = CELL_PX * px_rad * image.px_per_tangent
        farthest_px = cell_px * 3 * math.sqrt(2)
        self._reach_px = math.ceil(farthest_px) + 1
        rows, columns = np.nonzero(image.image > least)
        right = columns - self.middle_px
        down = rows - self.middle_px
        forward = np.full(len(rows), image.px_per_tangent)
        lit = np.stack([right, down, forward], axis=-1)
        lit /= np.linalg.norm(lit, axis=1, keepdims=True)
        lit = lit @ image.axes
        self.middle = lit.mean(axis=0)
        self.middle /= np.linalg.norm(self.middle)
        smallest_cosine = np.clip((lit @ self.middle).min(), -1.0, 1.0)
        radius_rad = math.acos(smallest_cosine) + 3 * CELL_PX * px_rad
        self.cos_radius = math.cos(min(radius_rad, math.pi))
        padded = np.pad(image.image, self._reach_px)
        self.most = maximum_filter(padded, 2 * self._reach_px + 1, mode="constant")

    def most_at(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The most light near places; none at NaN."""
        size = len(self.most)
        x = np.nan_to_num(np.rint(x_px) + self._reach_px, nan=-1.0)
        y = np.nan_to_num(np.rint(y_px) + self._reach_px, nan=-1.0)
        across = (x >= 0) & (x < size)
        down = (y >= 0) & (y < size)
        inside = across & down
        row = (y * inside).astype(np.intp)
        column = (x * inside).astype(np.intp)
        return np.where(inside, self.most[row, column], 0.0)

    def holds(self, x_px: Float32Array, y_px: Float32Array) -> BoolArray:
        """True for places within the face's edge, or hardly beyond it: two faces both hold a place
        on their common edge.
        """
        half_px = self.image.max_tangent * self.image.px_per_tangent + ON_EDGE_PX
        across = np.abs(x_px - self.middle_px) <= half_px
        down = np.abs(y_px - self.middle_px) <= half_px
        return np.asarray(across & down)
