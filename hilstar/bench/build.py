"""From a bench file to the parts that it describes: stars, geometry, light, effort and a renderer."""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from msgspec.structs import replace

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile, read_bench_file
from hilstar.bench.cameras import bench_camera, display_psf, tracker_camera, tracker_psf
from hilstar.bench.config import DEFAULT_BRIGHTEST_V_MAG, BenchConfig, Monitor, RenderSettings, Tracker
from hilstar.bench.config.bench_config import epoch_utc_ns, has_observer, sky_jd
from hilstar.bench.config.sky import SkySettings
from hilstar.bench.config.values import MAX_NUMBER, MIN_POSITIVE
from hilstar.bench.effort import Effort, Light, plan_effort
from hilstar.bench.frame import Bench
from hilstar.errors import InputError
from hilstar.frame.layers import NO_SOURCES, Sources, light_of, seen_in, sky_layers
from hilstar.frame.truth import StarInView, brightest_in_view
from hilstar.frame.view import Canvas, View
from hilstar.monitor.balance import Seen
from hilstar.monitor.calibration import BUILT_IN, Calibration, load_calibration
from hilstar.monitor.quantise import Panel
from hilstar.monitor.quantisers import QUANTISERS
from hilstar.render.backend import Target, level_cost
from hilstar.render.numpy_backend import headless_context, open_backend
from hilstar.scene.camera import Camera
from hilstar.scene.frame_motion import Orientation, Scan
from hilstar.scene.psf import Psf
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import Optics, Photometry, all_channels, star_temperatures_k, tabulate, tabulate_pickles
from hilstar.sky.spectral_types import star_types, tabulate_types
from hilstar.sky.spectrum import Curve, load_curve
from hilstar.sky.star_table import TableChoice, choose_catalog
from hilstar.sky.stars import Stars, aberrate, make_stars, split_by_rate, total_and_colours, unit_vectors_icrs

if TYPE_CHECKING:
    from hilstar.render.context import Context
    from hilstar.sky.bodies.moving import MovingSky
    from hilstar.sky.diffuse import TangentImage

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
        seen=seen_by(file, camera),
        centroider=file.config.verify.centroider,
        exposure_frames=file.config.exposure_frames,
        cost=partial(level_cost, context=context),
    )
    effort = _effort(file.config.render, light)
    config = _chosen(file.config, effort)
    target = _target(config, Panel(calibration.response, white_e_per_s, uniformity), effort, light.seen)
    faintest = QUANTISERS[target.quantisation].faintest_e_per_s(light.panel, target.psf)
    shown, faint = split_by_rate(stars, faintest)
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
        tracker_psf=tracker_psf(config.tracker, file.folder),
        renderer=open_backend(target, context),
    )


def seen_by(file: BenchFile, camera: Camera) -> Seen:
    """How the tracker sees the monitor at the boresight: its blur and its pixel in monitor pixels."""
    tracker = file.config.tracker
    pixel_px = camera.focal_length_px * tracker.pixel_pitch_um * 1e-3 / tracker.focal_length_mm
    return Seen(blur_px=math.sqrt(math.prod(tracker_psf(tracker, file.folder).width_px)) * pixel_px, pixel_px=pixel_px)


