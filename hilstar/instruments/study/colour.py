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
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from msgspec.structs import replace as replace_keys

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, GREEN, MUTED, ORANGE, chart, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import magnitude
from hilstar.display.response import Levels, srgb_response
from hilstar.instruments.simulate.budget import RED_NM, SOLAR_BV
from hilstar.instruments.study.study_benches import (
    GLASS,
    Isolation,
    bench_text,
    centroid_px,
    lone_windows,
)
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, in_turn
from hilstar.optics.glass.glass_psf import NodeSpline
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import tracker_psf
from hilstar.server.bench.colours import Colours, warmth
from hilstar.server.bench.config.hardware import TrackerOptics
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
Row = tuple[str | float, ...]
# Stars to V = 7 without codes: share of electrons in a wrong channel, of one channel nm of the mean
# wavelength, and subtypes.
GAMUT = (
    "panel",
    "sensor",
    "condition",
    "out_share",
    "off_median",
    "off_95",
    "off_percent_k",
    "subtypes",
    "subtypes_white",
)
# The same of a mono sensor by spectral class: stars to V = 7, their mean wavelength and how far it
# is off, and subtypes.
BY_CLASS = ("panel", "sensor", "class", "stars", "mean_nm", "off_nm", "subtypes", "subtypes_white")
# Lone stars of V = 1 to 5.5 as codes show them: mean errors of colour, 95 % of light, a channel's
# light [%] and place; time.
CHOICE = (
    "tracker",
    "colour",
    "method",
    "stars",
    "wall_ms",
    "cpu_ms",
    "subtypes",
    "off_percent_k",
    "mag",
    "channel",
    "px",
)
# Places through a lens against a star's like the Sun: of the sky, and shown minus sky. "linear": 1
# px for 100 nm of the mean.
LATERAL = ("lens", "panel", "colour", "sky_px", "off_px", "off_share")
# Errors of a noiseless star's place along an axis, over places in four pixels.
PLACES = ("sigma_px", "temperature_k", "image", "rms_px", "max_px")


def curve_of(lobes: Lobes) -> FloatArray:
    """A sum of Gaussians at NM."""
    return np.asarray(
        sum(height * np.exp(-(((NM - peak) / wide) ** 2)) for peak, wide, height in lobes)
    )


def write_spectra(folder: Path) -> None:
    """Primaries and quantum efficiencies as the files that benches name."""
    for name, three in PANELS.items():
        rows = []
        for row in zip(NM, *map(curve_of, three), strict=True):
            rows.append(",".join(f"{x:.6g}" for x in row))
        (folder / f"{name}.csv").write_text("\n".join(["wavelength_nm,r,g,b", *rows]))
    for name, three in SENSORS.items():
        for channel, lobes in zip(CHANNELS, three, strict=True):
            lines = [
                "wavelength_nm,value",
                *(f"{nm:g},{value:.6g}" for nm, value in zip(NM, curve_of(lobes), strict=True)),
            ]
            (folder / f"{name} {channel}.csv").write_text("\n".join(lines))
    whole = load_curve(MONO_SENSOR, "quantum_efficiency")
    cut = (
        f"{nm:g},{value:.6g}"
        for nm, value in zip(NM[CUT_NM > NM], whole(NM[CUT_NM > NM]), strict=True)
    )
    (folder / MONO[f"{MONO_SENSOR} to {CUT_NM:g} nm"]).write_text(
        "\n".join(["wavelength_nm,value", *cut])
    )


