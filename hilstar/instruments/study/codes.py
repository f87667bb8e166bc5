"""Ways from light to code values, and the error of each by every centroider: of one frame, and
over an exposure.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, GREEN, ORANGE, PURPLE
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
    Levels,
    Response,
    Weights,
    bit_stealing_response,
    gamma_response,
    srgb_response,
    table_response,
)
from hilstar.display.temporal import TemporalQuantiser
from hilstar.instruments.study.engine import (
    ChartSpec,
    LineSpec,
    PanelSpec,
    draw_rows,
    finite,
    looks_of,
    write_rows,
)
from hilstar.optics.sprites import FrameLight, pack_sprites
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.star_errors import Judge, StarErrors

BITS = (8, 10, 12)
# By bits: the largest flux error allowed, mag, and the magnitudes under white over which it is
# allowed.
AIMS = {8: (0.05, 6.0), 10: (0.02, 8.0), 12: (0.02, 8.0)}
AIM_PX = 0.01  # the largest place error allowed, by a PSF fit
# Rec. 709's shares of white stand in for the primaries as a tracker sees them.
STEALING_WEIGHTS: Weights = (0.2126, 0.7152, 0.0722)
FRAME_PX = (1920, 1080)
STARS = 1000
SEED = 1
STEALING = ", bit stealing"
JUDGE: Centroider = "fit"  # as most trackers do
FRAMES = (1, 2, 4, 6, 8, 16, 32, 64)  # of an exposure
BEGINS = (2.0, 3.4, 5.7, 7.1)  # refreshes: exposures begin within frames too
AIM_FRAMES = 6  # of an exposure of 0.1 s at 60 Hz
JUDGED: tuple[Centroider, ...] = ("moment", "window", "fit")  # over frames
MANY_STEPS = 100  # from which on they are written without a decimal
SMALL = {"ms": 4}
FRAMES_NOTE = (
    "Solid: temporal. Dotted: dither with a mask that turns. Steps: a star's light in steps of the"
    " panel from black."
)


@dataclass(frozen=True, slots=True)
class Way:
    """A way from light to levels: its name, the renderer's method, its colour in charts, and the
    frames of an exposure.
    """

    name: str
    method: Quantisation
    colour: str
    stealing: bool = False
    frames: int = 1


WAYS: tuple[Way, ...] = (
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
    """STARS sprites anywhere on a frame over eight magnitudes, three times as many in each as in
    the one before.
    """
    rng = np.random.default_rng(SEED)
    brightest_share = rng.uniform(size=STARS)
    mag = 2 * np.log10(1 + brightest_share * (10 ** (8 / 2) - 1))
    white_e_per_s = WHITE / USUAL_PSF.peak_share
    flux = white_e_per_s * flux_ratio(mag)
    size_px = np.array(frame_px)[:, None]
    x_px, y_px = rng.uniform(0, 1, (2, STARS)) * size_px
    return pack_sprites(x_px, y_px, flux, np.arange(STARS), frame_px, footprint_px)


def judged_phases(phases: int) -> tuple[FrameLight, int, FloatArray, Judge]:
    """phases^2 stars whose peak is white, one at each place within a pixel, and what judges them.

    Returns sprites, the side of a star's tile, px, their image, and the judge of the usual tracker.
    """
    sprites, tile = phase_grid(phases, USUAL_PSF)
    bright = phase_image(sprites, USUAL_PSF)
    judge = Judge(
        bright, line_places(sprites), USUAL_PSF.width_px, AS_USUAL.blur_px, AS_USUAL.pixel_px
    )
    return sprites, tile, bright, judge


def code_errors(bits: int, way: Way, phases: int, mags: Iterable[float]) -> list[StarErrors]:
    """The errors of phases^2 stars at magnitudes under white, on an sRGB panel, by the usual
    tracker.
    """
    panel = Panel(response_of(bits, way), WHITE)
    balance = Balance(USUAL_PSF, AS_USUAL)
    kind = QUANTISERS[way.method]
    sprites, _, bright, judge = judged_phases(phases)
    errors = []
    for mag in mags:
        wanted = fainter(sprites, mag)
        share = flux_ratio(mag)
        linear = (bright * share).astype(np.float32)
        shown = shown_by(kind, way.frames, panel, linear, wanted, balance)
        errors.append(judge.errors(shown, share))
    return errors


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Errors of stars over sub-pixel phases, by every centroider.

    `centroid_...` are distances by the plain moment, `axis_rms_...` along one axis.
    """

    flux_rms_mag: float
    flux_max_mag: float
    centroid_rms_px: float
    centroid_max_px: float
    axis_rms_px_moment: float
    axis_rms_px_window: float
    axis_rms_px_wide: float
    axis_rms_px_fit: float
    axis_rms_px_box3: float
    axis_rms_px_box5: float
    max_px_moment: float
    max_px_window: float
    max_px_wide: float
    max_px_fit: float
    max_px_box3: float
    max_px_box5: float

    def axis_rms_px(self, kind: Centroider) -> float:
        """The rms along an axis by one centroider."""
        return float(getattr(self, f"axis_rms_px_{kind}"))


