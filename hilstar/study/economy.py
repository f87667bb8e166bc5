"""The gain of `effort = "auto"`: five scenes at full effort and at the effort that they need, with their times and errors."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.bench.frame import Bench
from hilstar.charts import BLUE, MUTED, ORANGE, RED, SMALL_PT, chart, two_digits, write_records
from hilstar.monitor.quantise import shown_light
from hilstar.render.reference import linear_image
from hilstar.rotation import from_radec_roll_deg
from hilstar.scene.frame_motion import CameraTurn, Scan, swept_sprites
from hilstar.study.settings import FULL_HD, GLASS, Isolation, Table, lone_windows, squares, star_error, study_bench
from hilstar.study.sweep import NOT_JUDGED, Judged, Load, OtherWork, medians_ms
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.star_errors import stamp_errors

# Full effort: `exact` codes and whole sprites reach every tolerance that can be reached.
EFFORTS: dict[str, Table] = {
    "full": {"quantisation": "exact", "motion_above_px": 0.0},
    "auto": {"effort": "auto", "quantisation": "auto"},
}
ISOLATION = Isolation(margin_px=7, max_share=2e-4)  # 2e-4 of its light is 2e-4 mag
ROUNDS, QUICK_ROUNDS = 60, 5


@dataclass(frozen=True, slots=True)
class EffortScene:
    """Where a bench points, how faint it goes and how fast it turns, and the tolerance, in magnitudes and in pixels alike."""

    name: str
    radec_roll_deg: tuple[float, float, float]
    focal_length_mm: float
    faintest_v_mag: float
    bits: int
    tolerance: float
    rate_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def turn(self) -> CameraTurn:
        """The attitude, and the turn from it."""
        return CameraTurn(from_radec_roll_deg(*self.radec_roll_deg), np.radians(self.rate_deg_s))


SCENES = (
    EffortScene("narrow, sparse", (192.9, 27.1, 0.0), 600.0, 8.0, 12, 0.1),
    EffortScene("wide, sparse", (192.9, 27.1, 0.0), 120.0, 6.5, 10, 0.1),
    EffortScene("narrow, Milky Way", (305.0, 40.0, 20.0), 350.0, 8.0, 12, 0.1),
    EffortScene("wide, Milky Way", (305.0, 40.0, 20.0), 120.0, 8.0, 12, 0.1),
    EffortScene("wide, Milky Way, 1 deg/s", (305.0, 40.0, 20.0), 120.0, 7.0, 12, 0.1, (0.6, 0.8, 0.0)),
)


@dataclass(frozen=True, slots=True)
class EffortOutcome:
    """A scene at one effort: the time of a frame, the largest errors of stars that stand alone, and the tolerance.

    `centroid_max_px` is by the plain moment of the light on the monitor, `max_px_...` as each centroider finds them on the
    tracker.
    """

    scene: str
    effort: str
    quantisation: str
    stars: int
    frame_ms: float
    flux_max_mag: float
    centroid_max_px: float
    measured_stars: int
    tolerance: float
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
    def within(self) -> bool:
        """Light and place, by each centroider, are under the scene's tolerance."""
        return max(self.flux_max_mag, self.worst_px) <= self.tolerance


