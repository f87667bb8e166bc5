"""The three fields of the thesis's simulations (tables 5.2 to 5.4), and a field of one's own."""

from dataclasses import dataclass

OWN = "field"


@dataclass(frozen=True, slots=True)
class SkyField:
    """A field: the stem of its files, its name and place, and the star in the middle of the
    thesis's zoom.
    """

    stem: str
    name: str
    radec_roll_deg: tuple[float, float, float]
    zoom_hip: int | None = None


FIELDS: tuple[SkyField, ...] = (
    SkyField("orion", "Orion", (84.057, -1.200, 0.0), 26311),
    SkyField("lyra", "Lyra", (283.021, 35.349, 0.0), 92420),
    SkyField("rosetta", "zeta Cas before the Rosetta NAVCAM", (9.122, 53.817, 0.0), 2920),
)
ROSETTA: SkyField = FIELDS[2]
ZETA_CAS: SkyField = SkyField("zeta_cas", "zeta Cas", ROSETTA.radec_roll_deg, ROSETTA.zoom_hip)


def fields_of(radec_roll_deg: tuple[float, float, float] | None) -> tuple[SkyField, ...]:
    """The fields in which a bench is shown: the thesis's three, and the user's own where one is
    given.
    """
    three = (*FIELDS[:2], ZETA_CAS)
    if radec_roll_deg is None:
        return three
    ra_deg, dec_deg, roll_deg = radec_roll_deg
    name = f"RA {ra_deg:g}, Dec {dec_deg:g}, roll {roll_deg:g}°"
    return (*three, SkyField(OWN, name, radec_roll_deg))