def error_figures(errors: StarErrors) -> ErrorFigures:
    """The figures of the errors of stars."""
    by_centroider = {}
    for kind in FAMILY:
        by_centroider[f"axis_rms_px_{kind}"] = errors.axis_rms_px(kind)
        by_centroider[f"max_px_{kind}"] = errors.max_px(kind)
    distance_px = np.sqrt(2) * errors.axis_rms_px("moment")
    return ErrorFigures(
        flux_rms_mag=errors.flux_rms_mag,
        flux_max_mag=errors.flux_max_mag,
        centroid_rms_px=float(distance_px),
        centroid_max_px=errors.max_px("moment"),
        **by_centroider,
    )


@dataclass(frozen=True, slots=True)
class OverFrames:
    """Errors of a star over an exposure of some frames: rms over places within a pixel and starts.

    Places are along one axis. `steps` is the star's light in steps of the panel from black; errors
    are infinite where a star may show nothing.
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


@dataclass(frozen=True, slots=True)
class FramesPanel:
    """A panel whose frames are summed, and how faint the star on it is."""

    name: str
    response: Response
    mag_under_white: float


def frames_panels() -> list[FramesPanel]:
    """Monitors of 8 bits, and microdisplays whose levels are equal."""
    equal = {bits: table_response(bits, np.linspace(0, 1, 2**bits)) for bits in (8, 2, 1)}
    return [
        FramesPanel("sRGB, 8 bits", srgb_response(8), 6.0),
        FramesPanel("gamma 2.2, 8 bits", gamma_response(8), 6.0),
        FramesPanel("linear, 8 bits", equal[8], 6.0),
        FramesPanel("linear, 2 bits", equal[2], 2.0),
        FramesPanel("1 bit", equal[1], 2.0),
    ]


def measure_frames(quick: bool) -> list[OverFrames]:
    """The errors over the frames of an exposure, on every panel."""
    phases = 16
    counts: tuple[int, ...] = FRAMES
    if quick:
        phases = 6
        counts = FRAMES[:4]
    rows: list[OverFrames] = []
    for panel in frames_panels():
        rows += over_frames(panel, phases, counts)
    return rows


def report_frames(directory: Path, rows: Sequence[OverFrames]) -> str:
    """Write over_frames.csv and its chart into `directory`; the finding."""
    write_rows(directory / "over_frames.csv", rows)
    draw(directory / "over_frames", rows)
    errors = []
    for row in rows:
        if row.frames == AIM_FRAMES and row.method == "temporal":
            light = f"{row.flux_rms_mag:.2g} mag"
            errors.append(f"{row.panel} {light}, {row.axis_rms_px_fit:.2g} px")
    finding = f"temporal over any {AIM_FRAMES} frames, rms, places by a PSF fit"
    return f"{finding}: {'; '.join(errors)}"


def light_to_frames(
    levels_of: Callable[[int], Levels], panel: Panel, shape: tuple[int, ...], frames: int
) -> FloatArray:
    """A panel's light up to the start of each frame and of one more: (frames + 1, h, w)."""
    to_frame = np.zeros((frames + 1, *shape))
    for frame in range(frames):
        to_frame[frame + 1] = to_frame[frame] + shown_light(levels_of(frame), panel)
    return to_frame


