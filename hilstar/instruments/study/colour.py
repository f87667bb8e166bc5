"""The study of colour: what the primaries of a display can do for mono and Bayer trackers, and what
no primary can.

Stars stand alone in frames drawn by each choice. Codes become light by primary, and that the
tracker's electrons by channel. Subtypes are those of the Pickles library's dwarfs of the same
colour, as the same tracker sees it: the ratio of blue to red, or for one channel the mean
wavelength of detected photons.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from msgspec.structs import replace as replace_keys

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.charts import BLUE, GREEN, MUTED, ORANGE, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import magnitude
from hilstar.display.quantise import Quantisation
from hilstar.display.response import Codes, Levels, srgb_response
from hilstar.instruments.simulate.budget import RED_NM, SOLAR_BV
from hilstar.instruments.study.engine import (
    ChartSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    SeriesLook,
    draw_rows,
    write_rows,
)
from hilstar.instruments.study.study_benches import (
    GLASS,
    Isolation,
    Value,
    bench_text,
    centroid_px,
    lone_windows,
)
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, in_turn
from hilstar.optics.glass.glass_psf import NodeSpline
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import FrameLight
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import tracker_psf
from hilstar.server.bench.colours import Colours, warmth
from hilstar.server.bench.config.hardware import Tracker, TrackerOptics
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.primary_panels import bench_colours
from hilstar.server.bench.star_glass import StarGlass
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.bench.star_rates import bench_channels, bench_optics, named_channels
from hilstar.sky.electrons import Optics, Photometry, dgs_electrons_per_s, load_library
from hilstar.sky.spectral_types import CLASSES, LETTERS, class_shares, read_types, star_types
from hilstar.sky.spectrum import load_curve
from hilstar.sky.stars import Stars
from hilstar.tracker.centroids import CentroidSettings, LocalBackground, find_stars
from hilstar.tracker.mosaic import CHANNELS, SUPERPIXEL_VARIANCE_PX2, in_pixels, luminance

NM = np.arange(380.0, 1001.0, 2.0)
Lobes = tuple[tuple[float, float, float], ...]  # peak, half width at 1/e, nm, and height
# Primaries as wide as an OLED's, as an sRGB LCD's with a phosphor of two red lines, and as a
# projector's lasers.
PANELS: dict[str, tuple[Lobes, ...]] = {
    "OLED": (((625, 40, 1.0),), ((530, 45, 1.0),), ((460, 30, 0.8),)),
    "sRGB LCD": (((612, 12, 1.0), (645, 15, 0.6)), ((540, 35, 1.0),), ((450, 15, 1.2),)),
    "laser": (((638, 4, 1.0),), ((520, 6, 1.0),), ((445, 4, 1.5),)),
}
# Mosaics: dyes behind an infrared cut, wide dyes, and dyes that all pass the near infrared.
SENSORS: dict[str, tuple[Lobes, ...]] = {
    "Bayer, infrared cut": (((600, 45, 0.75),), ((530, 45, 0.85),), ((460, 35, 0.7),)),
    "Bayer, wide dyes": (((620, 80, 0.6),), ((540, 80, 0.7),), ((460, 70, 0.6),)),
    "Bayer, no cut": (
        ((610, 50, 0.6), (850, 90, 0.3)),
        ((535, 50, 0.7), (850, 80, 0.3)),
        ((460, 40, 0.6), (850, 75, 0.3)),
    ),
}
# Mono sensors, the quantum efficiency of each: one that no light from CUT_NM on reaches is as any
# panel has light for it.
CUT_NM = 700.0
MONO_SENSOR = "ccd47-20"
MONO = {
    "ccd47-20": "ccd47-20",
    "kai-4021": "kai-4021",
    "ccd47-20 to 700 nm": "ccd47-20 to 700 nm.csv",
}
TRACKERS = {
    "mono": MONO_SENSOR,
    "Bayer": "Bayer, wide dyes",
    "mono to 700 nm": f"{MONO_SENSOR} to {CUT_NM:g} nm",
}
QUICK_TRACKERS = ("mono", "Bayer")
MARKERS = {"mono": "o", "Bayer": "s", "mono to 700 nm": "^"}
INKS = {"white": MUTED, "star": BLUE, "depth": ORANGE}
FRAME_PX = (800, 600)
FIELDS, QUICK_FIELDS, ROUNDS, QUICK_ROUNDS = 40, 3, 15, 3
BRIGHTEST_V_MAG, FAINTEST_V_MAG = 1.0, 5.5
LONE = Isolation(5.0, 1e-3)
PUBLISHED_SUBTYPES = 6.55  # a rig with an OLED of 2025
# Sigmas of a mosaic's stars, px, their black bodies, and the places along two pixels at which they
# stand.
SIGMAS_PX, STARS_K, PHASES, TILE_PX = (0.55, 0.8, 1.0, 1.5), (3500.0, 6000.0, 12_000.0), 16, 24
LENS, LENS_PSF = "planar-1897.toml", "planar-1897.fits"
METHODS: tuple[Quantisation, ...] = ("round", "exact")
QUOTED_SIGMA_PX = 1.0  # of the mosaic's stars that the findings name
NOTE = (
    "Full: exact; open: round. Circles: mono; triangles: mono to 700 nm; squares: Bayer. Lone"
    " stars of V = 1 to 5.5 on an sRGB LCD of 8 bits."
)
LEGEND = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.25), "ncols": 4, "frameon": False}
POINT = {"ms": 7}
PUBLISHED_WIDTH = 1.8


@dataclass(frozen=True, slots=True)
class GamutRow:
    """Stars to V = 7 of a panel before a sensor, as its primaries can show them; no codes.

    `out_share` is the share of stars outside the gamut. `off_...` is the error of colour: the share
    of electrons in a wrong channel, or for one channel nm of the mean wavelength. `subtypes` is the
    error with each star's own mixture, `subtypes_white` with white.
    """

    panel: str
    sensor: str
    condition: float
    out_share: float
    off_median: float
    off_95: float
    off_percent_k: float
    subtypes: float
    subtypes_white: float


@dataclass(frozen=True, slots=True)
class GamutClass:
    """The stars of one spectral class before a mono sensor: their mean wavelength and its error,
    nm.
    """

    panel: str
    sensor: str
    class_: str
    stars: int
    mean_nm: float
    off_nm: float
    subtypes: float
    subtypes_white: float


@dataclass(frozen=True, slots=True)
class ColourChoice:
    """Lone stars of V = 1 to 5.5 with the codes of one choice.

    `subtypes` and `off_percent_k` are mean errors of colour; `mag`, `channel` (%) and `px` are what
    95 % of the stars are within. The times are of the fastest frame.
    """

    tracker: str
    colour: str
    method: str
    stars: int
    wall_ms: float
    cpu_ms: float
    subtypes: float
    off_percent_k: float
    mag: float
    channel: float
    px: float


@dataclass(frozen=True, slots=True)
class LateralColour:
    """The shift of stars' places by a lens's lateral colour, against a star like the Sun, rms.

    `sky_px` is the sky's own, `off_px` the error of the shown one. The lens "linear" moves a star
    by 1 px for 100 nm of its mean wavelength.
    """

    lens: str
    panel: str
    colour: str
    sky_px: float
    off_px: float
    off_share: float


@dataclass(frozen=True, slots=True)
class MosaicPlaces:
    """Errors of a noiseless star's place along an axis, over places within two by two pixels."""

    sigma_px: float
    temperature_k: float
    image: str
    rms_px: float
    max_px: float


