"""Where methods fail between a catalogue and electrons: colours, spectra, the poles, the edge of a field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.errors import InputError
from hilstar.monitor.geometry import monitor_camera
from hilstar.scene.camera import Camera
from hilstar.scene.sprites import pack_sprites
from hilstar.sky.astrometry import RAD_PER_MAS, unit_vectors_icrs
from hilstar.sky.catalog import HIPPARCOS_EPOCH_JYEAR, load_catalog
from hilstar.sky.cells import cell_grid
from hilstar.sky.electrons import (
    TABLE_DEGREE,
    Optics,
    Photometry,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    star_temperatures_k,
    tabulate,
)
from hilstar.sky.pickles import library_electrons_per_s, load_library, tabulate_pickles
from hilstar.sky.spectrum import TEMPERATURE_SCALES, blackbody_exitance_w_m2_m, load_curve
from hilstar.study.models import leave_one_out, study_optics
from hilstar.study.place import Figures, Place

# Leave-one-out over the library (README.md): 95 % of the stars with V-I < 2.5 are within 2.4 %, of the redder 25 %.
BLUE_ERROR, RED_ERROR = 0.024, 0.25
COOL_K = 5000.0
# The median of both (README.md): 0.8 % for V-I < 2.5, 5 % beyond, where a fifth of the library's stars under 5000 K are.
COOL_MEDIAN = 0.8 * 0.008 + 0.2 * 0.05
TABLE_ERROR = 1e-6  # a millionth of a magnitude; the table itself is within 1e-11 (hilstar/sky/electrons.py)
STEP_MAG = 1e-8  # 2e-9 mag of B-V are crossed, at a slope of order 1
STEP_BV_MAG = 1e-9
# float64 knows a direction of length 1 to 2e-16 rad: 1e-7 mas. Times 100 for what a few operations add.
MOTION_MAS = 1e-5
POLE_MAS = 1e-5
# float64 places a pixel of 6e6 px to 1e-9; the slope of the tangent at 89.9 degrees makes 3e5 times 2e-16 of it, in focal
# lengths of 1000 px: 1e-4 px at the edge of such a field.
EDGE_PX = 1e-3
NOTHING = 0.0
ARCSEC_PER_RAD = float(np.degrees(1.0) * 3600.0)
OPTICS = study_optics("ccd47-20")
BEHIND = np.array([1.0, 0.0, 0.0, 0.0])


def bluest_star() -> Place:
    """B-V = -0.4, the bluest of Hipparcos."""
    library = load_library()
    why = "B-V saturates: there 0.01 mag is thousands of K. Pickles holds its bluest star's spectrum"
    return _colour(-0.4, int(np.argmin(library.bv_mag)), BLUE_ERROR, why)


def reddest_star() -> Place:
    """B-V = 5.5, past the reddest of Hipparcos."""
    library = load_library()
    plain = np.where(library.vi_mag < 2.0, library.bv_mag, -np.inf)
    why = "a carbon star's B-V is absorption, not temperature. Without V-I Pickles holds its reddest K giant"
    return _colour(5.5, int(np.argmax(plain)), RED_ERROR, why)


def _colour(bv_mag: float, star: int, tolerance: float, why: str) -> Place:
    """Rates at a colour against the library's `star` at that end."""
    bv, zero, library = np.array([bv_mag]), np.zeros(1), load_library()
    spectrum = library_electrons_per_s(library, OPTICS, Photometry())[star]
    kelvin = {name: float(star_temperatures_k(bv, name)[0]) for name in TEMPERATURE_SCALES}
    bodies = {name: float(dgs_electrons_per_s(t, OPTICS, Photometry())) / spectrum - 1 for name, t in kelvin.items()}
    pickles = tabulate_pickles(OPTICS, Photometry()).electrons_per_s(zero, bv, np.array([np.nan]))[0] / spectrum - 1
    fails = ", ".join(f"{name} {kelvin[name]:.0f} K, {100 * error:+.0f} %" for name, error in bodies.items())
    return Place(
        f"B-V = {bv_mag:g}",
        "a black body by B-V",
        f"{fails} against the spectrum of the library's {library.spectral_type[star].strip()}",
        f"{100 * pickles:+.1f} %",
        why,
        Figures(abs(float(pickles)), float(max(map(abs, bodies.values()))), tolerance),
    )


