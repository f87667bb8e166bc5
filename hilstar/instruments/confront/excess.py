"""What the scatter of stars about the prediction is made of: its parts, and how each was told apart
from the others.

Parts of the detector and of colour are fitted to residuals by columns that they would follow. As
many random columns would take a share, too, which is taken off again.
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
BY_FIT = "the fit's own errors, by the detector's gain and noise"


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the scatter: rms in the whole's unit (mag or px), NaN where it is not known, and
    how it was told apart.
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


@dataclass(frozen=True, slots=True)
class _Sightings:
    """Stars (n,) that count, each with its photograph's verdict: places, px, how far off they are,
    px (n, 2) and mag, and B-V.
    """

    verdicts: list[Verdict]
    rows: list[StarRow]

    @classmethod
    def of(cls, verdicts: Sequence[Verdict]) -> "_Sightings":
        """Those that count of all verdicts."""
        sightings = cls([], [])
        for verdict in verdicts:
            for row in verdict.stars:
                if row.counted and math.isfinite(row.off_mag):
                    sightings.verdicts.append(verdict)
                    sightings.rows.append(row)
        return sightings

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def places_px(self) -> FloatArray:
        """Places seen (n, 2), px."""
        return np.array([(row.x_px, row.y_px) for row in self.rows])

    @property
    def off_px(self) -> FloatArray:
        """Places seen less predicted (n, 2), px."""
        return np.array([row.off_px for row in self.rows])

    @property
    def off_mag(self) -> FloatArray:
        """Magnitudes seen less predicted (n,)."""
        return np.array([row.off_mag for row in self.rows])

    @property
    def bv_mag(self) -> FloatArray:
        """B-V (n,), 0 where it is not known."""
        return np.asarray(np.nan_to_num([row.b_v_mag for row in self.rows]))

    @property
    def phases(self) -> FloatArray:
        """Cosines and sines (n, 4) of the place within the pixel, a turn a pixel."""
        phase_rad = 2 * np.pi * self.places_px
        return np.column_stack([np.cos(phase_rad), np.sin(phase_rad)])


def split_excess(session: Session, verdicts: Sequence[Verdict]) -> Excess | None:
    """The parts of the scatter; None with fewer than MIN_STARS stars."""
    sightings = _Sightings.of(verdicts)
    if len(sightings) < MIN_STARS:
        return None
    return Excess(
        rms_mag=_rms(sightings.off_mag),
        rms_px=_rms(sightings.off_px.ravel()),
        stars=len(sightings),
        light=_light(session, sightings),
        places=_places(session, sightings),
    )


def shot_sigma(verdict: Verdict, row: StarRow) -> FloatArray:
    """One sigma of a star's place, px, (1,)."""
    shot = verdict.shot
    return np.asarray(shot.found.sigma_px[shot.star == row.star][:1])


def _places(session: Session, sightings: _Sightings) -> tuple[Part, ...]:
    """The parts of the scatter of places, px an axis."""
    sigmas = []
    for verdict, row in zip(sightings.verdicts, sightings.rows, strict=True):
        sigmas.append(shot_sigma(verdict, row))
    off_px = sightings.off_px
    phases = sightings.phases
    phase_ms = sum(_taken(phases, off_px[:, axis]) for axis in (0, 1)) / 2
    parts = [
        Part("photon and background noise", _rms(np.concatenate(sigmas)), BY_FIT),
        Part(
            "place within the pixel",
            math.sqrt(phase_ms),
            "what repeats with the place in the pixel: the model of the PSF, and the pixel's own"
            " response",
        ),
        Part("pixel response", _response(session)[1], "as in the light: it moves a star's centre"),
        Part(
            "colour",
            math.sqrt(_colour_ms(session, sightings)),
            "what goes with B-V and with B-V times the radius: lateral colour, the air's"
            " dispersion",
        ),
    ]
    return (*parts, _rest(_ms(off_px.ravel()), parts))


