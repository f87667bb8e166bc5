"""The gain of `effort = "auto"`: five scenes on panels of 8, 10 and 12 bits, at full effort and at
the effort that two tolerances need, with the times of whole frames and the errors of stars.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.basics.charts import BLUE, MUTED, ORANGE, RED
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.study.engine import (
    BarSpec,
    ChartSpec,
    LevelLine,
    PanelSpec,
    SeriesLook,
    row_panels,
    write_rows,
)
from hilstar.instruments.study.study_benches import (
    FULL_HD,
    GLASS,
    LoneErrors,
    Table,
    lone_errors,
    study_bench,
)
from hilstar.instruments.study.sweep import NOT_JUDGED, Judged, Load, OtherWork, Spent, in_turn
from hilstar.optics.frame_motion import CameraTurn
from hilstar.server.bench.config.render import DEFAULT_TOLERANCE_MAG, DEFAULT_TOLERANCE_PX
from hilstar.server.bench.drawn import Drawn
from hilstar.server.bench.frame import Bench
from hilstar.tracker.centroiders import FAMILY

# Full effort: `exact` codes and whole sprites reach every tolerance that can be reached.
FULL: Table = {"quantisation": "exact", "motion_above_px": 0.0}
AUTO: Table = {"effort": "auto", "quantisation": "auto"}
ROUNDS, QUICK_ROUNDS = 60, 5
BITS = (8, 10, 12)
COLOURS = {8: ORANGE, 10: BLUE, 12: MUTED}


@dataclass(frozen=True, slots=True)
class EffortTolerance:
    """The largest allowed error of a star, mag and px, and the tolerance's name."""

    name: str
    mag: float
    px: float


DEFAULT = EffortTolerance("default", DEFAULT_TOLERANCE_MAG, DEFAULT_TOLERANCE_PX)
TOLERANCES: tuple[EffortTolerance, ...] = (DEFAULT, EffortTolerance("0.1", 0.1, 0.1))


@dataclass(frozen=True, slots=True)
class EffortScene:
    """Where a bench points, how faint its stars go and how fast it turns."""

    name: str
    radec_roll_deg: tuple[float, float, float]
    focal_length_mm: float
    faintest_v_mag: float
    rate_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def turn(self) -> CameraTurn:
        """The attitude and its rate."""
        return CameraTurn(from_radec_roll_deg(*self.radec_roll_deg), np.radians(self.rate_deg_s))


SCENES: tuple[EffortScene, ...] = (
    EffortScene("narrow, sparse", (192.9, 27.1, 0.0), 600.0, 8.0),
    EffortScene("wide, sparse", (192.9, 27.1, 0.0), 120.0, 6.5),
    EffortScene("narrow, Milky Way", (305.0, 40.0, 20.0), 350.0, 8.0),
    EffortScene("wide, Milky Way", (305.0, 40.0, 20.0), 120.0, 8.0),
    EffortScene("wide, Milky Way, 1 deg/s", (305.0, 40.0, 20.0), 120.0, 7.0, (0.6, 0.8, 0.0)),
)
CASES = tuple(product(BITS, SCENES))


@dataclass(frozen=True, slots=True)
class EffortOutcome:
    """A scene at one effort: the times of a frame, the largest errors of lone stars, and the
    tolerance.

    `tolerance` is "full" at full effort, which has the default's figures. `frame_ms` is the median
    time of a whole frame, `cpu_ms` its processor time. `claimed_mag` and `claimed_px` are the
    plan's figures of the worst star. `centroid_max_px` is by the plain moment on the monitor,
    `max_px_...` by each centroider on the tracker.
    """

    scene: str
    bits: int
    tolerance: str
    tolerance_mag: float
    tolerance_px: float
    quantisation: str
    stars: int
    frame_ms: float
    cpu_ms: float
    flux_max_mag: float
    centroid_max_px: float
    claimed_mag: float
    claimed_px: float
    claimed_within: bool
    measured_stars: int
    max_px_moment: float
    max_px_window: float
    max_px_wide: float
    max_px_fit: float
    max_px_box3: float
    max_px_box5: float

    @property
    def worst_px(self) -> float:
        """The largest error of a place by any centroider."""
        return max(float(getattr(self, f"max_px_{kind}")) for kind in FAMILY)

    @property
    def share(self) -> float:
        """The larger of the errors of light and place, as a multiple of the tolerance."""
        return max(self.flux_max_mag / self.tolerance_mag, self.worst_px / self.tolerance_px)

    @property
    def within(self) -> bool:
        """Light and place, by each centroider, are within the tolerance."""
        return self.share <= 1.0


