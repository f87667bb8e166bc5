"""From a bench file to the parts that it describes, and from an attitude to a frame."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from hilstar.arrays import Float32Array, FloatArray, IntArray
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.bench.config import DEFAULT_BRIGHTEST_V_MAG, BenchConfig, SkySettings, Tracker, Vector, read_config
from hilstar.bench.effort import Effort, Light, faintest_shown_e_per_s, plan_effort
from hilstar.bench.mounting import scan_of
from hilstar.errors import InputError
from hilstar.monitor.calibration import BUILT_IN, Calibration, load_calibration
from hilstar.monitor.footprints import FootprintMap
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.losses import star_losses
from hilstar.monitor.quantise import cycle_warning
from hilstar.monitor.response import Codes, code_dtype
from hilstar.reading import read_bytes
from hilstar.render.renderer import Context, Renderer, Target
from hilstar.rotation import normalise, to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.clipping import clipped_sprites
from hilstar.scene.frame_motion import Turn, swept_sprites
from hilstar.scene.psf import peak_share, pixel_shares
from hilstar.scene.sprites import Sprites, make_sprites
from hilstar.sky.astrometry import aberrate, unit_vectors_icrs
from hilstar.sky.catalog import MAX_CATALOGUE_BYTES, load_catalog
from hilstar.sky.electrons import Optics, Photometry, star_temperatures_k, tabulate
from hilstar.sky.pickles import tabulate_pickles
from hilstar.sky.spectrum import BUILT_IN_CURVES, load_curve
from hilstar.sky.stars import Stars, brighter_stars, make_stars

log = logging.getLogger(__name__)
WARM_UP_ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0])
WARM_UP_RATE_RAD_S = np.array([0.1, 0.0, 0.0])
TRUTH_DTYPE = np.dtype(
    [
        ("hip", "i4"),
        ("x_px", "f8"),
        ("y_px", "f8"),
        ("v_mag", "f8"),
        ("bv", "f8"),
        ("temperature_k", "f8"),
        ("electrons_per_s", "f8"),
        ("drawn", "?"),
        ("clipped", "?"),
    ]
)


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame: what each monitor pixel should cause, the codes that ask for it, and the stars behind it.

    `linear` is float32 (height, width), electrons per second; `levels`, uint8 or uint16 of the same shape, are the places
    in the response's table; `codes` are the code values, the same array or with bit stealing (height, width, 3);
    `truth` is a structured array of TRUTH_DTYPE, a row for each star whose sprite touches the monitor.
    """

    q_icrs_to_cam: FloatArray
    linear: Float32Array
    levels: Codes
    codes: Codes
    truth: npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class Prepared:
    """A frame before it is drawn: its attitude (None: blank), the turn of its paths (None: points), and its sprites."""

    q_icrs_to_cam: FloatArray | None
    turn: Turn | None
    sprites: Sprites | None


class Drawn:
    """What a draw put on the monitor: how many stars, and those too bright for it.

    `turn` is what the stars' paths were drawn for, None where they are points, and `capped` how many of those are coarser
    than they should be (see `scene.frame_motion`).
    """

    def __init__(self, bench: Bench, q_icrs_to_cam: FloatArray | None, turn: Turn | None = None) -> None:
        self.star_count = 0
        self.clipped_hip: tuple[int, ...] = ()
        self.capped = 0
        self.turn = turn
        self._bench = bench
        self._q_icrs_to_cam = q_icrs_to_cam
        self._levels: Codes | None = None

    @property
    def levels(self) -> Codes:
        """The levels (see `Bench.code_values`), read back when they are first asked for; the next draw overwrites them."""
        if self._levels is None:
            self._levels = self._bench.renderer.codes()
        return self._levels

    @property
    def below_step(self) -> int:
        """How many stars in view are too faint for the monitor."""
        return 0 if self._q_icrs_to_cam is None else self._bench.count_faint(self._q_icrs_to_cam)