def file_of(
    folder: Path, panel: str, sensor: str, faintest_v_mag: float = 7.0, **render: str | float
) -> BenchFile:
    """The bench of a panel with vertical stripes and a sensor, in the folder of the spectra."""
    three = {f"quantum_efficiency_{letter}": f"{sensor} {letter}.csv" for letter in CHANNELS}
    if sensor in MONO:
        efficiency_keys = {"quantum_efficiency": MONO[sensor]}
    else:
        efficiency_keys = three
    text = bench_text(
        {
            "tracker": {**efficiency_keys, "transmission": GLASS, "resolution_px": (1024, 1024)},
            "tracker.detector": {} if sensor in MONO else {"bayer": "rggb"},
            "sky": {"faintest_v_mag": faintest_v_mag},
            "monitor": {"resolution_px": FRAME_PX, "pixel_pitch_um": 57.65},
            "monitor.primaries": {"file": f"{panel}.csv", "layout": "rgb-stripe"},
            "collimator": {"focal_length_mm": 180},
            "render": {"brightest_v_mag": BRIGHTEST_V_MAG, "colour": "star", **render},
        }
    )
    path = folder / "bench.toml"
    path.write_text(
        text if sensor in MONO else text.replace('quantum_efficiency = "ccd47-20"\n', "")
    )
    return read_bench_file(path)


def subtypes_by(channels: Mapping[str, Optics]) -> Callable[[FloatArray], FloatArray]:
    """Spectral subtypes (0 is O0, 60 is M0) by a tracker's colour: shares of channels (n, 3), or a
    mean wavelength (n, 1).

    Those of colours beyond the dwarfs' are their ends'.
    """
    library = load_library()
    kinds = read_types(np.array(library.spectral_type, dtype=np.bytes_))
    order = np.flatnonzero(kinds[:, 1] == CLASSES["V"])
    nm = library.wavelength_nm
    order = order[np.argsort(kinds[order, 0])]
    response_nm = np.array(
        [
            channel.quantum_efficiency(nm) * channel.transmission(nm) * nm
            for channel in channels.values()
        ]
    )
    light = library.flux[order] @ response_nm.T
    if len(response_nm) > 1:
        colour = light
    else:
        colour = library.flux[order] @ (response_nm * nm).T / light
    index = np.maximum.accumulate(-warmth(colour))
    return lambda wanted: np.asarray(np.interp(-warmth(wanted), index, kinds[order, 0]))


def colours_of(file: BenchFile, stars: Stars) -> Colours:
    """The mixtures of a bench that drives its primaries apart. Raises InputError."""
    colours = bench_colours(file.config, file.folder, stars.catalog)
    if colours is None:
        raise AssertionError('colour = "star"')
    return colours


def study_gamut(folder: Path, by_class: list[Row]) -> Iterator[Row]:
    """Every panel before every sensor: rows of GAMUT; those of BY_CLASS are appended."""
    for panel, sensor in product(PANELS, (*MONO, *SENSORS)):
        file = file_of(folder, panel, sensor)
        stars = bench_stars(file.config, folder)
        colours = colours_of(file, stars)
        subtypes = subtypes_by(named_channels(file.config.tracker, folder))
        wanted = colours.wanted(stars)
        shares = colours.shares(wanted)
        own_subtypes = subtypes(wanted[:, : 1 if colours.mono else 3])
        off = colours.off(wanted, shares)
        warmer = np.abs(colours.temperature_factor(wanted, shares) - 1).mean()
        by_star, by_white = (
            np.abs(subtypes(colours.shown(mixture)) - own_subtypes)
            for mixture in (shares, colours.of_white[None])
        )
        out = (~colours.in_gamut(off)).mean()
        condition = colours.matrix.condition or math.nan
        at_off = np.percentile(off, (50, 95))
        kinds = np.floor(star_types(stars.catalog)[:, 0] / 10)
        for number, letter in enumerate(LETTERS if colours.mono else ""):
            some = np.flatnonzero(kinds[stars.row] == number)
            figures = (
                float(mixture[some].mean()) for mixture in (wanted[:, 0], off, by_star, by_white)
            )
            by_class.append((panel, sensor, letter, len(some), *figures))
        yield (
            panel,
            sensor,
            *map(float, (condition, out, *at_off, 100 * warmer, by_star.mean(), by_white.mean())),
        )


