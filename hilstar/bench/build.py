"""From a bench file to the parts that it describes: stars, geometry, light, effort and a renderer."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile, read_bench_file
from hilstar.bench.cameras import bench_camera, tracker_camera
from hilstar.bench.config import DEFAULT_BRIGHTEST_V_MAG, BenchConfig, Monitor, RenderSettings, Tracker
from hilstar.bench.config.bench_config import epoch_utc_ns, has_observer
from hilstar.bench.config.values import MAX_NUMBER, MIN_POSITIVE
from hilstar.bench.effort import Effort, Light, faintest_shown_e_per_s, plan_effort
from hilstar.bench.frame import Bench
from hilstar.errors import InputError
from hilstar.frame.layers import NO_SOURCES, Sources, light_of, seen_in, sky_layers
from hilstar.frame.truth import StarInView, brightest_in_view
from hilstar.frame.view import Canvas, View
from hilstar.monitor.balance import Seen
from hilstar.monitor.calibration import BUILT_IN, Calibration, load_calibration
from hilstar.monitor.quantise import Panel
from hilstar.render.backend import Target, has_compute
from hilstar.render.numpy_backend import headless_context, open_backend
from hilstar.scene.camera import Camera
from hilstar.scene.frame_motion import Orientation, Scan
from hilstar.scene.psf import peak_share
from hilstar.sky.electrons import Optics, Photometry, star_temperatures_k, tabulate, tabulate_pickles
from hilstar.sky.spectrum import load_curve
from hilstar.sky.star_table import TableChoice, choose_catalog
from hilstar.sky.stars import Stars, aberrate, make_stars, split_by_rate, unit_vectors_icrs

if TYPE_CHECKING:
    from hilstar.render.context import Context
    from hilstar.sky.bodies.moving import MovingSky

S_PER_MS = 1e-3


def load(path: str | Path) -> Bench:
    """Assemble the bench that a file describes; NumPy draws where OpenGL is missing. Raises InputError."""
    return open_bench(read_bench_file(Path(path)))


def open_bench(file: BenchFile, context: Context | None = None) -> Bench:
    """Assemble the bench of a file, in a `context` if one is given; NumPy draws where OpenGL is missing. Raises InputError."""
    sources = bench_sources(file.config, file.folder)
    return assembled(file, bench_stars(file.config, file.folder, sources.moving), context, sources)


def assembled(file: BenchFile, stars: Stars, context: Context | None = None, sources: Sources = NO_SOURCES) -> Bench:
    """The bench of a file whose stars are made already, as `bench_stars` makes them. Raises InputError."""
    if context is not None:  # a window's context, which the window frees
        return _assembled(file, stars, context, sources)
    context = headless_context(file.config.render.gpu)
    try:
        return _assembled(file, stars, context, sources)
    except BaseException:
        if context is not None:
            context.release()
        raise


def _assembled(file: BenchFile, stars: Stars, context: Context | None, sources: Sources) -> Bench:
    calibration = bench_calibration(file.config, file.folder)
    white_e_per_s = _white_e_per_s(file.config.render, stars)
    uniformity = calibration.uniformity_map(file.config.monitor.resolution_px)
    darkest = 1.0 if uniformity is None else float(uniformity.min())
    # Vignetting asks for more from a pixel: where the screen is darkest a fainter star gets a code.
    finer = calibration.can_steal_bits and not file.config.render.bit_stealing
    camera = bench_camera(file.config, file.folder)
    sky_share, refresh_hz = _sky_share(camera), file.config.monitor.refresh_hz
    light = Light(
        response=calibration.response,
        white_e_per_s=white_e_per_s * darkest,
        rates_e_per_s=stars.electrons_per_s,
        can_steal_bits=finer,
        sky_share=sky_share,
        refresh_hz=refresh_hz,
        seen=seen_by(file.config.tracker, camera),
        centroider=file.config.verify.centroider,
        exposure_frames=file.config.exposure_frames,
        has_compute=has_compute(context),
    )
    effort = _effort(file.config.render, light)
    config = _chosen(file.config, effort)
    faintest = faintest_shown_e_per_s(config.render.quantisation, light, config.render.sprite_sigma_px)
    shown, faint = split_by_rate(stars, faintest)
    panel = Panel(calibration.response, white_e_per_s, uniformity)
    return Bench(
        file=file,
        config=config,
        effort=effort,
        camera=camera,
        scan=scan_of(config.monitor),
        calibration=calibration,
        uniformity=uniformity,
        darkest=darkest,
        flux_at_white_e_per_s=white_e_per_s,
        faintest_shown_e_per_s=faintest,
        stars=moved(stars, sources.moving),
        shown_stars=moved(shown, sources.moving),
        faint_stars=faint,
        sources=sources,
        renderer=open_backend(_target(config, panel, effort, light.seen), context),
    )


def seen_by(tracker: Tracker, camera: Camera) -> Seen:
    """How the tracker sees the monitor at the boresight: its blur and its pixel in monitor pixels."""
    pixel_px = camera.focal_length_px * tracker.pixel_pitch_um * 1e-3 / tracker.focal_length_mm
    return Seen(blur_px=math.sqrt(math.prod(tracker.psf_sigma_px)) * pixel_px, pixel_px=pixel_px)


def _target(config: BenchConfig, panel: Panel, effort: Effort | None, seen: Seen) -> Target:
    render = config.render
    if render.quantisation == "auto":
        raise AssertionError("the effort's plan has chosen")
    return Target(
        resolution_px=config.monitor.resolution_px,
        sigma_px=render.sprite_sigma_px,
        response=panel.response,
        flux_at_white_e_per_s=panel.flux_at_white_e_per_s,
        quantisation=render.quantisation,
        uniformity=panel.uniformity,
        sides=() if effort is None else effort.sides,
        seen=seen,
    )


def _sky_share(camera: Camera) -> float:
    """The share of the whole sky that a screen covers, about."""
    width, height = camera.resolution_px
    return width * height / math.prod(camera.scales_px_rad()) / (4 * math.pi)


def _effort(render: RenderSettings, light: Light) -> Effort | None:
    """The settings chosen within the bench file's tolerance; None if the file sets them all."""
    return plan_effort(render, light) if render.effort == "auto" or render.quantisation == "auto" else None


