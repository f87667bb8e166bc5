"""The truth of an image: which stars are in it, where, and how bright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray, with_columns
from hilstar.basics.rotation import to_matrix, to_radec_deg
from hilstar.optics.camera import Camera
from hilstar.optics.layers.bodies import disc_stars
from hilstar.optics.sprites import FrameLight
from hilstar.sky.catalog import Catalog
from hilstar.sky.facts import errors_of, motion_at, sigma_v_mag
from hilstar.sky.stars import Stars

ERROR_DECIMALS = 4  # errors in a written table
CHANNEL_COLUMNS = ("electrons_r_per_s", "electrons_g_per_s", "electrons_b_per_s")

TRUTH_DTYPE = np.dtype(
    [
        ("hip", "i4"),
        ("x_px", "f8"),
        ("y_px", "f8"),
        ("v_mag", "f8"),
        ("bv", "f8"),
        ("temperature_k", "f8"),
        ("electrons_per_s", "f8"),
        ("drawn", "?"),
        ("clipped", "?"),
        ("variable", "U1"),
        ("range_mag", "f8"),
        ("period_d", "f8"),
        ("double", "U1"),
        ("separation_arcsec", "f8"),
        ("name", "U32"),
        ("sigma_pos_mas", "f8"),
        ("sigma_mag", "f8"),
        ("ra_deg", "f8"),
        ("dec_deg", "f8"),
    ]
)
# what light that a fault adds has not, as it is no catalogue's
UNKNOWN_OF_ADDED = (
    *("temperature_k", "range_mag", "period_d", "separation_arcsec"),
    *("sigma_pos_mas", "sigma_mag", "ra_deg", "dec_deg"),
)


def clipped_in(truth: npt.NDArray[np.void]) -> list[int | str]:
    """The rows of a table of TRUTH_DTYPE that clip: HIP numbers, or names without one."""
    rows = truth[truth["clipped"]]
    return [
        name or hip for name, hip in zip(rows["name"].tolist(), rows["hip"].tolist(), strict=True)
    ]


def truth_table(
    stars: Stars, star: IntArray, x_px: FloatArray, y_px: FloatArray
) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE for the stars at the indices `star` (n,) of `stars`: all drawn, none
    clipped yet.

    `ra_deg` and `dec_deg` are where `stars` have them, ICRS axes: with aberration and the air, as
    they are drawn.
    """
    truth = np.zeros(len(star), dtype=TRUTH_DTYPE)
    truth["hip"] = stars.hip[star]
    truth["name"] = stars.names(star)
    truth["x_px"] = x_px
    truth["y_px"] = y_px
    truth["v_mag"] = stars.v_mag[star]
    truth["bv"] = stars.bv_mag[star]
    truth["temperature_k"] = stars.temperature_k[star]
    truth["electrons_per_s"] = stars.electrons_per_s[star]
    truth["drawn"] = True
    truth["sigma_pos_mas"] = np.nan
    truth["sigma_mag"] = np.nan
    ra_deg, dec_deg = to_radec_deg(stars.directions(star))
    truth["ra_deg"] = ra_deg
    truth["dec_deg"] = dec_deg
    listed = stars.row[star] >= 0
    row = stars.row[star[listed]]
    catalog = stars.catalog
    truth["variable"][listed] = catalog.variable[row]
    truth["double"][listed] = catalog.multiple[row]
    for name in ("range_mag", "period_d", "separation_arcsec"):
        truth[name] = np.nan
        values = getattr(catalog, name)[row]
        # Back to the catalogue's decimals from float32.
        truth[name][listed] = np.round(values.astype(np.float64), 3)
    return truth


def with_channels(truth: npt.NDArray[np.void], colours: FloatArray | None) -> npt.NDArray[np.void]:
    """Rows (n,) with the electrons per second of each channel of a tracker of three, by its shares
    (n, 3) of a star's.

    `colours` None, of a tracker with one channel: the rows themselves.
    """
    if colours is None:
        return truth
    light = {}
    for name, share in zip(CHANNEL_COLUMNS, colours.T, strict=True):
        light[name] = truth["electrons_per_s"] * share
    return with_columns(truth, light)