def temperature_range() -> Place:
    """1500 to 60 000 K."""
    kelvin = np.geomspace(1500, 60_000, 2000)
    exact = dgs_electrons_per_s(kelvin, OPTICS, Photometry())
    knots = np.linspace(1500, 60_000, TABLE_DEGREE + 1)
    straight = np.interp(kelvin, knots, dgs_electrons_per_s(knots, OPTICS, Photometry()))
    ours = tabulate("dgs", OPTICS, Photometry()).electrons_per_s(np.zeros(len(kelvin)), kelvin)
    error, fault = (float(np.abs(table / exact - 1).max()) for table in (ours, straight))
    return Place(
        "T = 1500 to 60000 K",
        f"a table of {len(knots)} temperatures and straight lines",
        f"off by up to {100 * fault:.0f} %",
        f"off by at most {error:.1e}",
        f"ln(rate) is smooth in 1/T: a Chebyshev series of degree {TABLE_DEGREE} holds it",
        Figures(error, fault, TABLE_ERROR),
    )


def planck_overflow() -> Place:
    """A Planck curve where exp(hc / lambda k T) has no float64, and where it is nearly 1."""
    x = np.array([1e5, 1e3, 1.0, 1e-12])
    wavelength_nm = 500.0
    kelvin = SECOND_RADIATION_NM_K / (wavelength_nm * x)
    # Without exp(x) - 1: the Wien and the Rayleigh-Jeans end by their own series, one figure in between by tanh.
    scale = blackbody_scale_w_m2_m(wavelength_nm)
    exact = scale * np.array([0.0, 0.0, (1 / np.tanh(0.5) - 1) / 2, 1e12 - 0.5])
    with np.errstate(over="ignore"):
        naive = scale / (np.exp(x) - 1)
        overflows = int(np.isinf(np.exp(x)).sum())
    with np.errstate(all="raise", under="ignore"):
        ours = blackbody_exitance_w_m2_m(np.array(wavelength_nm), kelvin)
    error, fault = (float((np.abs(curve - exact) / np.maximum(exact, scale)).max()) for curve in (ours, naive))
    return Place(
        "Planck at small and large lambda T",
        "exp(x) - 1 as the formula has it",
        f"{overflows} overflows in {len(x)}; {fault:.0e} off at x = 1e-12",
        f"no overflow, 0 at x = 1000; {error:.0e} off at most",
        "written with exp(-x) and expm1",
        Figures(error, fault, TABLE_ERROR),
    )


def source_step() -> Place:
    """Eq. 3.13 at B-V = 0."""
    around = np.array([-STEP_BV_MAG, STEP_BV_MAG])
    jumps = {}
    for name, scale in TEMPERATURE_SCALES.items():
        kelvin = scale(around)
        jumps[name] = float(kelvin[1] - kelvin[0]), _jump_mag(dgs_electrons_per_s(kelvin, OPTICS, Photometry()))
    colours = np.zeros(2), around, around
    jumps["pickles"] = 0.0, _jump_mag(tabulate_pickles(OPTICS, Photometry()).electrons_per_s(*colours))
    kelvin_step, fault = jumps.pop("wang2021")
    return Place(
        "B-V = 0",
        "wang2021, eq. 3.13",
        f"jumps by {kelvin_step:.0f} K, {fault:+.4f} mag",
        ", ".join(f"{name} {mag:+.1e} mag" for name, (_, mag) in jumps.items()),
        "its two branches do not meet there; the others have one",
        Figures(max(abs(mag) for _, mag in jumps.values()), abs(fault), STEP_MAG),
    )


