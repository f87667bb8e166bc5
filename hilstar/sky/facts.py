"""What a catalogue knows of its stars beside place, V and colours: errors, origins, spectral types.

Hipparcos' facts are a file of their own, read when somebody first asks. Errors of place and motion
are carried to an epoch.
"""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.sky.catalog import HIPPARCOS_EPOCH_JYEAR, PACKAGED_CATALOG, Catalog
from hilstar.sky.stars import RAD_PER_MAS

PACKAGED_FACTS = Path(__file__).resolve().parent / "data" / "hipparcos_facts.npz"

MOTION = ("ra", "dec", "pm_ra", "pm_dec")  # the parameters whose errors are carried to an epoch
SIGMAS = ("sigma_ra_mas", "sigma_dec_mas", "sigma_pm_ra_mas_yr", "sigma_pm_dec_mas_yr")  # theirs
# Columns of hip_main.dat (CDS I/239 ReadMe): name -> (column counted from 0, steps per unit, stored
# as).
STEP_FACTS: dict[str, tuple[int, int, str]] = {
    "sigma_ra_mas": (14, 100, "i2"),
    "sigma_dec_mas": (15, 100, "i2"),
    "sigma_parallax_mas": (16, 100, "i2"),
    "sigma_pm_ra_mas_yr": (17, 100, "i2"),
    "sigma_pm_dec_mas_yr": (18, 100, "i2"),
    "ra_dec_correlation": (19, 100, "i1"),
    "ra_pm_ra_correlation": (22, 100, "i1"),
    "dec_pm_ra_correlation": (23, 100, "i1"),
    "ra_pm_dec_correlation": (25, 100, "i1"),
    "dec_pm_dec_correlation": (26, 100, "i1"),
    "pm_ra_pm_dec_correlation": (28, 100, "i1"),
    "sigma_measured_mag": (45, 10_000, "i2"),
    "sigma_bv_mag": (38, 1000, "i2"),
    "sigma_vi_mag": (41, 100, "i2"),
    "difference_hp_mag": (66, 100, "i2"),
}
# Fields of one letter: where V, B-V, V-I and the spectral type are from.
LETTER_FACTS = {"v_source": 7, "bv_source": 39, "vi_source": 42, "spectral_type_source": 77}
# Scatter of V about Hp by colour, of single constant stars, measured over the catalogue: V from Hp
# (H), from the ground (G) for B-V under 1 and above; V from Tycho's VT (T) as the ground's.
# A user's table (U) gives the error of V itself.
V_SCATTER_MAG = {b"H": (0.004, 0.004), b"G": (0.010, 0.025), b"T": (0.010, 0.025), b"U": (0.0, 0.0)}
RED_BV_MAG = 1.0
STEP = 1e-30  # complex-step derivatives: exact to rounding


@cache
def _packaged() -> dict[str, npt.NDArray[Any]]:
    """The facts in their units, by the rows of the packaged catalogue, and its `hip`; unknown
    figures NaN.
    """
    with np.load(PACKAGED_CATALOG) as catalog, np.load(PACKAGED_FACTS) as packed:
        facts: dict[str, npt.NDArray[Any]] = {"hip": catalog["hip"]}
        for name, (_, per_unit, _) in STEP_FACTS.items():
            steps = packed[name]
            facts[name] = np.where(steps == np.iinfo(steps.dtype).min, np.nan, steps / per_unit)
        for name in LETTER_FACTS:
            facts[name] = packed[name].view("S1")
        facts["spectral_type"] = packed["spectral_types"][packed["spectral_type"]]
    return facts


@cache
def _by_hip() -> npt.NDArray[np.intp]:
    """The rows of the packaged catalogue in the order of their HIP numbers."""
    return np.argsort(_packaged()["hip"])


def facts_of(hip: npt.NDArray[np.int32]) -> dict[str, npt.NDArray[Any]]:
    """Hipparcos' facts of stars (n,) by their HIP numbers: NaN and empty text for those that it
    does not have.
    """
    facts = _packaged()
    order = _by_hip()
    place = np.searchsorted(facts["hip"], hip, sorter=order)
    place = np.minimum(place, len(order) - 1)
    row = order[place]
    has_row = facts["hip"][row] == hip
    facts_by_name: dict[str, npt.NDArray[Any]] = {}
    for name, values in facts.items():
        if name == "hip":
            continue
        unknown = np.nan if values.dtype.kind == "f" else b""
        facts_by_name[name] = np.where(has_row, values[row], unknown)
    return facts_by_name


def errors_of(catalog: Catalog) -> dict[str, npt.NDArray[Any]]:
    """Hipparcos' facts of a catalogue's stars (n,). Their standard errors are those of Hipparcos'
    own figures: NaN for the stars of a table, whose figures are not Hipparcos'.
    """
    facts = facts_of(catalog.hip)
    has_epoch = catalog.epoch_jyear == HIPPARCOS_EPOCH_JYEAR
    is_hipparcos = (catalog.identifier == catalog.hip) & has_epoch
    for name in STEP_FACTS:
        if name.startswith("sigma_"):
            facts[name] = np.where(is_hipparcos, facts[name], np.nan)
    return facts


