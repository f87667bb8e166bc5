"""What the scatter of stars about the prediction is made of, each part with how it was told apart
from the others.

Parts of the detector and of colour are fitted to residuals, and what as many random columns would
take is taken off again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.confront.judge import StarRow, Verdict
from hilstar.instruments.confront.light import MAG
from hilstar.instruments.confront.session import Session
from hilstar.instruments.confront.star_psf import HALF, field_terms
from hilstar.sky.air import scintillation as young

MIN_STARS = 12
FWHM = 2.3548
LAW = "scintillation by law"


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the scatter: rms in the whole's unit, NaN where it is not known, and how it was
    told.
    """

    name: str
    rms: float
    how: str


@dataclass(frozen=True, slots=True)
class Excess:
    """The scatter of clean stars to V = 6.5 in all photographs, mag and px an axis, and what it
    is made of.
    """

    rms_mag: float
    rms_px: float
    stars: int
    light: tuple[Part, ...]
    places: tuple[Part, ...]


def split_excess(session: Session, verdicts: Sequence[Verdict]) -> Excess | None:
    """The parts of the scatter; None with fewer than MIN_STARS stars."""
    every = [
        (v, row) for v in verdicts for row in v.stars if row.counted and math.isfinite(row.off_mag)
    ]
    if len(every) < MIN_STARS:
        return None
    rows = [row for _, row in every]
    x, y, off_mag = (
        np.array([getattr(row, name) for row in rows]) for name in ("x_px", "y_px", "off_mag")
    )
    off = np.array([(row.x_px - row.x_predicted_px, row.y_px - row.y_predicted_px) for row in rows])
    bv = np.nan_to_num(np.array([row.b_v_mag for row in rows]))
    size = session.shots[0].photo.size_px
    phase = 2 * np.pi * np.column_stack([x, y])
    phases = np.column_stack([np.cos(phase), np.sin(phase)])
    terms = field_terms(x, y, size)[:, 2:]
    light = _light(session, every, off_mag, bv, phases, terms)
    radial = np.column_stack([x, y]) - np.array(session.camera.camera.principal_point_px)
    lateral = (bv - bv.mean())[:, None] * radial / math.hypot(*size)
    columns = [np.column_stack([lateral[:, k], (bv - bv.mean())]) for k in (0, 1)]
    noise = np.concatenate([shot_sigma(v, row) for v, row in every])
    whole = _ms(off.ravel())
    parts = [
        Part(
            "photon and background noise",
            math.sqrt(_ms(noise)),
            "the fit's own errors, by the detector's gain and noise",
        ),
        Part(
            "place within the pixel",
            math.sqrt(sum(_taken(phases, off[:, k]) for k in (0, 1)) / 2),
            "what repeats with the place in the pixel: the model of the PSF, and the pixel's own"
            " response",
        ),
        Part("pixel response", _response(session)[1], "as in the light: it moves a star's centre"),
        Part(
            "colour",
            math.sqrt(sum(_taken(columns[k], off[:, k]) for k in (0, 1)) / 2),
            "what goes with B-V and with B-V times the radius: lateral colour, the air's"
            " dispersion",
        ),
    ]
    places = (*parts, _rest(whole, parts))
    return Excess(math.sqrt(_ms(off_mag)), math.sqrt(whole), len(rows), light, places)


def shot_sigma(verdict: Verdict, row: StarRow) -> FloatArray:
    """One sigma of a star's place, px, (1,)."""
    shot = verdict.shot
    return np.asarray(shot.found.sigma_px[shot.star == row.star][:1])


def _light(
    session: Session,
    every: Sequence[tuple[Verdict, StarRow]],
    off_mag: FloatArray,
    bv: FloatArray,
    phases: FloatArray,
    terms: FloatArray,
) -> tuple[Part, ...]:
    rows = [row for _, row in every]
    noise = np.array([MAG * row.sigma_dn / row.dn for row in rows])
    sigma_v = np.array([v.shot.sky.within(np.array([row.star]))[0][0] for v, row in every])
    known = np.array(["variable" in row.flags or "double" in row.flags for row in rows])
    if (~known).sum() >= MIN_STARS:
        steady = _ms(off_mag[~known])
    else:
        steady = _ms(off_mag)
    parts = [
        Part(
            "photon and background noise",
            math.sqrt(_ms(noise)),
            "the fit's own errors, by the detector's gain and noise",
        ),
        Part("catalogue: V's own error", math.sqrt(_ms(sigma_v)), "Hipparcos' errors of V"),
        Part(
            "catalogue: variables and doubles",
            math.sqrt(max(_ms(off_mag) - steady, 0.0)),
            f"the scatter with {int(known.sum())} known variables and doubles less that without",
        ),
        Part(
            "colour",
            math.sqrt(_taken(np.column_stack([bv, bv**2]), off_mag)),
            "what goes with B-V: the tracker's curve",
        ),
        _blends(session, every),
        Part(
            "pixel response",
            MAG * _response(session)[0],
            "the pixels' response, by products of photographs of different skies, over the pixels"
            " that a star lies on",
        ),
        Part(
            "flat field",
            math.sqrt(_taken(terms, off_mag)),
            "what slopes over the field beyond the vignetting in the radius",
        ),
        Part(
            "place within the pixel",
            math.sqrt(_taken(phases, off_mag)),
            "what repeats with the place in the pixel",
        ),
        _scintillation(session, every, off_mag, noise),
    ]
    return (*parts, _rest(_ms(off_mag), parts))


