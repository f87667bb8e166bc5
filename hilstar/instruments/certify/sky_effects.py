"""What the sky and the codes add to each star: catalogue, spectrum, quantisation. They are in the
`star_` figures alone.
"""

from collections.abc import Iterator

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import magnitude
from hilstar.instruments.certify.budget import Input
from hilstar.instruments.certify.effects import Effect, root_mean_square
from hilstar.instruments.certify.model import Figures
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.catalogue import sigma_instrument_mag
from hilstar.server.bench.star_light import catalogue_choice, star_catalog
from hilstar.server.bench.star_rates import star_flux, star_kinds, star_rates
from hilstar.sky.facts import errors_of, motion_at
from hilstar.sky.star_table import table_facts

SKY = (("star_flux", "mag"), ("star_place_along", "arcsec"), ("star_place_across", "arcsec"))
FLUX, ALONG, ACROSS = range(len(SKY))
# stars' light by library spectra of their V-I: results/tradeoff.csv, 0.026 mag at 95 %
LIBRARY_MAG = 0.013
UNKNOWN_B_V_MAG = 0.65  # the Sun's


def of_sky(file: BenchFile, figures: Figures) -> Iterator[Effect]:
    """The effects of the sky on each star's own figures."""
    stars = figures.stars
    count = len(stars)
    rows = np.array([star.row for star in stars], dtype=np.intp)
    mag, arcsec = catalogue_errors(file, rows)
    source = "each star's errors in the catalogue"
    light = Input("catalogue light", "normal", source, count, root_mean_square(mag), "mag")
    yield Effect(light, sky=_of_own_star(mag, FLUX))
    both = np.concatenate([_of_own_star(arcsec, ALONG), _of_own_star(arcsec, ACROSS)])
    error = root_mean_square(arcsec)
    yield Effect(Input("catalogue place", "normal", source, 2 * count, error, "arcsec"), sky=both)
    colour, source = spectrum_mag(file, np.array([star.b_v_mag for star in stars]))
    common = np.zeros((1, len(SKY), count))
    common[0, FLUX] = colour
    spectrum = Input("spectrum", "normal", source, 1, root_mean_square(colour), "mag")
    yield Effect(spectrum, sky=common)
    scatter = 0.0
    if count > 2:
        scatter = float(np.std([star.quantised_mag for star in stars], ddof=1))
    source = "scatter of what the codes of the reference stars lose"
    codes = Input("quantisation", "normal", source, count, scatter, "mag")
    yield Effect(codes, sky=_of_own_star(np.full(count, scatter), FLUX))


def _of_own_star(values: FloatArray, kind: int) -> FloatArray:
    """Slopes (stars, 3, stars) of errors (stars,) of a kind that each star has for itself."""
    count = len(values)
    slopes = np.zeros((count, len(SKY), count))
    slopes[np.arange(count), kind, np.arange(count)] = values
    return slopes


def catalogue_errors(file: BenchFile, row: IntArray) -> tuple[FloatArray, FloatArray]:
    """The catalogue's errors of stars (n,) by their rows in `star_catalog`: of light in the
    tracker, mag, and of place along an axis, arcsec.
    """
    sky = file.config.sky
    choice = catalogue_choice(file.config, file.folder)
    stars = star_catalog(file.config, file.folder).taken(row)
    facts = table_facts(choice, stars, errors_of(stars))
    covariance = motion_at(stars, facts, sky.epoch_jyear).covariance
    place_mas = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    rates = star_rates(file.config, file.folder)
    mag = sigma_instrument_mag(stars, facts, rates, star_kinds(file.config, stars))
    return np.nan_to_num(mag), np.nan_to_num(place_mas) / 1000


def spectrum_mag(file: BenchFile, b_v_mag: FloatArray) -> tuple[FloatArray, str]:
    """The standard uncertainty of stars' light by the way from colour to spectrum (n,), mag, and
    its source.
    """
    sky = file.config.sky
    if sky.spectrum != "blackbody" or sky.brightness != "dgs":
        source = "real stars of one colour (study tradeoff: 0.026 mag at 95 %)"
        return np.full(len(b_v_mag), LIBRARY_MAG), source
    known = np.nan_to_num(b_v_mag, nan=UNKNOWN_B_V_MAG)
    none = np.zeros(len(known))
    rates = []
    for spectrum in ("pickles", "blackbody"):
        other = msgspec.structs.replace(sky, spectrum=spectrum)
        flux = star_flux(msgspec.structs.replace(file.config, sky=other), file.folder)
        channels = np.asarray(flux(none, known, none + np.nan, None))
        rates.append(channels.sum(axis=1))
    source = "black bodies against library spectra of the same B-V"
    return np.abs(magnitude(rates[0] / rates[1])), source