def _jump_mag(rates: FloatArray) -> float:
    return float(-2.5 * np.log10(rates[1] / rates[0]))


def cool_stars() -> Place:
    """The average model, AGS, below 5000 K."""
    library = load_library()
    spectra = library_electrons_per_s(library, OPTICS, Photometry())
    cool = star_temperatures_k(library.bv_mag, "ballesteros2012") < COOL_K
    average = np.abs(ags_electrons_per_s(OPTICS, Photometry()) / spectra - 1)[cool]
    ours = np.abs(leave_one_out(spectra))[cool]
    error, fault = float(np.median(ours)), float(np.median(average))
    return Place(
        f"AGS, stars under {COOL_K:.0f} K",
        "one average for every colour (AGS)",
        f"off by {100 * fault:.0f} % in the median of {cool.sum()} real spectra, {100 * average.max():.0f} % at worst",
        f"pickles, the star itself left out: {100 * error:.1f} % in the median, {100 * ours.max():.0f} % at worst (late M giants)",
        "most of a cool star's light is red of V, where AGS has a body of 9602 K",
        Figures(error, fault, COOL_MEDIAN),
    )


def blind_tracker() -> Place:
    """A tracker that detects no light at all."""
    blind = replace(OPTICS, quantum_efficiency=load_curve(0.0, "qe"))
    rate = dgs_electrons_per_s(np.array([5000.0]), blind, Photometry())
    with np.errstate(divide="ignore"):
        logarithm = np.log(rate)
    try:
        tabulate("dgs", blind, Photometry())
        happens, taken = "taken", 1.0
    except InputError as refusal:
        happens, taken = f"refused: {refusal}", NOTHING
    return Place(
        "quantum efficiency 0",
        "a table of ln(rate)",
        f"ln(rate) = {logarithm[0]:.0f}, no finite curve through it",
        happens,
        "no electrons to scale",
        Figures(taken, float((~np.isfinite(logarithm)).sum()), NOTHING),
    )


def motion_at_pole() -> Place:
    """Proper motion a thousandth of a degree from the pole."""
    catalog = load_catalog().brighter_than(0.0)
    n, years = len(catalog), 34.75
    at_pole = replace(
        catalog,
        ra_deg=np.full(n, 359.9999),
        dec_deg=np.full(n, 89.999),
        pm_ra_cosdec_mas_yr=np.full(n, 100.0),
        pm_dec_mas_yr=np.full(n, 50.0),
    )
    moved = unit_vectors_icrs(at_pole, HIPPARCOS_EPOCH_JYEAR + years)[0]
    turn_deg = 100.0 * years * RAD_PER_MAS / np.radians(1.0)
    dec_deg = 89.999 + turn_deg / 2
    wrong = [_vector(359.9999 + turn_deg / cosine, dec_deg) for cosine in (1.0, np.cos(np.radians(89.999)))]
    exact = _great_circle(359.9999, 89.999, np.array([100.0, 50.0]) * years * RAD_PER_MAS)
    error, *faults = (_apart_rad(v, exact) / RAD_PER_MAS for v in (moved, *wrong))
    return Place(
        "proper motion at declination 89.999",
        "RA + pm t, as eq. 2.1; with pm / cos(dec)",
        f"{faults[0]:.0f} mas off after {years:g} years; {faults[1]:.2g} mas",
        f"{error:.1e} mas off a great circle",
        "space motion on unit vectors: nothing divides by cos(dec)",
        Figures(error, min(faults), MOTION_MAS),
    )


