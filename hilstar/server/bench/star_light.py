"""The light of a bench's sky: stars, bodies, diffuse light and the air over a site."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.optics.layers.layers import Sources, light_of, seen_in, sky_layers
from hilstar.optics.layers.truth import StarInView, brightest_in_view
from hilstar.optics.layers.view import Canvas, View
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import (
    tracker_camera,
    tracker_psf,
)
from hilstar.server.bench.config import (
    BenchConfig,
)
from hilstar.server.bench.config.bench_config import (
    epoch_utc_ns,
    has_observer,
    sky_jd,
)
from hilstar.server.bench.star_rates import (
    bench_channels,
    bench_optics,
    channel_rates,
    star_flux,
    star_kinds,
    star_rates,
)
from hilstar.sky.air import SiteAir, dimmed_mag
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import (
    star_temperatures_k,
)
from hilstar.sky.star_table import TableChoice, choose_catalog
from hilstar.sky.stars import (
    BV_MAG,
    Stars,
    aberrate,
    make_stars,
    total_and_colours,
    unit_vectors_icrs,
)

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky

SUNLIGHT, V_NM = (0.0, 0.65, 0.70), 545.0  # V, B-V and V-I; the wavelength of V


def bench_sources(config: BenchConfig, folder: Path) -> Sources:
    """The light of a bench's sky other than its stars: bodies, and a map of diffuse light. Raises
    InputError or MachineError.
    """
    moving = bench_moving(config, folder)
    diffuse = config.sky.diffuse
    if diffuse.map is None:
        return Sources(moving)
    # Importing WCS and coordinates takes 200 ms, which a bench without a map saves.
    from hilstar.sky.diffuse import read_diffuse_map

    bv_mag = diffuse.bv_mag
    rates = star_rates(config, folder)
    (v0_e_per_s,) = rates(np.zeros(1), np.array([bv_mag]), np.array([np.nan]))
    faces = []
    for face in read_diffuse_map(folder / diffuse.map):
        image = face.image * np.float32(v0_e_per_s)
        faces.append(dataclasses.replace(face, image=image, bv_mag=bv_mag))
    return Sources(moving, tuple(faces))


def bench_moving(config: BenchConfig, folder: Path) -> MovingSky | None:
    """The bodies and the observer of a bench; None where its file states neither. Raises InputError
    or MachineError.
    """
    if not has_observer(config):
        return None
    from hilstar.server.bench.moving_sky import (
        moving_sky,  # importing the ephemeris takes 50 ms, which only bodies and an observer need
    )

    return moving_sky(config, folder, bench_channels(config.tracker, folder))


def moved(stars: Stars, moving: MovingSky | None) -> Stars:
    """The stars with the bodies among them at t = 0, in new arrays that `moving` may change;
    without `moving` the stars themselves.
    """
    if moving is None:
        return stars
    return moving.among(stars)


def catalogue_choice(config: BenchConfig, folder: Path) -> TableChoice:
    """The catalogue that `[sky] catalogue` names, and the options with which it is read."""
    sky = config.sky
    source = sky.catalogue if sky.catalogue == "hipparcos" else folder / sky.catalogue
    return TableChoice(source, sky.with_hipparcos, sky.catalogue_epoch_jyear)


def star_catalog(config: BenchConfig, folder: Path) -> Catalog:
    """The catalogue of a bench's stars, down to its faintest: `Stars.row` counts in its rows.
    Raises InputError.
    """
    sky = config.sky
    choice = catalogue_choice(config, folder)
    if sky.variables == "phase":
        # All stars are read first, as a variable that is too faint on average may be bright enough
        # at this time.
        everything = dataclasses.replace(choice, faintest_v_mag=math.inf)
        chosen = choose_catalog(everything).at_phase(sky_jd(config, None))
    else:
        chosen = choose_catalog(dataclasses.replace(choice, faintest_v_mag=sky.faintest_v_mag))
    return chosen.brighter_than(sky.faintest_v_mag)


def bench_stars(config: BenchConfig, folder: Path, moving: MovingSky | None = None) -> Stars:
    """The stars of a bench, with directions as the observer of `moving` sees them, and with their
    electron rates, which are computed only here. Raises InputError.
    """
    sky = config.sky
    # called for its check: it refuses an epoch that a source should have given
    epoch_utc_ns(config)
    catalog = star_catalog(config, folder)
    vectors = unit_vectors_icrs(catalog, sky.epoch_jyear)
    # A moving sky has its observer's position and velocity; without one the bench file may state a
    # velocity.
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
    flux = through(catalog.v_mag, catalog.bv_mag, catalog.vi_mag, kind)
    by_bv = None
    if flux.shape[1] > 1:
        flux_by_bv = through(np.zeros_like(BV_MAG), BV_MAG, np.full_like(BV_MAG, np.nan))
        by_bv = total_and_colours(flux_by_bv).colours
    # set here, as the air dims each star by its own spectrum
    if config.site is not None and moving is not None:
        moving.air = site_air(config, folder, catalog, kind)
    stars = make_stars(catalog, vectors, temperature_k, flux)
    return dataclasses.replace(stars, colours_by_bv=by_bv)


def site_air(
    config: BenchConfig, folder: Path, catalog: Catalog, kind: FloatArray | None = None
) -> SiteAir:
    """The air over `[site]`, with the dimming of each star of a catalogue and, as the last, of
    sunlight. `kind` are the stars' MK types, None where spectra are by colour. Raises InputError.
    """
    # Importing ERFA takes 30 ms, which a bench without a site saves.
    from hilstar.server.bench.site import (
        Ground,
        site_extinction,
        site_glow_e_per_s_sr,
        site_refraction,
    )

    if config.site is None:
        raise AssertionError("the file has a site")
    extinction = site_extinction(config.site, folder)
    optics = bench_optics(config.tracker, folder)
    channels = bench_channels(config.tracker, folder)
    v, bv, vi = (
        np.append(c, sunlight)
        for c, sunlight in zip(
            (catalog.v_mag, catalog.bv_mag, catalog.vi_mag), SUNLIGHT, strict=True
        )
    )
    if kind is None:
        kinds = None
    else:
        kinds = np.vstack([kind, np.full((1, 2), np.nan)])
    dimming = [
        dimmed_mag(
            lambda through: channel_rates(config.sky, through)(v, bv, vi, kinds),
            sunlight,
            extinction,
        )
        for sunlight in channels
    ]
    return SiteAir(
        up_at=Ground(config.site).up,
        refraction_rad=site_refraction(config.site, optics),
        height_m=config.site.height_m,
        aperture_mm=config.tracker.aperture_mm,
        dimming_mag=np.array(dimming, dtype=np.float32),
        v_extinction_mag=float(extinction(np.array([V_NM]))[0]),
        glow_e_per_s_sr=np.array(
            [site_glow_e_per_s_sr(config, folder, sunlight) for sunlight in channels]
        ),
    )


def brightest_seen(file: BenchFile, view: View, count: int) -> list[StarInView]:
    """The `count` brightest stars and bodies in a view of a bench's tracker, the brightest first.

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
