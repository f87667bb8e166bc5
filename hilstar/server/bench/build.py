"""From a bench file to the parts that it describes: stars, geometry, light, effort and a
renderer.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from msgspec.structs import replace

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.reading import warn_once
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.balance import Seen
from hilstar.display.calibration import BUILT_IN, Calibration, load_calibration, primary_responses
from hilstar.display.panel import Panel
from hilstar.display.primaries import chromatic_primaries, read_primaries
from hilstar.display.quantise import Quantisation
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.backend import level_cost
from hilstar.display.render.numpy_backend import headless_context, open_backend
from hilstar.display.render.target import Target
from hilstar.optics.camera import Camera
from hilstar.optics.frame_motion import Orientation, Scan
from hilstar.optics.glass.glass_psf import NodeSpline
from hilstar.optics.layers.layers import NO_SOURCES, Sources, light_of, seen_in, sky_layers
from hilstar.optics.layers.truth import StarInView, brightest_in_view
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import Psf
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
    display_psfs,
    tracker_camera,
    tracker_psf,
)
from hilstar.server.bench.colours import Colours, mixed_for
from hilstar.server.bench.config import (
    DEFAULT_BRIGHTEST_V_MAG,
    BenchConfig,
    Monitor,
    RenderSettings,
    Tracker,
)
from hilstar.server.bench.config.bench_config import (
    drives_apart,
    epoch_utc_ns,
    has_observer,
    sky_jd,
)
from hilstar.server.bench.config.sky import SkySettings
from hilstar.server.bench.config.values import MAX_NUMBER, MIN_POSITIVE
from hilstar.server.bench.effort import (
    BEST,
    CHEAP,
    IN_TIME_SHARE,
    SURELY_IN_TIME,
    Effort,
    FieldCost,
    Light,
    plan_effort,
)
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.glass import glass_transmission
from hilstar.server.bench.least_psf import WHOLE, Choice
from hilstar.sky.air import SiteAir, dimmed_mag
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import (
    Optics,
    Photometry,
    all_channels,
    star_temperatures_k,
    tabulate,
    tabulate_pickles,
)
from hilstar.sky.spectral_types import star_types, tabulate_types
from hilstar.sky.spectrum import QUANTUM_EFFICIENCIES, Curve, load_curve
from hilstar.sky.star_table import TableChoice, choose_catalog
from hilstar.sky.stars import (
    BV_MAG,
    Stars,
    aberrate,
    make_stars,
    split_by_rate,
    total_and_colours,
    unit_vectors_icrs,
)

if TYPE_CHECKING:
    from hilstar.display.render.context import Context
    from hilstar.sky.bodies.moving import MovingSky

S_PER_MS = 1e-3
# Bands of a star's light as a glass sees it: twice as fine moves no share by over 1e-3
# (tests/unit/instruments/simulate/test_glass.py)
BAND_NM, KNOT_NM = 25.0, 5.0
# Codes are timed in fields spread evenly over the sky, turning at 1 deg/s, as often as these times
# allow. The fastest frame of each field counts.
TIMED_FIELDS = [
    from_radec_roll_deg(*place, 0.0)
    for place in ((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))
]
TIMED_RATE_RAD_S = np.array([math.radians(1.0), 0.0, 0.0])
SUNLIGHT, V_NM = (0.0, 0.65, 0.70), 545.0  # V, B-V and V-I; the wavelength of V
V_BAND_NM, V_BAND_POINTS = (470.0, 700.0), 231  # Johnson V
TIMED_EXACT_S, TIMED_ROUND_S, MAX_TIMED = 0.1, 0.05, 10


def load(path: str | Path) -> Bench:
    """Assemble the bench that a file describes; NumPy draws where OpenGL is missing. Raises
    InputError.
    """
    return open_bench(read_bench_file(Path(path)))


def open_bench(
    file: BenchFile, context: Context | None = None, *, timed: bool = False, on_screen: bool = False
) -> Bench:
    """Assemble the bench of a file, in a `context` if one is given; NumPy draws where OpenGL is
    missing. Raises InputError.

    `on_screen` is for runs whose frames a screen lights row by row. `timed` is for runs that a
    clock paces: where `quantisation = "auto"` depends on what codes cost, that is measured here.
    """
    sources = bench_sources(file.config, file.folder)
    stars = bench_stars(file.config, file.folder, sources.moving)
    return assembled(file, stars, context, sources, timed=timed, on_screen=on_screen)


def assembled(
    file: BenchFile,
    stars: Stars,
    context: Context | None = None,
    sources: Sources = NO_SOURCES,
    *,
    timed: bool = False,
    on_screen: bool = False,
) -> Bench:
    """The bench of a file whose stars are made already, as `bench_stars` makes them. Raises
    InputError.
    """
    if context is not None:  # a window's context, which the window frees
        return _assembled(file, stars, context, sources, timed, on_screen)
    context = headless_context(file.config.render.gpu)
    try:
        return _assembled(file, stars, context, sources, timed, on_screen)
    except BaseException:
        if context is not None:
            context.release()
        raise


class Scene(NamedTuple):
    """What a bench's light is planned for: how its stars are drawn, full scale with that, and
    the light of both.
    """

    psf: Psf
    choice: Choice | None
    white_e_per_s: float
    light: Light


class Display(NamedTuple):
    """What shows a bench's stars: its light, its geometry, its GL; how much of white each star
    asks for; see `turning_of` and `path_of`.
    """

    calibration: Calibration
    camera: Camera
    context: Context | None
    drive: FloatArray | float
    turning: float
    path_px: float
    darkest: float


def _scenes(file: BenchFile, stars: Stars, display: Display) -> Iterator[Scene]:
    """The scene of each way to draw a bench's stars, from the cheapest on."""
    camera, drive, render = display.camera, display.drive, file.config.render
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
            cost=partial(level_cost, context=display.context),
            turning=display.turning,
            path_px=display.path_px,
        )
        yield Scene(psf, choice, white_e_per_s, light)