def shown_stars(bench: Bench, colours: Colours, fields: int) -> Iterator[tuple[FloatArray, ...]]:
    """Lone stars of frames: what is wanted, the shares of primaries shown (3,), light over
    wanted (1,), and place off (2,).
    """
    light = srgb_response(bench.config.monitor.bits).light
    rgb = bench.calibration.response.rgb
    white = colours.of_white * bench.flux_at_white_e_per_s
    stars = bench.shown_stars
    rng = np.random.default_rng(1)
    for _ in range(fields):
        q = from_radec_roll_deg(
            rng.uniform(0, 360), math.degrees(math.asin(rng.uniform(-1, 1))), 0.0
        )
        levels, sprites = bench.draw(q).levels, bench.sprites(q, stars)
        if levels.ndim == 3:
            relative = light[levels]
        elif rgb is None:
            relative = np.repeat(light[levels][..., None], 3, axis=2)
        else:
            relative = light[rgb[levels]]
        images = relative * white
        for number, window in lone_windows(sprites, sprites.x_px, sprites.y_px, FRAME_PX, LONE):
            by_primary = images[window].sum(axis=(0, 1))
            if not (BRIGHTEST_V_MAG < stars.v_mag[number] < FAINTEST_V_MAG and by_primary.any()):
                continue
            row = int(np.flatnonzero(sprites.star == number)[0])
            rate = float(stars.electrons_per_s[number])
            middles = (
                np.nan_to_num([centroid_px(images[..., k], window) for k in range(3)])
                + colours.places_px
            )
            place = by_primary @ middles / by_primary.sum()
            share = by_primary / (by_primary.sum() if colours.mono else rate)
            place -= sprites.x_px[row], sprites.y_px[row]
            yield (
                colours.wanted(stars, np.array([number]))[0],
                share,
                by_primary.sum(keepdims=True) / rate,
                place,
            )


def frame_of(bench: Bench, number: int) -> Levels:
    """The levels of one of the frames that are timed."""
    return bench.draw(from_radec_roll_deg(84.0 + number, 0.0, 0.0)).levels


def study_choices(
    folder: Path, trackers: Mapping[str, str], fields: int, rounds: int
) -> Iterator[Row]:
    """Each choice before trackers by their sensors, on the LCD; frames of all are timed in turn:
    rows of CHOICE.
    """
    for tracker, sensor in trackers.items():
        with ExitStack() as stack:
            benches = {
                key: stack.enter_context(
                    open_bench(
                        file_of(folder, "sRGB LCD", sensor, colour=key[0], quantisation=key[1])
                    )
                )
                for key in product(INKS, ("round", "exact"))
            }
            chosen_bench = benches["star", "exact"]
            colours = colours_of(chosen_bench.file, chosen_bench.stars)
            subtypes = subtypes_by(named_channels(chosen_bench.config.tracker, folder))
            times = in_turn(
                {" ".join(key): partial(frame_of, bench) for key, bench in benches.items()}, rounds
            )
            for key, bench in benches.items():
                stars = zip(*shown_stars(bench, colours, fields), strict=True)
                wanted, shares, flux, off = (np.array(part) for part in stars)
                shown = colours.shown(shares)
                # what all are off by is the alignment's
                off = np.hypot(*(off - np.median(off, axis=0)).T)
                flux_mag = np.abs([magnitude(float(star_flux)) for star_flux in flux[:, 0]])
                if colours.mono:
                    channels = np.abs(flux - 1)
                else:
                    channels = np.abs(shown / wanted - 1)
                off_kind = np.abs(subtypes(shown) - subtypes(wanted[:, : shown.shape[1]])).mean()
                off_k = 100 * np.abs(colours.temperature_factor(wanted, shares) - 1).mean()
                at_95 = (
                    np.percentile(star_flux, 95) for star_flux in (flux_mag, 100 * channels, off)
                )
                figures = (*np.min(times[" ".join(key)], axis=0), off_kind, off_k, *at_95)
                yield (tracker, *key, len(flux), *map(float, figures))


