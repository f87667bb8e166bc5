"""Which column of a table is which: the names of Gaia, Tycho-2, Hipparcos and this project, and what their units say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hilstar.errors import InputError, shortened
from hilstar.sky.tables.photometry import ROUTES

# Names in lower case, the first that a table has is taken. A later pair of places fills the rows of an earlier one that are
# blank: Tycho-2 has no mean place for one star in 20.
PLACES = (
    ("ra", "dec"),
    ("ramdeg", "demdeg"),
    ("ra_icrs", "de_icrs"),
    ("raicrs", "deicrs"),
    ("ra_deg", "dec_deg"),
    ("radeg", "dedeg"),
    ("raj2000", "dej2000"),
    ("ra(icrs)", "de(icrs)"),
    ("rarad", "derad"),
    ("ra_icrs_", "de_icrs_"),
    ("_raj2000", "_dej2000"),
)
NAMES: dict[str, tuple[str, ...]] = {
    "pm_ra_cosdec_mas_yr": ("pmra", "pm_ra_cosdec_mas_yr", "pm_ra_cosdec", "pm_ra"),
    "pm_dec_mas_yr": ("pmdec", "pmde", "pm_dec_mas_yr", "pm_dec"),
    "parallax_mas": ("parallax", "plx", "parallax_mas"),
    "epoch_jyear": ("ref_epoch", "epoch_jyear"),
    "v_mag": ("v_mag", "vmag", "v"),
    "b_mag": ("b_mag", "bmag", "b"),
    "bv_mag": ("bv_mag", "b-v", "b_v", "bv"),
    "vi_mag": ("vi_mag", "v-i", "v_i", "vi"),
    "bt_mag": ("btmag", "bt_mag", "bt"),
    "vt_mag": ("vtmag", "vt_mag", "vt"),
    "g_mag": ("phot_g_mean_mag", "gmag", "g"),
    "bp_mag": ("phot_bp_mean_mag", "bpmag"),
    "rp_mag": ("phot_rp_mean_mag", "rpmag"),
    "bp_rp_mag": ("bp_rp", "bp-rp"),
    "gaia": ("source_id", "source"),
    "tyc1": ("tyc1",),
    "tyc2": ("tyc2",),
    "tyc3": ("tyc3",),
    "hip": ("hip",),
}
WANTED = (
    "name V with B-V or V-I (vmag, b-v, v-i), Tycho's vtmag and btmag, or Gaia's phot_g_mean_mag with bp_rp or with "
    "phot_bp_mean_mag and phot_rp_mean_mag"
)
MAX_NAMED = 12
HOURS = ("h", "hr", "hour", "hourangle")
UNITS = {"deg": ("ra_deg", "dec_deg"), "mas / yr": ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr"), "mas": ("parallax_mas",)}
UNIT_OF = {role: unit for unit, roles in UNITS.items() for role in roles}


@dataclass(frozen=True, slots=True)
class Layout:
    """The table's column for each role, the pairs that give places, and the sets of roles that give V and a colour."""

    role: Mapping[str, str]
    places: tuple[tuple[str, str], ...]
    magnitudes: tuple[tuple[str, ...], ...]

    def needed(self) -> list[str]:
        """The columns to read."""
        return sorted({*self.role.values(), *(name for pair in self.places for name in pair)})


def layout_of(path: Path, names: Sequence[str]) -> Layout:
    """Which of a table's columns are used. Raises InputError where there is no place or no magnitude with a colour."""
    known = {name.strip().lower(): name for name in reversed(names)}
    places = tuple((known[ra], known[dec]) for ra, dec in PLACES if ra in known and dec in known)
    role = {role: known[found] for role, words in NAMES.items() if (found := next((w for w in words if w in known), None))}
    magnitudes = tuple(route.roles for route in ROUTES if all(name in role for name in route.roles))
    found = ", ".join(shortened(name, 40) for name in names[:MAX_NAMED]) + (", ..." if len(names) > MAX_NAMED else "")
    if not places:
        pairs = ", ".join(f"{ra} and {dec}" for ra, dec in PLACES[:4])
        raise InputError(f"{path}: has no right ascension and declination among its columns ({found}); name them {pairs}")
    if not magnitudes:
        raise InputError(f"{path}: has no magnitude with a colour among its columns ({found}); {WANTED}")
    return Layout(role, places, magnitudes)


def factor_to(role: str, column: str, unit: str | None, path: Path) -> float:
    """By what a column's figures are multiplied to have the role's unit; 1 where the table says none. Raises InputError."""
    from astropy import units as u

    wanted = UNIT_OF.get(role)
    if unit is None or not unit.strip() or wanted is None:
        return 1.0
    if role == "ra_deg" and unit.strip().lower() in HOURS:
        return 15.0
    try:
        return float(u.Unit(unit, parse_strict="raise").to(u.Unit(wanted), equivalencies=u.dimensionless_angles()))
    except (ValueError, TypeError, u.UnitConversionError) as error:
        raise InputError(f"{path}: column {column} is in {shortened(unit)!r}; give it in {wanted.replace(' ', '')}") from error