def _planned(render: RenderSettings, scenes: Iterator[Scene]) -> tuple[Scene, Effort]:
    """The first scene whose plan is within the tolerance; where none is, the first whose PSF
    alone is within it.
    """
    near: list[tuple[Scene, Effort]] = []
    for scene in scenes:
        effort, choice = plan_effort(render, scene.light), scene.choice
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


def turning_of(config: BenchConfig, on_screen: bool) -> float:
    """How far stars without paths are from the mean of their light at most, in units of their
    motion; 0 at rest.

    A frame has them where they are at the middle row's first light, and its motion counts to the
    end of its light.
    """
    motion, scan = config.render.motion, scan_of(config.monitor)
    moves = motion == "on" or (motion == "auto" and on_screen)
    if not moves or not scan.longest_s:
        return 0.0
    return (scan.scanout_s + scan.hold_s) / 2 / scan.longest_s


def path_of(config: BenchConfig, camera: Camera, on_screen: bool) -> float:
    """How far a star moves on the monitor while its row is lit, turning at 1 deg/s, px; 0 at
    rest.
    """
    if not turning_of(config, on_screen):
        return 0.0
    turned_rad = math.hypot(*TIMED_RATE_RAD_S) * scan_of(config.monitor).hold_s
    return turned_rad * max(camera.scales_px_rad())


