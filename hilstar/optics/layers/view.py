"""From where and when an image is lit, on what, and what a layer of light is."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import to_matrix
from hilstar.optics.camera import Camera
from hilstar.optics.exposure_motion import Motion
from hilstar.optics.frame_motion import CameraTurn
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight
from hilstar.sky.stars import Stars

# A wider disc moves light by more than a point's sprite does: 0.2 px across widens a sigma of 0.85
# px by 0.2 %.
POINT_PX = 0.2

STILL = np.zeros(3)
AT_ONCE = Scan()


class Observer(NamedTuple):
    """When and from where the sky is seen, in the order in which `MovingSky` takes it."""

    t_ns: int | None
    velocity_km_s: FloatArray | None
    place_km: FloatArray | None


@dataclass(frozen=True, slots=True)
class View:
    """From where, when and for how long one looks.

    `rate_cam_rad_s` (3,) is the rate of cam in icrs in cam components, constant while light
    arrives; None for a still picture, whose light has its middle at the moment of the attitude.
    With a rate `q_icrs_to_cam` (4,) is the attitude when the middle row of `scan` lights up, or, in
    a view that is `exposed`, the attitude in the middle of the exposure.

    The sky is that of `t_ns` (None: the start) for an observer with `velocity_km_s` (3,), ICRS,
    relative to the bench's own observer, and `place_km` (3,), ICRS axes from the Earth's centre;
    None for the bench's own (see `MovingSky.seen`).
    """

    q_icrs_to_cam: FloatArray
    rate_cam_rad_s: FloatArray | None = None
    t_ns: int | None = None
    velocity_km_s: FloatArray | None = None
    place_km: FloatArray | None = None
    scan: Scan = AT_ONCE
    exposed: bool = False

    @classmethod
    def exposure(
        cls,
        q_icrs_to_cam: FloatArray,
        rate_cam_rad_s: FloatArray,
        exposure_s: float,
        t_ns: int | None = None,
        velocity_km_s: FloatArray | None = None,
        place_km: FloatArray | None = None,
    ) -> "View":
        """The view of a detector whose pixels all collect light for `exposure_s`; `t_ns` is the
        middle of that time.
        """
        scan = Scan(hold_s=exposure_s)
        return cls(q_icrs_to_cam, rate_cam_rad_s, t_ns, velocity_km_s, place_km, scan, exposed=True)

    @property
    def exposure_s(self) -> float:
        """How long a pixel has light."""
        return self.scan.hold_s

    @property
    def observer(self) -> Observer:
        """When and from where the sky is seen."""
        return Observer(self.t_ns, self.velocity_km_s, self.place_km)

    @property
    def turns(self) -> bool:
        """Whether the camera turns while light arrives."""
        return self.rate_cam_rad_s is not None and bool(self.rate_cam_rad_s.any())

    @property
    def turn(self) -> CameraTurn:
        """The attitude and the rate; at rest a rate of 0."""
        if self.rate_cam_rad_s is None:
            return CameraTurn(self.q_icrs_to_cam, STILL)
        return CameraTurn(self.q_icrs_to_cam, self.rate_cam_rad_s)

    @property
    def motion(self) -> Motion:
        """The same as an exposure."""
        return Motion(self.q_icrs_to_cam, self.turn.rate_cam_rad_s, self.exposure_s, self.t_ns)

    @property
    def rows(self) -> Scan:
        """How the image lights up: a still picture's rows all at once."""
        if self.rate_cam_rad_s is not None:
            return self.scan
        return Scan(hold_s=self.scan.hold_s)

    @property
    def begin_s(self) -> float:
        """When the middle row's light begins, from the moment of the attitude."""
        if self.exposed or self.rate_cam_rad_s is None:
            return -self.scan.hold_s / 2
        return 0.0

    def icrs_to_image(self, camera: Camera) -> FloatArray:
        """The matrix (3, 3) from ICRS to image axes at the moment of the attitude."""
        return camera.cam_to_image @ to_matrix(self.q_icrs_to_cam)


@dataclass(frozen=True, slots=True)
class Canvas:
    """An image on which layers draw: its camera, and how a point is spread on it.

    A pixel shows up to `white_e_per_s` on a screen, or `full_e` electrons in a detector's exposure.
    A screen shows nothing of less light than its `first_step_e_per_s`.
    """

    camera: Camera
    psf: Psf
    white_e_per_s: float = math.inf
    full_e: float = math.inf
    first_step_e_per_s: float = 0.0

    def white_in(self, view: View) -> float:
        """The largest rate that a pixel shows in a view, electrons per second."""
        return min(self.white_e_per_s, self.full_e / (view.scan.hold_s or 1.0))


class Layer(Protocol):
    """One kind of light in an image, or what takes light away. Layers are applied in order (see
    `layers.light_of`).
    """

    def add(self, light: FrameLight, stars: Stars, view: View) -> FrameLight:
        """The light of the layers before, together with this layer's; `stars` are as seen in the
        view.
        """
