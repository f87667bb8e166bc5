"""What would bring a bench within its tolerance: one key at a time, tried by the bench's own plan.

The keys stand in the order of what they cost a user: nothing that is seen (bits, bit stealing,
`exact` where it is late), then frames that are right over an exposure only, stars that clip, wider
stars, and stars that are missing.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import msgspec

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.display.calibration import load_calibration
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.build import bench_stars, calibration_source, white_of
from hilstar.server.bench.config import GAUSSIAN, RenderSettings
from hilstar.server.bench.effort import BEST, Effort, Light, plan_effort
from hilstar.server.bench.frame import Bench
from hilstar.sky.stars import Stars

BITS = (10, 12, 14, 16)
BRIGHTER_MAG = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)  # by which full scale comes down
WIDER = (1.2, 1.4, 1.7, 2.0)  # times the sprite's sigma
SHALLOWER_MAG = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)  # above the faintest star
DIGITS = 3
Value = float | bool | str | tuple[float, float]


@dataclass(frozen=True, slots=True)
class Remedy:
    """A key of the bench file with another value, and the worst errors that the bench then has.

    An error is infinite where a star still shows nothing.
    """

    key: str
    value: Value
    error_mag: float
    error_px: float
    within: bool


@dataclass(frozen=True, slots=True)
class _Trial:
    """A key with another value, and what the bench's plan is then made of."""

    key: str
    value: Value
    render: RenderSettings
    light: Light


@dataclass(frozen=True, slots=True)
class _Sky:
    """The stars of a bench, how much of white each asks for, and the relative light of the
    darkest pixel.
    """

    stars: Stars
    drive: FloatArray | float
    darkest: float


def would_do(bench: Bench) -> list[Remedy]:
    """Each key that alone brings a bench within its tolerance, with the smallest change that does.

    Where no key alone does, each one's largest change. None for a bench that is within already.
    """
    if bench.effort.within:
        return []
    nearest, found = [], []
    for trials in _trials(bench):
        effort, trial = None, None
        for trial in trials:
            effort = plan_effort(trial.render, trial.light)
            if effort.within:
                found.append(_remedy(trial, effort))
                break
        if trial is not None and effort is not None and not effort.within:
            nearest.append((trial, effort))
    return found or [_remedy(*one) for one in nearest]


def _remedy(trial: _Trial, effort: Effort) -> Remedy:
    return Remedy(trial.key, trial.value, effort.error_mag, effort.error_px, effort.within)


def _trials(bench: Bench) -> Iterator[Iterator[_Trial]]:
    """The trials of each key, the smallest change first."""
    sky = _sky(bench)
    yield _more_bits(bench)
    yield _stolen_bits(bench)
    yield _other_codes(bench)
    yield _brighter(bench, sky)
    yield _wider(bench, sky)
    yield _shallower(bench, sky)


def _sky(bench: Bench) -> _Sky:
    stars = bench_stars(bench.file.config, bench.file.folder)
    drive: FloatArray | float = 1.0
    if bench.colours is not None:
        stars = bench.colours.on(stars)
        if stars.primaries is not None:
            drive = bench.colours.drive(stars.primaries)
    return _Sky(stars, drive, bench.darkest)


def _more_bits(bench: Bench) -> Iterator[_Trial]:
    """More bits, of a response that exists for any number of them."""
    config, effort = bench.file.config, bench.effort
    if not bench.calibration.is_formula:
        return
    for bits in BITS:
        if bits <= config.monitor.bits:
            continue
        try:
            calibration = load_calibration(
                bench.calibration.name, bits, bit_stealing=config.render.bit_stealing
            )
        except InputError:  # bit stealing of so many bits
            continue
        light = replace(effort.light, response=calibration.response)
        yield _Trial("[monitor] bits", bits, effort.asked, light)


def _stolen_bits(bench: Bench) -> Iterator[_Trial]:
    config, effort = bench.file.config, bench.effort
    if (
        config.render.bit_stealing
        or bench.colours is not None
        or not bench.calibration.can_steal_bits
    ):
        return
    source = calibration_source(config.monitor, bench.file.folder)
    response = load_calibration(source, config.monitor.bits, bit_stealing=True).response
    light = replace(effort.light, response=response)
    render = msgspec.structs.replace(effort.asked, bit_stealing=True)
    yield _Trial("[render] bit_stealing", True, render, light)


def _other_codes(bench: Bench) -> Iterator[_Trial]:
    """`exact`, where a slow machine or the file has other codes, and `temporal`."""
    effort = bench.effort
    methods = (BEST, "temporal") if effort.light.exposure_frames > 1 else (BEST,)
    for method in methods:
        if method == effort.quantisation:
            continue
        render = msgspec.structs.replace(effort.asked, quantisation=method)
        yield _Trial("[render] quantisation", method, render, effort.light)


def _brighter(bench: Bench, sky: _Sky) -> Iterator[_Trial]:
    """A full scale of fewer electrons: faint stars take more codes, and more bright ones clip."""
    effort = bench.effort
    for mag in BRIGHTER_MAG:
        if effort.asked.flux_at_white_e_per_s is not None:
            key = "flux_at_white_e_per_s"
            value = float(f"{effort.asked.flux_at_white_e_per_s * 10 ** (-0.4 * mag):.{DIGITS}g}")
        else:
            key = "brightest_v_mag"
            value = (effort.asked.brightest_v_mag or 0.0) + mag
            if value > sky.stars.v_mag.max(initial=0.0):
                return
        render = msgspec.structs.replace(effort.asked, **{key: value})
        white_e_per_s = white_of(render, sky.stars, effort.light.psf, sky.drive) * sky.darkest
        yield _Trial(
            f"[render] {key}", value, render, replace(effort.light, white_e_per_s=white_e_per_s)
        )


def _wider(bench: Bench, sky: _Sky) -> Iterator[_Trial]:
    """Stars over more pixels, each of which has its own rounding."""
    effort = bench.effort
    if effort.asked.psf != GAUSSIAN:
        return
    for factor in WIDER:
        x, y = (round(sigma * factor, 2) for sigma in effort.asked.sprite_sigma_px)
        render, psf = (
            msgspec.structs.replace(effort.asked, sprite_sigma_px=(x, y)),
            GaussianPsf((x, y)),
        )
        white_e_per_s = white_of(render, sky.stars, psf, sky.drive) * sky.darkest
        light = replace(effort.light, psf=psf, white_e_per_s=white_e_per_s)
        yield _Trial("[render] sprite_sigma_px", (x, y), render, light)


def _shallower(bench: Bench, sky: _Sky) -> Iterator[_Trial]:
    """A catalogue that ends at brighter stars."""
    effort, v_mag = bench.effort, sky.stars.v_mag
    faintest = min(bench.file.config.sky.faintest_v_mag, float(v_mag.max(initial=-99.0)))
    for mag in SHALLOWER_MAG:
        value = round(faintest - mag, 2)
        kept = v_mag <= value
        if not kept.any():
            return
        light = replace(effort.light, rates_e_per_s=sky.stars.electrons_per_s[kept])
        yield _Trial("[sky] faintest_v_mag", value, effort.asked, light)
