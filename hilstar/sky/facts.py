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


def facts_of(hip: npt.NDArray[np.int32]) -> dict[str, npt.NDArray[Any]]:
    """Hipparcos' facts of stars (n,) by their HIP numbers: NaN and empty text for those that it
    does not have.
    """
    facts = _packaged()
    order = np.argsort(facts["hip"])
    place = np.minimum(np.searchsorted(facts["hip"], hip, sorter=order), len(order) - 1)
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
    is_hipparcos = (catalog.identifier == catalog.hip) & (
        catalog.epoch_jyear == HIPPARCOS_EPOCH_JYEAR
    )
    errors = [name for name in STEP_FACTS if name.startswith("sigma_")]
    return facts | {name: np.where(is_hipparcos, facts[name], np.nan) for name in errors}


class PropagatedPlaces(NamedTuple):
    """Places and proper motions at an epoch, (n,), and the covariance (n, 4, 4) of MOTION's
    parameters, mas and mas a year.

    Places are degrees, ICRS; right ascensions' errors and motions carry the cos(dec).
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
    )
    u, pm_ra, pm_dec = _moved(start.astype(np.complex128), years)
    x, y, z = u.real
    flat = np.hypot(x, y)
    jacobian = np.empty((len(catalog), 4, 4))
    for k in range(4):
        varied = start.astype(np.complex128)
        if k == 0:
            varied[k] += 1j * STEP / np.cos(start[1])  # RA: its error is given times cos Dec
        else:
            varied[k] += 1j * STEP
        du, d_ra, d_dec = (part.imag / STEP for part in _moved(varied, years))
        jacobian[:, 0, k] = (x * du[1] - y * du[0]) / flat
        jacobian[:, 1, k] = flat * du[2] - z * (x * du[0] + y * du[1]) / flat
        jacobian[:, 2, k], jacobian[:, 3, k] = d_ra, d_dec
    covariance = jacobian @ _covariance(facts) @ jacobian.transpose(0, 2, 1)
    ra_deg = np.degrees(np.arctan2(y, x)) % 360.0
    dec_deg = np.degrees(np.arctan2(z, flat))
    return PropagatedPlaces(
        ra_deg, dec_deg, pm_ra.real / RAD_PER_MAS, pm_dec.real / RAD_PER_MAS, covariance
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
    motion = np.stack(
        (
            -east * sin_ra - north * sin_dec * cos_ra,
            east * cos_ra - north * sin_dec * sin_ra,
            north * cos_dec,
        )
    )
    squared = east**2 + north**2
    shrink = 1 / np.sqrt(1 + squared * years**2)
    u = (u0 + motion * years) * shrink
    motion = (motion - u0 * squared * years) * shrink**3
    flat = np.sqrt(u[0] ** 2 + u[1] ** 2)
    return u, (u[0] * motion[1] - u[1] * motion[0]) / flat, motion[2] / flat


def _covariance(facts: dict[str, npt.NDArray[Any]]) -> FloatArray:
    """The covariance (n, 4, 4) of the catalogue's own epoch."""
    sigma = np.stack(
        [
            facts[name]
            for name in (
                "sigma_ra_mas",
                "sigma_dec_mas",
                "sigma_pm_ra_mas_yr",
                "sigma_pm_dec_mas_yr",
            )
        ]
    )
    covariance = np.empty((sigma.shape[1], 4, 4))
    for i, quantity in enumerate(MOTION):
        covariance[:, i, i] = sigma[i] ** 2
        for j in range(i + 1, 4):
            covariance[:, i, j] = covariance[:, j, i] = (
                sigma[i] * sigma[j] * facts[f"{quantity}_{MOTION[j]}_correlation"]
            )
    return covariance


def sigma_v_mag(facts: dict[str, npt.NDArray[Any]], bv_mag: FloatArray) -> FloatArray:
    """The error of V (n,), magnitudes: that of the measured Hp or VT and the scatter of V about
    it; NaN where unknown.
    """
    scatter = np.full(len(bv_mag), np.nan)
    for source, (blue, red) in V_SCATTER_MAG.items():
        chosen = facts["v_source"] == source
        scatter[chosen] = np.where(bv_mag[chosen] < RED_BV_MAG, blue, red)
    return np.asarray(np.hypot(facts["sigma_measured_mag"], scatter), dtype=np.float64)
