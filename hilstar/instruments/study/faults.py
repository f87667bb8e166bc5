"""The cost of each fault on request in a frame, and the error of stars in the codes under stray
light.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hilstar.basics.charts import BLUE, GREEN, chart, write_records
from hilstar.basics.rotation import from_radec_roll_deg, propagate
from hilstar.basics.units import NS_PER_S, magnitude
from hilstar.display.quantise import shown_light
from hilstar.instruments.study.row_charts import (
    ChartSpec,
    LevelLine,
    LineSpec,
    PairSpec,
    PanelSpec,
    SeriesLook,
    draw_pairs,
    draw_rows,
    finite,
    name_places,
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
from hilstar.optics.sprites import join_sprites
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

NOWHERE = "a scenario, nothing on"
CASES: dict[str, list[dict[str, Any]]] = {
    NOWHERE: [],
    "false star, on the sky": [{"kind": "false-star", "radec_deg": [84.2, -1.0], "v_mag": 2.0}],
    "false star, moving": [
        {"kind": "false-star", "tracker_px": [400, 500], "rate_px_s": [60, 10], "v_mag": 2.0}
    ],
    "64 false stars": [
        {"kind": "false-star", "radec_deg": [82 + k / 16, -3 + k / 16], "v_mag": 4.0}
        for k in range(64)
    ],
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
    """One case: median times of a frame, ms, with the fault and without any, in turn in the same
    run.
    """

    quantisation: str
    case: str
    frame_ms: float
    without_ms: float
    cost_ms: float


@dataclass(frozen=True, slots=True)
class Stray:
    """Stars over even stray light of a share of white: the error of their light in the codes,
    and the share that is lost.
    """

    quantisation: str
    share_of_white: float
    stars: int
    median_mag: float
    p95_mag: float
    lost: float


def bench_of(folder: Path, quantisation: str) -> Bench:
    """The bench of a study: an 8-bit monitor of 1920 x 1080 before a tracker of 11 degrees."""
    np.save(folder / "stray.npy", np.hypot(*np.indices((256, 256))) * 3.0)
    tables: dict[str, Table] = {
        "tracker": {"resolution_px": (1024, 1024)},
        "monitor": {**FULL_HD, "refresh_hz": REFRESH_HZ},
        "collimator": {"focal_length_mm": 350},
        "render": {"quantisation": quantisation},
    }
    return study_bench(folder / f"{quantisation}.toml", tables)


def cost_of(bench: Bench, folder: Path, case: str, rounds: int) -> FaultCost:
    """The time of a frame with the faults of a case and without any, in turn."""
    faults = tuple(fault_of({"name": f"fault {k}", **table}) for k, table in enumerate(CASES[case]))
    scenario = Scenario(folder / "faults.toml", "", 1, faults, folder)
    view = display_view(bench, scenario)
    waiting = fault_of({"kind": "blank", "name": "later", "at_s": 1e6})
    schedule = FaultSchedule(replace(scenario, faults=(waiting,)), 1 / REFRESH_HZ)
    ready = [view.prepare(fault) for fault in faults]

    def plain(k: int) -> object:
        return bench.draw(propagate(FIELD, SLEW_RAD_S, k / REFRESH_HZ)).levels

    def faulty(k: int) -> object:
        t_ns = round(k / REFRESH_HZ * NS_PER_S)
        schedule.at(t_ns)
        effects = FaultLayer(
            view, tuple(Now(n, fault, t_ns) for n, fault in enumerate(ready, start=1))
        )
        if any(isinstance(fault, Freeze) for fault in ready):
            return bench.renderer.levels()
        if effects.blank:
            return bench.draw_sprites(None).levels
        turned_view = effects.turned(bench.view(propagate(FIELD, SLEW_RAD_S, k / REFRESH_HZ)))
        return bench.draw_sprites(bench.light(turned_view, effects if effects.now else None)).levels

    ms = medians_ms({"without": plain, "with": faulty}, rounds)
    return FaultCost(
        bench.config.render.quantisation,
        case,
        ms["with"],
        ms["without"],
        ms["with"] - ms["without"],
    )


def stray_light(bench: Bench, share: float) -> Stray:
    """Each star's light in the codes over even stray light: the frame with the stars, less the
    same without them.
    """
    white = bench.flux_at_white_e_per_s
    sprites = bench.light(bench.view(FIELD))
    # 100 rad wide: even
    glow = GlowLight(np.array([0.0, 0.0, 1.0]), share * white, 100.0, 1.0, bench.camera)
    lights = (glow,) if share else ()
    both, alone = (
        shown_light(
            bench.draw_sprites(replace(sprite_set, extended=lights)).levels, bench.panel
        ).copy()
        for sprite_set in (sprites, join_sprites([], sprites.footprint_px))
    )
    off_mag = []
    for star, window in lone_windows(
        sprites, sprites.x_px, sprites.y_px, bench.camera.resolution_px, ISOLATION
    ):
        wanted = float(sprites.data["electrons_per_s"][sprites.star == star].sum())
        got = float((both[window] - alone[window]).sum())
        off_mag.append(magnitude(got / wanted) if got > 0 else np.inf)
    errors = np.abs(np.array(off_mag))
    finite_errors = np.where(np.isfinite(errors), errors, 99.0)
    median, p95 = np.percentile(finite_errors, (50, 95)).tolist()
    return Stray(
        bench.config.render.quantisation,
        share,
        len(finite_errors),
        median,
        p95,
        float((finite_errors > LOST_MAG).mean()),
    )


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure; write `faults-cost.csv`, `faults-stray.csv` and their charts; the findings, a
    line each. Raises InputError.
    """
    costs: list[FaultCost] = []
    strays: list[Stray] = []
    rounds, shares = (QUICK_ROUNDS, QUICK_SHARES) if quick else (ROUNDS, SHARES)
    others = OtherWork()
    with TemporaryDirectory() as name:
        for quantisation in QUANTISATIONS:
            with bench_of(Path(name), quantisation) as bench:
                bench.warm_up()
                costs += [cost_of(bench, Path(name), case, rounds) for case in CASES]
                strays += [stray_light(bench, share) for share in shares]
    load = others.load()
    write_records(directory / "faults-cost.csv", costs)
    write_records(directory / "faults-stray.csv", strays)
    draw_stray(directory / "faults", strays)
    draw_costs(directory / "faults_cost", costs, load)
    findings = []
    for quantisation in QUANTISATIONS:
        mine = {cost.case: cost for cost in costs if cost.quantisation == quantisation}
        off = mine[NOWHERE]
        star = mine["false star, on the sky"]
        dearest = max(mine.values(), key=lambda cost: cost.cost_ms)
        findings.append(
            f"{quantisation}: of a frame of {off.without_ms:.1f} ms a scenario with nothing on"
            f" takes {off.cost_ms:+.2f} ms, a false star {star.cost_ms:+.2f} ms; the dearest,"
            f" {dearest.case}, {dearest.cost_ms:+.1f} ms"
        )
    for quantisation in QUANTISATIONS:
        share = spoilt_from(strays, quantisation)
        if share is None:
            limit = "no stray light here"
        else:
            limit = f"stray light of {share:g} of white"
        findings.append(
            f"{quantisation}: the stars' light is off by more than {SPOILT_MAG:g} mag (95 %) from"
            f" {limit} on"
        )
    return load.judged(findings)