def _assembled(
    file: BenchFile,
    stars: Stars,
    context: Context | None,
    sources: Sources,
    timed: bool,
    on_screen: bool,
) -> Bench:
    render, calibration = file.config.render, bench_calibration(file.config, file.folder)
    camera = bench_camera(file.config, file.folder)
    colours = bench_colours(file.config, file.folder, stars.catalog)
    stars = stars if colours is None else colours.on(stars)
    drive = 1.0 if stars.primaries is None or colours is None else colours.drive(stars.primaries)
    uniformity = calibration.uniformity_map(file.config.monitor.resolution_px)
    darkest = 1.0 if uniformity is None else float(uniformity.min())
    display = Display(
        calibration=calibration,
        camera=camera,
        context=context,
        drive=drive,
        turning=turning_of(file.config, on_screen),
        path_px=path_of(file.config, camera, on_screen),
        darkest=darkest,
    )
    scenes = _scenes(file, stars, display)
    (psf, drawn, white_e_per_s, light), planned = _planned(render, scenes)
    panels = () if colours is None else primary_panels(file, colours, white_e_per_s, uniformity)

    def bench_by(effort: Effort) -> Bench:
        codes = effort.quantisation
        chosen = replace(render, quantisation=codes, motion_above_px=effort.motion_above_px)
        config = replace(file.config, render=chosen)
        target = Target(
            resolution_px=config.monitor.resolution_px,
            psf=psf,
            response=calibration.response,
            flux_at_white_e_per_s=white_e_per_s,
            quantisation=codes,
            uniformity=uniformity,
            sides=effort.sides,
            seen=light.seen,
        )
        if colours is not None:
            together = colours.by_primary.T @ colours.by_primary
            target = dataclasses.replace(
                target, primaries=panels, places_px=colours.places_px, together=together
            )
        faintest = QUANTISERS[codes].faintest_e_per_s(light.panel, psf)
        shown, faint = split_by_rate(stars, faintest, drive)
        glass = star_glass(file, psf)
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
            stars=seen_with(stars),
            shown_stars=seen_with(shown),
            faint_stars=faint,
            sources=sources,
            tracker_psf=before_detector(config, file.folder, camera),
            spectra=None if glass is None else glass.shares,
            drawn=drawn,
            renderer=open_backend(target, context),
            colours=colours,
            panel=Panel(calibration.response, white_e_per_s, uniformity, panels),
        )

    def seen_with(some: Stars) -> Stars:
        among = moved(some, sources.moving)
        return among if colours is None else colours.on(among)

    bench = bench_by(planned)
    if not timed or not planned.by_cost or render.codes_ms is not None:
        return bench
    # The one that is not taken stays in the GL context until that is freed.
    benches: dict[Quantisation, Bench] = {planned.quantisation: bench}

    def frame_ms(method: Quantisation, for_s: float) -> float:
        if method not in benches:
            benches[method] = bench_by(plan_effort(replace(render, quantisation=method), light))
        return timed_frame_ms(benches[method], for_s)

    cost = measured_cost(
        frame_ms, light.tabulated_cost(bench.psf), IN_TIME_SHARE * light.refresh_ms
    )
    effort = plan_effort(render, dataclasses.replace(light, measured=cost))
    bench = benches[effort.quantisation]
    config = replace(
        bench.config, render=replace(bench.config.render, codes_ms=(cost.cheap_ms, cost.best_ms))
    )
    return dataclasses.replace(bench, effort=effort, config=config)


def measured_cost(
    frame_ms: Callable[[Quantisation, float], float], table: FieldCost, limit_ms: float
) -> FieldCost:
    """The cost of codes by `frame_ms`, which times a frame of a quantisation for so many seconds.

    Where `exact` is clearly in time, `round` is not timed: its share of that is the table's.
    """
    best_ms = frame_ms(BEST, TIMED_EXACT_S)
    if best_ms > limit_ms * SURELY_IN_TIME:
        cheap_ms = frame_ms(CHEAP, TIMED_ROUND_S)
    else:
        cheap_ms = best_ms * (table.cheap_ms / table.best_ms if table.best_ms else 1.0)
    cheap_ms, best_ms = (max(float(f"{ms:.3g}"), MIN_POSITIVE) for ms in (cheap_ms, best_ms))
    return FieldCost(
        cheap_ms,
        best_ms,
        f"as measured here ([render] codes_ms = [{cheap_ms:g}, {best_ms:g}] fixes it)",
    )


def timed_frame_ms(
    bench: Bench, for_s: float, now_ns: Callable[[], int] = time.monotonic_ns
) -> float:
    """The time of a frame of an average field that turns at 1 deg/s, ms, by drawing for about
    `for_s` after a warm-up.
    """
    bench.warm_up()
    took_ms: dict[int, float] = {}
    end_ns = now_ns() + round(for_s * NS_PER_S)
    for k, q_icrs_to_cam in [*enumerate(TIMED_FIELDS)] * MAX_TIMED:
        begin_ns = now_ns()
        if took_ms and begin_ns > end_ns:
            break
        bench.draw(q_icrs_to_cam, 0, TIMED_RATE_RAD_S)
        bench.renderer.finish()
        took_ms[k] = min(took_ms.get(k, math.inf), (now_ns() - begin_ns) / NS_PER_MS)
    bench.renderer.begin_anew()
    return sum(took_ms.values()) / len(took_ms)


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


