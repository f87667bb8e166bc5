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
    #: The path of a list of element sets: two lines each (TLE), with name lines or without, or OMM
    #: in
    #: JSON, XML or CSV. Satellites and debris along their own paths, by SGP4, in and out of the
    #: Earth's
    #: shadow. Default: none
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

    #: The path of a FITS image with a WCS, or of a HEALPix map of the whole sky (`pip install
    #: 'hilstar[healpix]'`). `BUNIT`, of HEALPix `TUNIT1`, is any surface brightness that Astropy
    #: knows, at V: such as `mag/arcsec2`, `MJy/sr` or `W/(m2 um sr)`. Default: none
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
    #: The UTC of t = 0 (`t_ns` = 0), such as `"2026-11-21T00:00:00Z"`. It takes the place of
    #: `epoch_jyear`, and bodies are where they are at each frame's time. `"unix"`: `t_ns` is Unix
    #: time, as `time.time_ns()` has it, leap seconds and all; stars are those of the day of the
    #: run. `"source"`: the log's own dates (AEM, SPICE, ROS), in `replay`, `simulate --log` and
    #: `attitude`. Default: none
    epoch_utc: str | None = None
    #: Faintest V magnitude used, inclusive; fainter stars do not exist for this bench.
    faintest_v_mag: Magnitude = 7.5
    #: `"dgs"`: each star's spectrum through the tracker's curves. `"ags"`: one band average for
    #: every colour.
    brightness: Literal["dgs", "ags"] = "dgs"
    # results/tradeoff.csv, spectrum: real spectra by V-I are 0.026 mag off (95 %), a black body
    # 0.2.
    #: `"pickles"`: spectra of real stars (Pickles 1998), chosen by V-I, and by B-V for the hottest.
    #: `"mk"`: by the MK type that Hipparcos gives and V-I, dust included; by colour where the type
    #: is none of O to M. `"blackbody"`: a black body at the temperature that the next key derives
    #: from B-V.
    spectrum: Literal["blackbody", "pickles", "mk"] = "pickles"
    #: Temperature from B-V. `"wang2021"` is the formula of the thesis, with its step of 350 K at
    #: B-V = 0. Both are held within 1000 and 200000 K, which matters to nine carbon stars under
    #: `wang2021`.
    temperature: Literal["ballesteros2012", "wang2021"] = "ballesteros2012"
    #: `"phase"`: stars of your table with `epoch_jd` (of largest light), `period_d` and
    #: `amplitude_mag` (half of the range) have their light at `epoch_utc`, by a sinusoid about V,
    #: all run long. Others have their mean, as all have by `"mean"`.
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

    #: `"geocentre"`, or the path of a file: one element set (two lines, or OMM in JSON, XML or
    #: CSV),
    #: propagated by SGP4, or a CCSDS OEM (KVN; ICRF, GCRF or EME2000 about the Earth); `"source"`:
    #: where
    #: the messages of `[attitude] source = "vizard"` (Basilisk) have the spacecraft. Default: none;
    #: `"geocentre"` with `[sky.bodies]`
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
    #: Extinction, mag an air mass: `"ctio"`, `"kpno"`, `"la-palma"`, `"lick"`, `"mauna-kea"` or
    #: `"paranal"`; the path of a CSV (`wavelength_nm,value`); or a number for all wavelengths. Lick
    #: is the lowest of them, 1290 m; the air of a town takes more.
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
    #: Zodiacal light by direction from the Sun, with its spectrum (Leinert 1998, tables 17 and 19).
    #: It needs `[sky] epoch_utc`. A field near the Sun, where the table is blank, is refused; the
    #: pictures of a run take the nearest tabled light there, and a warning says so. Calibration
    #: patterns have no such light. Default: none
    zodiacal: Literal["leinert1998"] | None = None
    #: By how many electrons per exposure the background grows from one edge of the detector to the
    #: other.
    gradient_electrons_across: Annotated[
        tuple[Signed, Signed], Meta(extra={"form": "[right, down]"})
    ] = (0.0, 0.0)
