"""Light that is no star's sprite: discs of bodies and maps of light, added to the linear image
before levels are chosen.

Its unit is that of the linear image, electrons per second of each pixel. It travels in a frame's
`FrameLight.extended` and is drawn in order, before the sprites. Compared by identity: one object
drawn twice is the same light. A small disc is a map of its spread places, a larger one is drawn ray
by ray.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.optics.camera import Camera
from hilstar.optics.psf import Psf
from hilstar.sky.bodies.disc import AIR_TOP, Disc

REACH_SIGMAS = 4.0  # as in disc.frag
LIMB_PLACES = 128
# minimum z of a unit direction: a limb nearer to the camera's plane has no useful outline
BEHIND = 0.05
BOW = 1.01  # margin for the outline's curvature between its places
Rectangle = tuple[int, int, int, int]  # left, top, width, height, pixels
# Below this radius (PSF and pixel combined) a disc's limb and centre cannot be told apart;
# disc.frag is off by 1 % at 5.5.
SMALL_SIGMAS = 8.0
# Along a radius. In the face's middle places are then up to pi^3 / 4 / 5 = 1.55 sigma apart, and
# the face is uneven by 2 exp(-2 pi^2 / 1.55^2) = 5e-4; with 4 it would be 1 %, also of the Sun
# behind.
NODES_A_SIGMA = 5.0
# coverage that counts as a whole pixel: the rest is rounding, and the Sun behind may be 1e9 times
# white
WHOLE = 0.999
MAX_NODES = 64  # enough for a Gaussian ten times as wide along one axis as along the other
MIN_NODES = 10  # 1e-4 of the light
# of a difference by which an image's speed is known
STEP_S = 1e-4
MAX_SHARE = 0.5  # of the rows, by which a disc moves meanwhile: as far as a star does


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """An image of light, float32 (height, width), `times` a factor, its first pixel at `corner_px`
    (x, y) of the image.

    `cover`, of the same shape, is the share of what was drawn before that each pixel hides; None
    hides nothing. `name` is the body's whose disc it is; other light has the colour of its
    `bv_mag`, None: of the stars.

    Keep one array for as long as the light is the same, and do not write to it: it is uploaded
    once. What a single frame has is not `lasting`.
    """

    image: Float32Array
    corner_px: tuple[int, int] = (0, 0)
    times: float = 1.0
    cover: Float32Array | None = None
    name: str = ""
    lasting: bool = True
    bv_mag: float | None = None

    def region(self, resolution_px: tuple[int, int]) -> Rectangle | None:
        """The part of an image that it lights, None where that is nothing."""
        height, width = self.image.shape
        left, top = self.corner_px
        return clipped((left, top, left + width, top + height), resolution_px)


@dataclass(frozen=True, slots=True, eq=False)
class GlowLight:
    """A glow about a direction (3,), unit, image axes: `peak_e_per_s` (1 + (angle /
    scale)^2)^(-exponent / 2) in each pixel.

    The direction may be off the image, or behind the camera.
    """

    direction_image: FloatArray
    peak_e_per_s: float
    scale_rad: float
    exponent: float
    camera: Camera
    bv_mag: float | None = None

    def region(self, resolution_px: tuple[int, int]) -> Rectangle | None:
        """The whole image."""
        return (0, 0, *resolution_px)


@dataclass(frozen=True, slots=True, eq=False)
class Shear:
    """A camera that turns at `rate_image_rad_s` (3,), image axes, while pixels light up one after
    the other.

    A pixel is lit `s_per_px` (x, y) times its distance from `middle_px` after the moment of the
    attitude.
    """

    rate_image_rad_s: FloatArray
    s_per_px: tuple[float, float]
    middle_px: tuple[float, float]

    def late_s(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """How long after the attitude's moment pixels (n,) are lit."""
        (a, b), (x, y) = self.s_per_px, self.middle_px
        return a * (x_px - x) + b * (y_px - y)


