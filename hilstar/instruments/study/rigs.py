"""The study of published rigs: what panel, codes, camera and centroider predict of the figures that
their authors state, and what hilstar's codes would leave on the same panel.

LASSI's rig (Zhao, Lembeck et al. 2024) has the panel and the lens of README's bench. It lights one
pixel of code 100 a star: the pixel that the star falls into. Its static scatter is that of
attitudes over five minutes of a display that stands still. It is predicted by exposures of its
camera with its own two centroiders, and a PSF fit in the place of its network. One figure is not
stated, how bright a star is; it is taken from the scatter of the Gaussian grid across the
boresight, and the others follow. Sources stand beside each figure below.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import ndimage

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.charts import BLUE, GREEN, ORANGE, two_digits
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.study.engine import (
    ChartSpec,
    DotsSpec,
    PanelSpec,
    SeriesLook,
    draw_rows,
    write_rows,
)
from hilstar.instruments.study.study_benches import (
    FULL_HD,
    GLASS,
    Table,
    lone_errors,
    study_bench,
    turning_sprites,
)
from hilstar.optics.frame_motion import CameraTurn
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.frame import Bench
from hilstar.sky.catalog import load_catalog
from hilstar.tracker.centroiders import star_places
from hilstar.tracker.detector import Detector
from hilstar.tracker.identify import wahba
from hilstar.tracker.settings import DetectorSettings

LASSI, NAPLES, P13 = "LASSI, Illinois 2024", "Naples 2013", "P13XM015"
REPOSITORY = "HongruiZhao/CNNStarDetectCentroid, commit 89de519"
SIMULATOR = f"{REPOSITORY}: starfield_simulator/star_img_sim.py"
STATIC = f"{REPOSITORY}: post_analysis/attitude_analysis.ipynb; arXiv 2404.19108"
OUTSIDE = "measured outside hilstar: 233 stars to V 6, twelve attitudes"
NAPLES_SOURCE = "Rufino et al. 2013, Int. J. of Aerospace Engineering 505720, tables 6 and 11"
P13_SOURCE = "abstract of the paper on the P13XM015 star simulator"
# The panel and the lens, SIMULATOR: FEELWORLD F5, 110.690 mm of 1920 pixels, before 350 mm.
PANEL_PX, PIXEL_MM, LENS_MM = (1920, 1080), 0.05765109021605092, 350.0
PIXEL_ARCSEC = PIXEL_MM / LENS_MM * ARCSEC_PER_RAD
FAINTEST_V_MAG = 6.0
ATTITUDES, SEED = 12, 58
# The camera behind the panel: main_detection_centroiding.py has its focal length and principal
# point before this panel, px; the sensor is MT9V022.
CAMERA_PX, FOCAL_PX, PRINCIPAL_PX = (640, 480), 2686.74091, (343.471001, 225.697237)
PITCH_UM = 6.0
# data_generation/sim/star_img_sim.py: full well, bits, the PSF of its lens, and a read noise of the
# full well over 30 times a number from 0 to 1, whose sigma is a root of twelfths.
FULL_WELL_E, BITS, PSF_SIGMA_PX = 8500.0, 8, 0.85
GAIN_E_PER_DN = FULL_WELL_E / (2**BITS - 1)
READ_NOISE_E = FULL_WELL_E / 30 / math.sqrt(12)
# star_detection_centroiding.py: a dark frame's mean; main_detection_centroiding.py: 3 DN over the
# background, areas over 3 px, and 7 x 7 px for the centre of mass.
DARK_DN, THRESHOLD_DN, MIN_PIXELS, MASS_HALF_PX = 10.0, 3.0, 4, 3
GRID_HALF_PX, FIT_HALF_PX = 2, 4  # half sides of the squares of pixels that they use
EDGE_PX, MATCHED_PX = 5, 3.0
# Sigma over five minutes about the boresight and two axes across it, arcsec, STATIC.
SCATTER_ARCSEC = {
    "network": (52.55005572, 1.94877399, 4.68926435),
    "Gaussian grid": (143.73856869, 6.31878699, 13.00288255),
    "centre of mass": (245.87403888, 7.82633869, 24.36435366),
}
FITTED, LIGHT_UNIT = "Gaussian grid", "DN"
LIGHTS_DN = (34.0, 40.0, 48.0, 60.0, 80.0)
EXPOSURES, QUICK_EXPOSURES = 300, 40  # chance moves a sigma of so many by 4 and 11 %
# Naples: a panel of 0.641 m of 2560 pixels before 1.3 m (REPOSITORY, old_error_analysis.py); 16
# stars a solution, 22.48 x 17.02 degrees, 5 and 30 arcsec (NAPLES_SOURCE).
NAPLES_PIXEL_ARCSEC = 641.0 / 2560 / 1300.0 * ARCSEC_PER_RAD
NAPLES_STARS, NAPLES_FIELD_DEG, NAPLES_ARCSEC = 16, (22.48, 17.02), (30.0, 5.0)
TRIALS = 2000  # chance moves an rms of so many by 1.6 %
P13_RESOLUTION_ARCSEC, P13_ARCSEC = 3.43, 2.0
OUTSIDE_PIXEL_ARCSEC, OUTSIDE_CODES_ARCSEC, OUTSIDE_CODES_MAG = 10.30, 0.082, 0.0054
PLACE_UNIT = "arcsec rms an axis"
NOTE = (
    "Static scatter: the same light of a star in all rows. The network is predicted by a PSF"
    " fit. Light is in mag, all else in arcsec."
)
DOTS = (
    ("published", SeriesLook("published", ORANGE, "o", is_open=True)),
    ("predicted", SeriesLook("predicted", BLUE, "o", more={"ms": 4})),
    ("with_hilstar", SeriesLook("with hilstar's codes", GREEN, "D", more={"ms": 4})),
)
Places = tuple[FloatArray, FloatArray]
# Places (x, y) of stars whose coarse columns and rows (n,) were found in an image.
Finder = Callable[[FloatArray, IntArray, IntArray], Places]


@dataclass(frozen=True, slots=True)
class RigFigure:
    """A figure of a rig: what is published, what is predicted of it, and the difference.

    `with_hilstar` is the same with hilstar's codes on the same panel. NaN where there is none.
    """

    rig: str
    figure: str
    unit: str
    published: float
    predicted: float
    difference: float
    with_hilstar: float
    source: str

    @classmethod
    def of(
        cls,
        rig: str,
        figure: str,
        unit: str,
        published: float,
        predicted: float,
        source: str,
        *,
        with_hilstar: float = math.nan,
    ) -> "RigFigure":
        """A figure with its difference, published less predicted."""
        difference = published - predicted
        return cls(rig, figure, unit, published, predicted, difference, with_hilstar, source)


def run(directory: Path, quick: bool = False) -> list[str]:
    """Predict every figure, and write `rigs.csv` and its chart; a line for each. Raises
    InputError.
    """
    count = 4 if quick else ATTITUDES
    places = place_rows(count)
    codes_share = places[0].with_hilstar / places[0].predicted
    rows = [*places, *scatter_rows(quick), *constant_rows(codes_share)]
    rows += [*naples_rows(), *p13_rows()]
    write_rows(directory / "rigs.csv", rows)
    draw(directory / "rigs", rows)
    return [finding_of(rows), *map(line_of, rows)]


def attitudes(count: int) -> list[FloatArray]:
    """Random attitudes, evenly over the sky: `count` quaternions q_icrs_to_cam."""
    rng = np.random.default_rng(SEED)
    ra_deg = rng.uniform(0.0, 360.0, count)
    dec_sine = rng.uniform(-1.0, 1.0, count)
    dec_deg = np.degrees(np.arcsin(dec_sine))
    roll_deg = rng.uniform(0.0, 360.0, count)
    angles = zip(ra_deg, dec_deg, roll_deg, strict=True)
    quaternions = []
    for radec_roll_deg in angles:
        quaternions.append(from_radec_roll_deg(*radec_roll_deg))
    return quaternions


def place_rows(count: int) -> list[RigFigure]:
    """The errors of places and light on the panel, by one pixel a star and by hilstar's codes."""
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024), "transmission": GLASS},
        "sky": {"faintest_v_mag": FAINTEST_V_MAG},
        "monitor": {**FULL_HD, "bits": BITS},
        "collimator": {"focal_length_mm": LENS_MM},
        "render": {"quantisation": "exact"},
    }
    rounded = list[FloatArray]()
    placed = list[FloatArray]()
    light = list[float]()
    with TemporaryDirectory() as folder, study_bench(Path(folder) / "lassi.toml", tables) as bench:
        for q_icrs_to_cam in attitudes(count):
            turn = CameraTurn(q_icrs_to_cam, np.zeros(3))
            rounded.append(pixel_errors(bench, turn))
            levels = bench.draw(q_icrs_to_cam).levels
            errors = lone_errors(bench, turn, levels)
            placed.append(errors.off_px["fit"])
            light += [star.flux_mag for star in errors.stars]
    rounded_px = np.concatenate(rounded, axis=1)
    pixel_arcsec = rms(rounded_px) * PIXEL_ARCSEC
    placed_px = np.concatenate(placed, axis=1)
    codes_arcsec = rms(placed_px) * PIXEL_ARCSEC
    light_mag = rms(np.array(light))
    pixel_places = RigFigure.of(
        LASSI,
        "places, one pixel a star",
        PLACE_UNIT,
        OUTSIDE_PIXEL_ARCSEC,
        pixel_arcsec,
        f"{SIMULATOR}; {OUTSIDE}",
        with_hilstar=codes_arcsec,
    )
    codes_places = RigFigure.of(
        LASSI, "places, hilstar's codes", PLACE_UNIT, OUTSIDE_CODES_ARCSEC, codes_arcsec, OUTSIDE
    )
    codes_light = RigFigure.of(
        LASSI, "light, hilstar's codes", "mag rms", OUTSIDE_CODES_MAG, light_mag, OUTSIDE
    )
    return [pixel_places, codes_places, codes_light]