def _chosen(config: BenchConfig, effort: Effort | None) -> BenchConfig:
    if effort is None:
        return config
    render = replace(config.render, quantisation=effort.quantisation, motion_above_px=effort.motion_above_px)
    return replace(config, render=render)


def bench_optics(tracker: Tracker, folder: Path) -> Optics:
    """The tracker's light-gathering part; curve paths are relative to `folder`."""
    return Optics(
        aperture_mm=tracker.aperture_mm,
        quantum_efficiency=load_curve(tracker.quantum_efficiency, "[tracker] quantum_efficiency", folder),
        transmission=load_curve(tracker.transmission, "[tracker] transmission", folder),
    )


def bench_sources(config: BenchConfig, folder: Path) -> Sources:
    """The light of a bench's sky beside its stars. Raises InputError or MachineError."""
    return Sources(bench_moving(config, folder))


def bench_moving(config: BenchConfig, folder: Path) -> MovingSky | None:
    """The bodies and the observer of a bench, None where its file has neither. Raises InputError or MachineError."""
    if not has_observer(config):
        return None
    from hilstar.bench.moving import moving_sky  # importing the ephemeris takes 50 ms, which only bodies and an observer need

    return moving_sky(config, folder, bench_optics(config.tracker, folder))


def moved(stars: Stars, moving: MovingSky | None) -> Stars:
    """The stars with bodies among them at t = 0, in arrays that `moving` may change; without `moving` the stars themselves."""
    return stars if moving is None else moving.among(stars)


def bench_stars(config: BenchConfig, folder: Path, moving: MovingSky | None = None) -> Stars:
    """The stars of a bench with their electron rates, which are computed only here, as `moving`'s observer sees them."""
    sky = config.sky
    epoch_utc_ns(config)  # which refuses one that a source was to give
    source = sky.catalogue if sky.catalogue == "hipparcos" else folder / sky.catalogue
    chosen = choose_catalog(TableChoice(source, sky.with_hipparcos, sky.catalogue_epoch_jyear))
    catalog = chosen.brighter_than(sky.faintest_v_mag)
    vectors = unit_vectors_icrs(catalog, sky.epoch_jyear)
    if moving is not None:
        vectors = moving.stars_seen(vectors, catalog.parallax_mas)
    elif any(sky.observer_velocity_km_s):
        vectors = aberrate(vectors, sky.observer_velocity_km_s)
    temperature_k = star_temperatures_k(catalog.bv_mag, sky.temperature)
    rates = star_rates(config, folder)(catalog.v_mag, catalog.bv_mag, catalog.vi_mag)
    return make_stars(catalog, vectors, temperature_k, rates)


