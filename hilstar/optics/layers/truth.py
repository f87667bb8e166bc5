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
    truth["hip"], truth["name"] = stars.hip[star], stars.names(star)
    truth["x_px"], truth["y_px"] = x_px, y_px
    truth["v_mag"], truth["bv"] = stars.v_mag[star], stars.bv_mag[star]
    truth["temperature_k"] = stars.temperature_k[star]
    truth["electrons_per_s"] = stars.electrons_per_s[star]
    truth["drawn"] = True
    truth["sigma_pos_mas"] = truth["sigma_mag"] = np.nan
    truth["ra_deg"], truth["dec_deg"] = to_radec_deg(stars.directions(star))
    listed = stars.row[star] >= 0
    row = stars.row[star[listed]]
    catalog = stars.catalog
    truth["variable"][listed], truth["double"][listed] = (
        catalog.variable[row],
        catalog.multiple[row],
    )
    for name in ("range_mag", "period_d", "separation_arcsec"):
        truth[name] = np.nan
        # Back to the catalogue's decimals from float32.
        truth[name][listed] = np.round(getattr(catalog, name)[row].astype(np.float64), 3)
    return truth


def with_channels(truth: npt.NDArray[np.void], colours: FloatArray | None) -> npt.NDArray[np.void]:
    """Rows (n,) with the electrons per second of each channel of a tracker of three, by its shares
    (n, 3) of a star's.

    `colours` None, of a tracker with one channel: the rows themselves.
    """
    if colours is None:
        light = None
    else:
        light = dict(
            zip(
                CHANNEL_COLUMNS,
                (truth["electrons_per_s"] * part for part in colours.T),
                strict=True,
            )
        )
    if light is None:
        return truth
    return with_columns(truth, light)


def with_errors(
    truth: npt.NDArray[np.void], catalog: Catalog, epoch_jyear: float
) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE with the errors of their stars: of V, and of a place at `epoch_jyear`,
    rms of its two axes.

    Both stay NaN for bodies, and for stars that have no errors in their `catalog`, whose facts are
    read here.
    """
    listed = np.flatnonzero(truth["hip"] > 0)
    # a tenth of the time that sorting a catalogue takes
    near = np.flatnonzero(np.isin(catalog.hip, truth["hip"][listed]))
    order = near[np.argsort(catalog.hip[near])]
    stars = catalog.taken(order[np.searchsorted(catalog.hip[order], truth["hip"][listed])])
    facts = errors_of(stars)
    covariance = motion_at(stars, facts, epoch_jyear).covariance
    table = truth.copy()
    table["sigma_pos_mas"][listed] = np.round(
        np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2), ERROR_DECIMALS
    )
    table["sigma_mag"][listed] = np.round(sigma_v_mag(facts, stars.bv_mag), ERROR_DECIMALS)
    return table


def designations(stars: Stars, sprites: FrameLight, which: IntArray) -> tuple[int | str, ...]:
    """The stars of the sprites at positions `which` (n,), each once: HIP numbers, or names
    without one.
    """
    star = np.unique(sprites.star[which])
    added = dict.fromkeys(sprites.added[-1 - k].name for k in star[star < 0])
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
        x_px, y_px = (np.bincount(which, light * places) / total for places in (x_px, y_px))
        star = once
    truth = truth_table(stars, star, x_px, y_px)
    truth["clipped"] = (
        over[is_star] if len(star) == is_star.sum() else np.isin(star, sprites.star[over])
    )
    if not sprites.added:
        return truth, star
    added = added_truth(sprites, over)
    return np.concatenate([truth, added]), np.concatenate([star, np.unique(sprites.star[~is_star])])


def added_truth(sprites: FrameLight, over: npt.NDArray[np.bool_]) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE for the light that faults add, by the index of each; `over` (n,) says
    which sprites clip.
    """
    of_added = np.flatnonzero(sprites.star < 0)
    star, line = np.unique(sprites.star[of_added], return_inverse=True)
    light = sprites.data["electrons_per_s"][of_added].astype(np.float64)
    rows = np.zeros(len(star), dtype=TRUTH_DTYPE)
    total = np.bincount(line, light, minlength=len(star))
    for name, places in (("x_px", sprites.x_px), ("y_px", sprites.y_px)):
        rows[name] = np.bincount(line, light * places[of_added], minlength=len(star)) / total
    for k, added in enumerate(sprites.added[-1 - index] for index in star.tolist()):
        rows[k]["name"], rows[k]["v_mag"], rows[k]["bv"] = added.name, added.v_mag, added.bv_mag
        rows[k]["electrons_per_s"] = added.electrons_per_s
    for name in (
        "temperature_k",
        "range_mag",
        "period_d",
        "separation_arcsec",
        "sigma_pos_mas",
        "sigma_mag",
        "ra_deg",
        "dec_deg",
    ):
        rows[name] = np.nan
    rows["drawn"] = True
    rows["clipped"] = np.bincount(line, over[of_added], minlength=len(star)) > 0
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
    brightest = inside[np.argsort(stars.v_mag[star_rows[inside]], kind="stable")][:count]
    star_rows = star_rows[brightest]
    cam = cam[brightest]
    vectors = vectors[brightest]
    x_px = x_px[brightest]
    y_px = y_px[brightest]
    off_rad = np.arctan2(np.hypot(cam[:, 0], cam[:, 1]), cam[:, 2])
    ra_deg, dec_deg = to_radec_deg(vectors)
    constellations: list[str] = []
    if len(star_rows):
        # takes half a second, which only this needs
        from astropy.coordinates import SkyCoord, get_constellation

        # IAU boundaries of 1930
        constellations = []
        for name in get_constellation(SkyCoord(ra_deg, dec_deg, unit="deg")):
            constellations.append(str(name))
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