def pixel_errors(bench: Bench, turn: CameraTurn) -> FloatArray:
    """The distances (2, n), px, from a field's stars to the middles of their pixels."""
    sprites = turning_sprites(bench, turn)
    places = np.stack([sprites.x_px, sprites.y_px])
    size_px = np.array(bench.camera.resolution_px)[:, None]
    middle_px = (size_px - 1) / 2
    from_middle = np.abs(places - middle_px)
    inside = (from_middle < size_px / 2).all(axis=0)
    inside_px = places[:, inside]
    return np.asarray(np.rint(inside_px) - inside_px)


def rms(values: FloatArray) -> float:
    """The root of the mean square of all values."""
    mean_square = np.mean(np.square(values))
    return float(np.sqrt(mean_square))


@dataclass(frozen=True, slots=True)
class RigField:
    """Stars that the camera sees on the panel: directions (n, 3) in cam, and their places (2, n) on
    the detector, px, of each star's own pixel and of the star itself.
    """

    directions: FloatArray
    pixel_px: FloatArray
    true_px: FloatArray


def polar_stars() -> FloatArray:
    """The directions (3, n) of the shown stars about the celestial pole, ICRS."""
    stars = load_catalog().brighter_than(FAINTEST_V_MAG)
    ra = np.radians(stars.ra_deg)
    dec = np.radians(stars.dec_deg)
    x = np.cos(dec) * np.cos(ra)
    y = np.cos(dec) * np.sin(ra)
    z = np.sin(dec)
    directions = np.stack([x, y, z])
    in_front = directions[2] > 0.9
    return directions[:, in_front]


