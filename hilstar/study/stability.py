"""Where methods fail: each place with its input, what happens there in figures, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.quaternion import from_radec_roll_deg
from hilstar.bench.simulation import Simulator
from hilstar.errors import InputError
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Renderer, Target
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.sky.electrons import Optics, Photometry, dgs_electrons_per_s, star_temperatures_k, tabulate
from hilstar.sky.pickles import tabulate_pickles
from hilstar.sky.spectrum import TEMPERATURE_SCALES, blackbody_exitance_w_m2_m, load_curve
from hilstar.study.charts import write_csv
from hilstar.tracker.detector import Detector, DetectorSettings

IMAGE_PX = (512, 512)
SEED = 1
BENCH = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [256, 256]
exposure_s = {exposure_s}
quantum_efficiency = "ccd47-20"
[tracker.detector]
offset_dn = 100
read_noise_e = 48
[monitor]
resolution_px = [256, 256]
pixel_pitch_um = 13
[collimator]
focal_length_mm = 70
[background]
electrons_per_px = {background_e}
"""


@dataclass(frozen=True, slots=True)
class Place:
    """One place where a method could fail: `right` says that hilstar is right there, or refuses it in one line."""

    case: str
    happens: str
    why: str
    right: bool


def run(directory: Path) -> list[Place]:
    """Visit every place and write `stability.csv`; the places, in order."""
    places = [visit() for visit in VISITS]
    rows = [(place.case, "right" if place.right else "WRONG", place.happens, place.why) for place in places]
    write_csv(directory / "stability.csv", ("case", "verdict", "what happens", "why"), rows)
    return places


def _optics() -> Optics:
    return Optics(30.0, load_curve("ccd47-20", "qe"), load_curve("n-bk7-10mm", "transmission"))


def bluest_star() -> Place:
    """B-V = -0.4, the bluest of Hipparcos."""
    return _colour(-0.4, "B-V saturates for hot stars: 0.01 mag there is 2000 K, but their light falls off alike")


def reddest_star() -> Place:
    """B-V = 5.5, past the reddest of Hipparcos."""
    return _colour(
        5.5, "a carbon star's B-V is absorption, not temperature: a black body gets its electrons wrong, Pickles holds its end"
    )


def _colour(bv_mag: float, why: str) -> Place:
    bv, zero = np.array([bv_mag]), np.zeros(1)
    kelvin = {name: float(star_temperatures_k(bv, name)[0]) for name in TEMPERATURE_SCALES}
    table = tabulate("dgs", _optics(), Photometry())
    rates = {name: float(table.electrons_per_s(zero, np.array([t]))[0]) for name, t in kelvin.items()}
    rates["pickles"] = float(tabulate_pickles(_optics(), Photometry()).electrons_per_s(zero, bv, np.array([np.nan]))[0])
    direct = {name: float(dgs_electrons_per_s(t, _optics(), Photometry())) for name, t in kelvin.items()}
    exact = all(abs(rates[name] / direct[name] - 1) < 1e-6 for name in kelvin)
    text = ", ".join(f"{name} {t:.0f} K" for name, t in kelvin.items())
    electrons = ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items())
    return Place(
        f"B-V = {bv_mag:g}", f"{text}; electrons/s at V = 0: {electrons}", why, exact and all(map(np.isfinite, rates.values()))
    )


def temperature_range() -> Place:
    """1500 to 60 000 K."""
    kelvin = np.geomspace(1500, 60_000, 2000)
    tabulated = tabulate("dgs", _optics(), Photometry()).electrons_per_s(np.zeros(len(kelvin)), kelvin)
    error = float(np.abs(tabulated / dgs_electrons_per_s(kelvin, _optics(), Photometry()) - 1).max())
    return Place("T = 1500 to 60000 K", f"table off by at most {error:.1e}", "ln(rate) is smooth in 1/T", error < 1e-6)