def without_errors(rows: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """The rows as they are: of a frame whose stars have no errors at hand."""
    return rows


def with_errors(
    truth: npt.NDArray[np.void], catalog: Catalog, epoch_jyear: float
) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE with the errors of their stars: of V, and of a place at `epoch_jyear`,
    rms of its two axes.

    Both stay NaN for bodies, and for stars that have no errors in their `catalog`, whose facts are
    read here.
    """
    listed = np.flatnonzero(truth["hip"] > 0)
    hips = truth["hip"][listed]
    # a tenth of the time that sorting a catalogue takes
    near = np.flatnonzero(np.isin(catalog.hip, hips))
    order = near[np.argsort(catalog.hip[near])]
    place = np.searchsorted(catalog.hip[order], hips)
    stars = catalog.taken(order[place])
    facts = errors_of(stars)
    covariance = motion_at(stars, facts, epoch_jyear).covariance
    variance_mas2 = (covariance[:, 0, 0] + covariance[:, 1, 1]) / 2
    sigma_mag = sigma_v_mag(facts, stars.bv_mag)
    table = truth.copy()
    table["sigma_pos_mas"][listed] = np.round(np.sqrt(variance_mas2), ERROR_DECIMALS)
    table["sigma_mag"][listed] = np.round(sigma_mag, ERROR_DECIMALS)
    return table


def designations(stars: Stars, sprites: FrameLight, which: IntArray) -> tuple[int | str, ...]:
    """The stars of the sprites at positions `which` (n,), each once: HIP numbers, or names
    without one.
    """
    star = np.unique(sprites.star[which])
    added: dict[str, None] = {}
    for k in star[star < 0].tolist():
        added[sprites.added[-1 - k].name] = None
    return (*stars.designations(star[star >= 0]), *added)


def sprite_names(stars: Stars, sprites: FrameLight) -> list[int | str]:
    """The star of each sprite: its HIP number, or its name without one."""
    star_names = iter(stars.designations(sprites.star[sprites.star >= 0]))
    names: list[int | str] = []
    for star in sprites.star.tolist():
        if star < 0:
            names.append(sprites.added[-1 - star].name)
        else:
            names.append(next(star_names))
    return names


def sprite_truth(
    stars: Stars, sprites: FrameLight, clipped: IntArray
) -> tuple[npt.NDArray[np.void], IntArray]:
    """Rows of TRUTH_DTYPE for the stars of sprites, all drawn, and their indices (n,); `clipped`
    are positions of sprites.

    Light that a fault adds has a row too, with its name, at the middle of its sprites.
    """
    over = np.zeros(len(sprites), dtype=bool)
    over[clipped] = True
    is_star = sprites.star >= 0
    star = sprites.star[is_star]
    x_px = sprites.x_px[is_star]
    y_px = sprites.y_px[is_star]
    once, which = np.unique(star, return_inverse=True)
    if len(once) < len(star):  # each star once, a satellite in the middle of its streak's light
        light = sprites.data["electrons_per_s"][is_star].astype(np.float64)
        total = np.bincount(which, light)
        x_px = np.bincount(which, light * x_px) / total
        y_px = np.bincount(which, light * y_px) / total
        star = once
    truth = truth_table(stars, star, x_px, y_px)
    if len(star) == is_star.sum():
        truth["clipped"] = over[is_star]
    else:
        truth["clipped"] = np.isin(star, sprites.star[over])
    if not sprites.added:
        return truth, star
    added = added_truth(sprites, over)
    added_index = np.unique(sprites.star[~is_star])
    return np.concatenate([truth, added]), np.concatenate([star, added_index])


def added_truth(sprites: FrameLight, over: npt.NDArray[np.bool_]) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE for the light that faults add, by the index of each; `over` (n,) says
    which sprites clip.
    """
    of_added = np.flatnonzero(sprites.star < 0)
    index, line = np.unique(sprites.star[of_added], return_inverse=True)
    light = sprites.data["electrons_per_s"][of_added].astype(np.float64)
    total = np.bincount(line, light, minlength=len(index))
    moment_x = np.bincount(line, light * sprites.x_px[of_added], minlength=len(index))
    moment_y = np.bincount(line, light * sprites.y_px[of_added], minlength=len(index))
    rows = np.zeros(len(index), dtype=TRUTH_DTYPE)
    for name in UNKNOWN_OF_ADDED:
        rows[name] = np.nan
    rows["x_px"] = moment_x / total
    rows["y_px"] = moment_y / total
    for row, number in zip(rows, index.tolist(), strict=True):
        added = sprites.added[-1 - number]
        row["name"] = added.name
        row["v_mag"] = added.v_mag
        row["bv"] = added.bv_mag
        row["electrons_per_s"] = added.electrons_per_s
    rows["drawn"] = True
    rows["clipped"] = np.bincount(line, over[of_added], minlength=len(index)) > 0
    return rows


@dataclass(frozen=True, slots=True)
class StarInView:
    """A star in the field: its place in the sky (ICRS, apparent), in the image, and its angle from
    the boresight.

    A body has a `name`, and 0 for `hip`.
    """

    hip: int
    v_mag: float
    ra_deg: float
    dec_deg: float
    constellation: str
    x_px: float
    y_px: float
    from_boresight_deg: float
    name: str


def brightest_in_view(
    light: FrameLight, stars: Stars, camera: Camera, q_icrs_to_cam: FloatArray, count: int
) -> list[StarInView]:
    """The `count` brightest stars and bodies of a view's light that are on the camera's pixels, the
    brightest first.

    `stars` are those of the light, as seen at the attitude.
    """
    star_rows = np.union1d(light.star[light.star >= 0], disc_stars(stars, light.discs))
    vectors = stars.directions(star_rows)
    cam = vectors @ to_matrix(q_icrs_to_cam).T
    x_px, y_px = camera.project(cam @ camera.cam_to_image.T)
    inside = np.flatnonzero(camera.contains_px(x_px, y_px))
    brightest_first = np.argsort(stars.v_mag[star_rows[inside]], kind="stable")
    brightest = inside[brightest_first][:count]
    star_rows = star_rows[brightest]
    cam = cam[brightest]
    vectors = vectors[brightest]
    x_px = x_px[brightest]
    y_px = y_px[brightest]
    right, down, forward = cam.T
    off_rad = np.arctan2(np.hypot(right, down), forward)
    ra_deg, dec_deg = to_radec_deg(vectors)
    constellations: list[str] = []
    if len(star_rows):
        # takes half a second, which only this needs
        from astropy.coordinates import SkyCoord, get_constellation

        places = SkyCoord(ra_deg, dec_deg, unit="deg")
        # IAU boundaries of 1930
        constellations = [str(name) for name in get_constellation(places)]
    columns = (
        stars.hip[star_rows].tolist(),
        stars.v_mag[star_rows].tolist(),
        ra_deg.tolist(),
        dec_deg.tolist(),
        constellations,
        x_px.tolist(),
        y_px.tolist(),
        np.degrees(off_rad).tolist(),
        stars.names(star_rows),
    )
    return [StarInView(*row) for row in zip(*columns, strict=True)]