def rig_field() -> RigField:
    """The field of the rig's static run, q = (0, 0, 0, 1): the celestial pole."""
    directions = polar_stars()
    slopes = directions[:2] / directions[2]
    panel_size = np.array(PANEL_PX)[:, None]
    panel_middle_px = panel_size / 2
    panel_px = slopes * LENS_MM / PIXEL_MM + panel_middle_px
    first_px = np.floor(panel_px)
    on_panel = (first_px >= 0).all(axis=0)
    on_panel &= (panel_px < panel_size).all(axis=0)
    own_pixel = first_px + 0.5
    from_middle_px = own_pixel - panel_middle_px
    shown_slopes = from_middle_px * PIXEL_MM / LENS_MM
    principal = np.array(PRINCIPAL_PX)[:, None]
    pixel_px = FOCAL_PX * shown_slopes + principal
    true_px = FOCAL_PX * slopes + principal
    limit = np.array(CAMERA_PX)[:, None] - EDGE_PX
    beyond_edge = pixel_px > EDGE_PX
    in_view = on_panel & beyond_edge.all(axis=0)
    in_view &= (pixel_px < limit).all(axis=0)
    seen_directions = directions[:, in_view].T
    return RigField(seen_directions, pixel_px[:, in_view], true_px[:, in_view])