def _colour_ms(session: Session, sightings: _Sightings) -> float:
    """The mean square an axis, px^2, that colour takes of places' residuals."""
    size_px = session.shots[0].photo.size_px
    radial_px = sightings.places_px - np.array(session.camera.camera.principal_point_px)
    bv_mag = sightings.bv_mag
    colour = bv_mag - bv_mag.mean()
    lateral = colour[:, None] * radial_px / math.hypot(*size_px)
    off_px = sightings.off_px
    squares = []
    for axis in (0, 1):
        columns = np.column_stack([lateral[:, axis], colour])
        squares.append(_taken(columns, off_px[:, axis]))
    return sum(squares) / 2


def _light(session: Session, sightings: _Sightings) -> tuple[Part, ...]:
    """The parts of the scatter of light, mag."""
    noise_mag = np.array([MAG * row.sigma_dn / row.dn for row in sightings.rows])
    off_mag = sightings.off_mag
    bv_mag = sightings.bv_mag
    x_px, y_px = sightings.places_px.T
    slopes = field_terms(x_px, y_px, session.shots[0].photo.size_px)[:, 2:]
    response, _ = _response(session)
    parts = [
        Part("photon and background noise", _rms(noise_mag), BY_FIT),
        Part("catalogue: V's own error", _rms(_v_errors(sightings)), "Hipparcos' errors of V"),
        _variables(sightings),
        Part(
            "colour",
            math.sqrt(_taken(np.column_stack([bv_mag, bv_mag**2]), off_mag)),
            "what goes with B-V: the tracker's curve",
        ),
        _blends(session, sightings),
        Part(
            "pixel response",
            MAG * response,
            "the pixels' response, by products of photographs of different skies, over the pixels"
            " that a star lies on",
        ),
        Part(
            "flat field",
            math.sqrt(_taken(slopes, off_mag)),
            "what slopes over the field beyond the vignetting in the radius",
        ),
        Part(
            "place within the pixel",
            math.sqrt(_taken(sightings.phases, off_mag)),
            "what repeats with the place in the pixel",
        ),
        _scintillation(session, sightings, noise_mag),
    ]
    return (*parts, _rest(_ms(off_mag), parts))


def _v_errors(sightings: _Sightings) -> FloatArray:
    """The catalogue's errors of V (n,), mag."""
    errors_mag = []
    for verdict, row in zip(sightings.verdicts, sightings.rows, strict=True):
        sigma_mag, _, _ = verdict.shot.sky.within(np.array([row.star]))
        errors_mag.append(sigma_mag[0])
    return np.array(errors_mag)


def _variables(sightings: _Sightings) -> Part:
    """By how much known variables and doubles widen the scatter."""
    off_mag = sightings.off_mag
    is_known = []
    for row in sightings.rows:
        is_known.append("variable" in row.flags or "double" in row.flags)
    known = np.array(is_known)
    steady = off_mag
    if (~known).sum() >= MIN_STARS:
        steady = off_mag[~known]
    added = max(_ms(off_mag) - _ms(steady), 0.0)
    return Part(
        "catalogue: variables and doubles",
        math.sqrt(added),
        f"the scatter with {int(known.sum())} known variables and doubles less that without",
    )


def _blends(session: Session, sightings: _Sightings) -> Part:
    """The light of other stars of the catalogue that a star's own profile takes up."""
    x_px, y_px = sightings.places_px.T
    fwhm_px = float(np.median(session.psf.fwhm_px(x_px, y_px)))
    variance_px2 = (fwhm_px / FWHM) ** 2
    added_mag = []
    for verdict, row in zip(sightings.verdicts, sightings.rows, strict=True):
        stars = verdict.expected
        dx_px = stars.x_px - row.x_predicted_px
        dy_px = stars.y_px - row.y_predicted_px
        overlap = np.exp(-(dx_px**2 + dy_px**2) / (4 * variance_px2))
        added_mag.append(MAG * float((stars.dn * overlap).sum()) / row.dn_predicted)
    # the mean of it, and a star's own light, which is the same share of each, is in the zero point
    spread_mag = np.array(added_mag) - np.mean(added_mag)
    return Part(
        "catalogue: blends",
        _rms(spread_mag),
        "light of the catalogue's other stars within a star's profile",
    )


