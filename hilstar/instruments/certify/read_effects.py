"""What a bench's readings tell: its deviations, and the effects of the readings' own errors and of
the structure that their residuals have.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.certify.bench_readings import BesideRatio
from hilstar.instruments.certify.budget import Input
from hilstar.instruments.certify.effects import Effect, of_all_stars, root_mean_square
from hilstar.instruments.certify.estimates import Evenness, LightDeviation, Surface
from hilstar.instruments.certify.lens import LensFit, Places
from hilstar.instruments.certify.model import Deviations, Figures
from hilstar.instruments.certify.stated_effects import NEIGHBOURS, stated_delay
from hilstar.instruments.certify.structure import in_time, lasting_root
from hilstar.server.bench.bench_file import BenchFile

PLACES_IN_SQUARE = 7  # along each side
RECTANGLE, TRIANGLE = math.sqrt(3), math.sqrt(6)  # half of a range over its standard deviation


@dataclass(frozen=True, slots=True)
class Read:
    """A bench's readings, fitted; what could not be read is None."""

    light: LightDeviation
    even: Evenness
    place: LensFit
    delays_ms: FloatArray


def of_readings(
    file: BenchFile, figures: Figures, read: Read, missing: list[str]
) -> tuple[Deviations, list[Effect]]:
    """The deviations by a bench's readings (b = 1), and the effects of the readings' errors.

    `missing` gets what was not read, as in stated_effects.
    """
    if read.light.beside is None:
        missing.append(NEIGHBOURS)
    light = read.light
    join = light.weights(figures.log_light)
    even = map_at(read.even.fit, read.light.square_px, figures.x_px, figures.y_px)
    place = read.place.at(figures.x_px, figures.y_px)
    delay_ms = file.config.monitor.panel_delay_ms
    if len(read.delays_ms) > 1:
        delay_ms = float(read.delays_ms.mean())
    value = Deviations(
        (join @ light.value)[None],
        even.midway[None],
        place.value[None],
        np.array([delay_ms]),
        np.zeros(1),
    )
    effects = [*_of_light(light, figures), *_of_evenness(read.even, even), _of_places(place)]
    effects += _of_structure(figures, read, place)
    if file.config.certify.tracker.direction_expanded_arcsec is not None:
        longest_px = float(place.structure.length[-1])
        missing.append(
            f"smooth errors of dots: over more than {longest_px:.0f} px, half of the field, they"
            " look like the lens; [certify.tracker] direction_expanded_arcsec has to hold them"
        )
    if len(read.delays_ms) > 1:
        effects += _of_delays(read.delays_ms)
    else:
        effects += stated_delay(file, missing)
    return value, effects


@dataclass(frozen=True, slots=True)
class MapAtStars:
    """The map of a screen's log light at stars, relative to the mean of the square where light was
    read: what its terms add (stars, terms), the smooth surface (stars,), and `form`, how far that
    is from a map that is linear between its places (stars,).
    """

    terms: FloatArray
    smooth: FloatArray
    form: FloatArray

    @property
    def midway(self) -> FloatArray:
        """Half way from the smooth surface to the linear map."""
        return np.asarray(self.smooth - self.form / 2)


def map_at(
    fit: Surface, square_px: tuple[int, int, int], x_px: FloatArray, y_px: FloatArray
) -> MapAtStars:
    """A surface's map at stars' pixels (stars,); `square_px` is left, top and side of the square
    where light was read.
    """
    square = _places_in(square_px)
    terms = fit.terms(x_px, y_px) - fit.terms(*square).mean(axis=0)
    form = fit.bowed(x_px, y_px) - fit.bowed(*square).mean()
    return MapAtStars(terms, terms @ fit.value[:, 0], form)


def _places_in(square_px: tuple[int, int, int]) -> tuple[FloatArray, FloatArray]:
    """Places (n,) all over a square of the screen, left, top and side, px."""
    first_x, first_y, side = square_px
    along = np.zeros(1)
    if side > 1:
        along = (np.arange(PLACES_IN_SQUARE) + 0.5) / PLACES_IN_SQUARE * side - 0.5
    x, y = np.meshgrid(first_x + along, first_y + along)
    return x.ravel(), y.ravel()


def _of_light(light: LightDeviation, figures: Figures) -> Iterator[Effect]:
    """The effects of what patches of light scatter, lit and dark, and of the curve between them."""
    join = light.weights(figures.log_light)
    size = light.factors.shape[1]
    source = "patches of light"
    response = Input("response", "Student t", source, size, light.noise, "relative", light.dof)
    yield Effect(response, levels=(join @ light.factors).T)
    dark = (join @ light.dark_factors).T
    source = "scatter of black"
    black = Input(
        "dark readings", "Student t", source, len(dark), light.dark, "of white", light.dark_dof
    )
    yield Effect(black, levels=dark)
    bent = light.bent(figures.log_light) / 2 / TRIANGLE  # the spline is the more likely of both
    source = "a spline, or straight between codes"
    error = root_mean_square(bent)
    form = Input("form of the response", "triangular", source, 1, error, "relative")
    yield Effect(form, levels=bent[None])