def centre_of_mass(image: FloatArray, columns: IntArray, rows: IntArray) -> Places:
    """The first moment of the pixels around a star, background included, as the rig's."""
    at = np.arange(-MASS_HALF_PX, MASS_HALF_PX + 1)
    stamps = stamps_at(image, columns, rows, MASS_HALF_PX)
    light = stamps.sum(axis=(1, 2))
    x_px = stamps.sum(axis=1) @ at / light
    y_px = stamps.sum(axis=2) @ at / light
    return columns + x_px, rows + y_px


def gaussian_grid(image: FloatArray, columns: IntArray, rows: IntArray) -> Places:
    """Parabolas through the logarithms of each line's pixels, weighted by the pixels; their
    coefficients are summed over the lines (Delabie et al. 2014, J. Astronaut. Sci. 61, 60).
    """
    pixels = stamps_at(image, columns, rows, GRID_HALF_PX)
    stamps = np.maximum(pixels, 1.0)
    transposed = stamps.transpose(0, 2, 1)
    return columns + _vertex(stamps), rows + _vertex(transposed)


def _vertex(lines: FloatArray) -> FloatArray:
    """The common top of the parabolas (n, lines, pixels), px from the middle.

    Each line's coefficients are multiplied by the determinant of its normal equations.
    """
    half = lines.shape[2] // 2
    exponents = np.arange(3)[:, None]
    at = np.arange(-half, half + 1)
    powers = at**exponents
    normal = np.einsum("jp,nlp,kp->nljk", powers, lines, powers)
    logarithms = np.log(lines)
    right_side = np.einsum("jp,nlp,nlp->nlj", powers, lines, logarithms)
    weight = np.linalg.det(normal)
    columns = right_side[..., None]
    coefficients = np.linalg.solve(normal, columns)[..., 0]
    solution = coefficients * weight[..., None]
    linear = solution[..., 1].sum(axis=1)
    square = solution[..., 2].sum(axis=1)
    # Without a top the star stays in the middle.
    zeros = np.zeros_like(linear)
    top = np.divide(-linear, 2 * square, out=zeros, where=square < 0)
    return np.asarray(np.clip(top, -half, half))


def psf_fit(image: FloatArray, columns: IntArray, rows: IntArray) -> Places:
    """A least-squares fit of the PSF with a known background: no centroider scatters much less."""
    stamps = stamps_at(image, columns, rows, FIT_HALF_PX) - DARK_DN
    x_px, y_px = star_places(stamps, "fit", (PSF_SIGMA_PX, PSF_SIGMA_PX))
    return columns + x_px, rows + y_px


FINDERS: dict[str, Finder] = {
    "network": psf_fit,
    "Gaussian grid": gaussian_grid,
    "centre of mass": centre_of_mass,
}


