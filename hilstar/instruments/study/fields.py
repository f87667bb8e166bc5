"""The three fields of the thesis's simulations (tables 5.2 to 5.4), and a field of one's own."""

from dataclasses import dataclass

OWN = "field"


@dataclass(frozen=True, slots=True)
class Field:
    """A field: stem of its files, name, place, and the star in the middle of the thesis's zoom."""

    stem: str
    name: str
    radec_roll_deg: tuple[float, float, float]
    zoom_hip: int | None = None


FIELDS = (
    Field("orion", "Orion", (84.057, -1.200, 0.0), 26311),
    Field("lyra", "Lyra", (283.021, 35.349, 0.0), 92420),
    Field("rosetta", "zeta Cas before the Rosetta NAVCAM", (9.122, 53.817, 0.0), 2920),
)
ZETA_CAS = Field("zeta_cas", "zeta Cas", FIELDS[2].radec_roll_deg, FIELDS[2].zoom_hip)


def fields_of(radec_roll_deg: tuple[float, float, float] | None) -> tuple[Field, ...]:
    """The fields in which a bench is shown: the thesis's three, and the one at `radec_roll_deg`."""
    three = (*FIELDS[:2], ZETA_CAS)
    if radec_roll_deg is None:
        return three
    ra_deg, dec_deg, roll_deg = radec_roll_deg
    return (
        *three,
        Field(OWN, f"RA {ra_deg:g}, Dec {dec_deg:g}, roll {roll_deg:g}°", radec_roll_deg),
    )