def brightest_seen(file: BenchFile, view: View, count: int) -> list[StarInView]:
    """The `count` brightest stars and bodies that a bench's tracker sees in a view, the brightest first.

    Raises InputError or MachineError (see `bench_sources`).
    """
    canvas = Canvas(tracker_camera(file.config.tracker, file.folder), 1, file.config.tracker.psf_sigma_px)
    sources = bench_sources(file.config, file.folder)
    stars = moved(bench_stars(file.config, file.folder, sources.moving), sources.moving)
    stars = seen_in(view, stars, sources.moving)
    light = light_of(canvas, sky_layers(canvas, sources), stars, view)
    return brightest_in_view(light, stars, canvas.camera, view.q_icrs_to_cam, count)


# Electron rates (n,) of stars by their V, B-V and V-I, which may be NaN.
StarRates = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


def star_rates(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates of stars on a bench's tracker, by tables that are made here, once."""
    sky, optics = config.sky, bench_optics(config.tracker, folder)
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    if sky.brightness == "dgs" and sky.spectrum == "pickles":
        return tabulate_pickles(optics, photometry).electrons_per_s
    by_temperature = tabulate(sky.brightness, optics, photometry)
    return lambda v_mag, bv_mag, _: by_temperature.electrons_per_s(v_mag, star_temperatures_k(bv_mag, sky.temperature))


def bench_calibration(config: BenchConfig, folder: Path) -> Calibration:
    """The light of the bench file's monitor. Raises InputError."""
    name = config.monitor.calibration
    source = name if name in BUILT_IN else folder / name
    return load_calibration(source, config.monitor.bits, bit_stealing=config.render.bit_stealing)


def _white_e_per_s(render: RenderSettings, stars: Stars) -> float:
    given = render.flux_at_white_e_per_s
    return given or brightest_peak_e_per_s(stars, render.sprite_sigma_px, render.brightest_v_mag)


def brightest_peak_e_per_s(
    stars: Stars, sigma_px: tuple[float, float], brightest_v_mag: float | None = DEFAULT_BRIGHTEST_V_MAG
) -> float:
    """Full scale where the file gives no flux for it: the brightest pixel of the brightest star at or below that magnitude.

    Brighter stars may clip. With the default magnitude and a catalogue of brighter stars alone, none does. Raises InputError
    when no star remains.
    """
    magnitude = DEFAULT_BRIGHTEST_V_MAG if brightest_v_mag is None else brightest_v_mag
    wanted = stars.electrons_per_s[stars.v_mag >= magnitude]
    if not len(wanted) and magnitude == DEFAULT_BRIGHTEST_V_MAG:
        wanted = stars.electrons_per_s
    if not len(wanted):
        key, better = ("[render] brightest_v_mag", "smaller") if len(stars) else ("[sky] faintest_v_mag", "larger")
        raise InputError(f"{key} leaves no star; write a {better} magnitude, or [render] flux_at_white_e_per_s")
    peak_e_per_s = float(wanted.max()) * peak_share(sigma_px)
    if not MIN_POSITIVE <= peak_e_per_s <= MAX_NUMBER:
        raise InputError(
            f"[tracker] aperture_mm, quantum_efficiency and transmission: the brightest star to show gives {peak_e_per_s:.3g}"
            f" electrons per second; write those of a lens that gives it {MIN_POSITIVE:g} to {MAX_NUMBER:g}"
        )
    return peak_e_per_s


def orientation_of(monitor: Monitor) -> Orientation:
    """How the image lies on the screen, as the bench file has it."""
    return Orientation(monitor.flip_x, monitor.flip_y, monitor.rotate_deg // 90)


def scan_of(monitor: Monitor) -> Scan:
    """When the rows light, and for how long."""
    return Scan(orientation_of(monitor).down, monitor.panel_scanout_ms * S_PER_MS, monitor.panel_hold_ms * S_PER_MS)