@dataclass(frozen=True, slots=True)
class GamutStars:
    """The stars (n,) of a panel before a sensor: the wanted colour of each, and its errors."""

    kinds: FloatArray
    wanted: FloatArray
    off: FloatArray
    subtypes: FloatArray
    subtypes_white: FloatArray
    condition: float
    out_share: float
    off_percent_k: float


@dataclass(frozen=True, slots=True)
class LoneLight:
    """Lone stars (n,) of a frame: their numbers, their light by primary (n, 3), and the errors of
    their places (n, 2), px.
    """

    numbers: IntArray
    by_primary: FloatArray
    off_px: FloatArray


@dataclass(frozen=True, slots=True)
class ShownStars:
    """Lone stars (n,): wanted colours (n, c), shown shares of primaries (n, 3), light relative to
    the wanted one (n,), and errors of place (n, 2), px.
    """

    wanted: FloatArray
    shares: FloatArray
    light: FloatArray
    off_px: FloatArray


def curve_of(lobes: Lobes) -> FloatArray:
    """A sum of Gaussians at NM."""
    curve = np.zeros_like(NM)
    for peak_nm, half_width_nm, height in lobes:
        curve += height * np.exp(-(((NM - peak_nm) / half_width_nm) ** 2))
    return curve


def write_spectrum(path: Path, header: str, *columns: FloatArray) -> None:
    """Write columns (n,) as a file of a spectrum."""
    lines = [header]
    for row in zip(*columns, strict=True):
        lines.append(",".join(f"{value:.6g}" for value in row))
    path.write_text("\n".join(lines) + "\n")


