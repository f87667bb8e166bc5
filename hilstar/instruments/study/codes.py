"""Ways from light to code values, and the error of each by every centroider: of one frame, and
over an exposure.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, GREEN, ORANGE, PURPLE, write_records
from hilstar.basics.units import flux_ratio
from hilstar.display.balance import AS_USUAL, Balance
from hilstar.display.panel import Panel
from hilstar.display.phases import (
    USUAL_PSF,
    WHITE,
    fainter,
    line_places,
    phase_grid,
    phase_image,
    shown_by,
)
from hilstar.display.quantise import (
    EXPOSURE_FRAMES,
    Quantisation,
    dither_levels,
    mask_turn,
    shown_light,
)
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.response import (
    Response,
    Weights,
    bit_stealing_response,
    gamma_response,
    srgb_response,
    table_response,
)
from hilstar.display.temporal import TemporalQuantiser
from hilstar.instruments.study.row_charts import (
    ChartSpec,
    LineSpec,
    PanelSpec,
    draw_rows,
    finite,
    looks_of,
)
from hilstar.optics.sprites import FrameLight, pack_sprites
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.star_errors import Judge, StarErrors

BITS = (8, 10, 12)
# By bits: the largest flux error allowed, mag, and the magnitudes under white over which it is
# allowed.
AIMS = {8: (0.05, 6.0), 10: (0.02, 8.0), 12: (0.02, 8.0)}
AIM_PX = 0.01
# Rec. 709's shares of white stand in for the primaries as a tracker sees them.
STEALING_WEIGHTS: Weights = (0.2126, 0.7152, 0.0722)
FRAME_PX = (1920, 1080)
STARS = 1000
SEED = 1
STEALING = ", bit stealing"
JUDGE: Centroider = "fit"  # as most trackers do
ERROR_COLUMNS = (
    "flux_rms_mag",
    "flux_max_mag",
    "centroid_rms_px",
    "centroid_max_px",
    *(f"axis_rms_px_{kind}" for kind in FAMILY),
    *(f"max_px_{kind}" for kind in FAMILY),
)
FRAMES = (1, 2, 4, 6, 8, 16, 32, 64)
BEGINS = (2.0, 3.4, 5.7, 7.1)  # refreshes: exposures begin within frames too
AIM_FRAMES = 6
MANY_STEPS = 100  # from which on they are told without a decimal
FRAMES_NOTE = (
    "Solid: temporal. Dotted: dither with a mask that turns. Steps: a star's light in steps of the"
    " panel from black."
)


@dataclass(frozen=True, slots=True)
class Way:
    """One way from light to levels: its name, the renderer's method, its colour, and in how many
    frames it is seen.
    """

    name: str
    method: Quantisation
    colour: str
    stealing: bool = False
    frames: int = 1


WAYS = (
    Way("round", "round", PURPLE),
    Way("dither", "dither", ORANGE),
    Way(f"temporal, mean of {EXPOSURE_FRAMES} frames", "temporal", GREEN, frames=EXPOSURE_FRAMES),
    Way("exact", "exact", BLUE),
    Way("round" + STEALING, "round", PURPLE, stealing=True),
    Way("exact" + STEALING, "exact", BLUE, stealing=True),
)


def response_of(bits: int, way: Way) -> Response:
    """The sRGB response of a way; with bit stealing, of three equal channels."""
    grey = srgb_response(bits)
    if way.stealing:
        return bit_stealing_response((grey, grey, grey), STEALING_WEIGHTS)
    return grey


def star_field(frame_px: tuple[int, int], footprint_px: int) -> FrameLight:
    """STARS sprites anywhere on the frame, over eight magnitudes, three times as many in each as
    in the one before.
    """
    rng = np.random.default_rng(SEED)
    mag = 2 * np.log10(1 + rng.uniform(size=STARS) * (10 ** (8 / 2) - 1))
    flux = WHITE / USUAL_PSF.peak_share * flux_ratio(mag)
    x_px, y_px = rng.uniform(0, 1, (2, STARS)) * np.array(frame_px)[:, None]
    return pack_sprites(x_px, y_px, flux, np.arange(STARS), frame_px, footprint_px)


def judged_phases(phases: int) -> tuple[FrameLight, int, FloatArray, Judge]:
    """phases^2 stars whose peak is white, the side of a star's tile, px, their image, and its
    judge by the usual tracker.
    """
    sprites, tile = phase_grid(phases, USUAL_PSF)
    bright = phase_image(sprites, USUAL_PSF)
    judge = Judge(
        bright, line_places(sprites), USUAL_PSF.width_px, AS_USUAL.blur_px, AS_USUAL.pixel_px
    )
    return sprites, tile, bright, judge


def code_errors(bits: int, way: Way, phases: int, mags: Iterable[float]) -> list[StarErrors]:
    """The errors of phases^2 stars, so many magnitudes under white, on an sRGB panel; the
    tracker is as usual.
    """
    panel = Panel(response_of(bits, way), WHITE)
    balance = Balance(USUAL_PSF, AS_USUAL)
    sprites, _, bright, judge = judged_phases(phases)
    errors = []
    for mag in mags:
        wanted = fainter(sprites, mag)
        share = flux_ratio(mag)
        kind = QUANTISERS[way.method]
        shown = shown_by(
            kind, way.frames, panel, (bright * share).astype(np.float32), wanted, balance
        )
        errors.append(judge.errors(shown, share))
    return errors


def error_cells(errors: StarErrors) -> tuple[float, ...]:
    """The values of ERROR_COLUMNS; `centroid_...` are distances by the plain moment,
    `axis_rms_...` along one axis.
    """
    distance_px = np.sqrt(2) * errors.axis_rms_px("moment")
    return (
        errors.flux_rms_mag,
        errors.flux_max_mag,
        float(distance_px),
        errors.max_px("moment"),
        *(errors.axis_rms_px(kind) for kind in FAMILY),
        *(errors.max_px(kind) for kind in FAMILY),
    )


@dataclass(frozen=True, slots=True)
class OverFrames:
    """A row of over_frames.csv: rms errors over phases and beginnings of exposures of so many
    frames, places along an axis.

    `steps` is the star's light in steps from black; errors are infinite where a star may show
    nothing.
    """

    panel: str
    mag_under_white: float
    steps: float
    method: str
    frames: int
    flux_rms_mag: float
    axis_rms_px_moment: float
    axis_rms_px_window: float
    axis_rms_px_fit: float


def study_frames(directory: Path, quick: bool) -> str:
    """Write over_frames.csv and its chart into `directory`; the finding."""
    phases, counts = (6, FRAMES[:4]) if quick else (16, FRAMES)
    equal = {bits: table_response(bits, np.linspace(0, 1, 2**bits)) for bits in (8, 2, 1)}
    # Monitors of 8 bits, and microdisplays whose levels are equal; a star so many magnitudes under
    # white on each.
    shown = (
        ("sRGB, 8 bits", srgb_response(8), 6.0),
        ("gamma 2.2, 8 bits", gamma_response(8), 6.0),
        ("linear, 8 bits", equal[8], 6.0),
        ("linear, 2 bits", equal[2], 2.0),
        ("1 bit", equal[1], 2.0),
    )
    residual_rows = [row for panel in shown for row in _left_by(*panel, phases, counts)]
    write_records(directory / "over_frames.csv", residual_rows)
    draw(directory / "over_frames", residual_rows)
    at = (row for row in residual_rows if (row.frames, row.method) == (AIM_FRAMES, "temporal"))
    row_text = "; ".join(
        f"{row.panel} {row.flux_rms_mag:.2g} mag, {row.axis_rms_px_fit:.2g} px" for row in at
    )
    return f"temporal over any {AIM_FRAMES} frames, rms, places by a PSF fit: {row_text}"


def _left_by(
    name: str, response: Response, mag: float, phases: int, counts: tuple[int, ...]
) -> Iterator[OverFrames]:
    panel = Panel(response, WHITE)
    share = flux_ratio(mag)
    sprites, tile, bright, judge = judged_phases(phases)
    stars = fainter(sprites, mag)
    linear = (share * bright).astype(np.float32)
    quantiser = TemporalQuantiser(panel, (phases * tile, phases * tile), USUAL_PSF)
    steps = float(stars.data["electrons_per_s"][0]) / (float(response.light[1]) * WHITE)
    kinds: tuple[Centroider, ...] = ("moment", "window", "fit")
    for method in ("temporal", "dither"):
        # light up to the end of each frame
        whole = np.zeros((int(max(BEGINS)) + max(counts) + 2, *linear.shape))
        for frame in range(len(whole) - 1):
            if method == "temporal":
                levels = quantiser.levels(stars)
            else:
                levels = dither_levels(linear, panel, mask_turn(frame))
            whole[frame + 1] = whole[frame] + shown_light(levels, panel)

        def until(refreshes: float, whole: FloatArray = whole) -> FloatArray:
            frame = int(refreshes)
            part = refreshes % 1
            return np.asarray(whole[frame] + part * (whole[frame + 1] - whole[frame]))

        for count in counts:
            error_rows = []
            for begin in BEGINS:
                mean_light = (until(begin + count) - until(begin)) / count
                errors = judge.errors(mean_light, share, kinds)
                axis_rms_px = [errors.axis_rms_px(kind) for kind in kinds]
                error_rows.append((errors.flux_rms_mag, *axis_rms_px))
            rms = np.sqrt(np.mean(np.square(error_rows), axis=0)).tolist()
            yield OverFrames(name, mag, steps, method, count, *rms)


def draw(path: Path, left: list[OverFrames]) -> None:
    """What is left over the frames of an exposure, each panel in its colour."""
    names = list(dict.fromkeys(row.panel for row in left))
    at = {
        row.panel: row.axis_rms_px_fit
        for row in left
        if row.frames == AIM_FRAMES and row.method == "temporal"
    }
    finding = (
        f"Over any {AIM_FRAMES} frames temporal places stars within {at[names[0]]:.2g} px rms on"
        f" {names[0]}, and within {at[names[-1]]:.2g} px on {names[-1]}"
    )
    panels = (
        frames_panel("flux_rms_mag", "flux error, rms [mag]"),
        replace(
            frames_panel("axis_rms_px_fit", "place by a PSF fit, rms [px]"),
            xlabel="frames of an exposure",
            xticks=sorted({row.frames for row in left}),
        ),
    )
    looks = looks_of({name: name for name in names})
    draw_rows(path, finding, ChartSpec(panels, lambda row: row.panel, looks, FRAMES_NOTE), left)


def frames_panel(error: str, ylabel: str) -> PanelSpec:
    """An error over the frames of an exposure, by `temporal` and by `dither`; the flux's has the
    steps.
    """
    label = steps_words if error == "flux_rms_mag" else None
    temporal = LineSpec(
        "frames",
        finite(error),
        marker="o",
        label=label,
        where=lambda row: row.method == "temporal",
        look={"ms": 4},
    )
    dither = LineSpec(
        "frames",
        finite(error),
        ":",
        named=False,
        where=lambda row: row.method == "dither",
        look={"ms": 4},
    )
    return PanelSpec((temporal, dither), ylabel, scales=("log", "log"))


def steps_words(row: OverFrames) -> str:
    """A panel, and how many of its steps a star's light is."""
    decimals = 0
    if row.steps < MANY_STEPS:
        decimals = 1
    return f"{row.panel}: {row.steps:.{decimals}f} steps"