class Bench:
    """A bench, assembled: stars, geometry and a renderer (in a window's `context`, where given). Free it with `close`."""

    def __init__(self, path: Path, context: Context | None = None) -> None:
        self.path = path
        self.config = read_config(path)
        self.bench_hash = bench_hash(self.config, path.parent)
        self.stars = bench_stars(self.config, path.parent)
        self.camera = bench_camera(self.config)
        self._sigma_px = self.config.render.sprite_sigma_px
        self.flux_at_white_e_per_s = self.config.render.flux_at_white_e_per_s or brightest_peak_e_per_s(
            self.stars, self._sigma_px, self.config.render.brightest_v_mag
        )
        self.calibration = bench_calibration(self.config, path.parent)
        self.uniformity = self.calibration.uniformity_map(self.config.monitor.resolution_px)
        self.darkest = 1.0 if self.uniformity is None else float(self.uniformity.min())
        self._plan()
        self.shown_stars = brighter_stars(self.stars, self.faintest_shown_e_per_s())
        self.scan = scan_of(self.config.monitor)
        self._warn_of_cycle()
        self.renderer = Renderer(self._target(), context)

    def _plan(self) -> None:
        """Choose what the bench file leaves to its tolerance."""
        render = self.config.render
        self.effort: Effort | None = None
        if render.effort == "auto" or render.quantisation == "auto":
            self.effort = plan_effort(render, self._light())
            chosen = replace(render, quantisation=self.effort.quantisation, motion_above_px=self.effort.motion_above_px)
            self.config = replace(self.config, render=chosen)

    def _target(self) -> Target:
        render = self.config.render
        if render.quantisation == "auto":
            raise AssertionError("the plan has chosen")
        return Target(
            resolution_px=self.config.monitor.resolution_px,
            sigma_px=self._sigma_px,
            response=self.calibration.response,
            flux_at_white_e_per_s=self.flux_at_white_e_per_s,
            quantisation=render.quantisation,
            uniformity=self.uniformity,
            cycle_frames=render.cycle_frames,
            sides=() if self.effort is None else self.effort.sides,
        )

    def faintest_shown_e_per_s(self) -> float:
        """The rate under which a star alone never lights a pixel, wherever it stands; 0 where the dither always may."""
        return faintest_shown_e_per_s(self.config.render.quantisation, self._light(), self._sigma_px)

    def _light(self) -> Light:
        # Vignetting asks for more from a pixel: where the screen is darkest a fainter star gets a code.
        finer = self.calibration.can_steal_bits and not self.config.render.bit_stealing
        return Light(self.calibration.response, self.flux_at_white_e_per_s * self.darkest, self.stars.electrons_per_s, finer)

    def _warn_of_cycle(self) -> None:
        render, refresh_hz = self.config.render, self.config.monitor.refresh_hz
        if render.quantisation == "temporal":
            warning = cycle_warning(self.config.tracker.exposure_s, refresh_hz, render.cycle_frames)
            if warning is not None:
                log.warning("%s: %s", self.path, warning)

    def sprites(self, q_icrs_to_cam: FloatArray, stars: Stars | None = None) -> Sprites:
        """The sprites of `stars` (those that can be seen, by default) at an attitude (unit quaternion, scalar first)."""
        icrs_to_image = self.camera.cam_to_image @ to_matrix(q_icrs_to_cam)
        return make_sprites(stars or self.shown_stars, icrs_to_image, self.camera, self.renderer.footprint_px)

    def draw(
        self, q_icrs_to_cam: FloatArray | None, frame: int = 0, rate_cam_rad_s: Vector | FloatArray | None = None
    ) -> Drawn:
        """Draw the levels for an attitude; None gives a blank frame. The frame path: no copy, no table.

        `frame` counts the frames shown, for temporal dithering. With a rate that moves stars by more than
        `[render] motion_above_px` each is drawn along its path while its row is lit; the attitude is then that of the middle
        row's first light.
        """
        return self.draw_prepared(self.prepare(q_icrs_to_cam, rate_cam_rad_s), frame)

    def prepare(self, q_icrs_to_cam: FloatArray | None, rate_cam_rad_s: Vector | FloatArray | None = None) -> Prepared:
        """The sprites of a frame (see `draw`), before anything is drawn."""
        if q_icrs_to_cam is None:
            return Prepared(None, None, None)
        turn = self._turn(q_icrs_to_cam, rate_cam_rad_s)
        return Prepared(q_icrs_to_cam, turn, self.sprites(q_icrs_to_cam) if turn is None else self._swept(turn))

    def draw_prepared(self, prepared: Prepared, frame: int = 0) -> Drawn:
        """Draw the levels of a frame that was prepared."""
        sprites = prepared.sprites
        self.renderer.draw(sprites, frame)
        drawn = Drawn(self, prepared.q_icrs_to_cam, prepared.turn)
        if sprites is None:
            return drawn
        drawn.star_count, drawn.capped = sprites.star_count, sprites.capped
        clipped = self._clipped(sprites)
        if len(clipped):
            drawn.clipped_hip = tuple(self.shown_stars.hip[np.unique(sprites.star[clipped])].tolist())
        return drawn

    def _turn(self, q_icrs_to_cam: FloatArray, rate_cam_rad_s: Vector | FloatArray | None) -> Turn | None:
        """The motion of a frame, None where no star moves far enough to be seen."""
        if rate_cam_rad_s is None:
            return None
        turn = Turn(q_icrs_to_cam, np.asarray(rate_cam_rad_s, dtype=np.float64))
        motion_px = turn.speed_rad_s * self.scan.longest_s * self.camera.focal_length_px
        return turn if motion_px > self.config.render.motion_above_px else None

    def _swept(self, turn: Turn) -> Sprites:
        return swept_sprites(self.shown_stars, turn, self.scan, self.camera, self.renderer.footprint_px, self._sigma_px)

    def count_faint(self, q_icrs_to_cam: FloatArray) -> int:
        """How many stars in view at an attitude are too faint for the monitor."""
        if self.shown_stars is self.stars:
            return 0
        return len(self.sprites(q_icrs_to_cam, self.stars)) - len(self.sprites(q_icrs_to_cam))

    def warm_up(self) -> None:
        """Draw once with paths, with stars and with none: a driver compiles its shaders at first use, 60 ms on llvmpipe.

        SciPy's functions too are imported at first use, 0.1 s: the first star that might clip would cost that frame.
        """
        pixel_shares(np.zeros(1), 1.0)
        for q, rate in ((WARM_UP_ATTITUDE, WARM_UP_RATE_RAD_S), (WARM_UP_ATTITUDE, None), (None, None)):
            _ = self.draw(q, 0, rate).levels

    def frame(self, q_icrs_to_cam: Sequence[float] | FloatArray, number: int = 0) -> Frame:
        """Draw one frame and bring everything about it back; the arrays are the caller's own.

        Stars too faint for the monitor are in the linear image and the truth, and not drawn. `number` counts frames, for
        temporal dithering. Raises InputError for a quaternion that is not unit within 1e-3.
        """
        q = checked_quaternion(q_icrs_to_cam)
        sprites = self.sprites(q, self.stars)
        self.renderer.draw(self.sprites(q), number)
        levels = self.renderer.codes().copy()
        if self.shown_stars is not self.stars or self.renderer.target.sides:
            self.renderer.draw(sprites, number, whole=True)
        linear = self.renderer.linear().copy()
        truth = truth_table(self.stars, sprites.star, sprites.x_px, sprites.y_px)
        truth["drawn"] = truth["electrons_per_s"] >= self.faintest_shown_e_per_s()
        truth["clipped"][self._clipped(sprites)] = True
        return Frame(q, linear, levels, self.code_values(levels), truth[np.argsort(truth["v_mag"], kind="stable")])

    def losses_mag(self, frame: Frame) -> dict[int, float]:
        """By HIP, the magnitudes that each clipped star of a frame is too faint by, its light summed over its own pixels."""
        hips = set(frame.truth["hip"][frame.truth["clipped"]].tolist())
        if not hips:
            return {}
        sprites, panel = self.sprites(frame.q_icrs_to_cam), self.renderer.target.panel()
        if panel is None:
            raise TypeError("a bench's renderer has a monitor")
        footprints = FootprintMap(self.camera.resolution_px, self._sigma_px)
        loss_mag = star_losses(sprites, panel, footprints, frame.levels).loss_mag
        hip = self.shown_stars.hip[sprites.star].tolist()
        return {h: float(loss) for h, loss in zip(hip, loss_mag, strict=True) if h in hips}

    def code_values(self, levels: Codes) -> Codes:
        """The monitor's code values of levels (height, width): the same, or (height, width, 3) with bit stealing."""
        rgb = self.calibration.response.rgb
        if rgb is None:
            return levels
        return np.asarray(rgb[levels], dtype=code_dtype(self.calibration.response.bits))

    def _clipped(self, sprites: Sprites) -> IntArray:
        size_px = self.camera.resolution_px
        return clipped_sprites(sprites, self._sigma_px, self.flux_at_white_e_per_s, size_px, self.uniformity, self.darkest)

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def load(path: str | Path) -> Bench:
    """Assemble the bench that a file describes. Raises InputError or MachineError (no OpenGL)."""
    return Bench(Path(path))