def bench_channels(tracker: Tracker, folder: Path) -> tuple[Optics, ...]:
    """The tracker's light-gathering part by channel: what it tells apart; curve paths are
    relative to `folder`.
    """
    given = tracker.quantum_efficiencies.items()
    efficiencies = [
        load_curve(source, f"[tracker] {key}", folder, QUANTUM_EFFICIENCIES)
        for key, source in given
    ]
    transmission = glass_transmission(tracker, folder)
    if not any(_sees_v(curve) for curve in efficiencies):
        names = ", ".join(tracker.quantum_efficiencies)
        band = f"{V_BAND_NM[0]:g} to {V_BAND_NM[1]:g} nm"
        warn_once(
            f"[tracker] {names}: no light of V ({band}), in which magnitudes are; all light is from"
            " their colours"
        )
    return tuple(
        Optics(
            tracker.aperture_mm,
            Curve(one.wavelength_nm, one.value * tracker.detector.fill_factor),
            transmission,
        )
        for one in efficiencies
    )


def _sees_v(efficiency: Curve) -> bool:
    return bool(efficiency(np.linspace(*V_BAND_NM, V_BAND_POINTS)).any())


def bench_optics(tracker: Tracker, folder: Path) -> Optics:
    """The tracker's light-gathering part in all channels together."""
    return all_channels(bench_channels(tracker, folder))


def bench_sources(config: BenchConfig, folder: Path) -> Sources:
    """The light of a bench's sky beside its stars. Raises InputError or MachineError."""
    moving, diffuse = bench_moving(config, folder), config.sky.diffuse
    if diffuse.map is None:
        return Sources(moving)
    # WCS and coordinates take 200 ms, which only a map needs
    from hilstar.sky.diffuse import read_diffuse_map

    one, bv_mag = np.ones(1), diffuse.bv_mag
    v0_e_per_s = np.float32(star_rates(config, folder)(0 * one, bv_mag * one, np.nan * one)[0])
    faces = read_diffuse_map(folder / diffuse.map)
    return Sources(
        moving,
        tuple(
            dataclasses.replace(face, image=face.image * v0_e_per_s, bv_mag=bv_mag)
            for face in faces
        ),
    )


def bench_moving(config: BenchConfig, folder: Path) -> MovingSky | None:
    """The bodies and the observer of a bench, None where its file has neither. Raises InputError
    or MachineError.
    """
    if not has_observer(config):
        return None
    from hilstar.server.bench.moving import (
        moving_sky,  # importing the ephemeris takes 50 ms, which only bodies and an observer need
    )

    return moving_sky(config, folder, bench_channels(config.tracker, folder))


def moved(stars: Stars, moving: MovingSky | None) -> Stars:
    """The stars with bodies among them at t = 0, in arrays that `moving` may change; without
    `moving` the stars themselves.
    """
    return stars if moving is None else moving.among(stars)


def catalogue_choice(config: BenchConfig, folder: Path) -> TableChoice:
    """What `[sky] catalogue` names, and how it is read."""
    sky = config.sky
    source = sky.catalogue if sky.catalogue == "hipparcos" else folder / sky.catalogue
    return TableChoice(source, sky.with_hipparcos, sky.catalogue_epoch_jyear)


def bench_stars(config: BenchConfig, folder: Path, moving: MovingSky | None = None) -> Stars:
    """The stars of a bench with their electron rates, which are computed only here, as
    `moving`'s observer sees them.
    """
    sky = config.sky
    epoch_utc_ns(config)  # which refuses one that a source was to give
    faintest = math.inf if sky.variables == "phase" else sky.faintest_v_mag
    chosen = choose_catalog(
        dataclasses.replace(catalogue_choice(config, folder), faintest_v_mag=faintest)
    )
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
        note = (
            f"{unread} of {len(catalog)} stars have no MK type of O to M, and their spectra by"
            " colour alone"
        )
        catalog = dataclasses.replace(catalog, notes=(*catalog.notes, note))
    through = star_flux(config, folder)
    flux, by_bv = through(catalog.v_mag, catalog.bv_mag, catalog.vi_mag, kind), None
    if flux.shape[1] > 1:
        by_bv = total_and_colours(through(0 * BV_MAG, BV_MAG, np.full_like(BV_MAG, np.nan))).colours
    # the air takes of each star by its own spectrum
    if config.site is not None and moving is not None:
        moving.air = site_air(config, folder, catalog, kind)
    return dataclasses.replace(
        make_stars(catalog, vectors, temperature_k, flux), colours_by_bv=by_bv
    )