@dataclass(frozen=True, slots=True)
class EffortComparison:
    """A scene at full effort and at the effort that it needs."""

    full: EffortOutcome
    auto: EffortOutcome

    @property
    def speed_up(self) -> float:
        """The time of a frame at full effort over that at auto effort."""
        return self.full.frame_ms / self.auto.frame_ms


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure every scene, and write `economy.csv` and its chart; a line for each scene. Raises InputError."""
    others = OtherWork()
    comparisons = [compare(scene, QUICK_ROUNDS if quick else ROUNDS) for scene in SCENES]
    write_records(directory / "economy.csv", [outcome for c in comparisons for outcome in (c.full, c.auto)])
    load = others.load()
    draw(directory / "economy", comparisons, load)
    return load.judged([_line(comparison, load) for comparison in comparisons])


def compare(scene: EffortScene, rounds: int) -> EffortComparison:
    """A scene at full effort and at the effort that it needs, timed in turn."""
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024), "transmission": GLASS},
        "sky": {"faintest_v_mag": scene.faintest_v_mag},
        "monitor": {**FULL_HD, "bits": scene.bits},
        "collimator": {"focal_length_mm": scene.focal_length_mm},
    }
    wanted: Table = {"brightest_v_mag": 2.0, "motion": "on", "tolerance_mag": scene.tolerance, "tolerance_px": scene.tolerance}
    turn = scene.turn
    with TemporaryDirectory() as folder, ExitStack() as stack:
        benches = {
            name: stack.enter_context(study_bench(Path(folder) / f"{name}.toml", {**tables, "render": {**wanted, **keys}}))
            for name, keys in EFFORTS.items()
        }
        draw = {
            name: lambda k, bench=bench: bench.draw(turn.q_icrs_to_cam, k, turn.rate_cam_rad_s).levels
            for name, bench in benches.items()
        }
        times = medians_ms(draw, rounds)
        return EffortComparison(**{name: _outcome(scene, name, bench, times[name]) for name, bench in benches.items()})


def _outcome(scene: EffortScene, name: str, bench: Bench, frame_ms: float) -> EffortOutcome:
    turn, size = scene.turn, bench.camera.resolution_px
    drawn = bench.draw(turn.q_icrs_to_cam, 0, turn.rate_cam_rad_s)
    shown = shown_light(drawn.levels, bench.panel)
    scan = Scan(bench.scan.down, bench.scan.scanout_s, bench.scan.hold_s)
    sprites = swept_sprites(bench.stars, turn, scan, bench.camera, bench.psf)
    true = linear_image(sprites, size, bench.psf)
    errors, windows = [], []
    rates = sprites.data["electrons_per_s"]
    for star, window in lone_windows(sprites, sprites.x_px, sprites.y_px, size, ISOLATION):
        if rates[sprites.star == star].sum() > 2 * bench.flux_at_white_e_per_s:
            continue  # clips at some sub-pixel phases
        errors.append(star_error(shown, true, window))
        windows.append(window)
    seen = bench.renderer.target.seen
    lit, wanted = (squares(image, windows) for image in (shown, true))
    off_px = stamp_errors(lit, wanted, bench.psf.width_px, seen.blur_px, seen.pixel_px)
    return EffortOutcome(
        scene=scene.name,
        effort=name,
        quantisation=bench.config.render.quantisation,
        stars=drawn.star_count,
        frame_ms=frame_ms,
        flux_max_mag=max(abs(error.flux_mag) for error in errors),
        centroid_max_px=max(error.centroid_px for error in errors),
        measured_stars=len(errors),
        tolerance=scene.tolerance,
        **{f"max_px_{kind}": float(np.hypot(*off_px[kind]).max()) for kind in FAMILY},
    )


def _line(comparison: EffortComparison, load: Load) -> str:
    full, auto, ratio = comparison.full, comparison.auto, comparison.speed_up
    compared = f"{ratio:.1f} times as fast" if ratio >= 1 else f"{1 / ratio:.1f} times as SLOW"
    if load.busy:
        compared = NOT_JUDGED
    return (
        f"{auto.scene}: {auto.frame_ms:.2f} ms ({auto.quantisation}) instead of {full.frame_ms:.2f} ms, {compared};"
        f" largest errors of {auto.measured_stars} stars {auto.flux_max_mag:.4f} mag and {auto.worst_px:.4f} px"
        f" by the worst of six centroiders ({auto.max_px_fit:.4f} by a PSF fit),"
        f" {'within' if auto.within else 'OVER'} {auto.tolerance:g}"
    )


def economy_finding(comparisons: list[EffortComparison]) -> str:
    """What is true of every scene, in one sentence: the range of the speed-up, and whether errors are within tolerance."""
    slowest, quickest = (extreme(comparison.speed_up for comparison in comparisons) for extreme in (min, max))
    verdict = within_words(comparisons)
    if slowest >= 1:
        return f"Auto effort is {slowest:.1f} to {quickest:.1f} times as fast as full effort, {verdict}"
    if quickest < 1:
        return f"Auto effort takes {1 / quickest:.1f} to {1 / slowest:.1f} times as long as full effort, {verdict}"
    slower = f"takes up to {1 / slowest:.1f} times as long as full effort in one scene"
    return f"Auto effort {slower} and is up to {quickest:.1f} times as fast in another, {verdict}"


def within_words(comparisons: list[EffortComparison]) -> str:
    """Whether the errors of all scenes are within tolerance, in words."""
    over = sum(not comparison.auto.within for comparison in comparisons)
    if over:
        return f"{over} of {len(comparisons)} scenes OVER tolerance"
    return "within tolerance"


def draw(path: Path, comparisons: list[EffortComparison], load: Load) -> None:
    """The time of each scene at both efforts, and the errors at the effort that it needs, as shares of the tolerance."""
    note = "Errors of stars that stand alone; places by the worst of six centroiders."
    title = load.title(economy_finding(comparisons), f"Auto effort is {within_words(comparisons)}")
    with chart(path, title, panels=2, note=load.note(note), heights=(1, 1)) as (cost, error):
        at = np.arange(len(comparisons))
        autos = [c.auto for c in comparisons]
        for shift, mine, colour, name in (
            (-0.2, [c.full for c in comparisons], MUTED, "full effort"),
            (0.2, autos, BLUE, 'effort = "auto"'),
        ):
            bars = cost.bar(at + shift, [o.frame_ms for o in mine], 0.38, color=colour, label=name)
            cost.bar_label(bars, fmt=two_digits, padding=2, fontsize=SMALL_PT)
        for shift, values, colour, name in (
            (-0.2, [o.flux_max_mag for o in autos], ORANGE, "light [mag]"),
            (0.2, [o.worst_px for o in autos], BLUE, "place [monitor px]"),
        ):
            bars = error.bar(at + shift, values, 0.38, color=colour, label=name)
            error.bar_label(bars, fmt=two_digits, padding=2, fontsize=SMALL_PT)
        for place, outcome in zip(at, autos, strict=True):
            error.plot([place - 0.45, place + 0.45], [outcome.tolerance] * 2, color=RED, label="_" if place else "tolerance")
        cost.set_ylabel("time of a frame [ms]")
        error.set_ylabel('largest error at "auto"')
        error.set_xticks(at, [outcome.scene.replace(", ", ",\n") for outcome in autos])
        for axes, high in ((cost, max(c.full.frame_ms for c in comparisons)), (error, max(o.tolerance for o in autos))):
            axes.grid(visible=False, axis="x")
            axes.set_ylim(0, 1.45 * max(high, *(bar.get_height() for bar in axes.patches)))  # type: ignore[attr-defined]
            axes.legend(loc="upper left", ncols=3)