class PropagatedPlaces(NamedTuple):
    """Places and proper motions at an epoch, (n,), and the covariance (n, 4, 4) of MOTION's
    parameters, mas and mas a year.

    Places are degrees, ICRS, right ascensions 0 to 360, whose errors and motions carry the
    cos(dec).
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    pm_ra_mas_yr: FloatArray
    pm_dec_mas_yr: FloatArray
    covariance: FloatArray


def motion_at(
    catalog: Catalog, facts: dict[str, npt.NDArray[Any]], epoch_jyear: float
) -> PropagatedPlaces:
    """The stars' places, motions and their errors at `epoch_jyear`; radial velocity zero (ESA
    SP-1200 vol. 1, 1.5.5).

    The Jacobian is that of the straight line in space itself, by complex steps. NaN errors where
    none are known.
    """
    years = epoch_jyear - catalog.epoch_jyear
    start = np.stack(
        (
            np.radians(catalog.ra_deg),
            np.radians(catalog.dec_deg),
            catalog.pm_ra_cosdec_mas_yr * RAD_PER_MAS,
            catalog.pm_dec_mas_yr * RAD_PER_MAS,
        )
    ).astype(np.complex128)
    cos_dec = np.cos(start[1].real)
    u, pm_ra, pm_dec = _moved(start, years)
    x, y, z = u.real
    flat = np.hypot(x, y)
    jacobian = np.empty((len(catalog), 4, 4))
    for k in range(4):
        varied = start.copy()
        if k == 0:
            varied[k] += 1j * STEP / cos_dec  # RA: its error is given times cos Dec
        else:
            varied[k] += 1j * STEP
        varied_u, varied_pm_ra, varied_pm_dec = _moved(varied, years)
        dx, dy, dz = varied_u.imag / STEP
        jacobian[:, 0, k] = (x * dy - y * dx) / flat
        jacobian[:, 1, k] = flat * dz - z * (x * dx + y * dy) / flat
        jacobian[:, 2, k] = varied_pm_ra.imag / STEP
        jacobian[:, 3, k] = varied_pm_dec.imag / STEP
    return PropagatedPlaces(
        ra_deg=np.degrees(np.arctan2(y, x)) % 360.0,
        dec_deg=np.degrees(np.arctan2(z, flat)),
        pm_ra_mas_yr=pm_ra.real / RAD_PER_MAS,
        pm_dec_mas_yr=pm_dec.real / RAD_PER_MAS,
        covariance=jacobian @ _covariance(facts) @ jacobian.transpose(0, 2, 1),
    )


def _moved(
    start: npt.NDArray[np.complex128], years: FloatArray
) -> tuple[npt.NDArray[np.complex128], ...]:
    """The unit vector (3, n) and the proper motions (n,) after `years`, of ra, dec and motions
    (4, n), radians.
    """
    ra, dec, east, north = start
    sin_ra = np.sin(ra)
    cos_ra = np.cos(ra)
    sin_dec = np.sin(dec)
    cos_dec = np.cos(dec)
    u0 = np.stack((cos_dec * cos_ra, cos_dec * sin_ra, sin_dec))
    motion_x = -east * sin_ra - north * sin_dec * cos_ra
    motion_y = east * cos_ra - north * sin_dec * sin_ra
    motion = np.stack((motion_x, motion_y, north * cos_dec))
    squared = east**2 + north**2
    shrink = 1 / np.sqrt(1 + squared * years**2)
    u = (u0 + motion * years) * shrink
    motion = (motion - u0 * squared * years) * shrink**3
    x, y, _ = u
    along_x, along_y, along_z = motion
    flat = np.sqrt(x**2 + y**2)
    return u, (x * along_y - y * along_x) / flat, along_z / flat


def _covariance(facts: dict[str, npt.NDArray[Any]]) -> FloatArray:
    """The covariance (n, 4, 4) of the catalogue's own epoch."""
    sigma = np.stack([facts[name] for name in SIGMAS])
    covariance = np.empty((sigma.shape[1], 4, 4))
    for i, quantity in enumerate(MOTION):
        covariance[:, i, i] = sigma[i] ** 2
        for j in range(i + 1, 4):
            correlation = facts[f"{quantity}_{MOTION[j]}_correlation"]
            both = sigma[i] * sigma[j] * correlation
            covariance[:, i, j] = both
            covariance[:, j, i] = both
    return covariance


def sigma_v_mag(facts: dict[str, npt.NDArray[Any]], bv_mag: FloatArray) -> FloatArray:
    """The error of V (n,), magnitudes: that of the measured Hp or VT and the scatter of V about
    it; NaN where unknown.
    """
    scatter = np.full(len(bv_mag), np.nan)
    for source, (blue, red) in V_SCATTER_MAG.items():
        chosen = facts["v_source"] == source
        scatter[chosen] = np.where(bv_mag[chosen] < RED_BV_MAG, blue, red)
    measured_mag = facts["sigma_measured_mag"]
    return np.asarray(np.hypot(measured_mag, scatter), dtype=np.float64)
