"""What a confrontation found: its figures for --json, its verdicts in words, and what is beyond
the limits of --strict.
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
from hilstar.instruments.confront.light import LINEAR_OFF, LINEAR_SIGMAS
from hilstar.instruments.confront.session import Session

MAX_RMS_PX, MAX_RMS_MAG, CHI2 = 0.15, 0.2, (0.8, 1.25)  # with --strict, of each photograph
MIN_STARS_JUDGED = 5
UNSURE_YEARS = 2.0


@dataclass(frozen=True, slots=True)
class Confronted:
    """What came of it: the session, a verdict of each photograph, the split of the scatter, and
    lines of words.
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
        camera = self.session.camera
        session = self.session
        lens = camera.camera.lens
        k1, k2, _ = lens.radial if lens else (0.0, 0.0, 0.0)
        p1, p2 = lens.tangential if lens else (0.0, 0.0)
        sigma = camera.sigma
        focal = camera.camera.focal_length_px
        light = session.light
        pixels = session.pixels
        return {
            "images": [_image_figures(session, verdict) for verdict in self.verdicts],
            "camera": {
                "focal_length_px": focal,
                "principal_point_px": list(camera.camera.principal_point_px),
                "distortion": {"k1": k1, "k2": k2, "p1": p1, "p2": p2},
                "model": camera.model,
                "held_out_px": camera.held_out_px,
                "psf_fwhm_px": float(np.median(_fwhms(session))),
                "gain_e_per_dn": pixels.gain_e_per_dn,
                "read_noise_e": pixels.read_noise_e,
                "pedestal_dn": pixels.pedestal_dn,
                "saturation_dn": session.shots[0].photo.full_dn,
                "zero_point_mag": _number(light.zero_point_mag),
                "colour_term": _number(light.colour_term),
                "colour_terms": light.colour_terms,
                "vignetting_mag": list(light.vignetting_mag),
                "extinction_mag_per_air_mass": extinction_of(session),
                "linearity_power": (
                    session.power * light.linearity if session.power != 1.0 else light.linearity
                ),
                "tone_curve": session.power != 1.0,
                "fixed_pattern": (
                    None
                    if not math.isfinite(pixels.pattern.errors[0])
                    else dict(zip(KINDS, pixels.pattern.rms, strict=True))
                ),
                "hot_pixels": self.defects[0],
                "dead_pixels": self.defects[1],
                "sigma": (
                    {
                        "focal_length_px": (
                            focal * sigma["log_focal"] if "log_focal" in sigma else None
                        )
                    }
                    | {"principal_point_px": [sigma.get("centre_x"), sigma.get("centre_y")]}
                    | {name: sigma[name] for name in ("k1", "k2", "p1", "p2") if name in sigma}
                    | {name: _number(value) for name, value in (light.sigma | pixels.sigma).items()}
                ),
            },
            "excess": (
                None
                if self.excess is None
                else {
                    "stars": self.excess.stars,
                    "rms_px": self.excess.rms_px,
                    "rms_mag": self.excess.rms_mag,
                    "light_mag": {
                        light_part.name: _number(light_part.rms) for light_part in self.excess.light
                    },
                    "places_px": {
                        light_part.name: _number(light_part.rms)
                        for light_part in self.excess.places
                    },
                }
            ),
            "fixed": session.fixed,
            "passed": not self.failures,
            "failures": list(self.failures),
            "notes": list(self.notes),
            "written": list(self.written),
        }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _image_figures(session: Session, verdict: Verdict) -> dict[str, Any]:
    pointing = session.camera.pointings[verdict.number]
    return {
        "file": verdict.shot.photo.name,
        "q_icrs_to_cam": [float(v) for v in pointing.q_icrs_to_cam],
        "stars": verdict.counted,
        "stars_seen": sum("missing" not in row.flags for row in verdict.stars),
        "rms_px": _number(verdict.rms_px),
        "rms_mag": _number(verdict.rms_mag),
        "background_chi2": _number(verdict.background_chi2),
        "star_chi2": _number(verdict.star_chi2),
        "unexplained": len(verdict.unexplained),
        "missing": len(verdict.missing),
        "fainter_than_catalogue": {
            "complete_v_mag": verdict.fainter.complete_v_mag,
            "reached_v_mag": _number(verdict.fainter.reached_v_mag),
            "expected": verdict.fainter.expected,
        },
        "dim": verdict.dim,
        "offset_mag": float(session.light.offsets_mag[verdict.number]),
        "altitude_deg": pointing.altitude_deg,
        "air_mass": session.light.masses[verdict.number],
        "sky_v_mag_arcsec2": sky_v_mag(session, verdict.number),
        "date_off_years": None if verdict.dated is None else verdict.dated.years,
        "date_sigma_years": None if verdict.dated is None else verdict.dated.sigma,
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
    dn = float(np.median(session.shots[number].level.level)) - pixels.pedestal_dn
    if dn <= 0:
        return None
    zero = session.sky_mag() + float(session.light.offsets_mag[number])
    return -2.5 * math.log10(dn * (camera.focal_length_px / ARCSEC_PER_RAD) ** 2) - zero


def _fwhms(session: Session) -> FloatArray:
    width, height = session.camera.camera.resolution_px
    x, y = (
        part.ravel()
        for part in np.meshgrid(np.linspace(0, width - 1, 5), np.linspace(0, height - 1, 5))
    )
    return session.psf.fwhm_px(x, y)


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
    camera = session.camera
    light = session.light
    pixels = session.pixels
    lens = camera.camera.lens
    lines = [
        (
            f"lens: {camera.camera.focal_length_px:.2f} px of focal length, k1 ="
            f" {lens.radial[0] if lens else 0:.4f} ({camera.model})"
        ),
        (
            f"PSF: {np.median(_fwhms(session)):.2f} px full width at half maximum, pixel included,"
            f" {np.min(_fwhms(session)):.2f} to {np.max(_fwhms(session)):.2f} px over the field"
        ),
        (
            f"detector: {pixels.gain_words}, {pixels.gain_e_per_dn * pixels.step_dn:.3g} a step of"
            f" {pixels.step_dn:.3g} DN, read noise {pixels.read_noise_e:.2f} e-, pedestal"
            f" {pixels.pedestal_dn:.0f} DN"
        ),
    ]
    if math.isfinite(pixels.pattern.errors[0]) and not session.fixed:
        lines.append(f"fixed pattern: {pixels.pattern.words()}")
    if not session.fixed:
        zero = (
            f"zero point {light.zero_point_mag:.2f} mag, colour term {light.colour_term:+.3f} (B-V)"
        )
        zero += "".join(f", {plane} {term:+.3f}" for plane, term in light.colour_terms.items())
        lines.append(f"light: {zero}; {_tone(session)}")
    if session.fixed:
        lines.append(
            "air: "
            + ", ".join(f"{v:+.2f}" for v in light.offsets_mag - light.offsets_mag.min())
            + " mag dimmer than the clearest"
        )
    extinction = extinction_of(session)
    if extinction is not None:
        sigma = next(value for name, value in light.sigma.items() if name.startswith("extinction"))
        masses = [air_mass for air_mass in light.masses if air_mass is not None]
        lines.append(
            f"extinction: {extinction:.3f} +- {sigma:.3f} mag an air mass, over {min(masses):.2f}"
            f" to {max(masses):.2f} of them"
        )
    skies = [v for k in range(len(session.shots)) if (v := sky_v_mag(session, k)) is not None]
    if skies:
        lines.append(
            f"sky: V {min(skies):.2f} to {max(skies):.2f} mag/arcsec2, if its spectrum is that of"
            " [site] sky_spectrum"
        )
    if defects[0] or defects[1]:
        lines.append(f"pixels: {defects[0]} hot and {defects[1]} dead, in most of the photographs")
    for verdict in verdicts:
        lines += [
            f"{verdict.shot.photo.name}: {line}"
            for line in (*verdict.dim, *_beyond(verdict), *_dated(verdict))
        ]
    if excess is not None:
        lines.append(
            f"scatter of {excess.stars} stars: {excess.rms_px:.3f} px an axis,"
            f" {excess.rms_mag:.3f} mag"
        )
    return lines


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
    bent = abs(light.linearity - 1) > max(LINEAR_OFF, LINEAR_SIGMAS * sigma)
    if bent:
        return f"{tone_text}: a tone curve that is no power, which stays in all figures"
    return f"{tone_text}: no tone curve"


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
        if verdict.counted < MIN_STARS_JUDGED:
            failures.append(
                f"{name}: {verdict.counted} clean stars to V = 6.5 are too few to judge by"
            )
        for what, value, limit, unit in (
            ("places", verdict.rms_px, MAX_RMS_PX, "px"),
            ("light", verdict.rms_mag, MAX_RMS_MAG, "mag"),
        ):
            if value > limit:
                failures.append(f"{name}: {what} are {value:.3f} {unit} rms off, over {limit:g}")
        if not CHI2[0] <= verdict.background_chi2 <= CHI2[1]:
            failures.append(
                f"{name}: background chi2 {verdict.background_chi2:.2f} is outside {CHI2[0]:g} to"
                f" {CHI2[1]:g}"
            )
        failures += [f"{name}: {line}" for line in verdict.dim]
    return failures
