"""The cost of each fault on request in a frame, and the error of stars in the codes under stray
light.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, GREEN
from hilstar.basics.rotation import from_radec_roll_deg, propagate
from hilstar.basics.units import NS_PER_S, magnitude
from hilstar.display.quantise import shown_light
from hilstar.display.response import Levels
from hilstar.instruments.study.engine import (
    ChartSpec,
    DotsSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    SeriesLook,
    draw_rows,
    finite,
    row_panels,
    write_rows,
)
from hilstar.instruments.study.study_benches import (
    FULL_HD,
    Isolation,
    Table,
    lone_windows,
    study_bench,
)
from hilstar.instruments.study.sweep import Judged, Load, OtherWork, medians_ms
from hilstar.optics.extended import GlowLight
from hilstar.optics.layers.fault_kinds import Freeze, Now, fault_of
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.sprites import FrameLight, join_sprites
from hilstar.server.bench.fault_views import display_view
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.scenario import FaultSchedule, Scenario

REFRESH_HZ = 60
ROUNDS, QUICK_ROUNDS = 30, 1
QUANTISATIONS = ("round", "exact")
COLOURS = dict(zip(QUANTISATIONS, (GREEN, BLUE), strict=True))
FIELD = from_radec_roll_deg(84.057, -1.2, 0.0)
# so that a fault that is fixed on the sky is new in each frame
SLEW_RAD_S = np.array([0.0, 2e-4, 0.0])
ISOLATION = Isolation(margin_px=7, max_share=1e-3)
SHARES = (0.0, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
QUICK_SHARES = (0.0, 0.01, 1.0)
SPOILT_MAG, DARK_MAG = 0.1, 90.0
STRAY_NOTE = (
    "Solid: 95 % of the stars are within it. Dotted: half of them. A line ends where such a star"
    " shows nothing."
)
STRAY_PANEL = PanelSpec(
    (
        LineSpec(
            "share_of_white",
            finite("p95_mag", DARK_MAG),
            label=lambda row: f"{row.quantisation}, 95 %",
        ),
        LineSpec(
            "share_of_white",
            finite("median_mag", DARK_MAG),
            ":",
            label=lambda row: f"{row.quantisation}, half",
        ),
    ),
    "error of stars' light [mag]",
    "even stray light [share of white in a monitor pixel]",
    levels=(LevelLine(SPOILT_MAG, f"{SPOILT_MAG:g} mag"),),
    scales=("log", "log"),
)
LOST_MAG = 1.0  # a star this much too faint is not the star that was asked for
NOTHING_MAG = 99.0  # of a star that shows nothing
EVEN_RAD = 100.0  # the width of a glow that is even over any field
COSTS_NOTE = (
    "Filled: a frame with the fault. Open: the same frame without it, in turn in the same run."
    " Medians; 1920 x 1080."
)

NOWHERE = "a scenario, nothing on"
# Along a line across the field
FALSE_STARS = [
    {"kind": "false-star", "radec_deg": [82 + k / 16, -3 + k / 16], "v_mag": 4.0} for k in range(64)
]
CASES: dict[str, list[dict[str, Any]]] = {
    NOWHERE: [],
    "false star, on the sky": [{"kind": "false-star", "radec_deg": [84.2, -1.0], "v_mag": 2.0}],
    "false star, moving": [
        {"kind": "false-star", "tracker_px": [400, 500], "rate_px_s": [60, 10], "v_mag": 2.0}
    ],
    "64 false stars": FALSE_STARS,
    "star gone": [{"kind": "star-gone", "hip": 26311}],
    "flash at a star": [{"kind": "flash", "hip": 26727, "for_s": 10, "electrons": 1e5}],
    "40 tracks of 12 px": [
        {"kind": "cosmic-rays", "number": 40, "electrons": 8000, "length_px": 12, "for_s": 10}
    ],
    "400 tracks of 25 px": [
        {"kind": "cosmic-rays", "number": 400, "electrons": 8000, "length_px": 25, "for_s": 10}
    ],
    "gradient": [{"kind": "gradient", "electrons_per_s": 400}],
    "glow, on the detector": [
        {"kind": "glow", "tracker_px": [-600, 200], "electrons_per_s": 3000, "scale_deg": 2}
    ],
    "glow, on the sky": [
        {"kind": "glow", "radec_deg": [84, 12], "electrons_per_s": 3000, "scale_deg": 2}
    ],
    "measured map": [{"kind": "light-map", "file": "stray.npy"}],
    "blank": [{"kind": "blank"}],
    "frozen": [{"kind": "freeze"}],
    "wrong attitude": [{"kind": "attitude-step", "turn_deg": [0, 0.5, 0]}],
}


@dataclass(frozen=True, slots=True)
class FaultCost:
    """One case: the median time of a frame with and without the fault, ms, in turn in one run."""

    quantisation: str
    case: str
    frame_ms: float
    without_ms: float
    cost_ms: float


@dataclass(frozen=True, slots=True)
class Stray:
    """Stars over even stray light: the errors of their light in the codes, mag, and the share lost.

    The stray light is a share of white.
    """

    quantisation: str
    share_of_white: float
    stars: int
    median_mag: float
    p95_mag: float
    lost: float


def bench_of(folder: Path, quantisation: str) -> Bench:
    """The bench of a study: an 8-bit monitor of 1920 x 1080 before a tracker of 11 degrees."""
    from_corner = np.hypot(*np.indices((256, 256)))
    light = from_corner * 3.0
    np.save(folder / "stray.npy", light)
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024)},
        "monitor": {**FULL_HD, "refresh_hz": REFRESH_HZ},
        "collimator": {"focal_length_mm": 350},
        "render": {"quantisation": quantisation},
    }
    return study_bench(folder / f"{quantisation}.toml", tables)


def attitude_of(frame: int) -> FloatArray:
    """The attitude (unit quaternion) of a frame of the slew."""
    return propagate(FIELD, SLEW_RAD_S, frame / REFRESH_HZ)


class CaseFrames:
    """The frames of a bench under the faults of a case, and the same frames without any."""

    def __init__(self, bench: Bench, folder: Path, case: str) -> None:
        self.bench = bench
        faults = []
        for number, table in enumerate(CASES[case]):
            faults.append(fault_of({"name": f"fault {number}", **table}))
        scenario = Scenario(folder / "faults.toml", "", 1, tuple(faults), folder)
        self.view = display_view(bench, scenario)
        # A run asks its schedule in every frame, whatever it has on.
        later = fault_of({"kind": "blank", "name": "later", "at_s": 1e6})
        later_scenario = replace(scenario, faults=(later,))
        self.schedule = FaultSchedule(later_scenario, 1 / REFRESH_HZ)
        self.prepared = []
        self.is_frozen = False
        for fault in faults:
            prepared = self.view.prepare(fault)
            self.prepared.append(prepared)
            self.is_frozen |= isinstance(prepared, Freeze)

    def without(self, frame: int) -> Levels:
        """A frame without faults."""
        return self.bench.draw(attitude_of(frame)).levels

    def with_faults(self, frame: int) -> Levels:
        """The same frame with the faults."""
        t_ns = round(frame / REFRESH_HZ * NS_PER_S)
        self.schedule.at(t_ns)
        now = []
        for number, fault in enumerate(self.prepared, start=1):
            now.append(Now(number, fault, t_ns))
        effects = FaultLayer(self.view, tuple(now))
        if self.is_frozen:
            return self.bench.renderer.levels()
        if effects.blank:
            return self.bench.draw_sprites(None).levels
        bench_view = self.bench.view(attitude_of(frame))
        turned_view = effects.turned(bench_view)
        layer = effects if effects.now else None
        light = self.bench.light(turned_view, layer)
        return self.bench.draw_sprites(light).levels


def cost_of(bench: Bench, folder: Path, case: str, rounds: int) -> FaultCost:
    """The time of a frame with the faults of a case and without any, in turn."""
    frames = CaseFrames(bench, folder, case)
    ms = medians_ms({"without": frames.without, "with": frames.with_faults}, rounds)
    return fault_cost(bench.config.render.quantisation, case, ms)


def fault_cost(quantisation: str, case: str, ms: Mapping[str, float]) -> FaultCost:
    """The cost of a case by the times of its frames "with" and "without" it."""
    cost_ms = ms["with"] - ms["without"]
    return FaultCost(quantisation, case, ms["with"], ms["without"], cost_ms)


def stray_light(bench: Bench, share: float) -> Stray:
    """The errors of stars over even stray light, by frames with them and without them."""
    view = bench.view(FIELD)
    sprites = bench.light(view)
    lights: tuple[GlowLight, ...] = ()
    if share:
        boresight = np.array([0.0, 0.0, 1.0])
        light_e_per_s = share * bench.flux_at_white_e_per_s
        light = GlowLight(boresight, light_e_per_s, EVEN_RAD, 1.0, bench.camera)
        lights = (light,)
    with_light = replace(sprites, extended=lights)
    both = light_of(bench, with_light)
    no_sprites = join_sprites([], sprites.footprint_px)
    light_alone = replace(no_sprites, extended=lights)
    alone = light_of(bench, light_alone)
    errors_mag = light_errors_mag(sprites, both - alone, bench.camera.resolution_px)
    return stray_of(bench.config.render.quantisation, share, errors_mag)


def stray_of(quantisation: str, share: float, errors_mag: Sequence[float]) -> Stray:
    """A row by the errors of stars' light, mag."""
    median, p95 = np.percentile(errors_mag, (50, 95)).tolist()
    is_lost = np.array(errors_mag) > LOST_MAG
    return Stray(quantisation, share, len(errors_mag), median, p95, float(is_lost.mean()))