def write_spectra(folder: Path) -> None:
    """Primaries and quantum efficiencies as the files that benches name."""
    for name, primaries in PANELS.items():
        curves = map(curve_of, primaries)
        write_spectrum(folder / f"{name}.csv", "wavelength_nm,r,g,b", NM, *curves)
    header = "wavelength_nm,value"
    for name, dyes in SENSORS.items():
        for channel, lobes in zip(CHANNELS, dyes, strict=True):
            write_spectrum(folder / f"{name} {channel}.csv", header, NM, curve_of(lobes))
    whole = load_curve(MONO_SENSOR, "quantum_efficiency")
    before_cut = NM[CUT_NM > NM]
    cut_name = MONO[f"{MONO_SENSOR} to {CUT_NM:g} nm"]
    write_spectrum(folder / cut_name, header, before_cut, whole(before_cut))


def file_of(
    folder: Path, panel: str, sensor: str, faintest_v_mag: float = 7.0, **render: str | float
) -> BenchFile:
    """The bench of a panel with vertical stripes and a sensor, in the folder of the spectra."""
    tracker: dict[str, Value] = {"transmission": GLASS, "resolution_px": (1024, 1024)}
    detector: dict[str, Value] = {}
    if sensor in MONO:
        tracker["quantum_efficiency"] = MONO[sensor]
    else:
        detector["bayer"] = "rggb"
        for letter in CHANNELS:
            tracker[f"quantum_efficiency_{letter}"] = f"{sensor} {letter}.csv"
    text = bench_text(
        {
            "tracker": tracker,
            "tracker.detector": detector,
            "sky": {"faintest_v_mag": faintest_v_mag},
            "monitor": {"resolution_px": FRAME_PX, "pixel_pitch_um": 57.65},
            "monitor.primaries": {"file": f"{panel}.csv", "layout": "rgb-stripe"},
            "collimator": {"focal_length_mm": 180},
            "render": {"brightest_v_mag": BRIGHTEST_V_MAG, "colour": "star", **render},
        }
    )
    if sensor not in MONO:
        # The usual tracker's sensor is mono.
        text = text.replace(f'quantum_efficiency = "{MONO_SENSOR}"\n', "")
    path = folder / "bench.toml"
    path.write_text(text)
    return read_bench_file(path)


def subtypes_by(channels: Mapping[str, Optics]) -> Callable[[FloatArray], FloatArray]:
    """Spectral subtypes (0 is O0, 60 is M0) by a tracker's colour: shares of channels (n, 3), or a
    mean wavelength (n, 1).

    A colour beyond the dwarfs' has the subtype of the nearest dwarf.
    """
    library = load_library()
    kinds = read_types(np.array(library.spectral_type, dtype=np.bytes_))
    dwarfs = np.flatnonzero(kinds[:, 1] == CLASSES["V"])
    dwarfs = dwarfs[np.argsort(kinds[dwarfs, 0])]
    subtype = kinds[dwarfs, 0]
    nm = library.wavelength_nm
    responses = []
    for channel in channels.values():
        efficiency = channel.quantum_efficiency(nm) * channel.transmission(nm)
        responses.append(efficiency * nm)
    response = np.array(responses)
    colour = library.flux[dwarfs] @ response.T
    if len(response) == 1:
        colour = library.flux[dwarfs] @ (response * nm).T / colour
    index = np.maximum.accumulate(-warmth(colour))
    return lambda wanted: np.asarray(np.interp(-warmth(wanted), index, subtype))