def stamps_at(image: FloatArray, columns: IntArray, rows: IntArray, half: int) -> FloatArray:
    """Squares of pixels (n, side, side) about columns and rows (n,)."""
    at = np.arange(-half, half + 1)
    pixel_rows = rows[:, None, None] + at[:, None]
    pixel_columns = columns[:, None, None] + at
    return np.asarray(image[pixel_rows, pixel_columns])


def found_stars(image: FloatArray) -> tuple[IntArray, IntArray]:
    """Columns and rows (n,) by the rig's detection: the middles of lit areas, rounded down."""
    lit = image > DARK_DN + THRESHOLD_DN
    labels, count = ndimage.label(lit)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    wide = np.flatnonzero(sizes >= MIN_PIXELS)
    wide = wide[wide > 0]
    equal = np.ones_like(image)
    middles = ndimage.center_of_mass(equal, labels, wide)
    middles_px = np.array(middles).reshape(-1, 2)
    corners_px = np.floor(middles_px)
    rows, columns = corners_px.astype(np.intp).T
    width, height = CAMERA_PX
    inside = (columns >= EDGE_PX) & (columns < width - EDGE_PX)
    inside &= (rows >= EDGE_PX) & (rows < height - EDGE_PX)
    return columns[inside], rows[inside]


def scatter_arcsec(
    field: RigField, places_px: FloatArray, star_dn: float, exposures: int
) -> dict[str, FloatArray]:
    """Sigma of attitudes about the boresight and across it (3,), arcsec, by centroider.

    The stars have one light, and stand at places on the detector (2, n), px.
    """
    settings = DetectorSettings(
        gain_e_per_dn=GAIN_E_PER_DN,
        full_well_e=FULL_WELL_E,
        bits=BITS,
        offset_dn=DARK_DN,
        read_noise_e=READ_NOISE_E,
    )
    detector = Detector(settings, CAMERA_PX, PITCH_UM)
    psf = GaussianPsf((PSF_SIGMA_PX, PSF_SIGMA_PX))
    star_e = star_dn * GAIN_E_PER_DN
    rates = np.full(places_px.shape[1], star_e)
    window = (0, 0, *CAMERA_PX)
    light_e = psf.spread(places_px[0], places_px[1], rates, window)
    mean_e = light_e.astype(np.float64)
    rng = np.random.default_rng(SEED)
    turns = {name: list[FloatArray]() for name in FINDERS}
    for _ in range(exposures):
        exposed_dn = detector.expose(mean_e, 0.0, rng)
        image = exposed_dn.astype(np.float64)
        columns, rows = found_stars(image)
        for name, finder in FINDERS.items():
            places = finder(image, columns, rows)
            turn = attitude_error(field, *places)
            if turn is not None:
                turns[name].append(turn)
    scatter: dict[str, FloatArray] = {}
    for name, errors in turns.items():
        scatter[name] = np.std(errors, axis=0)
    return scatter


def attitude_error(field: RigField, x_px: FloatArray, y_px: FloatArray) -> FloatArray | None:
    """The error of an attitude by centroids: turns about z, x and y (3,), arcsec; None with fewer
    than three stars.

    A centroid belongs to the nearest star within MATCHED_PX.
    """
    off_x = x_px[:, None] - field.pixel_px[0]
    off_y = y_px[:, None] - field.pixel_px[1]
    distance_px = np.hypot(off_x, off_y)
    nearest_px = distance_px.min(axis=1, initial=np.inf)
    matched = nearest_px < MATCHED_PX
    if matched.sum() < 3:
        return None
    star = distance_px[matched].argmin(axis=1)
    centroids_px = np.column_stack([x_px[matched], y_px[matched]])
    from_axis = centroids_px - PRINCIPAL_PX
    rays = unit_rays(from_axis / FOCAL_PX)
    weights = np.ones(len(rays))
    directions = field.directions[star]
    turn = to_matrix(wahba(rays, directions, weights))
    twice = turn - turn.T
    turns = np.array([twice[1, 0], twice[2, 1], twice[0, 2]])
    return turns / 2 * ARCSEC_PER_RAD