def _vector(ra_deg: float, dec_deg: float) -> FloatArray:
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def _great_circle(ra_deg: float, dec_deg: float, path_rad: FloatArray) -> FloatArray:
    """Where a straight path in space ends, seen at `path_rad` (east, north), by angles along a great circle."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    length = float(np.hypot(*path_rad))
    along = (path_rad[0] * east + path_rad[1] * north) / length
    angle = np.arctan(length)
    return np.asarray(np.cos(angle) * _vector(ra_deg, dec_deg) + np.sin(angle) * along)


def _apart_rad(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(np.cross(a, b)))


def field_over_wrap_and_pole() -> Place:
    """Fields of 10 degrees on the RA wrap and about the pole."""
    catalog = load_catalog().brighter_than(7.5)
    vectors = unit_vectors_icrs(catalog, HIPPARCOS_EPOCH_JYEAR)
    grid, radius = cell_grid(vectors), 10.0
    lost, box_lost, seen = 0, 0, 0
    for ra_deg, dec_deg in ((0.01, 0.0), (359.99, -45.0), (200.0, 89.0), (20.0, -90.0)):
        axis = _vector(ra_deg, dec_deg)
        inside = np.flatnonzero(vectors @ axis >= np.cos(np.radians(radius)))
        box = (np.abs(catalog.ra_deg - ra_deg) <= radius) & (np.abs(catalog.dec_deg - dec_deg) <= radius)
        lost += len(np.setdiff1d(inside, grid.order[grid.near(axis, np.radians(radius))]))
        box_lost, seen = box_lost + int((~box[inside]).sum()), seen + len(inside)
    return Place(
        "fields over RA = 0 and over the poles",
        "stars chosen by a box in RA and declination",
        f"{box_lost} of {seen} stars within {radius:.0f} degrees lost",
        f"{lost} lost",
        "cells of the sphere are chosen by the angle between unit vectors",
        Figures(float(lost), float(box_lost), NOTHING),
    )


def stars_behind() -> Place:
    """Half of the sky lies behind the camera."""
    camera, vectors = _camera(70.0), unit_vectors_icrs(load_catalog().brighter_than(7.5), HIPPARCOS_EPOCH_JYEAR)
    behind = vectors[vectors[:, 2] <= 0]
    ghosts = _on_image(behind[:, :2] / behind[:, 2:] * camera.focal_length_px + camera.principal_point_px, camera)
    ours = _on_image(np.column_stack(camera.project(behind)), camera)
    return Place(
        "stars behind the camera",
        "x = f X / Z for every star",
        f"{ghosts} of {len(behind)} stars behind are drawn, mirrored",
        f"{ours} drawn",
        "a star is projected only with Z > 0",
        Figures(float(ours), float(ghosts), NOTHING),
    )


def _camera(half_field_deg: float) -> Camera:
    """2000 px across, so many degrees from the middle to the edge."""
    focal_length_mm = 1000.0 / np.tan(np.radians(half_field_deg)) * 1e-3
    return monitor_camera((2001, 2001), 1.0, focal_length_mm, BEHIND)


def _on_image(places_px: FloatArray, camera: Camera) -> int:
    flux, star = np.ones(len(places_px)), np.arange(len(places_px), dtype=np.intp)
    return len(pack_sprites(places_px[:, 0], places_px[:, 1], flux, star, (camera.resolution_px, 1)))


def field_of_180_deg() -> Place:
    """A field that grows to 180 degrees."""
    error, fault, spread = 0.0, 0.0, 0.0
    for half_deg in (60.0, 85.0, 89.0, 89.9):
        camera = _camera(half_deg)
        angle = np.radians(np.linspace(0.0, half_deg, 1000))
        vectors = np.column_stack([np.sin(angle), np.zeros(1000), np.cos(angle)])
        exact = camera.focal_length_px * np.tan(angle) + 1000.0
        error = max(error, float(np.abs(camera.project(vectors)[0] - exact).max()))
        fault = max(fault, float(np.abs(camera.project(vectors.astype(np.float32).astype(np.float64))[0] - exact).max()))
        spread = 1 / np.cos(angle[-1]) ** 2
    return Place(
        "a field of 179.8 degrees",
        "float32 directions",
        f"{fault:.2g} px off at its edge, of 1000",
        f"{error:.1e} px off; but a degree at the edge is {spread:.2g} times a degree in the middle",
        "float64; the perspective itself diverges at 180 degrees, as a flat monitor does",
        Figures(error, fault, EDGE_PX),
    )