def colours_of(file: BenchFile, stars: Stars) -> Colours:
    """The mixtures of a bench that drives its primaries separately. Raises InputError."""
    colours = bench_colours(file.config, file.folder, stars.catalog)
    if colours is None:
        raise AssertionError('colour = "star"')
    return colours


def gamut_stars(panel: str, sensor: str, folder: Path) -> GamutStars:
    """The catalogue's stars of a panel before a sensor."""
    file = file_of(folder, panel, sensor)
    stars = bench_stars(file.config, folder)
    colours = colours_of(file, stars)
    subtypes = subtypes_by(named_channels(file.config.tracker, folder))
    wanted = colours.wanted(stars)
    shares = colours.shares(wanted)
    channels = 1 if colours.mono else 3
    true_subtypes = subtypes(wanted[:, :channels])
    off = colours.off(wanted, shares)
    warmer = np.abs(colours.temperature_factor(wanted, shares) - 1).mean()
    by_star = subtypes(colours.shown(shares))
    by_white = subtypes(colours.shown(colours.of_white[None]))
    kinds = np.floor(star_types(stars.catalog)[:, 0] / 10)
    return GamutStars(
        kinds=kinds[stars.row],
        wanted=wanted,
        off=off,
        subtypes=np.abs(by_star - true_subtypes),
        subtypes_white=np.abs(by_white - true_subtypes),
        condition=float(colours.matrix.condition or math.nan),
        out_share=float((~colours.in_gamut(off)).mean()),
        off_percent_k=float(100 * warmer),
    )


def study_gamut(folder: Path) -> tuple[list[GamutRow], list[GamutClass]]:
    """Every panel before every sensor, and mono sensors by spectral class."""
    rows = []
    by_class: list[GamutClass] = []
    for panel, sensor in product(PANELS, (*MONO, *SENSORS)):
        stars = gamut_stars(panel, sensor, folder)
        median, at_95 = np.percentile(stars.off, (50, 95)).tolist()
        rows.append(
            GamutRow(
                panel=panel,
                sensor=sensor,
                condition=stars.condition,
                out_share=stars.out_share,
                off_median=median,
                off_95=at_95,
                off_percent_k=stars.off_percent_k,
                subtypes=float(stars.subtypes.mean()),
                subtypes_white=float(stars.subtypes_white.mean()),
            )
        )
        if sensor in MONO:
            by_class += class_rows(panel, sensor, stars)
    return rows, by_class


def class_rows(panel: str, sensor: str, stars: GamutStars) -> list[GamutClass]:
    """The stars before a mono sensor by spectral class."""
    rows = []
    for number, letter in enumerate(LETTERS):
        of_class = np.flatnonzero(stars.kinds == number)
        mean_nm = float(stars.wanted[of_class, 0].mean())
        off_nm = float(stars.off[of_class].mean())
        subtypes = float(stars.subtypes[of_class].mean())
        by_white = float(stars.subtypes_white[of_class].mean())
        count = len(of_class)
        rows.append(GamutClass(panel, sensor, letter, count, mean_nm, off_nm, subtypes, by_white))
    return rows


def light_by_primary(levels: Levels, bits: int, rgb: Codes | None) -> FloatArray:
    """A frame's light by primary (h, w, 3), relative to each one's white; `rgb` has the codes of
    each level where bit stealing makes them.
    """
    light = srgb_response(bits).light
    if levels.ndim == 3:
        return light[levels]
    if rgb is None:
        return np.repeat(light[levels][..., None], 3, axis=2)
    return light[rgb[levels]]


def shown_stars(bench: Bench, colours: Colours, fields: int) -> ShownStars:
    """The lone stars of `fields` frames, anywhere on the sky."""
    white = colours.of_white * bench.flux_at_white_e_per_s
    stars = bench.shown_stars
    rng = np.random.default_rng(1)
    bits, rgb = bench.config.monitor.bits, bench.calibration.response.rgb
    judged = is_judged(stars.v_mag)
    wanted = []
    shares = []
    light = []
    off_px = []
    for _ in range(fields):
        ra_deg = rng.uniform(0, 360)
        dec_deg = math.degrees(math.asin(rng.uniform(-1, 1)))
        q = from_radec_roll_deg(ra_deg, dec_deg, 0.0)
        images = light_by_primary(bench.draw(q).levels, bits, rgb) * white
        found = lone_light(images, bench.sprites(q, stars), judged, colours.places_px)
        rates = stars.electrons_per_s[found.numbers]
        wanted.append(colours.wanted(stars, found.numbers))
        shares.append(primary_shares(found.by_primary, rates, colours.mono))
        light.append(found.by_primary.sum(axis=1) / rates)
        off_px.append(found.off_px)
    return ShownStars(*map(np.concatenate, (wanted, shares, light, off_px)))