def study_lateral(folder: Path) -> Iterator[Row]:
    """Stars of all colours over the field of a lens of 1897, and of a linear one: rows of LATERAL.

    A panel whose primaries its filter does not all pass has no row.
    """
    planar = read_bench_file(resource_path("configs", "planar-1897.toml")).config.tracker
    tracker = replace_keys(
        planar, optics=TrackerOptics(psf=str(resource_path("configs", "planar-1897.fits")))
    )
    psf, (width, height) = tracker_psf(tracker, folder), tracker.resolution_px
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
        own_shares = StarGlass(file, psf).shares(stars, np.arange(len(stars)))
        wanted = colours.wanted(stars)
        solar = int(np.abs(stars.bv_mag - SOLAR_BV).argmin())
        places = (
            np.random.default_rng(1).uniform(-0.5, (width - 0.5, height - 0.5), (len(stars), 2)).T
        )
        # as for a lens that is not known
        white = colours.of_white + 0 * wanted[:, :1]
        plain = replace(colours, lateral=None)
        for colour, known, unknown in (
            ("white", white, white),
            ("star", colours.shares(wanted), plain.shares(wanted)),
        ):
            glass = [
                moved_px(psf, places, spectrum_shares, solar)
                for spectrum_shares in (own_shares, known @ by_primary)
            ]
            means = [
                (spectrum_shares - spectrum_shares[solar]).T / 100
                for spectrum_shares in (wanted[:, :1], plain.shown(unknown))
            ]
            for lens, (sky, shown) in (("planar-1897", glass), ("linear", means)):
                sky_px, off_px = (
                    float(np.sqrt((spectrum_shares**2).sum(axis=0).mean()))
                    for spectrum_shares in (sky, shown - sky)
                )
                yield lens, panel, colour, sky_px, off_px, off_px / sky_px


def moved_px(psf: Psf, places_px: FloatArray, spectra: FloatArray, against: int) -> FloatArray:
    """By how much spectra (n, L) move stars at places (2, n), px, against one of them there."""
    centroids = []
    for spectrum_shares in (spectra, spectra[against]):
        centroids.append(psf.centroids_px(places_px[0], places_px[1], spectrum_shares)[:2])
    return np.asarray(np.stack(centroids[0]) - np.stack(centroids[1]))


