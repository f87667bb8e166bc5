"""The glass of a lens whose rays are a closed form, in place of those that optiland traces: an
aplanat, which keeps Abbe's sine condition, so that its PSF is Airy's.

Its light is even over direction cosines. A pupil that is cut to an ellipse, or is round at places
that are unevenly far from each other, is as good as the circle of the same edge.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import j1

from hilstar.basics.arrays import FloatArray
from hilstar.optics.glass import prescription
from hilstar.optics.glass.lens_data import FieldPoint
from hilstar.optics.glass.prescription import Plate, traced
from tests.support.refusals import refusal

FOCAL_MM, F_NUMBER, UM = 50.0, 4.0, 0.5
NA = 1 / (2 * F_NUMBER)
FIELD_TANGENT = 0.05
PITCH_UM = 4.0
# A circle that 96 cells count across: their edges' parts are known to an eighth of a cell.
AIRY_OF_PEAK = 2e-3
# of all light: sums of five samples a pixel against nine, 0.8 um apart; measured 3e-3
FRINGES = 6e-3
MOVED_PX = 1e-5  # slopes by differences of a ray's places; Newton's rounds end at rounding
MOMENT = 0.01  # the circle's edge, as above, squared; and shares of four samples


class Aplanat:
    """What the glass asks of an optic of optiland's. `crowding` puts the pupil's places nearer to
    the middle; `cut` is the share of the pupil that is cut off along x and y.

    As optiland's does, it cuts by its fields' factors itself. Its detector's middle is at
    `detector_mm`; the image of a `relay` is turned round, and its focal length counts below 0.
    """

    def __init__(
        self,
        max_field: float = 1.0,
        crowding: float = 0.0,
        cut: tuple[float, float] = (0.0, 0.0),
        relay: bool = False,
        detector_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.crowding = crowding
        self.detector_mm = detector_mm
        self.upright = -1 if relay else 1
        self.object_surface = SimpleNamespace(is_infinite=True)
        edge = SimpleNamespace(x=0.0, y=max_field, vx=cut[0], vy=cut[1])
        self.fields = SimpleNamespace(max_field=max_field, fields=[edge])
        wave = SimpleNamespace(value=UM)
        self.wavelengths = SimpleNamespace(wavelengths=[wave])
        self.primary_wavelength = UM
        focal_mm = self.upright * FOCAL_MM
        self.paraxial = SimpleNamespace(f2=lambda: focal_mm, FNO=lambda: [F_NUMBER])
        frame = SimpleNamespace(get_effective_transform=lambda: (detector_mm, np.eye(3)))
        self.image_surface = SimpleNamespace(geometry=SimpleNamespace(cs=frame))
        generator = SimpleNamespace(generate_rays=self.generate_rays)
        self.ray_tracer = SimpleNamespace(ray_generator=generator)

    def generate_rays(self, hx, hy, px, py, um):
        """Rays that enter: parallel, from places in the plane of the pupil, mm."""
        scale = FIELD_TANGENT if self.fields.max_field else 0.0
        length = np.sqrt(1 + scale**2 * (hx**2 + hy**2))
        (edge,) = self.fields.fields
        px = px * (1 - edge.vx)
        py = py * (1 - edge.vy)
        radius = np.hypot(px, py)
        at = FOCAL_MM * NA * ((1 - self.crowding) + self.crowding * radius**2)
        return SimpleNamespace(
            x=at * px, y=at * py, z=np.zeros_like(px),
            L=scale * hx / length, M=scale * hy / length, N=1 / length,
        )  # fmt: skip

    def trace_generic(self, hx, hy, px, py, um):
        """Rays at the image: all of a field in one point, in phase; those far beyond the pupil are
        lost.
        """
        hx, hy, px, py = np.broadcast_arrays(hx, hy, px, py)
        start = self.generate_rays(hx, hy, px, py, um)
        is_lost = np.hypot(px, py) > 1.2
        right_mm, down_mm, along_mm = self.detector_mm
        x = np.where(is_lost, np.nan, self.upright * FOCAL_MM * start.L / start.N) + right_mm
        y = self.upright * FOCAL_MM * start.M / start.N + down_mm
        cos_x = self.upright * (start.L - start.x / FOCAL_MM)
        cos_y = self.upright * (start.M - start.y / FOCAL_MM)
        return SimpleNamespace(
            x=x, y=y, z=np.full_like(x, along_mm),
            L=cos_x, M=cos_y, N=np.sqrt(1 - cos_x**2 - cos_y**2),
            opd=100.0 - start.L * start.x - start.M * start.y,
            i=np.where(is_lost, 0.0, 1.0),
        )  # fmt: skip


def airy(stretch_x: float, stretch_y: float, off_mm: FloatArray) -> FloatArray:
    """Airy's pattern, 1 at its peak, of a pupil that is stretched (Born and Wolf, 8.5.2)."""
    x_mm, y_mm = np.meshgrid(off_mm * stretch_x, off_mm * stretch_y)
    v = 2 * np.pi * NA / (UM * 1e-3) * np.hypot(x_mm, y_mm)
    near = np.where(v == 0, 1.0, v)
    return np.where(v == 0, 1.0, (2 * j1(near) / near) ** 2)