def is_judged(v_mag: FloatArray) -> BoolArray:
    """Whether stars (n,) are fainter than white and bright enough for their colour to be read."""
    return np.asarray((v_mag > BRIGHTEST_V_MAG) & (v_mag < FAINTEST_V_MAG))


def primary_shares(by_primary: FloatArray, rates: FloatArray, mono: bool) -> FloatArray:
    """The shares of primaries (n, 3) in the light of stars: of all that is shown before a mono
    sensor, of the wanted rates (n,) before another.
    """
    of = by_primary.sum(axis=1) if mono else rates
    return np.asarray(by_primary / of[:, None])


def lone_light(
    images: FloatArray, sprites: FrameLight, judged: BoolArray, places_px: FloatArray
) -> LoneLight:
    """The lone stars that are judged (by the number of a star) and show light, in the images
    (h, w, 3) of the primaries, which stand at `places_px` (3, 2) within a pixel.
    """
    height, width, _ = images.shape
    numbers = []
    lights = []
    off_px = []
    for number, window in lone_windows(sprites, sprites.x_px, sprites.y_px, (width, height), LONE):
        by_primary = images[window].sum(axis=(0, 1))
        if not (judged[number] and by_primary.any()):
            continue
        centroids = []
        for k in range(3):
            centroids.append(centroid_px(images[..., k], window))
        middles = np.nan_to_num(centroids) + places_px
        row = int(np.flatnonzero(sprites.star == number)[0])
        true_px = sprites.x_px[row], sprites.y_px[row]
        numbers.append(number)
        lights.append(by_primary)
        off_px.append(by_primary @ middles / by_primary.sum() - true_px)
    count = len(numbers)
    return LoneLight(
        np.array(numbers, dtype=np.intp),
        np.reshape(lights, (count, 3)),
        np.reshape(off_px, (count, 2)),
    )


def frame_of(bench: Bench, number: int) -> Levels:
    """The levels of one of the frames that are timed."""
    return bench.draw(from_radec_roll_deg(84.0 + number, 0.0, 0.0)).levels


def study_choices(
    folder: Path, trackers: Mapping[str, str], fields: int, rounds: int
) -> Iterator[ColourChoice]:
    """Each choice on the LCD before each tracker; the frames of all choices are timed in turn."""
    for tracker, sensor in trackers.items():
        with ExitStack() as stack:
            benches = {}
            works = {}
            for colour, method in product(INKS, METHODS):
                file = file_of(folder, "sRGB LCD", sensor, colour=colour, quantisation=method)
                bench = stack.enter_context(open_bench(file))
                benches[colour, method] = bench
                works[f"{colour} {method}"] = partial(frame_of, bench)
            known = benches["star", "exact"]
            colours = colours_of(known.file, known.stars)
            subtypes = subtypes_by(named_channels(known.config.tracker, folder))
            times = in_turn(works, rounds)
            for (colour, method), bench in benches.items():
                stars = shown_stars(bench, colours, fields)
                fastest = np.min(times[f"{colour} {method}"], axis=0).tolist()
                figures = colour_figures(stars, colours, subtypes)
                yield ColourChoice(tracker, colour, method, len(stars.light), *fastest, *figures)