def truth_table(stars: Stars, star: IntArray, x_px: FloatArray, y_px: FloatArray) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE for the stars at places `star` of `stars`: all drawn, none clipped yet."""
    truth = np.zeros(len(star), dtype=TRUTH_DTYPE)
    truth["hip"] = stars.hip[star]
    truth["x_px"], truth["y_px"] = x_px, y_px
    truth["v_mag"], truth["bv"] = stars.v_mag[star], stars.bv_mag[star]
    truth["temperature_k"] = stars.temperature_k[star]
    truth["electrons_per_s"] = stars.electrons_per_s[star]
    truth["drawn"] = True
    return truth


def checked_quaternion(q: Sequence[float] | FloatArray) -> FloatArray:
    """`q` (w, x, y, z) as a float64 unit array. Raises InputError where it is not unit within 1e-3."""
    array = np.asarray(q, dtype=np.float64)
    if array.shape != (4,):
        raise InputError(f"quaternion of shape {array.shape}: four numbers w, x, y, z are wanted")
    norm = math.hypot(*array)  # without NumPy's warning where it overflows
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise InputError(f"quaternion {array.tolist()}: its norm is {norm:.6g}; write a unit quaternion w, x, y, z")
    return normalise(array)


def bench_optics(tracker: Tracker, folder: Path) -> Optics:
    """The tracker's light-gathering part; curve paths are relative to `folder`."""
    return Optics(
        aperture_mm=tracker.aperture_mm,
        quantum_efficiency=load_curve(tracker.quantum_efficiency, "[tracker] quantum_efficiency", folder),
        transmission=load_curve(tracker.transmission, "[tracker] transmission", folder),
    )