def site_air(
    config: BenchConfig, folder: Path, catalog: Catalog, kind: FloatArray | None = None
) -> SiteAir:
    """The air over `[site]` for stars of a catalogue. Raises InputError."""
    # ERFA takes 30 ms
    from hilstar.server.bench.site import (
        Ground,
        site_extinction,
        site_glow_e_per_s_sr,
        site_refraction,
    )

    if config.site is None:
        raise AssertionError("the file has a site")
    extinction, optics = site_extinction(config.site, folder), bench_optics(config.tracker, folder)
    channels = bench_channels(config.tracker, folder)
    v, bv, vi = (
        np.append(c, one)
        for c, one in zip((catalog.v_mag, catalog.bv_mag, catalog.vi_mag), SUNLIGHT, strict=True)
    )
    kinds = None if kind is None else np.vstack([kind, np.full((1, 2), np.nan)])
    dimming = [
        dimmed_mag(
            lambda through: channel_rates(config.sky, through)(v, bv, vi, kinds), one, extinction
        )
        for one in channels
    ]
    return SiteAir(
        up_at=Ground(config.site).up,
        refraction_rad=site_refraction(config.site, optics),
        height_m=config.site.height_m,
        aperture_mm=config.tracker.aperture_mm,
        dimming_mag=np.array(dimming, dtype=np.float32),
        v_extinction_mag=float(extinction(np.array([V_NM]))[0]),
        glow_e_per_s_sr=np.array([site_glow_e_per_s_sr(config, folder, one) for one in channels]),
    )


def brightest_seen(file: BenchFile, view: View, count: int) -> list[StarInView]:
    """The `count` brightest stars and bodies that a bench's tracker sees in a view, the brightest
    first.

    Raises InputError or MachineError (see `bench_sources`).
    """
    canvas = Canvas(
        tracker_camera(file.config.tracker, file.folder),
        tracker_psf(file.config.tracker, file.folder),
    )
    sources = bench_sources(file.config, file.folder)
    stars = moved(bench_stars(file.config, file.folder, sources.moving), sources.moving)
    stars = seen_in(view, stars, sources.moving)
    light = light_of(canvas, sky_layers(canvas, Sources(sources.moving)), stars, view)
    return brightest_in_view(light, stars, canvas.camera, view.q_icrs_to_cam, count)


class StarRates(Protocol):
    """Electron rates of stars (n,) by their V, B-V, V-I (NaN where unknown) and, if it is used,
    `kind` of `star_kinds`.
    """

    def __call__(
        self,
        v_mag: FloatArray,
        bv_mag: FloatArray,
        vi_mag: FloatArray,
        kind: FloatArray | None = None,
        /,
    ) -> FloatArray:
        """The rates (n,), or by channel (n, channels)."""


def star_kinds(config: BenchConfig, catalog: Catalog) -> FloatArray | None:
    """The types (n, 2) of stars, as `star_types` reads them, where a bench's spectra follow
    types; None elsewhere.
    """
    return (
        star_types(catalog)
        if (config.sky.brightness, config.sky.spectrum) == ("dgs", "mk")
        else None
    )


