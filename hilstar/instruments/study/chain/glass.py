"""The tracker's glass in the study of the chain: what each PSF in its place costs a star, against a
frame's time.

The frame is the virtual tracker's in the densest field, noise and truth included. Errors are of
each star in its own light, without noise, as the bench's centroider finds it, against the file's
whole basis, integrated over pixels star by star.
"""

from collections.abc import Iterator, Mapping
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
from hilstar.instruments.study.chain.measuring import AUTO, rounded, said, times_of
from hilstar.instruments.study.sweep import MAX_ROUNDS, in_turn, pareto_front
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

TIME_S, QUICK_TIME_S = 30.0, 2.0
MIN_STARS = 3
SEED = 1


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

    def words(self) -> str:
        """ "a basis of 6: 0.12 arcsec, 0.4 %, 9.1 ms"."""
        error = f"{two_digits(self.error_arcsec)} arcsec, {two_digits(self.error_percent)} %"
        return (
            f"{self.psf}{f' ({self.chosen})' if self.chosen else ''}: {error},"
            f" {two_digits(self.time_ms)} ms"
        )


def glass_rows(file: BenchFile, scene: ChainScene, quick: bool) -> list[GlassRow]:
    """Each PSF that may stand for a bench's glass, in one scene; none where the bench has no
    glass, or too few stars.
    """
    tracker = file.config.tracker
    if tracker.optics.psf == GAUSSIAN:
        whole = None
    else:
        whole = tracker_psf(replace(tracker, effort="full"), file.folder)
    if not isinstance(whole, GlassPsf):
        return []
    drawable = dict(_drawable(whole))
    with ExitStack() as stack:
        simulators = {
            name: stack.enter_context(Simulator(file, psf=psf)) for name, psf in drawable.items()
        }
        errors = _errors(next(iter(simulators.values())), whole, drawable, scene)
        if not errors:
            return []
        view = next(iter(simulators.values())).view(scene.q_icrs_to_cam, np.zeros(3))
        works = {name: partial(_exposed, simulator, view) for name, simulator in simulators.items()}
        time_s = QUICK_TIME_S if quick else TIME_S
        spent_by_name = in_turn(works, MAX_ROUNDS, time_s / len(works))
    times = {name: times_of(np.array(spent)) for name, spent in spent_by_name.items()}
    errors_arcsec = [errors[name][1] for name in drawable]
    fronts = pareto_front(errors_arcsec, [times[name].time_ms for name in drawable])
    tolerance = tracker.tolerance_mag, tracker.tolerance_px
    _, reason = least_tracker_psf(whole, tracker.resolution_px, tolerance)
    auto = reason.choice
    return [
        GlassRow(
            scene.name,
            name,
            psf.components,
            *errors[name],
            **asdict(times[name]),
            on_front=said(bool(on)),
            chosen=AUTO if name == auto else "",
        )
        for (name, psf), on in zip(drawable.items(), fronts, strict=True)
    ]


def _exposed(simulator: Simulator, view: View, number: int) -> object:
    """The exposure of one round."""
    return simulator.expose(view, np.random.default_rng((SEED, number)))


def _drawable(whole: GlassPsf) -> Iterator[tuple[str, Psf]]:
    for name, make in candidates(whole):
        try:
            yield name, make()
        except InputError:  # as in `least_psf`
            continue


def _errors(
    tracker: Simulator, whole: GlassPsf, found: Mapping[str, Psf], scene: ChainScene
) -> dict[str, tuple[int, float, float, float]]:
    """How many stars, and how far off each PSF has them: place, rms arcsec; light, rms and most,
    %.
    """
    reach = whole.footprint_px // 2
    rows = field_stars(tracker.stars, tracker.camera, scene.q_icrs_to_cam)
    row, column = (np.floor(rows[name] + 0.5).astype(np.intp) for name in ("y_px", "x_px"))
    shares = StarGlass(tracker.file, whole).shares_of(tracker.stars, rows["hip"])
    light = whole.unreduced(rows["x_px"], rows["y_px"], shares)
    lit = light.sum(axis=(1, 2)) > 0  # a corner may be dark
    if lit.sum() < MIN_STARS:
        return {}
    kind = tracker.config.verify.judge or "window"
    arcsec_per_px = ARCSEC_PER_RAD / tracker.camera.scales_px_rad()[1]

    def measured(stamps: FloatArray) -> FloatArray:
        return np.stack(
            [*star_places(stamps[lit], kind, whole.width_px), stamps[lit].sum(axis=(1, 2))]
        )

    def off(psf: Psf) -> tuple[int, float, float, float]:
        psf_stamp = told_psf(psf, (row, column), 2 * reach + 1, shares)
        x, y, flux = measured(psf_stamp(rows["x_px"] - column, rows["y_px"] - row))
        place = np.hypot(x - true[0], y - true[1]) * arcsec_per_px
        percent = 100 * (flux / true[2] - 1)
        rms = [rounded(float(np.sqrt(np.mean(error_px**2)))) for error_px in (place, percent)]
        return len(place), rms[0], rms[1], rounded(float(np.abs(percent).max()))

    true = measured(light)
    return {name: off(psf) for name, psf in found.items()}


def glass_line(rows: list[GlassRow]) -> str:
    """What the PSFs cost, for a person."""
    return f"PSF of the tracker's glass, {rows[0].scene}, {rows[0].stars} stars: " + "; ".join(
        row.words() for row in rows
    )


def draw_glass(place: "Axes", light: "Axes", rows: list[GlassRow]) -> None:
    """Two panels: error of place and of light against a frame's time, a point for each PSF."""
    place.set_title(f"PSF of the virtual tracker, {rows[0].scene}, {rows[0].stars} stars")
    for axes, error, label in (
        (place, "error_arcsec", "star's place, rms [arcsec]"),
        (light, "error_percent", "light, rms [%]"),
    ):
        axes.set(xscale="log", yscale="log", ylabel=label)
        floor = min((getattr(row, error) for row in rows if getattr(row, error) > 0), default=1.0)
        named = []
        for row in rows:
            at = (row.time_ms, max(getattr(row, error), floor))
            colour = RED if row.chosen else BLUE if row.on_front == "true" else INK
            axes.plot(
                [max(at[0] - row.noise_ms, at[0] / 2), at[0] + row.noise_ms],
                [at[1]] * 2,
                color=colour,
                lw=1.0,
                alpha=0.4,
            )
            axes.plot(*at, "o", color=colour, ms=6 if row.on_front == "true" else 4)
            row_text = row.psf + (f" ({row.chosen})" if row.chosen else "")
            named.append(
                (
                    f"{row_text}: {two_digits(getattr(row, error))}, {two_digits(row.time_ms)} ms",
                    at,
                    colour,
                )
            )
        axes.margins(0.06, 0.12)
        name_at_side(axes, named)
    light.set_xlabel("median time of a frame of the virtual tracker [ms]")