def light_errors_mag(
    sprites: FrameLight, shown_light: FloatArray, size_px: tuple[int, int]
) -> list[float]:
    """The errors of lone stars' light, mag, in an image (h, w) of what they add to a frame."""
    rates = sprites.data["electrons_per_s"]
    errors_mag = []
    windows = lone_windows(sprites, sprites.x_px, sprites.y_px, size_px, ISOLATION)
    for star, window in windows:
        of_star = sprites.star == star
        true = float(rates[of_star].sum())
        shown = float(shown_light[window].sum())
        error_mag = NOTHING_MAG
        if shown > 0:
            error_mag = abs(magnitude(shown / true))
        errors_mag.append(error_mag)
    return errors_mag


def light_of(bench: Bench, sprites: FrameLight) -> FloatArray:
    """The light (h, w) of the panel when it shows a frame of sprites."""
    levels = bench.draw_sprites(sprites).levels
    return shown_light(levels, bench.panel).copy()


@dataclass(frozen=True, slots=True)
class FaultsMeasured:
    """The costs of faults, the errors under stray light, and the work of others meanwhile."""

    costs: Sequence[FaultCost]
    strays: Sequence[Stray]
    load: Load


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure; write `faults-cost.csv`, `faults-stray.csv` and their charts; the findings, a
    line each. Raises InputError.
    """
    return report(directory, measure(quick))


def measure(quick: bool) -> FaultsMeasured:
    """Every case and every share of stray light, with each quantisation."""
    costs: list[FaultCost] = []
    strays: list[Stray] = []
    rounds = QUICK_ROUNDS if quick else ROUNDS
    shares = QUICK_SHARES if quick else SHARES
    others = OtherWork()
    with TemporaryDirectory() as name:
        for quantisation in QUANTISATIONS:
            with bench_of(Path(name), quantisation) as bench:
                bench.warm_up()
                for case in CASES:
                    costs.append(cost_of(bench, Path(name), case, rounds))
                for share in shares:
                    strays.append(stray_light(bench, share))
    return FaultsMeasured(costs, strays, others.load())


def report(directory: Path, measured: FaultsMeasured) -> Judged:
    """Write what was measured; the findings, a line each. Raises InputError."""
    costs, strays, load = measured.costs, measured.strays, measured.load
    write_rows(directory / "faults-cost.csv", costs)
    write_rows(directory / "faults-stray.csv", strays)
    draw_stray(directory / "faults", strays)
    draw_costs(directory / "faults_cost", costs, load)
    cost_lines = []
    stray_lines = []
    for quantisation in QUANTISATIONS:
        cost_lines.append(cost_line(costs, quantisation))
        stray_lines.append(stray_line(strays, quantisation))
    return load.judged([*cost_lines, *stray_lines])


def cost_line(costs: Sequence[FaultCost], quantisation: str) -> str:
    """The cost of a scenario without faults, of a false star and of the dearest fault, in words."""
    by_case = {cost.case: cost for cost in costs if cost.quantisation == quantisation}
    nothing = by_case[NOWHERE]
    star = by_case["false star, on the sky"]
    dearest = max(by_case.values(), key=lambda cost: cost.cost_ms)
    return (
        f"{quantisation}: of a frame of {nothing.without_ms:.1f} ms a scenario with nothing on"
        f" takes {nothing.cost_ms:+.2f} ms, a false star {star.cost_ms:+.2f} ms; the dearest,"
        f" {dearest.case}, {dearest.cost_ms:+.1f} ms"
    )


def stray_line(strays: Sequence[Stray], quantisation: str) -> str:
    """The stray light that spoils stars, in words."""
    share = spoilt_from(strays, quantisation)
    limit = "no stray light here"
    if share is not None:
        limit = f"stray light of {share:g} of white"
    return (
        f"{quantisation}: the stars' light is off by more than {SPOILT_MAG:g} mag (95 %) from"
        f" {limit} on"
    )


def spoilt_from(strays: Sequence[Stray], quantisation: str) -> float | None:
    """The smallest stray light, share of white, at which 95 % of the stars are not within
    SPOILT_MAG; None where none is that large.
    """
    shares = []
    for stray in strays:
        is_spoilt = stray.quantisation == quantisation and stray.p95_mag > SPOILT_MAG
        if is_spoilt and stray.share_of_white:
            shares.append(stray.share_of_white)
    return min(shares, default=None)


def draw_stray(path: Path, strays: Sequence[Stray]) -> None:
    """The error of stars under even stray light."""
    limits = []
    for name in QUANTISATIONS:
        share = spoilt_from(strays, name)
        if share is not None:
            limits.append(f"from {share:g} of white on with {name}")
    finding = "No stray light spoils stars"
    if limits:
        named_limits = ", and ".join(limits)
        finding = f"Stray light spoils stars by more than {SPOILT_MAG:g} mag {named_limits}"
    looks = {name: SeriesLook(name, colour, "o") for name, colour in COLOURS.items()}
    spec = ChartSpec((STRAY_PANEL,), quantisation_of, looks, STRAY_NOTE)
    rows = [row for row in strays if row.share_of_white]
    draw_rows(path, finding, spec, rows)


def quantisation_of(row: Stray | FaultCost) -> str:
    """The series of a row: its quantisation."""
    return row.quantisation


def draw_costs(path: Path, costs: Sequence[FaultCost], load: Load) -> None:
    """The time of a frame with each fault and without it."""
    dearest = max(costs, key=lambda cost: cost.frame_ms)
    star_ms = max(cost.frame_ms for cost in costs if "false star" in cost.case)
    finding = (
        f"With false stars a frame takes at most {star_ms:.1f} ms, with the dearest fault,"
        f" {dearest.case}, {dearest.frame_ms:.0f} ms"
    )
    title = load.title(finding, "Times of frames with each fault")
    panels = tuple(map(costs_panel, QUANTISATIONS))
    layout = {"share_y": True, "height_inch": 5.2}
    spec = ChartSpec(panels, quantisation_of, {}, COSTS_NOTE, len(panels), layout)
    with row_panels(path, title, spec, costs, load) as grid:
        for axes, quantisation in zip(grid, QUANTISATIONS, strict=True):
            axes.set_title(quantisation, color=COLOURS[quantisation])


def costs_panel(quantisation: str) -> PanelSpec:
    """The times of frames of one quantisation; the first panel has the names for all."""
    colour = COLOURS[quantisation]
    without = SeriesLook("without", colour, is_open=True)
    with_fault = SeriesLook("with the fault", colour)
    dots = DotsSpec(
        (
            ("without_ms", without),
            ("frame_ms", with_fault),
        ),
        where=lambda row: row.quantisation == quantisation,
        name=(lambda row: row.case) if quantisation == QUANTISATIONS[0] else None,
    )
    return PanelSpec(xlabel="time of a frame [ms]", dots=dots, names=False)