@dataclass(frozen=True, slots=True, eq=False)
class DiscLight:
    """A body's disc through a camera, spread by a PSF; `icrs_to_image` (3, 3) as for sprites.

    Its light is multiplied by `times`. Where it `covers`, it hides what was drawn before it.
    `disc_lights` chooses between it and, for a small disc, a map.
    """

    disc: Disc
    icrs_to_image: FloatArray
    camera: Camera
    psf: Psf
    times: float = 1.0
    covers: bool = True
    shear: Shear | None = None

    @property
    def name(self) -> str:
        """The body's name."""
        return self.disc.name

    def region(self, resolution_px: tuple[int, int]) -> Rectangle | None:
        """The pixels within the outline of its limb, its air and the Gaussian's reach; all where
        that is partly behind.
        """
        air = 1 + AIR_TOP * self.disc.air_radii
        limb_directions = self.disc.limb(LIMB_PLACES, air) @ self.icrs_to_image.T
        if (limb_directions[:, 2] < BEHIND).any():
            return (0, 0, *resolution_px)
        x_px, y_px = self.camera.project_outward(limb_directions)
        if not (np.isfinite(x_px).all() and np.isfinite(y_px).all()):
            return (0, 0, *resolution_px)
        middle_x, half_x = _middle_and_half(x_px)
        middle_y, half_y = _middle_and_half(y_px)
        variance_x, variance_y = self.psf.variance_px2
        sheared_px = self._sheared_px()
        spread_x = REACH_SIGMAS * float(np.sqrt(variance_x))
        spread_y = REACH_SIGMAS * float(np.sqrt(variance_y))
        half_x = half_x + spread_x + 1 + sheared_px
        half_y = half_y + spread_y + 1 + sheared_px
        left = middle_x - half_x
        right = middle_x + half_x
        top = middle_y - half_y
        bottom = middle_y + half_y
        return clipped((left, top, right, bottom), resolution_px)

    def _sheared_px(self) -> float:
        """How far the first and the last pixels' light is moved by the shear at most, about."""
        if self.shear is None:
            return 0.0
        width, height = self.camera.resolution_px
        by_column_s, by_row_s = self.shear.s_per_px
        whole_s = abs(by_column_s) * width + abs(by_row_s) * height
        late_s = whole_s / 2
        turn_rad = float(np.linalg.norm(self.shear.rate_image_rad_s)) * late_s
        lever_px = float(np.hypot(self.camera.focal_length_px, max(width, height)))
        return 2 * turn_rad * lever_px


def _middle_and_half(limb_px: FloatArray) -> tuple[float, float]:
    """The middle of a limb's places along an axis, and how far from it they reach, as a limb may
    bow between two of them.
    """
    low = float(limb_px.min())
    high = float(limb_px.max())
    middle = (low + high) / 2
    half = (high - low) / 2 * BOW
    return middle, half


ExtendedLight = LightMap | GlowLight | DiscLight


def times(light: ExtendedLight, factor: float) -> ExtendedLight:
    """Light with all of its electrons times a factor; what it hides stays hidden."""
    if isinstance(light, GlowLight):
        return replace(light, peak_e_per_s=light.peak_e_per_s * factor)
    return replace(light, times=light.times * factor)


def shifted(light: ExtendedLight, right_px: float, down_px: float) -> ExtendedLight:
    """Light a part of a pixel to the right and down of its place; of a map by cubic splines."""
    if not (right_px or down_px):
        return light
    if isinstance(light, LightMap):
        from scipy.ndimage import shift

        # Splines overshoot: no light is negative, and nothing hides more than all.
        offset_px = (down_px, right_px)
        image = shift(np.pad(light.image, 1), offset_px, output=np.float32).clip(0.0)
        cover = light.cover
        if cover is not None:
            cover = shift(np.pad(cover, 1), offset_px, output=np.float32).clip(0.0, 1.0)
        corner = light.corner_px[0] - 1, light.corner_px[1] - 1
        return replace(light, image=image, cover=cover, corner_px=corner)
    x_px, y_px = light.camera.principal_point_px
    return replace(
        light, camera=replace(light.camera, principal_point_px=(x_px + right_px, y_px + down_px))
    )


def clipped(
    edges_px: tuple[float, float, float, float], resolution_px: tuple[int, int]
) -> Rectangle | None:
    """The pixels of an image within left, top, right and bottom (the last two excluded); None
    where there is none.
    """
    first = np.floor(edges_px[:2]).clip(0, resolution_px)
    end = np.ceil(edges_px[2:]).clip(0, resolution_px)
    left, top = first.astype(int).tolist()
    right, bottom = end.astype(int).tolist()
    if right > left and bottom > top:
        return (left, top, right - left, bottom - top)
    return None


@dataclass(frozen=True, slots=True)
class Pose:
    """The camera at one moment of a frame: the map (3, 3) of ICRS to image axes, and the
    moment's share of the light.
    """

    icrs_to_image: FloatArray
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class DiscView:
    """A camera and the PSF that spreads its image, at the poses of a frame, and how it turns
    meanwhile.
    """

    camera: Camera
    psf: Psf
    poses: tuple[Pose, ...]
    shear: Shear | None = None