def _of_evenness(even: Evenness, at_stars: MapAtStars) -> Iterator[Effect]:
    """The effects of the noise of dots' light on the map's terms, and of the map's form."""
    noise = even.fit.noise
    factors = even.fit.factors
    if even.structure.total:
        # What is the screen's is no noise of the dots.
        alone = math.sqrt(even.structure.noise_variance)
        factors = factors * alone / noise
        noise = alone
    size = at_stars.terms.shape[1]
    source = "light of dots"
    light = Input("evenness", "Student t", source, size, noise, "relative", even.fit.dof)
    yield Effect(light, even=(at_stars.terms @ factors).T)
    half = np.abs(at_stars.form) / 2 / RECTANGLE
    source = "smooth, or linear between a map's places"
    error = root_mean_square(half)
    shape = Input("form of the light map", "rectangular", source, 1, error, "relative")
    yield Effect(shape, even=half[None])


def _of_places(place: Places) -> Effect:
    """The effect of the noise of dots' places."""
    error = math.sqrt(place.structure.noise_variance)
    size = len(place.noise)
    source = "places of dots"
    geometry = Input("geometry", "Student t", source, size, error, "arcsec", place.noise_dof)
    return Effect(geometry, place=place.noise)


def _of_delays(late_ms: FloatArray) -> Iterator[Effect]:
    """The effects of edges (n,) that a photodiode saw: of each by itself, and of what correlates
    from one to the next.
    """
    count = len(late_ms)
    order = np.arange(count, dtype=np.float64)
    structure = in_time(order, late_ms - late_ms.mean(), np.ones((count, 1)))
    source = f"{count} edges of a photodiode"
    error = math.sqrt(structure.noise_variance / count)
    alone = Input("delay", "Student t", source, 1, error, "ms", count - 1.0)
    yield Effect(alone, delay=np.array([error]))
    if structure.total:
        error = float(np.linalg.norm(lasting_root(order, structure).mean(axis=0)))
        source = f"{source}, which correlate"
        several = Input("delay that lasts", "Student t", source, 1, error, "ms", structure.dof)
        yield Effect(several, delay=np.array([error]))


def _of_structure(figures: Figures, read: Read, place: Places) -> Iterator[Effect]:
    """The effects of what the residuals have of structure, where they have it: in time, of codes,
    of pixels beside each other, of light, of places.
    """
    yield from _of_common_light(read.light, figures)
    rough = read.light.rough(figures.log_light)
    if rough.any():
        source = "codes read, each foretold by the others: those not read"
        error = root_mean_square(rough[rough > 0])
        name = "roughness of the response"
        codes = Input(name, "normal", source, len(rough), error, "relative")
        yield Effect(codes, levels=np.diag(rough))
    if read.light.beside is not None:
        yield from _of_neighbours(read.light.beside, len(figures.stars))
    if read.even.structure.total:
        yield _of_uneven_light(figures, read.even, read.light.square_px)
    if place.structure.total:
        error = math.sqrt(place.structure.total)
        length = place.structure.mean_length
        source = f"places of dots about the lens, which correlate over {length:.0f} px"
        size = len(place.correlated)
        dof = place.structure.dof
        dots = Input("dots that correlate", "Student t", source, size, error, "arcsec", dof)
        yield Effect(dots, place=place.correlated)


def _of_common_light(light: LightDeviation, figures: Figures) -> Iterator[Effect]:
    """The effects of what correlates from one reading of light to the next, and of what several
    have in common.
    """
    join = light.weights(figures.log_light)
    structure = light.lasting
    if structure.total:
        slopes = (join @ light.lasting_factors).T
        error = light.noise * math.sqrt(structure.total)
        source = "readings that correlate from one to the next"
        size = len(slopes)
        name = "noise that lasts"
        lasting = Input(name, "Student t", source, size, error, "relative", structure.dof)
        yield Effect(lasting, levels=slopes)
    if light.common_factors.size:
        slopes = (join @ light.common_factors).T
        error = float(np.abs(light.common_factors).max())
        source = (
            "ratios of lattices by pairs of images, the ADC's rounding and its lowest code, black"
        )
        shared = Input("what readings share", "normal", source, len(slopes), error, "relative")
        yield Effect(shared, levels=slopes)


def _of_neighbours(beside: BesideRatio, count: int) -> Iterator[Effect]:
    """The effect of pixels that change each other's light on stars (count,).

    How a star's pixels do it is not known. Each has neighbours that are brighter and darker than
    itself, and a lattice has only its own code beside it. So a star's light is taken as between
    that of pixels alone and twice as far from it as the lattice's: two sigmas.
    """
    excess = beside.excess
    if not excess:
        return
    source = (
        "pixels among lit ones of their code against single ones:"
        f" {beside.ratio:.5f} +- {beside.error:.5f} times"
    )
    pixels = Input("pixels beside lit ones", "normal", source, 1, excess, "relative")
    yield Effect(pixels, even=of_all_stars(count, excess))


def _of_uneven_light(figures: Figures, even: Evenness, square_px: tuple[int, int, int]) -> Effect:
    """The effect of the light that a map leaves, at each star's place and in the square where light
    was read.
    """
    structure = even.structure
    count = len(figures.stars)
    x, y = _places_in(square_px)
    of_square = np.full((count, len(x)), -1 / len(x))
    shares = np.concatenate([np.eye(count), of_square], axis=1)
    x = np.append(figures.x_px, x)
    y = np.append(figures.y_px, y)
    scatter = even.scatter(x, y, shares)
    error = math.sqrt(structure.total)
    length = structure.mean_length
    source = (
        f"light of dots about its map, over {length:.0f} px: the screen's, at each star's place"
    )
    size = len(scatter)
    uneven = Input("uneven light", "Student t", source, size, error, "relative", structure.dof)
    return Effect(uneven, even=scatter)