def planck_overflow() -> Place:
    """A Planck curve where exp(hc / lambda k T) has no float64."""
    wavelength_nm = np.array([1.0, 10.0, 300.0])
    with np.errstate(over="ignore"):
        naive = np.exp(1.438777e7 / (wavelength_nm * 10.0))
    ours = blackbody_exitance_w_m2_m(wavelength_nm, 10.0)
    happens = (
        f"exp(x) overflows at {int(np.isinf(naive).sum())} of 3 wavelengths; ours is {ours.max():.1g} W/m2/m at most, finite"
    )
    return Place(
        "Planck at small lambda T", happens, "written with exp(-x)", bool(np.isfinite(ours).all() and (ours >= 0).all())
    )


def source_step() -> Place:
    """Eq. 3.13 at B-V = 0."""
    around = np.array([-1e-9, 0.0])
    jumps = {}
    for name, scale in TEMPERATURE_SCALES.items():
        kelvin = scale(around)
        rates = dgs_electrons_per_s(kelvin, _optics(), Photometry())
        jumps[name] = float(kelvin[1] - kelvin[0]), float(-2.5 * np.log10(rates[1] / rates[0]))
    happens = ", ".join(f"{name} jumps by {k:.0f} K, {mag:+.4f} mag" for name, (k, mag) in jumps.items())
    return Place(
        "B-V = 0, eq. 3.13",
        happens,
        "its two branches do not meet; ballesteros2012 has one",
        abs(jumps["ballesteros2012"][1]) < 1e-6,
    )


def billion_electrons() -> Place:
    """1e9 electrons in one pixel."""
    deep = Detector(DetectorSettings(gain_e_per_dn=1e5, full_well_e=1e12, bits=16), (64, 64))
    dn = deep.expose(np.full((64, 64), 1e9), 1.0, np.random.default_rng(SEED))
    plain = Detector(DetectorSettings(), (64, 64)).expose(np.full((64, 64), 1e9), 1.0, np.random.default_rng(SEED))
    happens = f"deep well: mean {dn.mean() * 1e5:.6g} e-; a CCD47-20 saturates at {plain.max()} DN = 70000 e- / 24"
    # 4096 pixels of 1e9: the mean is known to sqrt(1e9 / 4096) = 494 e-, rounding aside (1e5 / sqrt(12 * 4096)).
    return Place(
        "1e9 electrons in a pixel",
        happens,
        "Poisson is drawn exactly to 1e12",
        abs(dn.mean() * 1e5 - 1e9) < 5000 and plain.max() == 2917,
    )


def _simulated(exposure_s: float, background_e: float, faintest: float = 7.5) -> tuple[FloatArray, int]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        text = BENCH.format(exposure_s=exposure_s, background_e=background_e)
        path.write_text(f"{text}\n[sky]\nfaintest_v_mag = {faintest}\n")
        with Simulator(path) as simulator:
            motion = simulator.motion(from_radec_roll_deg(84.057, -1.2, 0.0), np.zeros(3))
            exposure = simulator.expose(motion, np.random.default_rng(SEED))
    return exposure.dn.astype(np.float64), len(exposure.truth)


def empty_field() -> Place:
    """No star in view."""
    dn, stars = _simulated(0.1, 2400.0, faintest=-1.4)
    right = stars == 0 and abs(dn.mean() - 200) < 0.2
    return Place(
        "an empty field", f"{stars} stars, mean {dn.mean():.2f} DN for 2400 e- and an offset of 100", "nothing to draw", right
    )


def no_exposure() -> Place:
    """An exposure of 0 s."""
    dn, stars = _simulated(0.0, 0.0)
    happens = f"{stars} stars in view, no electrons: mean {dn.mean():.2f} DN, sigma {dn.std():.2f} DN"
    # The offset of 100, read noise of 2 DN and rounding's 1 / sqrt 12: 2.02.
    right = abs(dn.mean() - 100) < 0.1 and abs(dn.std() - 2.02) < 0.05
    return Place("exposure 0 s", happens, "bias and read noise alone remain", right)