def colour_figures(
    stars: ShownStars, colours: Colours, subtypes: Callable[[FloatArray], FloatArray]
) -> tuple[float, ...]:
    """The errors of a choice: subtypes, % of temperature; mag, % of a channel, px, of 95 %."""
    shown = colours.shown(stars.shares)
    true_subtypes = subtypes(stars.wanted[:, : shown.shape[1]])
    off_subtypes = np.abs(subtypes(shown) - true_subtypes).mean()
    warmth_factor = colours.temperature_factor(stars.wanted, stars.shares)
    off_percent_k = 100 * np.abs(warmth_factor - 1).mean()
    light_mag = np.abs([magnitude(float(light)) for light in stars.light])
    if colours.mono:
        channels = np.abs(stars.light - 1)
    else:
        channels = np.abs(shown / stars.wanted - 1)
    # what all are off by is the alignment's
    off_x, off_y = (stars.off_px - np.median(stars.off_px, axis=0)).T
    distance_px = np.hypot(off_x, off_y)
    at_95 = [np.percentile(errors, 95) for errors in (light_mag, 100 * channels, distance_px)]
    return tuple(map(float, (off_subtypes, off_percent_k, *at_95)))


def lens_tracker() -> Tracker:
    """The tracker with the lens of 1897."""
    tracker = read_bench_file(resource_path("configs", LENS)).config.tracker
    optics = TrackerOptics(psf=str(resource_path("configs", LENS_PSF)))
    return replace_keys(tracker, optics=optics)


def study_lateral(folder: Path) -> Iterator[LateralColour]:
    """Stars of all colours over the field of a lens of 1897, and of a linear one.

    A panel has no row where the lens's filter blocks one of its primaries.
    """
    tracker = lens_tracker()
    psf = tracker_psf(tracker, folder)
    width, height = tracker.resolution_px
    if not psf.by_colour:
        raise AssertionError("the file has a glass")
    for panel in PANELS:
        file = file_of(folder, panel, MONO_SENSOR, FAINTEST_V_MAG)
        file = replace(file, config=replace_keys(file.config, tracker=tracker))
        stars = bench_stars(file.config, folder)
        try:
            colours = colours_of(file, stars)
        except InputError:
            continue
        by_primary = colours.density @ NodeSpline(psf.wavelengths_nm)(colours.nm)
        true_shares = StarGlass(file, psf).shares(stars, np.arange(len(stars)))
        wanted = colours.wanted(stars)
        solar = int(np.abs(stars.bv_mag - SOLAR_BV).argmin())
        corner_px = width - 0.5, height - 0.5
        places = np.random.default_rng(1).uniform(-0.5, corner_px, (len(stars), 2)).T
        # as for a lens that is not known
        plain = replace(colours, lateral=None)
        white = colours.of_white + 0 * wanted[:, :1]
        shares = {"white": white, "star": colours.shares(wanted)}
        plain_shares = {"white": white, "star": plain.shares(wanted)}
        sky_px = moved_px(psf.centroids_px, places, true_shares, solar)
        linear_sky_px = linear_px(wanted[:, :1], solar)
        for colour, mixture in shares.items():
            shown_px = moved_px(psf.centroids_px, places, mixture @ by_primary, solar)
            yield lateral_colour("planar-1897", panel, colour, sky_px, shown_px)
            linear_shown_px = linear_px(plain.shown(plain_shares[colour]), solar)
            yield lateral_colour("linear", panel, colour, linear_sky_px, linear_shown_px)


def lateral_colour(
    lens: str, panel: str, colour: str, sky_px: FloatArray, shown_px: FloatArray
) -> LateralColour:
    """A row by the places (axes, n) of stars in the sky and as they are shown."""
    size_px = distance_rms_px(sky_px)
    off_px = distance_rms_px(shown_px - sky_px)
    return LateralColour(lens, panel, colour, size_px, off_px, off_px / size_px)


def distance_rms_px(places_px: FloatArray) -> float:
    """The rms distance of places (axes, n)."""
    return float(np.sqrt((places_px**2).sum(axis=0).mean()))


def linear_px(mean_nm: FloatArray, against: int) -> FloatArray:
    """The shift by a linear lens of stars of mean wavelengths (n, 1), px, against one of them."""
    return np.asarray((mean_nm - mean_nm[against]).T / 100)


def moved_px(
    centroids_px: Callable[..., tuple[FloatArray, ...]],
    places_px: FloatArray,
    spectra: FloatArray,
    against: int,
) -> FloatArray:
    """The shift of spectra (n, L) at places (2, n), px, against one of them at the same places, by
    the centroids of a PSF.
    """
    x_px, y_px = places_px
    moved = np.stack(centroids_px(x_px, y_px, spectra)[:2])
    reference = np.stack(centroids_px(x_px, y_px, spectra[against])[:2])
    return np.asarray(moved - reference)


