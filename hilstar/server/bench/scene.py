"""What a bench's light is planned for: each way to draw its stars, full scale with that, and the
first whose plan is within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.display.balance import Seen
from hilstar.display.calibration import Calibration
from hilstar.display.render.backend import level_cost
from hilstar.optics.camera import Camera
from hilstar.optics.psf import Psf
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import (
    before_detector,
    display_psfs,
)
from hilstar.server.bench.config import (
    DEFAULT_BRIGHTEST_V_MAG,
    BenchConfig,
    RenderSettings,
)
from hilstar.server.bench.config.values import MAX_NUMBER, MIN_POSITIVE
from hilstar.server.bench.effort import (
    CLAIMED_TURN_DEG_S,
    Effort,
    Light,
    plan_effort,
)
from hilstar.server.bench.least_psf import WHOLE, Choice
from hilstar.server.bench.monitor import scan_of
from hilstar.sky.stars import (
    Stars,
)

if TYPE_CHECKING:
    from hilstar.display.render.context import Context


class Scene(NamedTuple):
    """What the light of a bench is planned with: the PSF and why it was chosen, the full scale that
    it allows, and the stars' light.
    """

    psf: Psf
    choice: Choice | None
    white_e_per_s: float
    light: Light


class Display(NamedTuple):
    """The display of a bench: calibration, camera, GL context and darkest pixel; the share of white
    that each star asks for; `turning` and `path_px` as of `turning_of` and `path_of`.
    """

    calibration: Calibration
    camera: Camera
    context: Context | None
    drive: FloatArray | float
    turning: float | None
    path_px: float
    darkest: float

    @property
    def gl_version(self) -> int | None:
        """The version of its OpenGL, 430 for 4.3; None where NumPy draws."""
        return None if self.context is None else int(self.context.version_code)


def scenes_of(file: BenchFile, stars: Stars, display: Display) -> Iterator[Scene]:
    """The scene of each way to draw a bench's stars, from the cheapest on."""
    camera = display.camera
    drive = display.drive
    render = file.config.render
    for psf, choice in display_psfs(file.config, file.folder, camera):
        white_e_per_s = white_of(render, stars, psf, drive)
        light = Light(
            response=display.calibration.response,
            # Vignetting asks for more from a pixel: where the screen is darkest a fainter star gets
            # a code.
            white_e_per_s=white_e_per_s * display.darkest,
            rates_e_per_s=stars.electrons_per_s,
            # about
            sky_share=math.prod(camera.resolution_px)
            / math.prod(camera.scales_px_rad())
            / (4 * math.pi),
            refresh_hz=file.config.monitor.refresh_hz,
            seen=seen_by(file, camera),
            centroider=file.config.verify.judge,
            psf=psf,
            psf_choice=choice,
            exposure_frames=file.config.exposure_frames,
            cost=partial(level_cost, gl_version=display.gl_version),
            turning=display.turning,
            path_px=display.path_px,
        )
        yield Scene(psf, choice, white_e_per_s, light)


def plan_scene(render: RenderSettings, scenes: Iterator[Scene]) -> tuple[Scene, Effort]:
    """The first scene whose plan is within the tolerance; where none is, the first whose PSF
    alone is within it.
    """
    near: list[tuple[Scene, Effort]] = []
    for scene in scenes:
        effort = plan_effort(render, scene.light)
        choice = scene.choice
        if choice is None:
            return scene, effort
        is_last = choice.choice == WHOLE
        if not is_last and (
            choice.error_mag > render.tolerance_mag or choice.error_px > render.tolerance_px
        ):
            continue
        near.append((scene, effort))
        if effort.within:
            return scene, effort
    return near[0]


def white_of(
    render: RenderSettings, stars: Stars, psf: Psf, drive: FloatArray | float = 1.0
) -> float:
    """Full scale, electrons per second of a pixel. Raises InputError as
    `brightest_peak_e_per_s`.
    """
    return render.flux_at_white_e_per_s or brightest_peak_e_per_s(
        stars, psf, render.brightest_v_mag, drive
    )


def turning_of(config: BenchConfig, on_screen: bool) -> float | None:
    """How far stars without paths are from the mean of their light at most, in units of their
    motion; None at rest.

    A frame has them where they are at the middle of the middle row's light. The first and the last
    row light up half a scan-out earlier and later, and the motion counts to the last row's end.
    """
    motion = config.render.motion
    scan = scan_of(config.monitor)
    moves = motion == "on" or (motion == "auto" and on_screen)
    if not moves or not scan.longest_s:
        return None
    return scan.scanout_s / 2 / scan.longest_s


def path_of(config: BenchConfig, camera: Camera, on_screen: bool) -> float:
    """How far a star moves on the monitor while its row is lit, turning at CLAIMED_TURN_DEG_S,
    px; 0 at rest.
    """
    if turning_of(config, on_screen) is None:
        return 0.0
    turned_rad = math.radians(CLAIMED_TURN_DEG_S) * scan_of(config.monitor).hold_s
    return turned_rad * max(camera.scales_px_rad())


def seen_by(file: BenchFile, camera: Camera) -> Seen:
    """How the tracker sees the monitor at the boresight: its blur and its pixel in monitor
    pixels.
    """
    tracker = file.config.tracker
    pixel_px = camera.focal_length_px * tracker.pixel_pitch_um * 1e-3 / tracker.focal_length_mm
    blur_px = (
        math.sqrt(math.prod(before_detector(file.config, file.folder, camera).width_px)) * pixel_px
    )
    return Seen(blur_px=blur_px, pixel_px=pixel_px)


def brightest_peak_e_per_s(
    stars: Stars,
    psf: Psf,
    brightest_v_mag: float | None = DEFAULT_BRIGHTEST_V_MAG,
    drive: FloatArray | float = 1.0,
) -> float:
    """Full scale where the file gives no flux for it: the brightest pixel of the brightest star at
    or below that magnitude.

    A star counts `drive` (n,) times, as much of white as its colour asks for. Brighter stars may
    clip. With the default magnitude and a catalogue of brighter stars alone, none does. Raises
    InputError when no star remains.
    """
    if brightest_v_mag is None:
        magnitude = DEFAULT_BRIGHTEST_V_MAG
    else:
        magnitude = brightest_v_mag
    rates = stars.electrons_per_s * drive
    wanted = rates[stars.v_mag >= magnitude]
    if not len(wanted) and magnitude == DEFAULT_BRIGHTEST_V_MAG:
        wanted = rates
    if not len(wanted):
        key, better = (
            ("[render] brightest_v_mag", "smaller")
            if len(stars)
            else ("[sky] faintest_v_mag", "larger")
        )
        raise InputError(
            f"{key} leaves no star; write a {better} magnitude, or [render] flux_at_white_e_per_s"
        )
    peak_e_per_s = float(wanted.max()) * psf.peak_share
    if not MIN_POSITIVE <= peak_e_per_s <= MAX_NUMBER:
        raise InputError(
            "[tracker] aperture_mm, quantum_efficiency and transmission: the brightest star to"
            f" show gives {peak_e_per_s:.3g} electrons per second; write those of a lens that gives"
            f" it {MIN_POSITIVE:g} to {MAX_NUMBER:g}"
        )
    return peak_e_per_s