def _response(session: Session) -> tuple[float, float]:
    """What the pixels' response leaves of a bright star: a share of its light, and px an axis of
    its place.
    """
    psf = session.psf
    x_px, y_px = np.array(psf.size_px) / 2
    reach = np.arange(-HALF, HALF + 1.0)[None]
    core = psf.core(np.array([x_px]), np.array([y_px]), np.array([np.nan]))
    share = psf.on_pixels(reach, reach, core)[0][0]
    light = math.sqrt(float((share**2).sum()))
    place_px = math.sqrt(float(((share * reach) ** 2).sum()))
    response = session.pixels.pattern.rms[0]
    return response * light, response * place_px


def _scintillation(session: Session, sightings: _Sightings, noise_mag: FloatArray) -> Part:
    """What changes from one photograph of a star to another beyond noise; with no star twice,
    Young's law.
    """
    off_mag = sightings.off_mag
    star = np.unique([row.star for row in sightings.rows], return_inverse=True)[1]
    counts = np.bincount(star)
    twice = counts[star] > 1
    free = int(twice.sum()) - len(np.unique(star[twice]))
    if free < MIN_STARS:
        return _by_law(session)
    mean_mag = np.bincount(star, off_mag) / counts
    changes_mag = (off_mag - mean_mag[star])[twice]
    noise_ms = float((noise_mag[twice] ** 2).mean())
    excess_ms = float((changes_mag**2).sum()) / free - noise_ms
    how = f"what changes between photographs of a star beyond noise, by {free} stars seen again"
    return Part("scintillation", math.sqrt(max(excess_ms, 0.0)), how)


def _by_law(session: Session) -> Part:
    """Scintillation by Young's law of aperture, exposure and air mass; NaN without an air mass."""
    tracker = session.file.config.tracker
    masses = [air_mass for air_mass in session.light.masses if air_mass is not None]
    exposures_s = [shot.photo.exposure_s for shot in session.shots if shot.photo.exposure_s]
    exposure_s = float(np.mean(exposures_s or [tracker.exposure_s]))
    if not masses or exposure_s <= 0:
        return Part(
            LAW,
            math.nan,
            "not known: no star is in two photographs, and no air mass, as refraction was not"
            " fitted",
        )
    mass = float(np.mean(masses))
    site = session.file.config.site
    height_m = 0.0
    if site is not None:
        height_m = site.height_m
    sigma = young(tracker.aperture_mm, np.array([mass]), height_m, exposure_s)
    how = (
        f"Young's law at {height_m:g} m: air mass {mass:.2f}, {tracker.aperture_mm:g} mm and"
        f" {exposure_s:g} s; not measured, as no star is in two photographs: it is in what"
        " is unexplained"
    )
    return Part(LAW, MAG * float(sigma[0]), how)


def _rest(whole_ms: float, parts: Sequence[Part]) -> Part:
    """What of the whole's mean square is in no part; a law's part is not measured, and stays in
    it.
    """
    squares = []
    for part in parts:
        if math.isfinite(part.rms) and part.name != LAW:
            squares.append(part.rms**2)
    rest = whole_ms - math.fsum(squares)
    return Part("unexplained", math.sqrt(max(rest, 0.0)), "what is left of the squares")


def _ms(values: FloatArray) -> float:
    """The mean square; 0 of no values."""
    if len(values):
        return float((values**2).mean())
    return 0.0


def _rms(values: FloatArray) -> float:
    return math.sqrt(_ms(values))


def _taken(columns: FloatArray, off: FloatArray) -> float:
    """The mean square that columns (n, k) take of residuals (n,), less what as many random ones
    would.
    """
    count = columns.shape[1]
    design = columns - columns.mean(axis=0)
    about_mean = off - off.mean()
    coefficients = np.linalg.lstsq(design, about_mean, rcond=None)[0]
    model = design @ coefficients
    rest = _ms(about_mean - model)
    by_chance = rest * count / max(len(off) - count, 1)
    return float(max(_ms(model) - by_chance, 0.0))