def bench_stars(config: BenchConfig, folder: Path) -> Stars:
    """The stars of a bench with their electron rates: everything that happens once."""
    sky = config.sky
    catalog = load_catalog(_catalogue_source(sky, folder)).brighter_than(sky.faintest_v_mag)
    vectors = unit_vectors_icrs(catalog, sky.epoch_jyear)
    if any(sky.observer_velocity_km_s):
        vectors = aberrate(vectors, sky.observer_velocity_km_s)
    temperature_k = star_temperatures_k(catalog.bv_mag, sky.temperature)
    optics = bench_optics(config.tracker, folder)
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    if sky.brightness == "dgs" and sky.spectrum == "pickles":
        rates = tabulate_pickles(optics, photometry).electrons_per_s(catalog.v_mag, catalog.bv_mag, catalog.vi_mag)
    else:
        rates = tabulate(sky.brightness, optics, photometry).electrons_per_s(catalog.v_mag, temperature_k)
    return make_stars(catalog, vectors, temperature_k, rates)


def bench_calibration(config: BenchConfig, folder: Path) -> Calibration:
    """What the bench file says of its monitor's light. Raises InputError."""
    name = config.monitor.calibration
    source = name if name in BUILT_IN else folder / name
    return load_calibration(source, config.monitor.bits, bit_stealing=config.render.bit_stealing)


def bench_camera(config: BenchConfig) -> Camera:
    """The monitor behind its collimator."""
    return monitor_camera(
        config.monitor.resolution_px,
        config.monitor.pixel_pitch_um,
        config.collimator.focal_length_mm,
        np.array(config.collimator.q_cam_to_mon),
        config.collimator.principal_point_px,
    )


def brightest_peak_e_per_s(
    stars: Stars, sigma_px: tuple[float, float], brightest_v_mag: float | None = DEFAULT_BRIGHTEST_V_MAG
) -> float:
    """White, where the file gives no light for it: the brightest pixel of the brightest star not brighter than that.

    Brighter ones may clip. By the default magnitude, in a catalogue of brighter stars alone, none does. Raises InputError
    when no star is left.
    """
    magnitude = DEFAULT_BRIGHTEST_V_MAG if brightest_v_mag is None else brightest_v_mag
    wanted = stars.electrons_per_s[stars.v_mag >= magnitude]
    if not len(wanted) and magnitude == DEFAULT_BRIGHTEST_V_MAG:
        wanted = stars.electrons_per_s
    if not len(wanted):
        key, better = ("[render] brightest_v_mag", "smaller") if len(stars) else ("[sky] faintest_v_mag", "larger")
        raise InputError(f"{key} leaves no star; write a {better} magnitude, or [render] flux_at_white_e_per_s")
    return float(wanted.max()) * peak_share(sigma_px)


def bench_hash(config: BenchConfig, folder: Path) -> str:
    """SHA-256 of everything that makes a bench's frames: its settings, defaults included, and the files it names."""
    digest = hashlib.sha256(msgspec.json.encode(config, order="sorted"))
    named = (config.tracker.quantum_efficiency, config.tracker.transmission, config.sky.catalogue, config.monitor.calibration)
    for name in named:
        if isinstance(name, str) and name not in (*BUILT_IN_CURVES, *BUILT_IN, "hipparcos"):
            digest.update(_named_bytes(folder / name))
    return digest.hexdigest()


def _named_bytes(path: Path) -> bytes:
    """A file that the bench names; nothing where there is none, for whoever reads it in earnest says that better."""
    try:
        return read_bytes(path, "", MAX_CATALOGUE_BYTES)
    except InputError:
        return b""


def _catalogue_source(sky: SkySettings, folder: Path) -> str | Path:
    return sky.catalogue if sky.catalogue == "hipparcos" else folder / sky.catalogue
