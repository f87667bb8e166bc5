"""Results of a confrontation: figures for --json, verdicts in words, and what is beyond the limits
of --strict.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.confront.background import KINDS
from hilstar.instruments.confront.excess import Excess
from hilstar.instruments.confront.judge import Verdict
from hilstar.instruments.confront.session import Session

MAX_RMS_PX, MAX_RMS_MAG, CHI2 = 0.15, 0.2, (0.8, 1.25)  # with --strict, of each photograph
MIN_STARS_JUDGED = 5
UNSURE_YEARS = 2.0
FWHM_GRID = 5  # field points along each side at which the PSF's width is stated
DISTORTION = ("k1", "k2", "p1", "p2")


@dataclass(frozen=True, slots=True)
class Confronted:
    """A confrontation's session, a verdict of each photograph, the split of the scatter, and lines
    in words.

    `defects` are the counts of hot and of dead pixels.
    """

    session: Session
    verdicts: tuple[Verdict, ...]
    excess: Excess | None
    lines: tuple[str, ...]
    failures: tuple[str, ...]
    notes: tuple[str, ...]
    written: tuple[str, ...]
    defects: tuple[int, int]

    @property
    def figures(self) -> dict[str, Any]:
        """The keys of --json."""
        return {
            "images": [_image_figures(self.session, verdict) for verdict in self.verdicts],
            "camera": _camera_figures(self.session, self.defects),
            "excess": _excess_figures(self.excess),
            "fixed": self.session.fixed,
            "passed": not self.failures,
            "failures": list(self.failures),
            "notes": list(self.notes),
            "written": list(self.written),
        }


def _camera_figures(session: Session, defects: tuple[int, int]) -> dict[str, Any]:
    fit = session.camera
    light = session.light
    pixels = session.pixels
    power = light.linearity
    has_tone_curve = session.power != 1.0
    if has_tone_curve:
        power = session.power * light.linearity
    fixed_pattern = None
    if math.isfinite(pixels.pattern.errors[0]):
        fixed_pattern = dict(zip(KINDS, pixels.pattern.rms, strict=True))
    full_dn = session.shots[0].photo.full_dn
    psf_fwhm_px = float(np.median(_fwhms(session)))
    return {
        "focal_length_px": fit.camera.focal_length_px,
        "principal_point_px": list(fit.camera.principal_point_px),
        "distortion": _distortion(session),
        "model": fit.model,
        "held_out_px": fit.held_out_px,
        "psf_fwhm_px": psf_fwhm_px,
        "gain_e_per_dn": pixels.gain_e_per_dn,
        "read_noise_e": pixels.read_noise_e,
        "pedestal_dn": pixels.pedestal_dn,
        "saturation_dn": full_dn,
        "zero_point_mag": _number(light.zero_point_mag),
        "colour_term": _number(light.colour_term),
        "colour_terms": light.colour_terms,
        "vignetting_mag": list(light.vignetting_mag),
        "extinction_mag_per_air_mass": extinction_of(session),
        "linearity_power": power,
        "tone_curve": has_tone_curve,
        "fixed_pattern": fixed_pattern,
        "hot_pixels": defects[0],
        "dead_pixels": defects[1],
        "sigma": _sigmas(session),
    }


def _distortion(session: Session) -> dict[str, float]:
    lens = session.camera.camera.lens
    if lens is None:
        return dict.fromkeys(DISTORTION, 0.0)
    k1, k2, _ = lens.radial
    p1, p2 = lens.tangential
    return dict(zip(DISTORTION, (k1, k2, p1, p2), strict=True))


def _sigmas(session: Session) -> dict[str, Any]:
    """One sigma of the camera's figures by name; null, or left out, where one was not fitted."""
    fit = session.camera
    focal_sigma_px = None
    if "log_focal" in fit.sigma:
        focal_sigma_px = fit.camera.focal_length_px * fit.sigma["log_focal"]
    sigmas: dict[str, Any] = {
        "focal_length_px": focal_sigma_px,
        "principal_point_px": [fit.sigma.get("centre_x"), fit.sigma.get("centre_y")],
    }
    for name in DISTORTION:
        if name in fit.sigma:
            sigmas[name] = fit.sigma[name]
    for name, value in (session.light.sigma | session.pixels.sigma).items():
        sigmas[name] = _number(value)
    return sigmas


def _excess_figures(excess: Excess | None) -> dict[str, Any] | None:
    if excess is None:
        return None
    return {
        "stars": excess.stars,
        "rms_px": excess.rms_px,
        "rms_mag": excess.rms_mag,
        "light_mag": {part.name: _number(part.rms) for part in excess.light},
        "places_px": {part.name: _number(part.rms) for part in excess.places},
    }