@pytest.mark.parametrize(
    ("crowding", "cut"),
    [(0.0, (0.0, 0.0)), (0.3, (0.0, 0.0)), (0.0, (0.3, 0.0)), (0.0, (0.0, 0.2))],
)
def test_an_aplanat_s_psf_is_airys(crowding, cut):
    """Its peak is pi NA^2 / lambda^2 of the light to an area, by the cut pupil's own area."""
    per_px = 8
    plate = Plate((9, 9), PITCH_UM, half_px=3)
    glass = traced(Aplanat(0.0, crowding, cut), plate, per_px, 1e-6, "a closed form").glass
    image = glass.images[0, 0, 0] * (1 - glass.outside[0, 0, 0])
    side = image.shape[0]
    step_mm = PITCH_UM * 1e-3 / per_px
    wide, high = (1 - part for part in cut)
    pattern = airy(wide, high, (np.arange(side) - side // 2) * step_mm)
    peak = np.pi * wide * high * (NA * step_mm / (UM * 1e-3)) ** 2
    assert image / peak == pytest.approx(pattern, abs=AIRY_OF_PEAK)


def test_a_pixel_has_the_light_of_all_its_fringes():
    """A sample of 4 um, where the pattern's own are 1 um apart, has the sum of finer ones."""
    plate = Plate((9, 9), PITCH_UM, half_px=3)
    whole, fine = (
        traced(Aplanat(0.0), plate, per_px, 1e-6, "a closed form").glass for per_px in (1, 9)
    )
    light = [made.images[0, 0, 0] * (1 - made.outside[0, 0, 0]) for made in (whole, fine)]
    by_pixel = np.pad(light[1], 4).reshape(7, 9, 7, 9).sum(axis=(1, 3))
    assert light[0] == pytest.approx(by_pixel, abs=FRINGES)


def test_rays_are_as_many_as_keep_the_next_image_of_the_star_off_its_stamp(monkeypatch):
    """The sum of plane waves repeats: with six rays across the pupil after 12 um, at the edge of
    this stamp.
    """
    monkeypatch.setattr(prescription, "MIN_RAYS", 6)
    plate = Plate((9, 9), PITCH_UM, half_px=3)
    glass = traced(Aplanat(0.0), plate, 2, 1e-6, "a closed form").glass
    image = glass.images[0, 0, 0]
    assert image[:, [0, -1]].max() < 0.01 * image.max()


@pytest.mark.parametrize(
    ("relay", "detector_mm"), [(False, (0.0, 0.0, 0.0)), (True, (0.3, -0.2, 60.0))]
)
def test_an_aplanat_has_a_pinhole_s_camera_and_an_even_field(relay, detector_mm):
    focus_um = 8.0
    plate = Plate((401, 301), PITCH_UM, (focus_um,), half_px=2)
    lens = Aplanat(relay=relay, detector_mm=detector_mm)
    made = traced(lens, plate, 2, 1e-3, "a closed form")
    assert made.focal_length_mm == pytest.approx(FOCAL_MM, rel=1e-9)
    assert (*made.glass.lens.radial, *made.glass.lens.tangential) == pytest.approx(
        [0] * 5, abs=1e-6
    )
    # at a focus of z a chief ray is farther from the middle by z / f of its place
    moved_px = (made.glass.places_px - [200, 150]) * focus_um * 1e-3 / FOCAL_MM
    assert np.abs(moved_px).max() == pytest.approx(0.032)
    assert made.glass.lateral_px[:, 0, 0] == pytest.approx(moved_px, abs=MOVED_PX)
    corners = [[0, 0], [400, 0], [0, 300], [400, 300]]
    assert set(map(tuple, corners)) <= set(map(tuple, made.glass.places_px.tolist()))
    # the beam's area is the pupil's, seen at the field's angle
    off_mm = (made.glass.places_px - [200, 150]) * PITCH_UM * 1e-3
    cosine = 1 / np.sqrt(1 + (np.hypot(*off_mm.T) / FOCAL_MM) ** 2)
    assert made.glass.illumination[:, 0, 0] == pytest.approx(cosine, rel=1e-6)


@pytest.mark.parametrize("defocus_um", [-2000.0, 2000.0])
def test_a_wide_image_is_the_cone_of_its_rays(defocus_um):
    """Stamps of so many fringes are counted ray by ray: of rays even over direction cosines the
    mean square of a tangent is -(NA^2 + log(1 - NA^2)) / NA^2, half of it along each axis.
    """
    plate = Plate((9, 9), 30.0, (defocus_um,), half_px=16)
    glass = traced(Aplanat(0.0), plate, 1, 1e-6, "a closed form").glass
    image = glass.images[0, 0, 0]
    off_px = np.arange(33) - 16
    tangent2 = -(NA**2 + np.log(1 - NA**2)) / NA**2
    # light that is shared by two samples, evenly between them, is wider by 1/6 px^2
    variance_px2 = tangent2 / 2 * (defocus_um / 30.0) ** 2 + 1 / 6
    assert glass.outside == pytest.approx(0, abs=1e-9)
    for axis in (0, 1):
        line = image.sum(axis=axis)
        assert line @ off_px == pytest.approx(0, abs=MOMENT)
        assert line @ off_px**2 == pytest.approx(variance_px2, rel=MOMENT)


def rays_of(lens: Aplanat) -> prescription._LensRays:
    return prescription._LensRays(lens, (FieldPoint(0.0, 0.0),))


def test_rays_are_placed_by_a_tilted_detector_s_own_axes(rng):
    turn = Rotation.from_euler("xyz", [3.0, -2.0, 5.0], degrees=True)
    detector_mm = (0.3, -0.2, 60.0)
    lens = Aplanat(detector_mm=detector_mm)
    frame = SimpleNamespace(get_effective_transform=lambda: (detector_mm, turn.as_matrix()))
    lens.image_surface = SimpleNamespace(geometry=SimpleNamespace(cs=frame))
    places_mm = np.column_stack([rng.uniform(-5, 5, (20, 2)), np.zeros(20)])
    directions = rng.normal(size=(20, 3))
    x, y, z = (turn.apply(places_mm) + detector_mm).T
    right, down, along = turn.apply(directions).T
    ends = SimpleNamespace(x=x, y=y, z=z, L=right, M=down, N=along)
    at_mm, cosines = rays_of(lens).at_image(ends)
    assert pytest.approx(places_mm[:, :2], abs=1e-12) == at_mm.T
    assert pytest.approx(directions, abs=1e-12) == cosines.T


def test_wavelengths_rise_each_once_and_figures_are_sizes():
    lens = Aplanat(relay=True)
    lens.wavelengths.wavelengths = [SimpleNamespace(value=um) for um in (0.65, 0.45, 0.5, 0.45)]
    rays = rays_of(lens)
    assert rays.wavelengths_um == [0.45, 0.5, 0.65]
    assert (rays.focal_length_mm, rays.f_number) == (FOCAL_MM, F_NUMBER)


def without_power(lens: Aplanat) -> None:
    lens.paraxial.f2 = lambda: np.array([np.inf])


def without_wavelengths(lens: Aplanat) -> None:
    lens.wavelengths.wavelengths = []


def of_a_near_object(lens: Aplanat) -> None:
    lens.object_surface.is_infinite = False


def without_its_middle(lens: Aplanat) -> None:
    trace = lens.trace_generic

    def traced_beside_it(hx, hy, px, py, um):
        rays = trace(hx, hy, px, py, um)
        rays.x = np.where(np.hypot(hx, hy) == 0, np.nan, rays.x)
        return rays

    lens.trace_generic = traced_beside_it


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_power, "no focal length or no wavelength"),
        (without_wavelengths, "no focal length or no wavelength"),
        (of_a_near_object, "its object is near"),
        (without_its_middle, "the chief ray of its field's middle is lost"),
    ],
)
def test_a_lens_that_is_none_for_stars_is_refused(change, words):
    lens = Aplanat()
    change(lens)
    assert words in refusal(rays_of, lens)
