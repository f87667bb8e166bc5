"""From found stars to an attitude: which star is which, by where they are expected or lost in
space, and Wahba's problem.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_matrix, normalise, to_matrix

MIN_STARS = 4  # identified, for an answer: three confirm a fourth
MIN_SHARE = 0.5  # part of the stars found that have to be the catalogue's
RADII_PX = (12.0, 3.0, 1.5)  # how far a found star may be from where it is expected, at each step
# a centroid's variance: 0.4 px^2 an electron, and the display's own share
CENTROID_E_PX2, CENTROID_FLOOR_PX = 0.4, 0.02
REFITS, REJECTED = 4, 4.0  # stars farther off than so many times the median are left out
FIELD_ERROR = 0.02  # share of the field of view that the database leaves open
GAIA_RECORD = np.dtype(
    [
        ("id", "<i8"),
        ("ra", "<f8"),
        ("dec", "<f8"),
        ("mag", "<f4"),
        ("pm_ra", "<f4"),
        ("pm_dec", "<f4"),
    ]
)  # of its catalogue's file: degrees, and motions of mas/yr


def wahba(seen: FloatArray, known: FloatArray, weight: FloatArray) -> FloatArray:
    """The rotation (4,), unit quaternion, that best turns directions `known` (n, 3) into `seen` (n,
    3); weights (n,).

    Wahba's problem by SVD (Markley 1988).
    """
    share = weight / weight.sum()
    profile = np.einsum("n,ni,nj->ij", share, seen, known)
    u, _, vt = np.linalg.svd(profile)
    # +1, or -1 where the product would be a reflection
    handedness = np.linalg.det(u) * np.linalg.det(vt)
    proper = np.diag([1.0, 1.0, handedness])
    return from_matrix(u @ proper @ vt)


@dataclass(frozen=True, slots=True)
class FoundStars:
    """Stars found in an image, brightest first: places (n,), px, signal (n,), e-, directions
    (n, 3), cam, unit, and the widths (m,), px, of the first m.
    """

    x_px: FloatArray
    y_px: FloatArray
    flux_e: FloatArray
    rays: FloatArray
    width_px: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.x_px)


@dataclass(frozen=True, slots=True)
class Identified:
    """An attitude q_icrs_to_cam and what it rests on: pairs (k,) of found stars and catalogue
    stars, and their rms, arcsec.
    """

    q_icrs_to_cam: FloatArray
    found: IntArray
    star: IntArray
    rms_rad: float


# Catalogue stars near an attitude: their numbers (m,), brightest first, and directions (m, 3),
# ICRS.
StarsNear = Callable[[FloatArray], tuple[IntArray, FloatArray]]
Place = Callable[[FloatArray], tuple[FloatArray, FloatArray]]  # pixels of directions (m, 3), cam


def identify(
    found: FoundStars, q_expected: FloatArray, stars_near: StarsNear, place: Place
) -> Identified | None:
    """The attitude near an expected one, by stars where they are expected; None where too few
    are there.
    """
    if len(found) < MIN_STARS:
        return None
    found_px = np.stack([found.x_px, found.y_px], axis=1)
    tree = KDTree(found_px)
    star, directions = stars_near(q_expected)
    variance_px2 = CENTROID_E_PX2 / np.maximum(found.flux_e, 1.0) + CENTROID_FLOOR_PX**2
    weight = 1 / variance_px2
    q = q_expected
    for step, radius_px in enumerate(RADII_PX):
        turned = directions @ to_matrix(q).T
        expected_x, expected_y = place(turned)
        expected_px = np.column_stack([expected_x, expected_y])
        inside = np.flatnonzero(np.isfinite(expected_px).all(axis=1))
        distance_px, neighbour = tree.query(expected_px[inside], distance_upper_bound=radius_px)
        is_near = np.isfinite(distance_px)
        # Of several catalogue stars near one find the brightest has it.
        pairs, first = np.unique(np.asarray(neighbour)[is_near], return_index=True)
        known = inside[is_near][first]
        # they all moved alike: those that did not are others
        if step == 0 and len(pairs) >= MIN_STARS:
            moved_px = found_px[pairs] - expected_px[known]
            rest_px = moved_px - np.median(moved_px, axis=0)
            apart_px = np.linalg.norm(rest_px, axis=1)
            alike = apart_px < RADII_PX[1]
            pairs = pairs[alike]
            known = known[alike]
        enough: float = MIN_STARS
        if step > 0:
            enough = max(MIN_STARS, MIN_SHARE * min(len(found), len(directions)))
        if len(pairs) < enough:
            return None
        q = wahba(found.rays[pairs], directions[known], weight[pairs])
    for _ in range(REFITS):  # a neighbour in a star's window pulls it away from where it is
        off_rad = _off_rad(found.rays[pairs], directions[known], q)
        misfit = off_rad**2 * weight[pairs]
        is_close = misfit <= REJECTED**2 * np.median(misfit)
        if is_close.all() or is_close.sum() < MIN_STARS:
            break
        pairs = pairs[is_close]
        known = known[is_close]
        q = wahba(found.rays[pairs], directions[known], weight[pairs])
    off_rad = _off_rad(found.rays[pairs], directions[known], q)
    mean_square = np.mean(off_rad**2) / 2
    rms_rad = float(np.sqrt(mean_square))
    return Identified(q, pairs, star[known], rms_rad)


def _off_rad(rays: FloatArray, directions: FloatArray, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The angles (n,) of rays (n, 3), cam, from directions (n, 3), ICRS, at an attitude."""
    expected = directions @ to_matrix(q_icrs_to_cam).T
    return np.asarray(np.linalg.norm(rays - expected, axis=1))