def about(scatter: Sequence[float] | FloatArray) -> float:
    """The scatter about the boresight."""
    return float(scatter[0])


def across_rms(scatter: Sequence[float] | FloatArray) -> float:
    """The rms of the two axes across the boresight."""
    return rms(np.asarray(scatter[1:]))


SCATTER_AXES: dict[str, Callable[[Sequence[float] | FloatArray], float]] = {
    "about": about,
    "across": across_rms,
}


def fitted_light_dn(field: RigField, exposures: int) -> float:
    """The light of a star, DN, at which FITTED scatters across the boresight as published."""
    by_light = []
    for star_dn in LIGHTS_DN:
        scatter = scatter_arcsec(field, field.pixel_px, star_dn, exposures)
        by_light.append(across_rms(scatter[FITTED]))
    return light_of_scatter(across_rms(SCATTER_ARCSEC[FITTED]), LIGHTS_DN, by_light)


def light_of_scatter(
    arcsec: float, lights_dn: Sequence[float], scatters_arcsec: Sequence[float]
) -> float:
    """The light of a star, DN, that scatters by `arcsec`, between lights (n,) and their scatters
    (n,), which fall; both by their logarithms.
    """
    # np.interp wants what it looks up in to rise.
    rising = np.log(scatters_arcsec)[::-1]
    rising_lights = np.log(lights_dn)[::-1]
    light = np.interp(np.log(arcsec), rising, rising_lights)
    return float(np.exp(light))


def scatter_rows(quick: bool) -> list[RigFigure]:
    """The rig's static scatters, by the light of a star that is taken from one of them."""
    exposures = QUICK_EXPOSURES if quick else EXPOSURES
    field = rig_field()
    light_dn = fitted_light_dn(field, exposures)
    before = scatter_arcsec(field, field.pixel_px, light_dn, exposures)
    after = scatter_arcsec(field, field.true_px, light_dn, exposures)
    light = RigFigure.of(LASSI, "light of a star (fitted)", LIGHT_UNIT, math.nan, light_dn, "none")
    rows = [light]
    for name, published in SCATTER_ARCSEC.items():
        for axis, size_of in SCATTER_AXES.items():
            figure = f"static scatter {axis}, {name}"
            if (name, axis) == (FITTED, "across"):
                figure += " (fitted)"
            stated = size_of(published)
            predicted = size_of(before[name])
            with_hilstar = size_of(after[name])
            row = RigFigure.of(
                LASSI,
                figure,
                "arcsec, sigma",
                stated,
                predicted,
                STATIC,
                with_hilstar=with_hilstar,
            )
            rows.append(row)
    return rows


def constant_rows(codes_share: float) -> list[RigFigure]:
    """The error that the panel's pixels give an attitude and no average removes; no source states
    it.

    `codes_share` is the error of hilstar's codes over that of one pixel a star.
    """
    count = rig_field().pixel_px.shape[1]
    half_slopes = np.array(CAMERA_PX) / 2 / FOCAL_PX
    half_sides = np.arctan(half_slopes)
    field_deg = np.degrees(2 * half_sides)
    width_deg, height_deg = field_deg.tolist()
    turns = pixel_attitudes_arcsec(count, (width_deg, height_deg), PIXEL_ARCSEC)
    rows = []
    for axis, predicted in zip(SCATTER_AXES, turns, strict=True):
        figure = f"constant error of an attitude, {axis}"
        after = predicted * codes_share
        row = RigFigure.of(
            LASSI, figure, "arcsec rms", math.nan, predicted, "none", with_hilstar=after
        )
        rows.append(row)
    return rows