def study_mosaic(channels: Sequence[Optics]) -> Iterator[Row]:
    """Noiseless stars in a mosaic, found as `hilstar tracker` does: rows of PLACES."""
    steps = np.arange(PHASES) / PHASES * 2
    y_px, x_px = (TILE_PX // 2 + grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    at = np.arange(TILE_PX)
    for sigma_px, kelvin in product(SIGMAS_PX, STARS_K):
        rates = [float(dgs_electrons_per_s(kelvin, channel, Photometry())) for channel in channels]
        shares = GaussianPsf((sigma_px, sigma_px)).shares(
            (at - x_px[:, None])[:, None, :], (at - y_px[:, None])[:, :, None]
        )
        stars = (
            shares.reshape(PHASES, PHASES, TILE_PX, TILE_PX)
            .swapaxes(1, 2)
            .reshape((PHASES * TILE_PX,) * 2)
        )
        raw = in_pixels([stars * rate / max(rates) for rate in rates], "rggb")
        for name, image, spread_px in (
            ("mosaic", raw, 0.0),
            ("superpixel", luminance(raw), SUPERPIXEL_VARIANCE_PX2),
        ):
            width_px = math.sqrt(sigma_px**2 + spread_px)
            settings = CentroidSettings(
                window_sigma_px=max(1.0, width_px),
                psf_sigma_px=(width_px, width_px),
                minimum_pixels=2,
            )
            centroids = find_stars(image, settings, LocalBackground(0.0, 1e-3))
            tiles = np.stack([centroids.x_px // TILE_PX, centroids.y_px // TILE_PX]).astype(np.intp)
            # the brightest of a tile
            first = np.unique(tiles[1] * PHASES + tiles[0], return_index=True)[1]
            column, row = tiles[:, first]
            true_x, true_y = (TILE_PX * tile + TILE_PX // 2 + steps[tile] for tile in (column, row))
            off = np.concatenate([centroids.x_px[first] - true_x, centroids.y_px[first] - true_y])
            yield sigma_px, kelvin, name, float(np.sqrt((off**2).mean())), float(np.abs(off).max())


def draw(path: Path, rows: Sequence[Row], load: Load) -> str:
    """The chart of the choices; its finding."""
    choices = [dict(zip(CHOICE, row, strict=True)) for row in rows]
    exact = {
        choice["colour"]: choice
        for choice in choices
        if (choice["tracker"], choice["method"]) == ("Bayer", "exact")
    }
    star = exact["star"]
    white = exact["white"]
    finding = (
        f"Each star's own mixture is {star['subtypes']:.2g} subtypes off before a Bayer tracker,"
        f" white {white['subtypes']:.0f}"
    )
    note = (
        "Full: exact; open: round. Circles: mono; triangles: mono to 700 nm; squares: Bayer. Lone"
        " stars of"
    )
    note += " V = 1 to 5.5 on an sRGB LCD of 8 bits."
    labels = {
        "subtypes": "colour, mean\n[subtypes]",
        "mag": "flux, 95 %\n[mag]",
        "px": "place, 95 %\n[px]",
    }
    with chart(path, finding, 3, note=load.note(note)) as axes:
        for axis, (name, label) in zip(axes, labels.items(), strict=True):
            for choice in choices:
                ink = INKS[str(choice["colour"])]
                marker = MARKERS[str(choice["tracker"])]
                face = ink if choice["method"] == "exact" else "none"
                axis.loglog(
                    choice["cpu_ms"], choice[name], marker, ms=7, color=ink, markerfacecolor=face
                )
            axis.set_ylabel(label)
        for name, ink in INKS.items():
            axes[0].plot([], [], "o", color=ink, label=name)
        axes[0].axhline(
            PUBLISHED_SUBTYPES,
            color=GREEN,
            linestyle=":",
            label=f"published, {PUBLISHED_SUBTYPES:g}",
        )
        axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, 1.25), ncols=4, frameon=False)
        axes[2].set_xlabel("frame, CPU time [ms]")
    return finding


def run(directory: Path, quick: bool = False) -> Judged:
    """Write colour.csv and its chart, and the tables colour_gamut, _class, _lateral, _red and
    _mosaic; findings.
    """
    others = OtherWork()
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_spectra(folder)
        by_class: list[Row] = []
        gamut = list(study_gamut(folder, by_class))
        lateral = list(study_lateral(folder))
        before = dict([*TRACKERS.items()][: 2 if quick else None])
        choices = list(
            study_choices(
                folder, before, *((QUICK_FIELDS, QUICK_ROUNDS) if quick else (FIELDS, ROUNDS))
            )
        )
        trackers = {}
        for sensor in (*MONO, *SENSORS):
            trackers[sensor] = file_of(folder, "OLED", sensor).config.tracker
        red = [
            (name, *class_shares(bench_optics(tracker_name, folder), RED_NM).values())
            for name, tracker_name in trackers.items()
        ]
        mosaic = list(study_mosaic(bench_channels(trackers["Bayer, wide dyes"], folder)))
    three = (
        ("", CHOICE, choices),
        ("_gamut", GAMUT, gamut),
        ("_class", BY_CLASS, by_class),
        ("_lateral", LATERAL, lateral),
    )
    for table, columns, rows in (
        *three,
        ("_red", ("sensor", *LETTERS), red),
        ("_mosaic", PLACES, mosaic),
    ):
        write_csv(directory / f"colour{table}.csv", columns, rows)
    load = others.load()
    lines = [draw(directory / "colour", choices, load)]
    lines += [
        f"lateral colour of {lens} by {by} on {on}: off by {off:.0%} of the sky's"
        for lens, on, by, *_, off in lateral
    ]
    lines += [
        f"a star of {px:g} px, {k:g} K, is {rms:.3f} px off rms in a {name}"
        for px, k, name, rms, _ in mosaic
        if px == 1
    ]
    return load.judged(lines)