def _drawn(sigma_px: float, x_px: float, electrons_per_s: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """One star by the renderer and by the oracle."""
    with Renderer(Target(IMAGE_PX, (sigma_px, sigma_px))) as gl:
        sprites = _one_star(x_px, gl.footprint_px, electrons_per_s)
        gl.draw(sprites)
        return gl.linear().astype(np.float64), linear_image(sprites, IMAGE_PX, (sigma_px, sigma_px))


def _one_star(x_px: float, footprint_px: int, electrons_per_s: float) -> Sprites:
    place, flux = np.array([x_px]), np.array([electrons_per_s])
    return pack_sprites(place, np.array([256.0]), flux, np.zeros(1, dtype=np.intp), (IMAGE_PX, footprint_px))


def narrow_star() -> Place:
    """Sigma 0.2 px."""
    return _sigma(
        0.2, "nearly all light in one pixel: the flux is right, and no centroid can be; tracker and monitor want 0.5 px"
    )


def wide_star() -> Place:
    """Sigma 20 px."""
    return _sigma(20.0, "float32 erf differences are small against the flux, and sum without loss")


def _sigma(sigma_px: float, why: str) -> Place:
    flux_error, lost_px = 0.0, 0.0
    for phase in (-0.5, -0.3, 0.0, 0.2, 0.4):
        drawn, exact = _drawn(sigma_px, 256 + phase)
        flux_error = max(flux_error, abs(drawn.sum() - 1))
        columns = np.arange(IMAGE_PX[0])
        centroid = drawn.sum(axis=0) @ columns / drawn.sum()
        lost_px = max(lost_px, abs(float(centroid) - 256 - phase))
        flux_error = max(flux_error, abs(drawn - exact).max())
    happens = f"flux off by {flux_error:.1e}; centre of gravity off by {lost_px:.1e} px, pixel sampling included"
    return Place(f"sigma {sigma_px:g} px", happens, why, flux_error < 1e-5)


def absurd_sigmas() -> Place:
    """Sigmas that no sprite can hold."""
    lines = []
    for sigma_px in (60.0, 1e6):
        try:
            Renderer(Target(IMAGE_PX, (sigma_px, sigma_px))).close()
        except InputError as refusal:
            lines.append(str(refusal))
    return Place("sigma 60 and 1e6 px", "refused: " + " | ".join(lines), "GL's largest point bounds a sprite", len(lines) == 2)


def flux_range() -> Place:
    """Twelve decades side by side."""
    with Renderer(Target(IMAGE_PX, (0.85, 0.85))) as gl:
        near = _one_star(100.3, gl.footprint_px, 1e12)
        far = _one_star(400.3, gl.footprint_px, 1.0)
        both = replace(
            near,
            data=np.concatenate([near.data, far.data]),
            star=np.arange(2),
            x_px=np.concatenate([near.x_px, far.x_px]),
            y_px=np.concatenate([near.y_px, far.y_px]),
        )
        gl.draw(both)
        image = gl.linear().astype(np.float64)
    errors = [abs(image[:, :250].sum() / 1e12 - 1), abs(image[:, 250:].sum() - 1)]
    happens = f"fluxes off by {errors[0]:.1e} and {errors[1]:.1e}"
    return Place("flux range 1e12", happens, "each star is drawn in its own footprint", max(errors) < 1e-5)


def blind_tracker() -> Place:
    """A tracker whose curves share no wavelength."""
    try:
        tabulate("dgs", replace(_optics(), quantum_efficiency=load_curve(0.0, "qe")), Photometry())
    except InputError as refusal:
        return Place("quantum efficiency 0", f"refused: {refusal}", "no electrons to scale", True)
    return Place("quantum efficiency 0", "taken", "no electrons to scale", False)


VISITS: tuple[Callable[[], Place], ...] = (
    bluest_star,
    reddest_star,
    temperature_range,
    planck_overflow,
    source_step,
    billion_electrons,
    empty_field,
    no_exposure,
    narrow_star,
    wide_star,
    absurd_sigmas,
    flux_range,
    blind_tracker,
)