class LostInSpace:
    """Attitudes from stars alone, by `tetra3rs` (the extra hilstar[solve]) and a database of the
    given catalogue.

    `directions` (n, 3), ICRS unit vectors, and magnitudes (n,) are the stars that the tracker can
    see; the database is made of them in a second. Raises InputError where the extra is missing.
    """

    def __init__(
        self,
        directions: FloatArray,
        v_mag: FloatArray,
        focal_length_px: float,
        size_px: tuple[int, int],
    ) -> None:
        try:
            import tetra3rs
        except ImportError as error:
            raise InputError(
                '--solver tetra3: needs the extra hilstar[solve]; run pip install "hilstar[solve]",'
                " or write --solver truth"
            ) from error
        self._result = tetra3rs.SolveResult
        width, height = size_px
        self._camera = tetra3rs.CameraModel(
            focal_length_px=focal_length_px, image_width=width, image_height=height
        )
        half_tangent = width / 2 / focal_length_px
        field_deg = float(np.degrees(2 * np.arctan(half_tangent)))
        order = np.argsort(v_mag, kind="stable")
        rows = np.zeros(len(order), dtype=GAIA_RECORD)
        x, y, z = directions[order].T
        rows["id"] = order + 1
        rows["mag"] = v_mag[order]
        rows["ra"] = np.degrees(np.arctan2(y, x)) % 360
        rows["dec"] = np.degrees(np.arcsin(np.clip(z, -1, 1)))
        # tetra3rs's Gaia file: its mark, its version, the number of stars, and their rows
        version = np.array([1], "<u4")
        count = np.array([len(rows)], "<u8")
        header = b"GDR3" + version.tobytes() + count.tobytes()
        with tempfile.TemporaryDirectory(prefix="hilstar-") as folder:
            path = Path(folder) / "stars.bin"
            path.write_bytes(header + rows.tobytes())
            self._database = tetra3rs.SolverDatabase.generate_from_gaia(
                str(path),
                max_fov_deg=field_deg * (1 + FIELD_ERROR),
                min_fov_deg=field_deg * (1 - FIELD_ERROR),
                star_max_magnitude=float(v_mag.max()),
                epoch_proper_motion_year=None,  # the stars are where they are
            )

    def solve(self, slopes: FloatArray, flux_e: FloatArray) -> FloatArray | None:
        """q_icrs_to_cam of stars at slopes (n, 2) from the boresight (x / z and y / z in cam),
        brightest first; or None.
        """
        places = np.column_stack([slopes * self._camera.focal_length_px, flux_e])
        solved = self._database.solve_from_centroids(places, camera_model=self._camera)
        if isinstance(solved, self._result):
            return normalise(np.asarray(solved.quaternion))
        return None