def mosaic_image(sigma_px: float, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Stars at places (PHASES^2,) within tiles of their own, row by row, as one image."""
    at = np.arange(TILE_PX)
    across = (at - x_px[:, None])[:, None, :]
    down = (at - y_px[:, None])[:, :, None]
    tiles = GaussianPsf((sigma_px, sigma_px)).shares(across, down)
    in_rows = tiles.reshape(PHASES, PHASES, TILE_PX, TILE_PX).swapaxes(1, 2)
    return in_rows.reshape(PHASES * TILE_PX, PHASES * TILE_PX)


def study_mosaic(channels: Sequence[Optics]) -> Iterator[MosaicPlaces]:
    """Noiseless stars in a mosaic, found as `hilstar tracker` does."""
    steps = np.arange(PHASES) / PHASES * 2
    down, across = np.meshgrid(steps, steps, indexing="ij")
    x_px = TILE_PX // 2 + across.ravel()
    y_px = TILE_PX // 2 + down.ravel()
    for sigma_px, kelvin in product(SIGMAS_PX, STARS_K):
        rates = []
        for channel in channels:
            rates.append(float(dgs_electrons_per_s(kelvin, channel, Photometry())))
        stars = mosaic_image(sigma_px, x_px, y_px)
        raw = in_pixels([stars * rate / max(rates) for rate in rates], "rggb")
        images = {"mosaic": (raw, 0.0), "superpixel": (luminance(raw), SUPERPIXEL_VARIANCE_PX2)}
        for name, (image, spread_px) in images.items():
            width_px = math.sqrt(sigma_px**2 + spread_px)
            off_px = mosaic_off_px(image, width_px, steps)
            yield mosaic_places(sigma_px, kelvin, name, off_px)


def mosaic_places(sigma_px: float, kelvin: float, image: str, off_px: FloatArray) -> MosaicPlaces:
    """A row by the errors of places, px, of either sign."""
    rms_px = float(np.sqrt((off_px**2).mean()))
    return MosaicPlaces(sigma_px, kelvin, image, rms_px, float(np.abs(off_px).max()))


def mosaic_off_px(image: FloatArray, width_px: float, steps: FloatArray) -> FloatArray:
    """The errors of the places of stars in an image of tiles, px: along x, then along y."""
    settings = CentroidSettings(
        window_sigma_px=max(1.0, width_px), psf_sigma_px=(width_px, width_px), minimum_pixels=2
    )
    centroids = find_stars(image, settings, LocalBackground(0.0, 1e-3))
    columns = (centroids.x_px // TILE_PX).astype(np.intp)
    rows = (centroids.y_px // TILE_PX).astype(np.intp)
    # the brightest of a tile
    first = np.unique(rows * PHASES + columns, return_index=True)[1]
    true_x = TILE_PX * columns[first] + TILE_PX // 2 + steps[columns[first]]
    true_y = TILE_PX * rows[first] + TILE_PX // 2 + steps[rows[first]]
    return np.concatenate([centroids.x_px[first] - true_x, centroids.y_px[first] - true_y])


def draw(path: Path, rows: Sequence[ColourChoice], load: Load) -> str:
    """The chart of the choices; its finding."""
    subtypes = {}
    for row in rows:
        if row.tracker == "Bayer" and row.method == "exact":
            subtypes[row.colour] = row.subtypes
    finding = (
        f"Each star's own mixture is {subtypes['star']:.2g} subtypes off before a Bayer tracker,"
        f" white {subtypes['white']:.0f}"
    )
    looks = {}
    for tracker, colour, method in product(MARKERS, INKS, METHODS):
        is_open = method != "exact"
        look = SeriesLook(colour, INKS[colour], MARKERS[tracker], is_open)
        looks[tracker, colour, method] = look
    published = LevelLine(
        PUBLISHED_SUBTYPES, f"published, {PUBLISHED_SUBTYPES:g}", GREEN, ":", PUBLISHED_WIDTH
    )
    first = replace(
        choice_panel("subtypes", "colour, mean\n[subtypes]"),
        levels=(published,),
        keys=tuple(SeriesLook(name, ink) for name, ink in INKS.items()),
        legend=LEGEND,
    )
    light = choice_panel("mag", "flux, 95 %\n[mag]")
    place = replace(choice_panel("px", "place, 95 %\n[px]"), xlabel="frame, CPU time [ms]")
    spec = ChartSpec((first, light, place), choice_of, looks, NOTE)
    draw_rows(path, finding, spec, rows, load)
    return finding


def choice_of(row: ColourChoice) -> tuple[str, str, str]:
    """The series of a row: a tracker and a choice."""
    return row.tracker, row.colour, row.method


def choice_panel(error: str, ylabel: str) -> PanelSpec:
    """An error of the choices against their time, a point each."""
    points = LineSpec("cpu_ms", error, "", named=False, look=POINT)
    return PanelSpec((points,), ylabel, scales=("log", "log"), names=False)


@dataclass(frozen=True, slots=True)
class ColourMeasured:
    """The rows of each table by its name, and the work of others while choices were timed; `red`
    has a sensor and the share of each class.
    """

    choices: Sequence[ColourChoice]
    gamut: Sequence[GamutRow]
    by_class: Sequence[GamutClass]
    lateral: Sequence[LateralColour]
    red: Sequence[tuple[str | float, ...]]
    mosaic: Sequence[MosaicPlaces]
    load: Load


def run(directory: Path, quick: bool = False) -> Judged:
    """Write colour.csv and its chart, and the tables colour_gamut, _class, _lateral, _red and
    _mosaic; findings.
    """
    return report(directory, measure(quick))


def measure(quick: bool) -> ColourMeasured:
    """Every panel's gamut, the lateral colours, the choices of codes, and the mosaic's places."""
    fields = FIELDS
    rounds = ROUNDS
    before = dict(TRACKERS)
    if quick:
        fields = QUICK_FIELDS
        rounds = QUICK_ROUNDS
        before = {name: TRACKERS[name] for name in QUICK_TRACKERS}
    others = OtherWork()
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_spectra(folder)
        gamut, by_class = study_gamut(folder)
        lateral = list(study_lateral(folder))
        choices = list(study_choices(folder, before, fields, rounds))
        load = others.load()
        red = red_shares(folder)
        wide = file_of(folder, "OLED", TRACKERS["Bayer"]).config.tracker
        mosaic = list(study_mosaic(bench_channels(wide, folder)))
    return ColourMeasured(choices, gamut, by_class, lateral, red, mosaic, load)


def red_shares(folder: Path) -> list[tuple[str | float, ...]]:
    """Each sensor, and the share of light that the stars of each class have beyond RED_NM."""
    rows: list[tuple[str | float, ...]] = []
    for sensor in (*MONO, *SENSORS):
        tracker = file_of(folder, "OLED", sensor).config.tracker
        shares = class_shares(bench_optics(tracker, folder), RED_NM)
        rows.append((sensor, *shares.values()))
    return rows


def report(directory: Path, measured: ColourMeasured) -> Judged:
    """Write what was measured; findings. Raises InputError."""
    write_rows(directory / "colour.csv", measured.choices)
    write_rows(directory / "colour_gamut.csv", measured.gamut)
    write_rows(directory / "colour_class.csv", measured.by_class)
    write_rows(directory / "colour_lateral.csv", measured.lateral)
    write_csv(directory / "colour_red.csv", ("sensor", *LETTERS), measured.red)
    write_rows(directory / "colour_mosaic.csv", measured.mosaic)
    lines = [draw(directory / "colour", measured.choices, measured.load)]
    lines += map(lateral_line, measured.lateral)
    for places in measured.mosaic:
        if places.sigma_px == QUOTED_SIGMA_PX:
            lines.append(mosaic_line(places))
    return measured.load.judged(lines)


def lateral_line(row: LateralColour) -> str:
    """A row in words."""
    of = f"lateral colour of {row.lens} by {row.colour} on {row.panel}"
    return f"{of}: off by {row.off_share:.0%} of the sky's"


def mosaic_line(row: MosaicPlaces) -> str:
    """A row in words."""
    star = f"a star of {row.sigma_px:g} px, {row.temperature_k:g} K"
    return f"{star}, is {row.rms_px:.3f} px off rms in a {row.image}"