def _number(value: float) -> float | None:
    """A number for JSON, which has no NaN."""
    if math.isfinite(value):
        return float(value)
    return None


def _image_figures(session: Session, verdict: Verdict) -> dict[str, Any]:
    pointing = session.camera.pointings[verdict.number]
    fainter = verdict.fainter
    stars_seen = sum("missing" not in row.flags for row in verdict.stars)
    off_years = None
    sigma_years = None
    if verdict.dated is not None:
        off_years = verdict.dated.years
        sigma_years = verdict.dated.sigma
    fainter_than_catalogue = {
        "complete_v_mag": fainter.complete_v_mag,
        "reached_v_mag": _number(fainter.reached_v_mag),
        "expected": fainter.expected,
    }
    return {
        "file": verdict.shot.photo.name,
        "q_icrs_to_cam": pointing.q_icrs_to_cam.tolist(),
        "stars": verdict.counted,
        "stars_seen": stars_seen,
        "rms_px": _number(verdict.rms_px),
        "rms_mag": _number(verdict.rms_mag),
        "background_chi2": _number(verdict.background_chi2),
        "star_chi2": _number(verdict.star_chi2),
        "unexplained": len(verdict.unexplained),
        "missing": len(verdict.missing),
        "fainter_than_catalogue": fainter_than_catalogue,
        "dim": verdict.dim,
        "offset_mag": float(session.light.offsets_mag[verdict.number]),
        "altitude_deg": pointing.altitude_deg,
        "air_mass": session.light.masses[verdict.number],
        "sky_v_mag_arcsec2": sky_v_mag(session, verdict.number),
        "date_off_years": off_years,
        "date_sigma_years": sigma_years,
    }


def extinction_of(session: Session) -> float | None:
    """Extinction in the tracker's light, mag an air mass, where photographs told it: of
    sunlight, with a site.
    """
    slope = session.light.extinction_mag
    if slope is None or session.air is None:
        return slope
    return slope + float(session.air.dimming_mag[0, 1, -1])


def sky_v_mag(session: Session, number: int) -> float | None:
    """V of the sky between the stars, mag/arcsec^2, by the zero point of stars; None where it is
    not above the pedestal.
    """
    pixels = session.pixels
    camera = session.camera.camera
    level_dn = float(np.median(session.shots[number].level.level)) - pixels.pedestal_dn
    if level_dn <= 0:
        return None
    px_per_arcsec = camera.focal_length_px / ARCSEC_PER_RAD
    dn_per_arcsec2 = level_dn * px_per_arcsec**2
    zero_mag = session.sky_mag() + float(session.light.offsets_mag[number])
    return -2.5 * math.log10(dn_per_arcsec2) - zero_mag


def _fwhms(session: Session) -> FloatArray:
    """Full widths at half maximum, px, on a grid of places over the field."""
    width, height = session.camera.camera.resolution_px
    columns = np.linspace(0, width - 1, FWHM_GRID)
    rows = np.linspace(0, height - 1, FWHM_GRID)
    x_px, y_px = np.meshgrid(columns, rows)
    return session.psf.fwhm_px(x_px.ravel(), y_px.ravel())


def words_of(verdict: Verdict) -> str:
    """One photograph in a line."""
    return (
        f"{verdict.counted} stars to V = 6.5 within {verdict.rms_px:.3f} px and"
        f" {verdict.rms_mag:.3f} mag, background chi2 {verdict.background_chi2:.3f},"
        f" {len(verdict.unexplained)} sources unexplained, {len(verdict.missing)} stars missing"
    )


def lines_of(
    session: Session, verdicts: Sequence[Verdict], excess: Excess | None, defects: tuple[int, int]
) -> list[str]:
    """Verdicts in words: what the simulator explains, and what it does not."""
    lines = list(_camera_lines(session))
    light = session.light
    extinction = extinction_of(session)
    if extinction is not None:
        sigma = next(value for name, value in light.sigma.items() if name.startswith("extinction"))
        masses = [air_mass for air_mass in light.masses if air_mass is not None]
        lines.append(
            f"extinction: {extinction:.3f} +- {sigma:.3f} mag an air mass, over {min(masses):.2f}"
            f" to {max(masses):.2f} of them"
        )
    skies_mag = [sky_v_mag(session, number) for number in range(len(session.shots))]
    known_mag = [v_mag for v_mag in skies_mag if v_mag is not None]
    if known_mag:
        lines.append(
            f"sky: V {min(known_mag):.2f} to {max(known_mag):.2f} mag/arcsec2, if its spectrum is"
            " that of [site] sky_spectrum"
        )
    hot, dead = defects
    if hot or dead:
        lines.append(f"pixels: {hot} hot and {dead} dead, in most of the photographs")
    for verdict in verdicts:
        name = verdict.shot.photo.name
        for line in (*verdict.dim, *_beyond(verdict), *_dated(verdict)):
            lines.append(f"{name}: {line}")
    if excess is not None:
        lines.append(
            f"scatter of {excess.stars} stars: {excess.rms_px:.3f} px an axis,"
            f" {excess.rms_mag:.3f} mag"
        )
    return lines