def spoilt_from(strays: list[Stray], quantisation: str) -> float | None:
    """The stray light, share of white, above which stars are off by more than SPOILT_MAG; None
    where none spoils them.
    """
    worst = [
        stray
        for stray in strays
        if stray.quantisation == quantisation and stray.p95_mag > SPOILT_MAG
    ]
    return min((stray.share_of_white for stray in worst if stray.share_of_white), default=None)


def draw_stray(path: Path, strays: list[Stray]) -> None:
    """The error of stars under even stray light."""
    shares = {name: spoilt_from(strays, name) for name in QUANTISATIONS}
    share_texts = [
        f"from {share:g} of white on with {name}"
        for name, share in shares.items()
        if share is not None
    ]
    if share_texts:
        finding = (
            f"Stray light spoils stars by more than {SPOILT_MAG:g} mag {', and '.join(share_texts)}"
        )
    else:
        finding = "No stray light spoils stars"
    looks = {name: SeriesLook(name, colour, "o") for name, colour in COLOURS.items()}
    spec = ChartSpec((STRAY_PANEL,), lambda row: row.quantisation, looks, STRAY_NOTE)
    draw_rows(path, finding, spec, [row for row in strays if row.share_of_white])


def draw_costs(path: Path, costs: list[FaultCost], load: Load) -> None:
    """The time of a frame with each fault and without it."""
    dearest = max(costs, key=lambda cost: cost.frame_ms)
    star = max(
        (cost for cost in costs if "false star" in cost.case), key=lambda cost: cost.frame_ms
    )
    points = f"With false stars a frame takes at most {star.frame_ms:.1f} ms"
    finding = f"{points}, with the dearest fault, {dearest.case}, {dearest.frame_ms:.0f} ms"
    note = (
        "Filled: a frame with the fault. Open: the same frame without it, in turn in the same run."
        " Medians; 1920 x 1080."
    )
    title = load.title(finding, "Times of frames with each fault")
    note = load.note(note)
    with chart(
        path, title, 1, len(QUANTISATIONS), note=note, share_y=True, height_inch=5.2
    ) as panels:
        for (name, colour), axes in zip(COLOURS.items(), panels, strict=True):
            mine = [cost for cost in costs if cost.quantisation == name]
            looks = SeriesLook("without", colour), SeriesLook("with the fault", colour)
            draw_pairs(axes, PairSpec("without_ms", "frame_ms", looks, open_first=True), mine)
            axes.set_xlabel("time of a frame [ms]")
            axes.set_title(name, color=colour)
        name_places(panels[0], list(CASES))
