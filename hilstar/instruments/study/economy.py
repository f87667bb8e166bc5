"""The gain of `effort = "auto"`: five scenes on panels of 8, 10 and 12 bits, at full effort and at
the effort that
two tolerances need, with the times of whole frames and the errors of stars.
"""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hilstar.basics.charts import BLUE, MUTED, ORANGE, RED, chart, write_records
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.quantise import shown_light
from hilstar.display.render.reference import linear_image
from hilstar.instruments.study.study_benches import (
    FULL_HD,
    GLASS,
    Isolation,
    Table,
    lone_windows,
    squares,
    star_error,
    study_bench,
)
from hilstar.instruments.study.sweep import NOT_JUDGED, Judged, Load, OtherWork, Spent, in_turn
from hilstar.optics.frame_motion import CameraTurn, swept_sprites
from hilstar.optics.scan import Scan
from hilstar.server.bench.code_errors import NO_THRESHOLD
from hilstar.server.bench.config.render import DEFAULT_TOLERANCE_MAG, DEFAULT_TOLERANCE_PX
from hilstar.server.bench.frame import Bench
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.star_errors import stamp_errors

# Full effort: `exact` codes and whole sprites reach every tolerance that can be reached.
FULL: Table = {"quantisation": "exact", "motion_above_px": 0.0}
AUTO: Table = {"effort": "auto", "quantisation": "auto"}
ISOLATION = Isolation(margin_px=7, max_share=2e-4)  # 2e-4 of its light is 2e-4 mag
ROUNDS, QUICK_ROUNDS = 60, 5
BITS = (8, 10, 12)
COLOURS = {8: ORANGE, 10: BLUE, 12: MUTED}


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What a star may be off, mag and px, and how the tolerance is called."""

    name: str
    mag: float
    px: float


DEFAULT = Tolerance("default", DEFAULT_TOLERANCE_MAG, DEFAULT_TOLERANCE_PX)
TOLERANCES = (DEFAULT, Tolerance("0.1", 0.1, 0.1))


@dataclass(frozen=True, slots=True)
class EffortScene:
    """Where a bench points, how faint it goes and how fast it turns."""

    name: str
    radec_roll_deg: tuple[float, float, float]
    focal_length_mm: float
    faintest_v_mag: float
    rate_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def turn(self) -> CameraTurn:
        """The attitude, and the turn from it."""
        return CameraTurn(from_radec_roll_deg(*self.radec_roll_deg), np.radians(self.rate_deg_s))


SCENES = (
    EffortScene("narrow, sparse", (192.9, 27.1, 0.0), 600.0, 8.0),
    EffortScene("wide, sparse", (192.9, 27.1, 0.0), 120.0, 6.5),
    EffortScene("narrow, Milky Way", (305.0, 40.0, 20.0), 350.0, 8.0),
    EffortScene("wide, Milky Way", (305.0, 40.0, 20.0), 120.0, 8.0),
    EffortScene("wide, Milky Way, 1 deg/s", (305.0, 40.0, 20.0), 120.0, 7.0, (0.6, 0.8, 0.0)),
)


@dataclass(frozen=True, slots=True)
class EffortOutcome:
    """A scene at one effort: the times of a frame, the largest errors of stars that stand alone,
    and the tolerance.

    `tolerance` is "full" at full effort, which has the default's figures. `frame_ms` is the median
    time of a whole frame, `cpu_ms` that of the processor in it. `claimed_mag` and `claimed_px` are
    what the plan says of the worst star. `centroid_max_px` is by the plain moment of the light on
    the monitor, `max_px_...` as each centroider finds stars on the tracker.
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
        """The larger of the errors of light and place, in tolerances."""
        return max(self.flux_max_mag / self.tolerance_mag, self.worst_px / self.tolerance_px)

    @property
    def within(self) -> bool:
        """Light and place, by each centroider, are within the tolerance."""
        return self.share <= 1.0