def disc_lights(disc: Disc, view: DiscView, covers: bool) -> list[ExtendedLight]:
    """A body's disc at all poses, none of it where it does not touch the image; where it
    `covers`, it hides what is behind.
    """
    if len(view.poses) == 1:
        pose = view.poses[0]
        return _at_pose(
            DiscLight(
                disc, pose.icrs_to_image, view.camera, view.psf, pose.share, covers, view.shear
            )
        )
    lights: list[ExtendedLight] = []
    if covers:
        # Poses hide together what one in the middle hides: each after the other would hide the
        # light of those before.
        middle = view.poses[len(view.poses) // 2].icrs_to_image
        lights += _at_pose(DiscLight(disc, middle, view.camera, view.psf, 0.0, True, view.shear))
    for pose in view.poses:
        lights += _at_pose(
            DiscLight(
                disc, pose.icrs_to_image, view.camera, view.psf, pose.share, False, view.shear
            )
        )
    return lights


def _at_pose(light: DiscLight) -> list[ExtendedLight]:
    """A disc at one pose: itself, a map where it is small, nothing where it is not on the image."""
    camera = light.camera
    radius_px = float(np.tan(min(light.disc.radius_rad, 1.0)) * camera.focal_length_px)
    widest_px = max(light.psf.variance_px2) ** 0.5
    narrowest_px = min(light.psf.variance_px2) ** 0.5
    if radius_px < SMALL_SIGMAS * widest_px:
        wanted = int(np.ceil(NODES_A_SIGMA * radius_px / narrowest_px))
        nodes = min(max(MIN_NODES, wanted), MAX_NODES)
        drawn = _disc_map(light, nodes)
        if drawn is None:
            return []
        return [drawn]
    if light.region(camera.resolution_px) is None:
        return []
    return [light]


def _seen(light: DiscLight, directions: FloatArray) -> FloatArray:
    """Directions (n, 3), ICRS, in image axes while their own pixels are lit."""
    image_directions = directions @ light.icrs_to_image.T
    if light.shear is None:
        return np.asarray(image_directions)
    x_px, y_px = light.camera.project(image_directions)
    late_s = np.nan_to_num(light.shear.late_s(x_px, y_px))
    turned = np.cross(light.shear.rate_image_rad_s, image_directions)
    return np.asarray(image_directions - late_s[:, None] * turned)


def _stretch(light: DiscLight, directions: FloatArray) -> FloatArray:
    """How many times as large as at rest the image about directions (n, 3), ICRS, is: what moves
    by a share s of the rows that light up meanwhile is lit in 1 / (1 - s) of them.
    """
    shear = light.shear
    if shear is None:
        return np.ones(len(directions))
    image_directions = directions @ light.icrs_to_image.T
    turned = np.cross(shear.rate_image_rad_s, image_directions)
    x_px, y_px = light.camera.project(image_directions)
    later_x_px, later_y_px = light.camera.project(image_directions - STEP_S * turned)
    s_per_column, s_per_row = shear.s_per_px
    right_px_s = (later_x_px - x_px) / STEP_S
    down_px_s = (later_y_px - y_px) / STEP_S
    share = np.nan_to_num(s_per_column * right_px_s + s_per_row * down_px_s)
    return np.asarray(1 / (1 - np.clip(share, -MAX_SHARE, MAX_SHARE)))


def _disc_map(light: DiscLight, nodes: int) -> LightMap | None:
    """The sum of the disc's places, each spread as a star is; its air, if any, is too thin to be
    seen.
    """
    disc = light.disc
    camera = light.camera
    reach_px = light.psf.footprint_px / 2
    lit = _places(light, disc, nodes)
    whole = lit
    if light.covers:
        whole = _places(light, replace(disc, law="uniform"), nodes)
    if not len(whole.x_px):
        return None
    left = float(whole.x_px.min()) - reach_px
    top = float(whole.y_px.min()) - reach_px
    right = float(whole.x_px.max()) + reach_px + 1
    bottom = float(whole.y_px.max()) + reach_px + 1
    edges = (left, top, right, bottom)
    region = clipped(edges, camera.resolution_px)
    if region is None:
        return None
    cover = None
    if light.covers:
        # Pixels to a steradian at the disc's middle: nearly the same over a small disc
        u, v, w = light.icrs_to_image @ disc.direction
        slopes = camera.slopes(np.array([u / w]), np.array([v / w]))
        px2_per_tangent2 = np.nan_to_num(slopes.areas)[0]
        px_per_sr = float(px2_per_tangent2 / abs(w) ** 3)
        share = light.psf.spread(whole.x_px, whole.y_px, whole.law_sr * px_per_sr, region)
        cover = np.where(share > WHOLE, np.float32(1), share)
    rates = light.times * disc.normal_e_per_s_sr * lit.law_sr
    image = light.psf.spread(lit.x_px, lit.y_px, rates, region)
    return LightMap(image, (region[0], region[1]), 1.0, cover, disc.name, lasting=False)


class FacePlaces(NamedTuple):
    """Places of a disc's face in pixels, and the value of its law times the steradians of each,
    (n,) each.
    """

    x_px: FloatArray
    y_px: FloatArray
    law_sr: FloatArray


def _places(light: DiscLight, disc: Disc, nodes: int) -> FacePlaces:
    """The places of a disc's face that have a pixel, and their light."""
    directions, law_sr = disc.points(nodes)
    law_sr = law_sr * _stretch(light, directions)
    x_px, y_px = light.camera.project(_seen(light, directions))
    known = np.isfinite(x_px)
    if known.all():
        return FacePlaces(x_px, y_px, law_sr)
    return FacePlaces(x_px[known], y_px[known], law_sr[known])