@dataclass(frozen=True, slots=True)
class EffortComparison:
    """A scene at full effort, and at the effort that a tolerance needs."""

    full: EffortOutcome
    auto: EffortOutcome

    @property
    def speed_up(self) -> float:
        """The time of a whole frame at full effort over that at auto effort."""
        return self.full.frame_ms / self.auto.frame_ms


@dataclass(frozen=True, slots=True)
class EconomyMeasured:
    """Each scene's outcomes at each depth, full effort first, and the work of others meanwhile."""

    groups: Sequence[Sequence[EffortOutcome]]
    load: Load


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure every scene, and write `economy.csv` and its chart; a line for each comparison.
    Raises InputError.
    """
    return report(directory, measure(quick))


def measure(quick: bool, cases: Sequence[tuple[int, EffortScene]] = CASES) -> EconomyMeasured:
    """The outcomes of scenes on panels of so many bits."""
    others = OtherWork()
    rounds = QUICK_ROUNDS if quick else ROUNDS
    groups = []
    for bits, scene in cases:
        groups.append(compare(scene, bits, rounds))
    return EconomyMeasured(groups, others.load())


def report(directory: Path, measured: EconomyMeasured) -> Judged:
    """Write what was measured; a line for each comparison. Raises InputError."""
    load = measured.load
    comparisons = []
    rows: list[EffortOutcome] = []
    for full, *autos in measured.groups:
        rows += [full, *autos]
        for auto in autos:
            comparisons.append(EffortComparison(full, auto))
    write_rows(directory / "economy.csv", rows)
    draw(directory / "economy", comparisons, load)
    lines = []
    for comparison in comparisons:
        lines.append(line_of(comparison, load))
    if not load.busy:
        lines.append(economy_finding(comparisons))
    return load.judged(lines)


def effort_keys(tolerance: EffortTolerance) -> Table:
    """The keys of [render] by which effort keeps a tolerance."""
    return {**AUTO, "tolerance_mag": tolerance.mag, "tolerance_px": tolerance.px}


def bench_tables(scene: EffortScene, bits: int) -> dict[str, dict[str, Table]]:
    """The bench files' tables of a scene at full effort, and at the effort that each of TOLERANCES
    needs, by the effort's name.
    """
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024), "transmission": GLASS},
        "sky": {"faintest_v_mag": scene.faintest_v_mag},
        "monitor": {**FULL_HD, "bits": bits},
        "collimator": {"focal_length_mm": scene.focal_length_mm},
    }
    motion = "on" if any(scene.rate_deg_s) else "auto"
    scene_keys: Table = {"brightest_v_mag": 2.0, "motion": motion}
    efforts: dict[str, Table] = {"full": FULL}
    for tolerance in TOLERANCES:
        efforts[tolerance.name] = effort_keys(tolerance)
    return {name: {**tables, "render": {**scene_keys, **keys}} for name, keys in efforts.items()}


def compare(scene: EffortScene, bits: int, rounds: int) -> list[EffortOutcome]:
    """A scene at full effort and at the effort that each of TOLERANCES needs, timed in turn."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        benches = {}
        for name, tables in bench_tables(scene, bits).items():
            bench = study_bench(Path(folder) / f"{name}.toml", tables)
            benches[name] = stack.enter_context(bench)
        times = in_turn(frame_works(benches, scene.turn), rounds)
        outcomes = []
        for name, bench in benches.items():
            drawn = frame_of(bench, scene.turn, 0)
            errors = lone_errors(bench, scene.turn, drawn.levels)
            found = FrameErrors(drawn.star_count, errors)
            outcomes.append(outcome(scene, name, bench, found, times[name]))
        return outcomes


