"""From a bench, and its readings where there are some, to the inputs of its budget and the model
that they go through.
"""

from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.instruments.certify.bench_readings import geometry_of
from hilstar.instruments.certify.budget import Input, Model
from hilstar.instruments.certify.effects import Effect
from hilstar.instruments.certify.estimates import evenness, light_deviation, place_errors
from hilstar.instruments.certify.lens import lens_fit
from hilstar.instruments.certify.model import Deviations, Figures, reference_stars
from hilstar.instruments.certify.read_effects import Read, of_readings
from hilstar.instruments.certify.readings import Reader, dot_places
from hilstar.instruments.certify.sky_effects import FLUX, SKY, of_sky
from hilstar.instruments.certify.stated_effects import of_drift, of_files, of_settings, of_warm_up
from hilstar.server.bench.bench_file import BenchFile

SEED = 5  # for the order of readings
DOT_IMAGES = 4
READINGS_A_ROUND = 8  # between one black and white and the next


def read_bench(file: BenchFile, reader: Reader) -> Read:
    """Read a bench for a certificate: its response, one pattern of dots, its delay. Raises
    InputError, MachineError.
    """
    certify = file.config.certify
    white = 2**file.config.monitor.bits - 1
    rng = np.random.default_rng(SEED)
    codes = planned_codes(white, certify.levels, certify.repeats, rng)
    light = light_deviation(file, reader.light(codes))
    dots = reader.dots(*dot_places(geometry_of(file)), DOT_IMAGES)
    place = lens_fit(file, dots, place_errors(file, dots))
    return Read(light, evenness(file, dots), place, reader.delays_ms())


def planned_codes(white: int, levels: int, repeats: int, rng: np.random.Generator) -> IntArray:
    """Codes to read (n,), in even steps of their logarithm, the faintest all of them; black and
    white before every eight.
    """
    count = min(levels, white)
    steps = count
    distinct = np.zeros(0)
    while len(distinct) < count:
        distinct = np.unique(np.rint(np.geomspace(1, white, steps)))
        steps += 1
    order = rng.permutation(np.repeat(distinct.astype(np.intp), repeats))
    black_and_white = np.array([0, white])
    rounds = []
    for k in range(0, len(order), READINGS_A_ROUND):
        rounds += [black_and_white, order[k : k + READINGS_A_ROUND]]
    return np.asarray(np.concatenate([*rounds, black_and_white]), dtype=np.intp)


@dataclass(frozen=True, slots=True)
class Assembled:
    """Inputs, the model of all figures, each figure's (quantity, star or field, unit), and what
    was not assessed.
    """

    inputs: list[Input]
    model: Model
    names: list[tuple[str, int, str]]
    figures: Figures
    not_assessed: list[str]


@dataclass(frozen=True, slots=True)
class _BenchModel:
    """The model of a bench's figures: its deviations as read or as its files have them, and what
    each input does to them.
    """

    figures: Figures
    value: Deviations
    effects: list[Effect]

    def __call__(self, variables: list[FloatArray]) -> FloatArray:
        """Figures (b, figures) by variables of each input (b, size)."""
        off = Deviations(
            levels=self._moved(self.value.levels, "levels", variables),
            even=self._moved(self.value.even, "even", variables),
            place_arcsec=self._moved(self.value.place_arcsec, "place", variables),
            delay_ms=self._moved(self.value.delay_ms, "delay", variables),
            late_ms=self._moved(self.value.late_ms, "late", variables),
        )
        count = len(self.figures.stars)
        of_bench = self.figures.of(off)
        shown = of_bench[:, : len(SKY) * count].reshape(-1, len(SKY), count)
        of_stars = self._moved(shown, "sky", variables)
        of_stars[:, FLUX] += [star.quantised_mag for star in self.figures.stars]
        columns = of_stars.reshape(len(of_bench), -1)
        return np.concatenate([of_bench, columns], axis=1)

    def _moved(self, value: FloatArray, kind: str, variables: list[FloatArray]) -> FloatArray:
        """A deviation (1 or b, ...) with what all inputs add to it (b, ...)."""
        trials = len(variables[0])
        moved = np.array(np.broadcast_to(value, (trials, *value.shape[1:])))
        for z, effect in zip(variables, self.effects, strict=True):
            slopes = getattr(effect, kind)
            if slopes is not None:
                moved += np.tensordot(z, slopes, axes=1)
        return moved


def assemble(
    file: BenchFile,
    read: Read | None,
    warm_up: float | None = None,
    checked: dict[str, float] | None = None,
) -> Assembled:
    """The budget of a bench. Raises InputError.

    White was seen to change by `warm_up` in ten minutes, relative, and its checks' figures by
    `checked`; None: not looked at.
    """
    figures = Figures(file, reference_stars(file))
    missing: list[str] = []
    if read is None:
        value = _as_stated(file, figures)
        effects = list(of_files(file, figures, value, missing))
    else:
        value, effects = of_readings(file, figures, read, missing)
    effects += of_settings(file, figures, missing)
    effects += of_warm_up(file, len(figures.stars), warm_up, missing)
    effects += of_drift(figures, checked, missing)
    effects += of_sky(file, figures)
    names = list(figures.names)
    for quantity, unit in SKY:
        names += [(quantity, star, unit) for star in range(len(figures.stars))]
    inputs = [effect.input for effect in effects]
    return Assembled(inputs, _BenchModel(figures, value, effects), names, figures, missing)


def _as_stated(file: BenchFile, figures: Figures) -> Deviations:
    """The deviations of a bench that is as its file says (b = 1)."""
    count = len(figures.stars)
    delay_ms = np.array([file.config.monitor.panel_delay_ms])
    return Deviations(
        np.ones((1, len(figures.log_light))),
        np.zeros((1, count)),
        np.zeros((1, count, 2)),
        delay_ms,
        np.zeros(1),
    )