def _target(config: BenchConfig, panel: Panel, effort: Effort | None, seen: Seen) -> Target:
    render = config.render
    if render.quantisation == "auto":
        raise AssertionError("the effort's plan has chosen")
    return Target(
        resolution_px=config.monitor.resolution_px,
        psf=display_psf(render),
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


def bench_channels(tracker: Tracker, folder: Path) -> tuple[Optics, ...]:
    """The tracker's light-gathering part by channel: what it tells apart; curve paths are relative to `folder`."""
    efficiencies = [load_curve(source, f"[tracker] {key}", folder) for key, source in tracker.quantum_efficiencies.items()]
    transmission = load_curve(tracker.transmission, "[tracker] transmission", folder)
    return tuple(
        Optics(tracker.aperture_mm, Curve(one.wavelength_nm, one.value * tracker.detector.fill_factor), transmission)
        for one in efficiencies
    )


def bench_optics(tracker: Tracker, folder: Path) -> Optics:
    """The same of all channels together."""
    return all_channels(bench_channels(tracker, folder))


def bench_sources(config: BenchConfig, folder: Path) -> Sources:
    """The light of a bench's sky beside its stars. Raises InputError or MachineError."""
    return Sources(bench_moving(config, folder), bench_diffuse(config, folder))


def bench_diffuse(config: BenchConfig, folder: Path) -> tuple[TangentImage, ...]:
    """The map of diffuse light of a bench, electrons/s/sr; () without one. Raises InputError or MachineError."""
    diffuse = config.sky.diffuse
    if diffuse.map is None:
        return ()
    from hilstar.sky.diffuse import read_diffuse_map  # WCS and coordinates take 200 ms, which only a map needs

    one = np.ones(1)
    v0_e_per_s = np.float32(star_rates(config, folder)(0 * one, diffuse.bv_mag * one, np.nan * one)[0])
    return tuple(dataclasses.replace(face, image=face.image * v0_e_per_s) for face in read_diffuse_map(folder / diffuse.map))


def bench_moving(config: BenchConfig, folder: Path) -> MovingSky | None:
    """The bodies and the observer of a bench, None where its file has neither. Raises InputError or MachineError."""
    if not has_observer(config):
        return None
    from hilstar.bench.moving import moving_sky  # importing the ephemeris takes 50 ms, which only bodies and an observer need

    return moving_sky(config, folder, bench_channels(config.tracker, folder))


def moved(stars: Stars, moving: MovingSky | None) -> Stars:
    """The stars with bodies among them at t = 0, in arrays that `moving` may change; without `moving` the stars themselves."""
    return stars if moving is None else moving.among(stars)


def bench_stars(config: BenchConfig, folder: Path, moving: MovingSky | None = None) -> Stars:
    """The stars of a bench with their electron rates, which are computed only here, as `moving`'s observer sees them."""
    sky = config.sky
    epoch_utc_ns(config)  # which refuses one that a source was to give
    source = sky.catalogue if sky.catalogue == "hipparcos" else folder / sky.catalogue
    chosen = choose_catalog(TableChoice(source, sky.with_hipparcos, sky.catalogue_epoch_jyear))
    if sky.variables == "phase":
        chosen = chosen.at_phase(sky_jd(config, None))
    catalog = chosen.brighter_than(sky.faintest_v_mag)
    vectors = unit_vectors_icrs(catalog, sky.epoch_jyear)
    if moving is not None:
        vectors = moving.stars_seen(vectors, catalog.parallax_mas)
    elif any(sky.observer_velocity_km_s):
        vectors = aberrate(vectors, sky.observer_velocity_km_s)
    temperature_k = star_temperatures_k(catalog.bv_mag, sky.temperature)
    kind = star_kinds(config, catalog)
    if kind is not None:
        unread = int(np.isnan(kind).any(axis=1).sum())
        note = f"{unread} of {len(catalog)} stars have no MK type of O to M, and their spectra by colour alone"
        catalog = dataclasses.replace(catalog, notes=(*catalog.notes, note))
    flux = star_flux(config, folder)(catalog.v_mag, catalog.bv_mag, catalog.vi_mag, kind)
    return make_stars(catalog, vectors, temperature_k, flux)


def brightest_seen(file: BenchFile, view: View, count: int) -> list[StarInView]:
    """The `count` brightest stars and bodies that a bench's tracker sees in a view, the brightest first.

    Raises InputError or MachineError (see `bench_sources`).
    """
    canvas = Canvas(tracker_camera(file.config.tracker, file.folder), tracker_psf(file.config.tracker, file.folder))
    sources = bench_sources(file.config, file.folder)
    stars = moved(bench_stars(file.config, file.folder, sources.moving), sources.moving)
    stars = seen_in(view, stars, sources.moving)
    light = light_of(canvas, sky_layers(canvas, Sources(sources.moving)), stars, view)
    return brightest_in_view(light, stars, canvas.camera, view.q_icrs_to_cam, count)


class StarRates(Protocol):
    """Electron rates of stars (n,) by their V, B-V, V-I (NaN where unknown) and, if it is used, `kind` of `star_kinds`."""

    def __call__(
        self, v_mag: FloatArray, bv_mag: FloatArray, vi_mag: FloatArray, kind: FloatArray | None = None, /
    ) -> FloatArray:
        """The rates (n,), or by channel (n, channels)."""


def star_kinds(config: BenchConfig, catalog: Catalog) -> FloatArray | None:
    """The types (n, 2) of stars, as `star_types` reads them, where a bench's spectra follow types; None elsewhere."""
    return star_types(catalog) if (config.sky.brightness, config.sky.spectrum) == ("dgs", "mk") else None


def star_rates(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates (n,) of stars on a bench's tracker, in all channels together."""
    flux = star_flux(config, folder)
    return lambda *columns: total_and_colours(flux(*columns)).electrons_per_s


def star_flux(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates (n, channels) of stars on a bench's tracker, by tables that are made here, once."""
    rates = [_channel_rates(config.sky, optics) for optics in bench_channels(config.tracker, folder)]
    return lambda *columns: np.stack([channel(*columns) for channel in rates], axis=1)


def _channel_rates(sky: SkySettings, optics: Optics) -> StarRates:
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    if sky.brightness == "dgs" and sky.spectrum == "pickles":
        by_colour = tabulate_pickles(optics, photometry)
        return lambda v_mag, bv_mag, vi_mag, _kind=None: by_colour.electrons_per_s(v_mag, bv_mag, vi_mag)
    if sky.brightness == "dgs" and sky.spectrum == "mk":
        return tabulate_types(optics, photometry).electrons_per_s
    by_temperature = tabulate(sky.brightness, optics, photometry)
    return lambda v_mag, bv_mag, vi_mag, kind=None: by_temperature.electrons_per_s(
        v_mag, star_temperatures_k(bv_mag, sky.temperature)
    )


def bench_calibration(config: BenchConfig, folder: Path) -> Calibration:
    """The light of the bench file's monitor. Raises InputError."""
    name = config.monitor.calibration
    source = name if name in BUILT_IN else folder / name
    return load_calibration(source, config.monitor.bits, bit_stealing=config.render.bit_stealing)


def _white_e_per_s(render: RenderSettings, stars: Stars) -> float:
    given = render.flux_at_white_e_per_s
    return given or brightest_peak_e_per_s(stars, display_psf(render), render.brightest_v_mag)


def brightest_peak_e_per_s(stars: Stars, psf: Psf, brightest_v_mag: float | None = DEFAULT_BRIGHTEST_V_MAG) -> float:
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
    peak_e_per_s = float(wanted.max()) * psf.peak_share
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