def frame_works(
    benches: Mapping[str, Bench], turn: CameraTurn
) -> dict[str, Callable[[int], Drawn]]:
    """What is timed of each bench: a frame of the turn, by its number."""
    works: dict[str, Callable[[int], Drawn]] = {}
    for name, bench in benches.items():
        works[name] = partial(frame_of, bench, turn)
    return works


def frame_of(bench: Bench, turn: CameraTurn, number: int) -> Drawn:
    """One of the frames of a turn."""
    return bench.draw(turn.q_icrs_to_cam, number, turn.rate_cam_rad_s)


@dataclass(frozen=True, slots=True)
class FrameErrors:
    """How many stars a frame shows, and the errors of those that stand alone."""

    stars: int
    lone: LoneErrors


def outcome(
    scene: EffortScene, name: str, bench: Bench, found: FrameErrors, times: Sequence[Spent]
) -> EffortOutcome:
    """The errors of a scene's stars at one effort, and the times of its frames."""
    tolerances = {tolerance.name: tolerance for tolerance in TOLERANCES}
    tolerance = tolerances.get(name, DEFAULT)
    errors = found.lone
    max_px = {}
    for kind in FAMILY:
        distance_px = np.hypot(*errors.off_px[kind])
        max_px[f"max_px_{kind}"] = float(distance_px.max())
    frame_ms, cpu_ms = np.median(times, axis=0).tolist()
    return EffortOutcome(
        scene=scene.name,
        bits=bench.config.monitor.bits,
        tolerance=name,
        tolerance_mag=tolerance.mag,
        tolerance_px=tolerance.px,
        quantisation=bench.config.render.quantisation,
        stars=found.stars,
        frame_ms=frame_ms,
        cpu_ms=cpu_ms,
        claimed_mag=bench.effort.error_mag,
        claimed_px=bench.effort.error_px,
        claimed_within=bench.effort.within,
        flux_max_mag=max(abs(error.flux_mag) for error in errors.stars),
        centroid_max_px=max(error.centroid_px for error in errors.stars),
        measured_stars=len(errors.stars),
        **max_px,
    )


def line_of(comparison: EffortComparison, load: Load) -> str:
    """A comparison in words."""
    full = comparison.full
    auto = comparison.auto
    compared = speed_words(comparison.speed_up)
    if load.busy:
        compared = NOT_JUDGED
    scene = f"{auto.scene}, {auto.bits} bits"
    times = f"{auto.frame_ms:.2f} ms ({auto.quantisation}) instead of {full.frame_ms:.2f} ms"
    within = "within" if auto.within else "OVER"
    return (
        f"{scene}, {auto.tolerance_mag:g} mag and {auto.tolerance_px:g} px: {times}, {compared};"
        f" largest errors of {auto.measured_stars} stars {auto.flux_max_mag:.4f} mag and"
        f" {auto.worst_px:.4f} px by the worst of six centroiders ({auto.max_px_fit:.4f} by a PSF"
        f" fit), {within} the tolerance"
    )


def speed_words(ratio: float) -> str:
    """How many times as fast auto effort is, in words."""
    if ratio >= 1:
        return f"{ratio:.1f} times as fast"
    return f"{1 / ratio:.1f} times as SLOW"


