"""The tracker's glass in the study of the chain: what each PSF in its place costs a star, against a
frame's time.

The frame is the virtual tracker's in the densest field, noise and truth included. Errors are of
each star in its own light, without noise, as the bench's centroider finds it, against the file's
whole basis, integrated over pixels star by star.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, INK, RED, name_at_side, two_digits
from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.simulate.glass import told_psf
from hilstar.instruments.simulate.noise import field_stars
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.instruments.study.chain.choices import ChainScene
from hilstar.instruments.study.chain.measuring import (
    AUTO,
    noise_ends_ms,
    rounded,
    said,
    times_of,
)
from hilstar.instruments.study.sweep import MAX_ROUNDS, in_turn, pareto_front
from hilstar.instruments.study.trials import FrontLook, FrontPoint, draw_front
from hilstar.optics.glass.glass_psf import GlassPsf
from hilstar.optics.layers.view import View
from hilstar.optics.psf import Psf
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import least_tracker_psf, tracker_psf
from hilstar.server.bench.config import GAUSSIAN
from hilstar.server.bench.least_psf import candidates
from hilstar.server.bench.star_glass import StarGlass
from hilstar.tracker.centroiders import star_places

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIME_S, QUICK_TIME_S = 30.0, 2.0  # for the frames of all PSFs
MIN_STARS = 3  # an rms of fewer is chance
SEED = 1
# Without a line: each point is named.
GLASS_LOOK = FrontLook(
    line=None, bar={"lw": 1.0, "alpha": 0.4}, beaten={"ms": 4}, ring_pt={}, ring_width=0
)

# Places (x, y) of stars (n,), px from the middles of their stamps (n, side, side).
Finder = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True)
class GlassRow:
    """A PSF in the glass's place; its fields are the columns of `chain_psf.csv`.

    Errors are rms over the `stars`, `worst_percent` the largest of light. `on_front` is that of
    `time_ms` and `error_arcsec`, `chosen` what `[tracker] effort = "auto"` takes.
    """

    scene: str
    psf: str
    components: int
    stars: int
    error_arcsec: float
    error_percent: float
    worst_percent: float
    time_ms: float
    iqr_ms: float
    noise_ms: float
    cpu_ms: float
    frames: int
    on_front: str
    chosen: str

    @property
    def name(self) -> str:
        """The PSF, and what chooses it in brackets."""
        if self.chosen:
            return f"{self.psf} ({self.chosen})"
        return self.psf

    def words(self) -> str:
        """ "a basis of 6: 0.12 arcsec, 0.4 %, 9.1 ms"."""
        error = f"{two_digits(self.error_arcsec)} arcsec, {two_digits(self.error_percent)} %"
        return f"{self.name}: {error}, {two_digits(self.time_ms)} ms"


@dataclass(frozen=True, slots=True)
class GlassErrors:
    """The errors of a PSF over some stars: place, arcsec rms; light, rms and largest, %."""

    stars: int
    error_arcsec: float
    error_percent: float
    worst_percent: float


def glass_rows(file: BenchFile, scene: ChainScene, quick: bool) -> list[GlassRow]:
    """Each PSF that may stand for a bench's glass, in one scene; none where the bench has no
    glass, or too few stars.
    """
    tracker = file.config.tracker
    if tracker.optics.psf == GAUSSIAN:
        return []
    whole = tracker_psf(replace(tracker, effort="full"), file.folder)
    if not isinstance(whole, GlassPsf):
        return []
    drawable = dict(_drawable(whole))
    works: dict[str, Callable[[int], object]] = {}
    with ExitStack() as stack:
        simulators = []
        for psf in drawable.values():
            simulators.append(stack.enter_context(Simulator(file, psf=psf)))
        errors = errors_in(simulators[0], whole, drawable, scene)
        if not errors:
            return []
        view = simulators[0].view(scene.q_icrs_to_cam, np.zeros(3))
        for name, simulator in zip(drawable, simulators, strict=True):
            works[name] = partial(_exposed, simulator, view)
        time_s = QUICK_TIME_S if quick else TIME_S
        spent_by_name = in_turn(works, MAX_ROUNDS, time_s / len(works))
    times = {}
    for name, spent in spent_by_name.items():
        times[name] = times_of(np.array(spent))
    errors_arcsec = [errors[name].error_arcsec for name in drawable]
    times_ms = [times[name].time_ms for name in drawable]
    fronts = pareto_front(errors_arcsec, times_ms)
    tolerance = tracker.tolerance_mag, tracker.tolerance_px
    _, reason = least_tracker_psf(whole, tracker.resolution_px, tolerance)
    rows = []
    for (name, psf), on_front in zip(drawable.items(), fronts, strict=True):
        rows.append(
            GlassRow(
                scene=scene.name,
                psf=name,
                components=psf.components,
                **asdict(errors[name]),
                **asdict(times[name]),
                on_front=said(bool(on_front)),
                chosen=AUTO if name == reason.choice else "",
            )
        )
    return rows


def _exposed(simulator: Simulator, view: View, number: int) -> object:
    """The exposure of one round."""
    return simulator.expose(view, np.random.default_rng((SEED, number)))


def _drawable(whole: GlassPsf) -> Iterator[tuple[str, Psf]]:
    for name, make in candidates(whole):
        try:
            yield name, make()
        except InputError:  # as in `least_psf`
            continue


def errors_in(
    tracker: Simulator, whole: GlassPsf, psfs: Mapping[str, Psf], scene: ChainScene
) -> dict[str, GlassErrors]:
    """The errors of each PSF in a scene; empty where too few stars are lit."""
    reach = whole.footprint_px // 2
    stars = field_stars(tracker.stars, tracker.camera, scene.q_icrs_to_cam)
    row = np.floor(stars["y_px"] + 0.5).astype(np.intp)
    column = np.floor(stars["x_px"] + 0.5).astype(np.intp)
    shares = StarGlass(tracker.file, whole).shares_of(tracker.stars, stars["hip"])
    light = whole.unreduced(stars["x_px"], stars["y_px"], shares)
    stamps = {}
    for name, psf in psfs.items():
        psf_stamp = told_psf(psf, (row, column), 2 * reach + 1, shares)
        stamps[name] = psf_stamp(stars["x_px"] - column, stars["y_px"] - row)
    find = partial(
        star_places, kind=tracker.config.verify.judge or "window", sigma_px=whole.width_px
    )
    return stamp_errors(light, stamps, find, ARCSEC_PER_RAD / tracker.camera.scales_px_rad()[1])


def stamp_errors(
    light: FloatArray, stamps: Mapping[str, FloatArray], find: Finder, arcsec_per_px: float
) -> dict[str, GlassErrors]:
    """The errors of stars' stamps (n, side, side) against their true `light`, by the name of each;
    empty where fewer than MIN_STARS are lit.
    """
    lit = light.sum(axis=(1, 2)) > 0  # a corner may be dark
    if lit.sum() < MIN_STARS:
        return {}

    def measured(stamps: FloatArray) -> FloatArray:
        """Places and light of the lit stars, (3, n)."""
        x_px, y_px = find(stamps[lit])
        return np.stack([x_px, y_px, stamps[lit].sum(axis=(1, 2))])

    true_x, true_y, true_light = measured(light)
    errors = {}
    for name, of_psf in stamps.items():
        x, y, flux = measured(of_psf)
        place = np.hypot(x - true_x, y - true_y) * arcsec_per_px
        percent = 100 * (flux / true_light - 1)
        largest = rounded(float(np.abs(percent).max()))
        errors[name] = GlassErrors(len(place), _rms(place), _rms(percent), largest)
    return errors


def _rms(errors: FloatArray) -> float:
    """The rms of errors, as the table has it."""
    return rounded(float(np.sqrt(np.mean(errors**2))))


def glass_line(rows: Sequence[GlassRow]) -> str:
    """The errors and times of the PSFs, in words."""
    scene = f"{rows[0].scene}, {rows[0].stars} stars"
    return f"PSF of the tracker's glass, {scene}: {'; '.join(row.words() for row in rows)}"


def draw_glass(place: "Axes", light: "Axes", rows: Sequence[GlassRow]) -> None:
    """Two panels: error of place and of light against a frame's time, a point for each PSF."""
    place.set_title(f"PSF of the virtual tracker, {rows[0].scene}, {rows[0].stars} stars")
    place.set_ylabel("star's place, rms [arcsec]")
    light.set_ylabel("light, rms [%]")
    light.set_xlabel("median time of a frame of the virtual tracker [ms]")
    for axes, error in ((place, "error_arcsec"), (light, "error_percent")):
        errors = [getattr(row, error) for row in rows]
        floor = min((size for size in errors if size > 0), default=1.0)
        points = []
        names = []
        for row, size in zip(rows, errors, strict=True):
            at = row.time_ms, max(size, floor)
            colour = colour_of(row)
            ends_ms = noise_ends_ms(row.time_ms, row.noise_ms)
            points.append(FrontPoint(*at, ends_ms, colour, row.on_front == "true"))
            name = f"{row.name}: {two_digits(size)}, {two_digits(row.time_ms)} ms"
            names.append((name, at, colour))
        draw_front(axes, points, GLASS_LOOK)
        axes.margins(0.06, 0.12)
        name_at_side(axes, names)


def colour_of(row: GlassRow) -> str:
    """The colour of a PSF's point."""
    if row.chosen:
        return RED
    if row.on_front == "true":
        return BLUE
    return INK