def light_until(to_frame: FloatArray, refreshes: float) -> FloatArray:
    """The light (h, w) up to a moment within a frame, by `light_to_frames`."""
    frame = int(refreshes)
    in_frame = to_frame[frame + 1] - to_frame[frame]
    return np.asarray(to_frame[frame] + refreshes % 1 * in_frame)


def over_frames(
    frames_panel: FramesPanel, phases: int, counts: tuple[int, ...]
) -> Iterator[OverFrames]:
    """The errors on one panel over each number of frames, by `temporal` and by `dither`."""
    response = frames_panel.response
    panel = Panel(response, WHITE)
    share = flux_ratio(frames_panel.mag_under_white)
    sprites, tile, bright, judge = judged_phases(phases)
    stars = fainter(sprites, frames_panel.mag_under_white)
    linear = (share * bright).astype(np.float32)
    quantiser = TemporalQuantiser(panel, (phases * tile, phases * tile), USUAL_PSF)
    first_step = float(response.light[1]) * WHITE
    steps = float(stars.data["electrons_per_s"][0]) / first_step

    def temporal(_: int) -> Levels:
        return quantiser.levels(stars)

    def dither(frame: int) -> Levels:
        return dither_levels(linear, panel, mask_turn(frame))

    methods: dict[str, Callable[[int], Levels]] = {"temporal": temporal, "dither": dither}
    frames = int(max(BEGINS)) + max(counts) + 1
    for method, levels_of in methods.items():
        to_frame = light_to_frames(levels_of, panel, linear.shape, frames)
        for count in counts:
            by_begin = []
            for begin in BEGINS:
                light = light_until(to_frame, begin + count) - light_until(to_frame, begin)
                errors = judge.errors(light / count, share, JUDGED)
                axis_rms_px = [errors.axis_rms_px(kind) for kind in JUDGED]
                by_begin.append((errors.flux_rms_mag, *axis_rms_px))
            rms = np.sqrt(np.mean(np.square(by_begin), axis=0)).tolist()
            mag = frames_panel.mag_under_white
            yield OverFrames(frames_panel.name, mag, steps, method, count, *rms)


def draw(path: Path, rows: Sequence[OverFrames]) -> None:
    """The errors over the frames of an exposure, each panel in its colour."""
    names = list(dict.fromkeys(row.panel for row in rows))
    at_aim = {}
    for row in rows:
        if row.frames == AIM_FRAMES and row.method == "temporal":
            at_aim[row.panel] = row.axis_rms_px_fit
    best, worst = names[0], names[-1]
    finding = (
        f"Over any {AIM_FRAMES} frames temporal places stars within {at_aim[best]:.2g} px rms on"
        f" {best}, and within {at_aim[worst]:.2g} px on {worst}"
    )
    light = error_panel("flux_rms_mag", "flux error, rms [mag]")
    place = replace(
        error_panel("axis_rms_px_fit", "place by a PSF fit, rms [px]"),
        xlabel="frames of an exposure",
        xticks=sorted({row.frames for row in rows}),
    )
    looks = looks_of({name: name for name in names})
    draw_rows(path, finding, ChartSpec((light, place), panel_of, looks, FRAMES_NOTE), rows)


def panel_of(row: OverFrames) -> str:
    """The series of a row: its panel."""
    return row.panel


def error_panel(error: str, ylabel: str) -> PanelSpec:
    """An error against the frames of an exposure, by `temporal` and by `dither`.

    The panel of the flux names each monitor's steps.
    """
    temporal = LineSpec(
        "frames",
        finite(error),
        marker="o",
        label=steps_words if error == "flux_rms_mag" else None,
        where=is_temporal,
        look=SMALL,
    )
    dither = LineSpec("frames", finite(error), ":", named=False, where=is_dither, look=SMALL)
    return PanelSpec((temporal, dither), ylabel, scales=("log", "log"))


def is_temporal(row: OverFrames) -> bool:
    """Whether a row is drawn solid."""
    return row.method == "temporal"


def is_dither(row: OverFrames) -> bool:
    """Whether a row is drawn dotted."""
    return row.method == "dither"


def steps_words(row: OverFrames) -> str:
    """A panel, and the star's light in its steps."""
    decimals = 0
    if row.steps < MANY_STEPS:
        decimals = 1
    return f"{row.panel}: {row.steps:.{decimals}f} steps"