def economy_finding(comparisons: Sequence[EffortComparison]) -> str:
    """The result in one sentence: the median speed-up at the default tolerance by bits, its
    range, and the errors.
    """
    by_bits: dict[int, list[float]] = {}
    for comparison in comparisons:
        if comparison.auto.tolerance == DEFAULT.name:
            by_bits.setdefault(comparison.auto.bits, []).append(comparison.speed_up)
    depths = ", ".join(str(bits) for bits in sorted(by_bits))
    medians = ", ".join(f"{np.median(by_bits[bits]):.1f}" for bits in sorted(by_bits))
    speed_ups = [comparison.speed_up for comparison in comparisons]
    extent = f"{min(speed_ups):.1f} to {max(speed_ups):.1f}"
    return (
        f"At {depths} bits auto effort is {medians} times as fast as full effort ({extent} over all"
        f" scenes and both tolerances), {within_words(comparisons)}"
    )


def within_words(comparisons: Sequence[EffortComparison]) -> str:
    """Whether the errors of all scenes are within tolerance, in words."""
    over = sum(not comparison.auto.within for comparison in comparisons)
    if over:
        return f"{over} of {len(comparisons)} OVER tolerance"
    return "within tolerance"


def draw(path: Path, comparisons: Sequence[EffortComparison], load: Load) -> None:
    """The speed-up by `effort = "auto"` in each scene, and its errors there relative to the
    tolerance.
    """
    title = load.title(economy_finding(comparisons), f"Auto effort is {within_words(comparisons)}")
    looks = {}
    depths = sorted({comparison.auto.bits for comparison in comparisons})
    for bits, tolerance in product(depths, TOLERANCES):
        fade = {"alpha": 1.0 if tolerance is DEFAULT else 0.5}
        look = SeriesLook(f"{bits} bits, {tolerance.name}", COLOURS[bits], more=fade)
        looks[bits, tolerance.name] = look
    speed = PanelSpec(
        ylabel="full / auto, time",
        bars=BarSpec(scene_words, "speed_up"),
        levels=(LevelLine(1.0, "as fast as full effort", RED, "-", 1),),
        ylim=bar_limits([comparison.speed_up for comparison in comparisons]),
        legend={"loc": "upper left", "ncols": 3},
    )
    error = PanelSpec(
        ylabel="error / limit",
        bars=BarSpec(scene_words, share_of_tolerance, named=False),
        levels=(LevelLine(1.0, "tolerance", RED, "-", 1),),
        ylim=bar_limits([comparison.auto.share for comparison in comparisons]),
        legend={"loc": "upper right"},
    )
    spec = ChartSpec((speed, error), effort_of, looks, note_of(), layout={"heights": (1, 1)})
    with row_panels(path, title, spec, comparisons, load) as (_, axes):
        # Shares of 0.25 would push the label off the canvas.
        axes.set_yticks(np.arange(0.0, axes.get_ylim()[1], 0.5))


def note_of() -> str:
    """How errors are measured, and the tolerances."""
    tolerances = []
    for tolerance in TOLERANCES:
        tolerances.append(f"{tolerance.name}, {tolerance.mag:g} mag and {tolerance.px:g} px")
    return (
        "Errors of stars that stand alone; places by the worst of six centroiders, whose boxes have"
        f" no threshold. Tolerances: {'; '.join(tolerances)}."
    )


def effort_of(comparison: EffortComparison) -> tuple[int, str]:
    """The series of a comparison: its panel and its tolerance."""
    return comparison.auto.bits, comparison.auto.tolerance


def scene_words(comparison: EffortComparison) -> str:
    """The group of a comparison: its scene, broken into lines."""
    return comparison.auto.scene.replace(", ", ",\n")


def share_of_tolerance(comparison: EffortComparison) -> float:
    """The error at auto effort as a multiple of the tolerance."""
    return comparison.auto.share


def bar_limits(heights: Sequence[float]) -> tuple[float, float]:
    """The limits of an axis of bars: from 0, with room for a legend over the highest."""
    return 0, 1.45 * max(1.0, *heights)