def star_rates(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates (n,) of stars on a bench's tracker, in all channels together."""
    flux = star_flux(config, folder)
    return lambda *columns: total_and_colours(flux(*columns)).electrons_per_s


def star_flux(config: BenchConfig, folder: Path) -> StarRates:
    """The electron rates (n, channels) of stars on a bench's tracker, by tables that are made
    here, once.
    """
    rates = [channel_rates(config.sky, optics) for optics in bench_channels(config.tracker, folder)]
    return lambda *columns: np.stack([channel(*columns) for channel in rates], axis=1)


def channel_rates(sky: SkySettings, optics: Optics) -> StarRates:
    """The electron rates (n,) of stars in one channel, by a table that is made here, once.
    Raises InputError.
    """
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    if sky.brightness == "dgs" and sky.spectrum == "pickles":
        by_colour = tabulate_pickles(optics, photometry)
        return lambda v_mag, bv_mag, vi_mag, _kind=None: by_colour.electrons_per_s(
            v_mag, bv_mag, vi_mag
        )
    if sky.brightness == "dgs" and sky.spectrum == "mk":
        return tabulate_types(optics, photometry).electrons_per_s
    by_temperature = tabulate(sky.brightness, optics, photometry)
    return lambda v_mag, bv_mag, vi_mag, kind=None: by_temperature.electrons_per_s(
        v_mag, star_temperatures_k(bv_mag, sky.temperature)
    )


def bench_calibration(config: BenchConfig, folder: Path) -> Calibration:
    """The light of the bench file's monitor. Raises InputError."""
    source = calibration_source(config.monitor, folder)
    return load_calibration(source, config.monitor.bits, bit_stealing=config.render.bit_stealing)


def calibration_source(monitor: Monitor, folder: Path) -> str | Path:
    """What `[monitor] calibration` names: a built-in curve, or the path of a file."""
    return monitor.calibration if monitor.calibration in BUILT_IN else folder / monitor.calibration


def bench_primaries(monitor: Monitor, folder: Path) -> tuple[Curve, ...] | None:
    """The spectra of a monitor's primaries, None where they are not known. Raises InputError."""
    primaries = monitor.primaries
    if primaries.file is not None:
        return read_primaries(folder / primaries.file)
    given = [one for one in (primaries.xy_r, primaries.xy_g, primaries.xy_b) if one is not None]
    return chromatic_primaries(given, primaries.width_nm) if given else None


def named_channels(tracker: Tracker, folder: Path) -> dict[str, Optics]:
    """The tracker's light-gathering part of each channel by its key."""
    return dict(zip(tracker.quantum_efficiencies, bench_channels(tracker, folder), strict=True))


def bench_colours(config: BenchConfig, folder: Path, catalog: Catalog) -> Colours | None:
    """What a bench mixes its primaries for; None where all three have one code, or stolen bits.
    Raises InputError.
    """
    if not drives_apart(config):
        return None
    primaries, monitor = bench_primaries(config.monitor, folder), config.monitor
    if primaries is None:
        raise InputError(
            '[tracker.detector] bayer, and [render] colour = "star" with it, need the light of the'
            ' primaries; write [monitor.primaries] file, or xy_r to xy_b; or colour = "white"'
        )
    places_px = [orientation_of(monitor).in_image(*place) for place in monitor.primaries.places_px]
    channels, rates_by = named_channels(config.tracker, folder), partial(channel_rates, config.sky)
    psf = (
        before_detector(config, folder, bench_camera(config, folder))
        if len(channels) == 1
        else None
    )
    return mixed_for(
        primaries, channels, places_px, rates_by, star_kinds(config, catalog), psf
    ).for_stars(catalog)


def primary_panels(
    file: BenchFile,
    colours: Colours,
    white_e_per_s: float,
    uniformity: Float32Array | None,
    name: str | None = None,
) -> tuple[Panel, ...]:
    """The panel of each primary of a monitor, of the calibration `name` (by default the
    bench's). Raises InputError.
    """
    monitor = file.config.monitor
    name = name or monitor.calibration
    responses = primary_responses(name if name in BUILT_IN else file.folder / name, monitor.bits)
    each = zip(responses, colours.of_white.tolist(), strict=True)
    return tuple(Panel(response, white_e_per_s * share, uniformity) for response, share in each)


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
    magnitude = DEFAULT_BRIGHTEST_V_MAG if brightest_v_mag is None else brightest_v_mag
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


def orientation_of(monitor: Monitor) -> Orientation:
    """How the image lies on the screen, as the bench file has it."""
    return Orientation(monitor.flip_x, monitor.flip_y, monitor.rotate_deg // 90)


def scan_of(monitor: Monitor) -> Scan:
    """When the rows light, and for how long."""
    return Scan(
        orientation_of(monitor).down,
        monitor.panel_scanout_ms * S_PER_MS,
        monitor.panel_hold_ms * S_PER_MS,
    )


class StarGlass:
    """The shares that a `psf`'s wavelengths have of the light of a bench's stars, through one
    channel's `optics` or all.

    The band is cut into narrow ones, whose electrons come from the same tables as a star's total,
    so every model of
    spectra (`[sky] brightness`, `spectrum`, `temperature`) counts here too.
    """

    def __init__(
        self, file: BenchFile, psf: Psf, optics: Optics | None = None, band_nm: float = BAND_NM
    ) -> None:
        self.psf, self._config, self._mean = psf, file.config, psf.mean_shares
        self._catalog: Catalog | None = None
        self._of_row = np.empty((0, 0))
        self._bands: list[StarRates] = []
        self._of_band = np.ones((0, 1))
        if len(psf.wavelengths_nm) > 1:
            flat = self._cut(
                file, optics or bench_optics(file.config.tracker, file.folder), band_nm
            )
            if optics is not None and self._bands:
                self._mean = flat @ self._of_band / flat.sum()

    def _cut(self, file: BenchFile, optics: Optics, band_nm: float) -> FloatArray:
        """Bands that overlap as triangles do, so that they sum to the tracker's own; each one's
        response to even photons.
        """
        low_nm, high_nm = optics.range_nm
        nodes_nm = np.linspace(low_nm, high_nm, math.ceil((high_nm - low_nm) / band_nm) + 1)
        fine_nm = np.linspace(low_nm, high_nm, math.ceil((high_nm - low_nm) / KNOT_NM) + 1)
        own_nm = optics.quantum_efficiency.wavelength_nm
        knots_nm = np.union1d(
            np.union1d(nodes_nm, fine_nm), own_nm[(own_nm >= low_nm) & (own_nm <= high_nm)]
        )
        efficiency = optics.quantum_efficiency(knots_nm)
        shares, of_band, flat = NodeSpline(self.psf.wavelengths_nm)(knots_nm), [], []
        for number in range(len(nodes_nm)):
            part = efficiency * np.interp(knots_nm, nodes_nm, np.eye(len(nodes_nm))[number])
            response = part * optics.transmission(knots_nm) * np.gradient(knots_nm)
            if not response.any():
                continue
            try:
                rates = channel_rates(
                    file.config.sky,
                    dataclasses.replace(optics, quantum_efficiency=Curve(knots_nm, part)),
                )
            except InputError:
                # so little light that some spectrum has none: the bands beside it stand for it
                continue
            self._bands.append(rates)
            flat.append(response.sum())
            of_band.append(response @ shares / flat[-1])
        self._of_band = np.array(of_band)
        return np.array(flat)

    def shares(self, stars: Stars, which: IntArray) -> FloatArray:
        """The shares (n, L) of stars at places (n,) of `stars`; those of light without a
        spectrum where a place is negative.
        """
        if not self._bands:
            return self._mean
        if self._catalog is not stars.catalog:
            self._catalog, self._of_row = (
                stars.catalog,
                np.full((len(stars.catalog), self._of_band.shape[1]), np.nan),
            )
        found = np.tile(self._mean, (len(which), 1))
        rows = np.where(which >= 0, stars.row[np.maximum(which, 0)], -1)
        listed, body = rows >= 0, (rows < 0) & (which >= 0)
        new = np.unique(rows[listed][np.isnan(self._of_row[rows[listed], 0])])
        if len(new):
            some = stars.catalog.taken(new)
            self._of_row[new] = self._through(
                some.bv_mag, some.vi_mag, star_kinds(self._config, some)
            )
        found[listed] = self._of_row[rows[listed]]
        if body.any():
            bv_mag = stars.bv_mag[which[body]]
            kind = (
                np.full((len(bv_mag), 2), np.nan)
                if star_kinds(self._config, stars.catalog.taken(np.arange(0))) is not None
                else None
            )
            found[body] = self._through(bv_mag, np.full_like(bv_mag, np.nan), kind)
        return found

    def shares_of(self, stars: Stars, hip: IntArray) -> FloatArray:
        """The same by Hipparcos numbers (n,) of `stars`, 0 for a body."""
        order = np.argsort(stars.hip)
        at = np.minimum(np.searchsorted(stars.hip, hip, sorter=order), len(order) - 1)
        return self.shares(stars, np.where(hip > 0, order[at], -1))

    def _through(
        self, bv_mag: FloatArray, vi_mag: FloatArray, kind: FloatArray | None
    ) -> FloatArray:
        rates = np.stack(
            [band(np.zeros_like(bv_mag), bv_mag, vi_mag, kind) for band in self._bands], axis=1
        )
        return np.asarray(rates @ self._of_band / rates.sum(axis=1, keepdims=True))


def star_glass(file: BenchFile, psf: Psf, optics: Optics | None = None) -> StarGlass | None:
    """The spectra of a bench's stars as `psf` has them; None for one that is the same for all."""
    return StarGlass(file, psf, optics) if psf.by_colour else None
