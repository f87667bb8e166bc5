"""The tables of the sky: [sky] and [sky.bodies], [spacecraft] from which it is seen, and
[background].
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from hilstar.basics.toml_tables import Table
from hilstar.server.bench.config.values import (
    EpochJyear,
    IcrsVector,
    Magnitude,
    NotNegative,
    Signed,
)

GEOCENTRE = "geocentre"
SOURCE = "source"
PressureHpa = Annotated[float, Meta(ge=0, le=1100)]


class Bodies(Table, frozen=True):
    """Bodies of the Solar System: places by JPL's DE421, magnitudes by phase, sunlight times
    their albedo.
    """

    #: Mercury, Venus, Mars, Jupiter, Saturn (with its rings' light), Uranus, Neptune.
    planets: bool = False
    moon: bool = False  #: The Moon.
    sun: bool = False  #: The Sun.
    #: The Earth with its air, seen from an orbit: `[spacecraft] orbit` is then a file or
    #: `"source"`. Its night side is dark.
    earth: bool = False
    #: A list of element sets (TLE or OMM in JSON, XML or CSV): satellites along their own paths, by
    #: SGP4, in and out of the Earth's shadow. Default: none
    satellites: str | None = None
    #: The path of a CSV with the columns
    #: `norad,standard_mag,period_s,amplitude_mag,flash_s,flash_at_s,size_m`, of which only the
    #: first has to be there: what is known of each satellite's light. Default: none
    satellite_magnitudes: str | None = None
    #: V at 1000 km, 90 degrees of phase, in sunlight, of satellites without `standard_mag` in that
    #: table.
    satellite_standard_mag: Annotated[float, Meta(ge=-30, le=50)] = 6.0


class Diffuse(Table, frozen=True):
    """Light that stands on the sky: galaxies, nebulae, unresolved stars. The virtual tracker
    always has it.
    """

    #: A FITS image with a WCS, or a HEALPix map (`pip install 'hilstar[healpix]'`), in any surface
    #: brightness at V (`BUNIT`, `TUNIT1`). Default: none
    map: str | None = None
    #: B-V of its light, by which it becomes electrons as a star's does; the Sun's is 0.65.
    bv_mag: Magnitude = 0.65


class SkySettings(Table, frozen=True):
    """Which stars there are, and how bright they are."""

    #: `"hipparcos"`, the packaged catalogue; or the path of a table of stars (FITS, ECSV, CSV,
    #: VOTable) with the column names of Gaia, Tycho-2 or Hipparcos, or of a `hip_main.dat` (CDS
    #: I/239).
    catalogue: str = "hipparcos"
    #: The table's stars are added to the packaged Hipparcos, whose star stands where both have one;
    #: otherwise the table stands alone.
    with_hipparcos: bool = False
    #: Julian year of the table's places, where neither a column nor its catalogue's own names say
    #: it. Default: the table's
    catalogue_epoch_jyear: EpochJyear | None = None
    #: Julian year to which proper motion is applied, from the epoch of the catalogue's places.
    epoch_jyear: Annotated[float, Meta(ge=-10_000, le=10_000)] = 2026.0
    #: The UTC of `t_ns` = 0, such as `"2026-11-21T00:00:00Z"`, in place of `epoch_jyear`. `"unix"`:
    #: `t_ns` is Unix time. `"source"`: the log's own dates (AEM, SPICE, ROS). Default: none
    epoch_utc: str | None = None
    #: Faintest V magnitude used, inclusive; fainter stars do not exist for this bench.
    faintest_v_mag: Magnitude = 7.5
    #: `"dgs"`: each star's spectrum through the tracker's curves. `"ags"`: one band average for
    #: every colour.
    brightness: Literal["dgs", "ags"] = "dgs"
    # results/tradeoff.csv, spectrum: real spectra by V-I are 0.026 mag off (95 %), a black body
    # 0.2.
    #: `"pickles"`: real spectra (Pickles 1998) by V-I, by B-V for the hottest. `"mk"`: by
    #: Hipparcos's MK type and V-I, dust included. `"blackbody"`: by `temperature`.
    spectrum: Literal["blackbody", "pickles", "mk"] = "pickles"
    #: Temperature from B-V. `"wang2021"` is the thesis's, with its step of 350 K at B-V = 0.
    temperature: Literal["ballesteros2012", "wang2021"] = "ballesteros2012"
    #: `"phase"`: stars of your table with `epoch_jd`, `period_d` and `amplitude_mag` have their
    #: light at `epoch_utc`; others their mean.
    variables: Literal["mean", "phase"] = "mean"
    #: Flux of a star of V = 0. `"vega"`: 3.631e-9 erg/s/cm2/A at V (Bessell 1998).
    #: `"iau-bolometric"`: the zero point of the thesis, 25 % fainter.
    zero_point: Literal["vega", "iau-bolometric"] = "vega"
    #: How Johnson V averages a spectrum. `"energy"` suits Bessell's curve; `"photon"` is the
    #: thesis's.
    passband_weighting: Literal["energy", "photon"] = "energy"
    #: Barycentric velocity of the observer, ICRS axes, for aberration: 20.5 arcsec at 29.8 km/s.
    #: Slower than light. With `[spacecraft]` or bodies it follows from the ephemeris.
    observer_velocity_km_s: IcrsVector = (0.0, 0.0, 0.0)
    bodies: Bodies = msgspec.field(default_factory=Bodies)
    diffuse: Diffuse = msgspec.field(default_factory=Diffuse)


class SpacecraftSettings(Table, frozen=True):
    """From where the sky is seen. With this table, or bodies, places are apparent: parallax,
    light bending and aberration.
    """

    #: `"geocentre"`; a file: one element set (two lines, or OMM) or a CCSDS OEM (KVN, about the
    #: Earth); or `"source"`: Basilisk's messages. Default: none; `"geocentre"` with `[sky.bodies]`
    orbit: str | None = None


class SiteSettings(Table, frozen=True):
    """A place on the Earth from which the sky is seen, through its air. It needs `[sky]
    epoch_utc` and `hilstar[bodies]`.
    """

    #: Geodetic latitude, north positive (WGS84).
    latitude_deg: Annotated[float, Meta(ge=-90, le=90)]
    longitude_deg: Annotated[float, Meta(ge=-180, le=360)]  #: Longitude, east positive.
    height_m: Annotated[float, Meta(ge=-500, le=20_000)] = 0.0  #: Height over the ellipsoid.
    #: Pressure; 0 bends nothing. Default: the standard atmosphere's at `height_m`
    pressure_hpa: PressureHpa | None = None
    temperature_c: Annotated[float, Meta(ge=-90, le=60)] = 10.0  #: Temperature of the air, Celsius.
    humidity: Annotated[float, Meta(ge=0, le=1)] = 0.5  #: Relative humidity.
    #: Mag an air mass: `"ctio"`, `"kpno"`, `"la-palma"`, `"lick"`, `"mauna-kea"`, `"paranal"`; a
    #: CSV (`wavelength_nm,value`); or a number.
    extinction: float | str = "lick"
    #: Surface brightness of the sky at the zenith, V: 21.7 where it is dark, 18 in a town. It
    #: replaces no `[background]`. Default: none
    sky_v_mag_arcsec2: Magnitude | None = None
    #: The shape of its spectrum: `"paranal"` (UVES, 340 to 1060 nm), or the path of a CSV
    #: (`wavelength_nm,value`).
    sky_spectrum: str = "paranal"


class Background(Table, frozen=True):
    """Light between the stars. Only the virtual tracker sees it; the monitor shows none."""

    #: Electrons that the background makes in each tracker pixel per exposure. Default: `0`
    electrons_per_px: NotNegative | None = None
    #: Surface brightness of sunlight through the tracker's optics, times each pixel's solid angle;
    #: the thesis takes 22.1. Default: none
    zodiacal_v_mag_arcsec2: Magnitude | None = None
    #: Zodiacal light by direction from the Sun, with its spectrum (Leinert 1998); needs `[sky]
    #: epoch_utc` ([background](the-light.md#the-background)). Default: none
    zodiacal: Literal["leinert1998"] | None = None
    #: By how many electrons per exposure the background grows from one edge of the detector to the
    #: other.
    gradient_electrons_across: Annotated[
        tuple[Signed, Signed], Meta(extra={"form": "[right, down]"})
    ] = (0.0, 0.0)