@dataclass(frozen=True, slots=True)
class EffortComparison:
    """A scene at full effort and at the effort that a tolerance needs."""

    full: EffortOutcome
    auto: EffortOutcome

    @property
    def speed_up(self) -> float:
        """The time of a whole frame at full effort over that at auto effort."""
        return self.full.frame_ms / self.auto.frame_ms


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure every scene, and write `economy.csv` and its chart; a line for each comparison.
    Raises InputError.
    """
    others = OtherWork()
    rounds = QUICK_ROUNDS if quick else ROUNDS
    comparisons = []
    rows = []
    for bits in BITS:
        for scene in SCENES:
            full, *autos = compare(scene, bits, rounds)
            rows += [full, *autos]
            comparisons += [EffortComparison(full, auto) for auto in autos]
    write_records(directory / "economy.csv", rows)
    load = others.load()
    draw(directory / "economy", comparisons, load)
    lines = [_line(comparison, load) for comparison in comparisons]
    return load.judged([*lines, *([] if load.busy else [economy_finding(comparisons)])])


def compare(scene: EffortScene, bits: int, rounds: int) -> list[EffortOutcome]:
    """A scene at full effort and at the effort that each of TOLERANCES needs, timed in turn."""
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024), "transmission": GLASS},
        "sky": {"faintest_v_mag": scene.faintest_v_mag},
        "monitor": {**FULL_HD, "bits": bits},
        "collimator": {"focal_length_mm": scene.focal_length_mm},
    }
    wanted: Table = {"brightest_v_mag": 2.0, "motion": "on" if any(scene.rate_deg_s) else "auto"}
    efforts: dict[str, Table] = {"full": FULL}
    for tolerance in TOLERANCES:
        efforts[tolerance.name] = {
            **AUTO,
            "tolerance_mag": tolerance.mag,
            "tolerance_px": tolerance.px,
        }
    turn = scene.turn
    with TemporaryDirectory() as folder, ExitStack() as stack:
        benches = {}
        for name, keys in efforts.items():
            path = Path(folder) / f"{name}.toml"
            benches[name] = stack.enter_context(
                study_bench(path, {**tables, "render": {**wanted, **keys}})
            )
        works = {
            name: lambda k, bench=bench: (
                bench.draw(turn.q_icrs_to_cam, k, turn.rate_cam_rad_s).levels
            )
            for name, bench in benches.items()
        }
        times = in_turn(works, rounds)
        return [_outcome(scene, name, bench, times[name]) for name, bench in benches.items()]


def _outcome(scene: EffortScene, name: str, bench: Bench, times: list[Spent]) -> EffortOutcome:
    tolerance = next(
        (known_tolerance for known_tolerance in TOLERANCES if known_tolerance.name == name), DEFAULT
    )
    turn = scene.turn
    size = bench.camera.resolution_px
    drawn = bench.draw(turn.q_icrs_to_cam, 0, turn.rate_cam_rad_s)
    shown = shown_light(drawn.levels, bench.panel)
    scan = Scan(bench.scan.down, bench.scan.scanout_s, bench.scan.hold_s)
    sprites = swept_sprites(bench.stars, turn, scan, bench.camera, bench.psf)
    true = linear_image(sprites, size, bench.psf)
    errors = []
    windows = []
    rates = sprites.data["electrons_per_s"]
    for star, window in lone_windows(sprites, sprites.x_px, sprites.y_px, size, ISOLATION):
        if rates[sprites.star == star].sum() > 2 * bench.flux_at_white_e_per_s:
            continue  # clips at some sub-pixel phases
        errors.append(star_error(shown, true, window))
        windows.append(window)
    seen_optics = bench.renderer.target.seen
    lit, wanted = (squares(image, windows) for image in (shown, true))
    width_px = bench.psf.width_px
    off_px = stamp_errors(
        lit, wanted, width_px, seen_optics.blur_px, seen_optics.pixel_px, box_share=NO_THRESHOLD
    )
    return EffortOutcome(
        scene=scene.name,
        bits=bench.config.monitor.bits,
        tolerance=name,
        tolerance_mag=tolerance.mag,
        tolerance_px=tolerance.px,
        quantisation=bench.config.render.quantisation,
        stars=drawn.star_count,
        frame_ms=float(np.median([known_tolerance.wall_ms for known_tolerance in times])),
        cpu_ms=float(np.median([known_tolerance.cpu_ms for known_tolerance in times])),
        claimed_mag=bench.effort.error_mag,
        claimed_px=bench.effort.error_px,
        claimed_within=bench.effort.within,
        flux_max_mag=max(abs(error.flux_mag) for error in errors),
        centroid_max_px=max(error.centroid_px for error in errors),
        measured_stars=len(errors),
        **{f"max_px_{kind}": float(np.hypot(*off_px[kind]).max()) for kind in FAMILY},
    )


def _line(comparison: EffortComparison, load: Load) -> str:
    full = comparison.full
    auto = comparison.auto
    ratio = comparison.speed_up
    if ratio >= 1:
        compared = f"{ratio:.1f} times as fast"
    else:
        compared = f"{1 / ratio:.1f} times as SLOW"
    if load.busy:
        compared = NOT_JUDGED
    return (
        f"{auto.scene}, {auto.bits} bits, {auto.tolerance_mag:g} mag and {auto.tolerance_px:g} px:"
        f" {auto.frame_ms:.2f} ms ({auto.quantisation}) instead of {full.frame_ms:.2f} ms,"
        f" {compared}; largest errors of {auto.measured_stars} stars {auto.flux_max_mag:.4f} mag"
        f" and {auto.worst_px:.4f} px by the worst of six centroiders ({auto.max_px_fit:.4f} by a"
        f" PSF fit), {'within' if auto.within else 'OVER'} the tolerance"
    )


def economy_finding(comparisons: list[EffortComparison]) -> str:
    """What was found in one sentence: the median speed-up at the default tolerance by bits, its
    range, and the errors.
    """
    by_bits: dict[int, list[float]] = {}
    for comparison in comparisons:
        if comparison.auto.tolerance == DEFAULT.name:
            by_bits.setdefault(comparison.auto.bits, []).append(comparison.speed_up)
    depths = ", ".join(str(bits) for bits in sorted(by_bits))
    medians = ", ".join(f"{np.median(by_bits[bits]):.1f}" for bits in sorted(by_bits))
    speed_ups = [comparison.speed_up for comparison in comparisons]
    return (
        f"At {depths} bits auto effort is {medians} times as fast as full effort"
        f" ({min(speed_ups):.1f} to {max(speed_ups):.1f} over all scenes and both tolerances),"
        f" {within_words(comparisons)}"
    )


def within_words(comparisons: list[EffortComparison]) -> str:
    """Whether the errors of all scenes are within tolerance, in words."""
    over = sum(not comparison.auto.within for comparison in comparisons)
    if over:
        return f"{over} of {len(comparisons)} OVER tolerance"
    return "within tolerance"


def draw(path: Path, comparisons: list[EffortComparison], load: Load) -> None:
    """The speed-up by `effort = "auto"` in each scene, and the errors that it leaves there,
    relative to the tolerance.
    """
    note = (
        "Errors of stars that stand alone; places by the worst of six centroiders, whose boxes have"
        " no threshold. Tolerances: "
    )
    note += (
        "; ".join(
            f"{known_tolerance.name}, {known_tolerance.mag:g} mag and {known_tolerance.px:g} px"
            for known_tolerance in TOLERANCES
        )
        + "."
    )
    title = load.title(economy_finding(comparisons), f"Auto effort is {within_words(comparisons)}")
    kinds = [(bits, tolerance) for bits in BITS for tolerance in TOLERANCES]
    width = 0.84 / len(kinds)
    with chart(path, title, panels=2, note=load.note(note), heights=(1, 1)) as (speed, error):
        scenes = list(dict.fromkeys(known_tolerance.auto.scene for known_tolerance in comparisons))
        at = np.arange(len(scenes))
        for place, (bits, tolerance) in enumerate(kinds):
            mine = [
                known_tolerance
                for known_tolerance in comparisons
                if (known_tolerance.auto.bits, known_tolerance.auto.tolerance)
                == (bits, tolerance.name)
            ]
            colour = COLOURS[bits]
            alpha = 1.0 if tolerance is DEFAULT else 0.5
            label = f"{bits} bits, {tolerance.name}"
            shift = (place - (len(kinds) - 1) / 2) * width
            speed.bar(
                at + shift,
                [known_tolerance.speed_up for known_tolerance in mine],
                width,
                label=label,
                color=colour,
                alpha=alpha,
            )
            error.bar(
                at + shift,
                [known_tolerance.auto.share for known_tolerance in mine],
                width,
                color=colour,
                alpha=alpha,
            )
        for axes, name in ((speed, "as fast as full effort"), (error, "tolerance")):
            axes.axhline(1.0, color=RED, linewidth=1, label=name)
            axes.grid(visible=False, axis="x")
            bars: Any = axes.patches
            axes.set_ylim(0, 1.45 * max(1.0, *(bar.get_height() for bar in bars)))
        speed.set_ylabel("full / auto, time")
        error.set_ylabel("error / limit")
        # Shares of 0.25 would push the label off the canvas.
        error.set_yticks(np.arange(0.0, error.get_ylim()[1], 0.5))
        error.set_xticks(at, [scene.replace(", ", ",\n") for scene in scenes])
        speed.legend(loc="upper left", ncols=3)
        error.legend(loc="upper right")