def naples_rows() -> list[RigFigure]:
    """The errors that pixels alone give the tracker's attitudes."""
    turns = pixel_attitudes_arcsec(NAPLES_STARS, NAPLES_FIELD_DEG, NAPLES_PIXEL_ARCSEC)
    rows = []
    for axis, published, predicted in zip(SCATTER_AXES, NAPLES_ARCSEC, turns, strict=True):
        figure = f"precision of tracking {axis}"
        row = RigFigure.of(NAPLES, figure, "arcsec", published, predicted, NAPLES_SOURCE)
        rows.append(row)
    return rows


def pixel_attitudes_arcsec(
    stars: int, field_deg: tuple[float, float], pixel_arcsec: float
) -> tuple[float, float]:
    """Errors of attitudes by stars that stand in the middles of their panel's pixels, rms.

    Returns the error about the boresight, and that of an axis across it.
    """
    rng = np.random.default_rng(SEED)
    half_field_rad = np.radians(field_deg) / 2
    half = np.tan(half_field_rad)
    turns = []
    for _ in range(TRIALS):
        across = rng.uniform(-1.0, 1.0, (stars, 2))
        slopes = across * half
        off_pixels = rng.uniform(-0.5, 0.5, (stars, 2))
        off = off_pixels * pixel_arcsec / ARCSEC_PER_RAD
        shown = unit_rays(slopes + off)
        true_rays = unit_rays(slopes)
        turn = to_matrix(wahba(shown, true_rays, np.ones(stars)))
        turns.append((turn[1, 0], turn[2, 1], turn[0, 2]))
    mean_square = np.mean(np.square(turns), axis=0)
    scatter = np.sqrt(mean_square) * ARCSEC_PER_RAD
    return about(scatter), across_rms(scatter)


def unit_rays(slopes: FloatArray) -> FloatArray:
    """Unit vectors (n, 3) of slopes (n, 2)."""
    ones = np.ones(len(slopes))
    rays = np.column_stack([slopes, ones])
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(rays / length)


def p13_rows() -> list[RigFigure]:
    """The largest error along an axis of a star on the pixel it falls into."""
    predicted = P13_RESOLUTION_ARCSEC / 2
    figure = "largest error of a place"
    return [RigFigure.of(P13, figure, "arcsec", P13_ARCSEC, predicted, P13_SOURCE)]


def finding_of(rows: Sequence[RigFigure]) -> str:
    """The error of places by each way on one panel."""
    first = rows[0]
    with_hilstar = two_digits(first.with_hilstar)
    return (
        f"one pixel a star leaves {first.predicted:.1f} arcsec rms an axis on LASSI's"
        f" panel, and hilstar's codes {with_hilstar}"
    )


def line_of(row: RigFigure) -> str:
    """A row in words."""
    after = ""
    if not math.isnan(row.with_hilstar):
        with_hilstar = two_digits(row.with_hilstar)
        after = f", with hilstar's codes {with_hilstar}"
    published = "not published"
    if not math.isnan(row.published):
        stated = two_digits(row.published)
        published = f"published {stated}"
    figure = two_digits(row.predicted)
    predicted = f"predicted {figure} {row.unit}"
    return f"{row.rig}: {row.figure}: {published}, {predicted}{after}"


def dots_name(row: RigFigure) -> str:
    """A row's rig without its place, and its figure."""
    rig = row.rig.partition(",")[0]
    return f"{rig}: {row.figure}"


def draw(path: Path, rows: Sequence[RigFigure]) -> None:
    """Each figure published, predicted, and with hilstar's codes."""
    drawn = [row for row in rows if row.unit != LIGHT_UNIT]
    panel = PanelSpec(
        xlabel="arcsec, or mag",
        dots=DotsSpec(DOTS, name=dots_name),
        legend={"loc": "center left", "bbox_to_anchor": (0.0, 0.62)},
    )
    height_inch = 1.6 + 0.3 * len(drawn)
    layout = {"height_inch": height_inch}
    spec = ChartSpec((panel,), lambda row: row.rig, {}, NOTE, layout=layout)
    finding = finding_of(rows)
    draw_rows(path, finding, spec, drawn)