def _blends(session: Session, every: Sequence[tuple[Verdict, StarRow]]) -> Part:
    """The light of other stars of the catalogue that a star's own profile takes up."""
    sigma2 = (
        float(
            np.median(session.psf.fwhm_px(*np.array([[row.x_px, row.y_px] for _, row in every]).T))
        )
        / FWHM
    ) ** 2
    off = []
    for verdict, row in every:
        all_of = verdict.expected
        away2 = (all_of.x_px - row.x_predicted_px) ** 2 + (all_of.y_px - row.y_predicted_px) ** 2
        taken = all_of.dn * np.exp(-away2 / (4 * sigma2)) * (all_of.star != row.star)
        off.append(MAG * float(taken.sum()) / row.dn_predicted)
    spread = np.array(off) - np.mean(off)
    return Part(
        "catalogue: blends",
        math.sqrt(_ms(spread)),
        "light of the catalogue's other stars within a star's profile",
    )


def _response(session: Session) -> tuple[float, float]:
    """What the pixels' response leaves of a bright star: a share of its light, and px an axis of
    its place.
    """
    (x, y), reach = np.array(session.psf.size_px) / 2, np.arange(-HALF, HALF + 1.0)[None]
    middle = np.array([x]), np.array([y]), np.array([np.nan])
    light = session.psf.on_pixels(reach, reach, session.psf.core(*middle))[0][0]
    response = session.pixels.pattern.rms[0]
    return response * math.sqrt(float((light**2).sum())), response * math.sqrt(
        float(((light * reach) ** 2).sum())
    )


def _scintillation(
    session: Session,
    every: Sequence[tuple[Verdict, StarRow]],
    off_mag: FloatArray,
    noise: FloatArray,
) -> Part:
    """What changes from one photograph of a star to another beyond noise; with no star twice,
    Young's law.
    """
    star = np.unique([row.star for _, row in every], return_inverse=True)[1]
    sightings = np.bincount(star)[star]
    twice = sightings > 1
    free = int(twice.sum()) - len(np.unique(star[twice]))
    if free >= MIN_STARS:
        mean = np.bincount(star, off_mag) / np.bincount(star)
        changed = float(((off_mag - mean[star])[twice] ** 2).sum()) / free - float(
            (noise[twice] ** 2).mean()
        )
        how = f"what changes between photographs of a star beyond noise, by {free} stars seen again"
        return Part("scintillation", math.sqrt(max(changed, 0.0)), how)
    tracker = session.file.config.tracker
    masses = [air_mass for air_mass in session.light.masses if air_mass is not None]
    if not masses or tracker.exposure_s <= 0:
        return Part(
            LAW,
            math.nan,
            "not known: no star is in two photographs, and no air mass, as refraction was not"
            " fitted",
        )
    mass = float(np.mean(masses))
    site = session.file.config.site
    height_m = 0.0 if site is None else site.height_m
    sigma = float(young(tracker.aperture_mm, np.array([mass]), height_m, tracker.exposure_s)[0])
    how = (
        f"Young's law at {height_m:g} m: air mass {mass:.2f}, {tracker.aperture_mm:g} mm and"
        f" {tracker.exposure_s:g} s"
    )
    return Part(
        LAW,
        MAG * sigma,
        f"{how}; not measured, as no star is in two photographs: it is in what is unexplained",
    )


def _rest(whole: float, parts: Sequence[Part]) -> Part:
    measured = [part for part in parts if math.isfinite(part.rms) and part.name != LAW]
    rest = whole - math.fsum(part.rms**2 for part in measured)
    return Part("unexplained", math.sqrt(max(rest, 0.0)), "what is left of the squares")


def _ms(values: FloatArray) -> float:
    return float((values**2).mean()) if len(values) else 0.0


def _taken(columns: FloatArray, off: FloatArray) -> float:
    """The mean square that columns take of residuals, less what as many random ones would."""
    count = columns.shape[1]
    design = columns - columns.mean(axis=0)
    model = design @ np.linalg.lstsq(design, off - off.mean(), rcond=None)[0]
    rest = _ms(off - off.mean() - model)
    return float(max(_ms(model) - rest * count / max(len(off) - count, 1), 0.0))