def _camera_lines(session: Session) -> Iterator[str]:
    """The lens, the PSF, the detector and the light, in words."""
    camera = session.camera.camera
    light = session.light
    pixels = session.pixels
    k1 = _distortion(session)["k1"]
    yield (
        f"lens: {camera.focal_length_px:.2f} px of focal length, k1 = {k1:.4f}"
        f" ({session.camera.model})"
    )
    fwhms = _fwhms(session)
    yield (
        f"PSF: {np.median(fwhms):.2f} px full width at half maximum, pixel included,"
        f" {np.min(fwhms):.2f} to {np.max(fwhms):.2f} px over the field"
    )
    step_e = pixels.gain_e_per_dn * pixels.step_dn
    yield (
        f"detector: {pixels.gain_words}, {step_e:.3g} a step of {pixels.step_dn:.3g} DN, read noise"
        f" {pixels.read_noise_e:.2f} e-, pedestal {pixels.pedestal_dn:.0f} DN"
    )
    if session.fixed:
        dimming_mag = light.offsets_mag - light.offsets_mag.min()
        dimming = ", ".join(f"{mag:+.2f}" for mag in dimming_mag)
        yield f"air: {dimming} mag dimmer than the clearest"
        return
    if math.isfinite(pixels.pattern.errors[0]):
        yield f"fixed pattern: {pixels.pattern.words()}"
    zero = f"zero point {light.zero_point_mag:.2f} mag, colour term {light.colour_term:+.3f} (B-V)"
    for plane, term in light.colour_terms.items():
        zero += f", {plane} {term:+.3f}"
    yield f"light: {zero}; {_tone(session)}"


def _tone(session: Session) -> str:
    """Whether DN go as light, in words."""
    power = session.power
    light = session.light
    if power != 1.0:
        return (
            f"a tone curve: DN go as light to the power {power:.3f} (gamma {1 / power:.2f}); other"
            " figures are without it"
        )
    sigma = light.sigma["linearity"]
    tone_text = f"DN go as light to the power {light.linearity:.3f} +- {sigma:.3f}"
    if light.is_linear:
        return f"{tone_text}: no tone curve"
    return f"{tone_text}: a tone curve that is no power, which stays in all figures"


def _beyond(verdict: Verdict) -> Iterator[str]:
    """What the unexplained sources may be: stars that no catalogue here has."""
    fainter = verdict.fainter
    if verdict.unexplained and fainter.expected >= 1:
        yield (
            f"{len(verdict.unexplained)} sources unexplained; about {fainter.expected:.0f} stars"
            " fainter than the catalogue's limit are to be expected: it is complete to V ="
            f" {fainter.complete_v_mag:.1f}, the image reaches {fainter.reached_v_mag:.1f}"
        )


def _dated(verdict: Verdict) -> Iterator[str]:
    """What the stars' own motions say of the date."""
    dated = verdict.dated
    if dated is None or verdict.shot.photo.t_ns is None:
        return
    if abs(dated.years) > max(5 * dated.sigma, 1.0):
        yield (
            f"its date is off: its stars stand {dated.years:+.1f} +- {dated.sigma:.1f} years"
            " from it"
        )
    elif dated.sigma > UNSURE_YEARS:
        yield f"no star in it is fast enough to check its year (+- {dated.sigma:.0f} years)"


def failures_of(verdicts: Sequence[Verdict]) -> list[str]:
    """What is beyond the limits of --strict."""
    failures = []
    for verdict in verdicts:
        name = verdict.shot.photo.name
        failures += [f"{name}: {failure}" for failure in _failures(verdict)]
    return failures


def _failures(verdict: Verdict) -> Iterator[str]:
    """What of one photograph is beyond the limits."""
    if verdict.counted < MIN_STARS_JUDGED:
        yield f"{verdict.counted} clean stars to V = 6.5 are too few to judge by"
    if verdict.rms_px > MAX_RMS_PX:
        yield f"places are {verdict.rms_px:.3f} px rms off, over {MAX_RMS_PX:g}"
    if verdict.rms_mag > MAX_RMS_MAG:
        yield f"light is {verdict.rms_mag:.3f} mag rms off, over {MAX_RMS_MAG:g}"
    lowest, highest = CHI2
    chi2 = verdict.background_chi2
    if not lowest <= chi2 <= highest:
        yield f"background chi2 {chi2:.2f} is outside {lowest:g} to {highest:g}"
    yield from verdict.dim
