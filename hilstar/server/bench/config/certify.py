"""The table [certify]: what a certificate says beside its figures, its limits, and what no
calibration file holds.
"""

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.basics.toml_tables import Table
from hilstar.server.bench.config.values import NotNegative, Positive

Relative = Annotated[float, Meta(ge=0, le=1)]


class InstrumentSettings(Table, frozen=True):
    """The photometer by which full scale was measured, from its own certificate."""

    name: str = ""  #: Maker, model and serial number; empty for none.
    #: Expanded uncertainty of its scale, relative: 0.01 for one per cent.
    relative_expanded: Relative = 0.0
    k: Annotated[float, Meta(ge=1, le=10)] = 2.0  #: The coverage factor of that.
    date: str = ""  #: The day of its certificate.


class TrackerReferenceSettings(Table, frozen=True):
    """How well the tracker is known through which all is read, from its own calibration: the
    reference of angles and of light.

    What is not written is not assessed; without `direction_expanded_arcsec` no place and no
    attitude is certified.
    """

    name: str = ""  #: What calibrated it: laboratory, report and serial number.
    #: Expanded uncertainty of a direction by the lens of `[tracker]`, along each axis, anywhere in
    #: its field, beside those of the next two; 0 where it is the measure of all angles. Default:
    #: not assessed
    direction_expanded_arcsec: NotNegative | None = None
    #: Expanded uncertainty of its focal length, relative: it scales angles from the boresight.
    focal_expanded_relative: Relative = 0.0
    #: Expanded uncertainty of its radial distortion at the edge of the field, half of the
    #: detector's smaller side from the middle. It grows as the cube of the angle off the boresight.
    distortion_expanded_arcsec: NotNegative = 0.0
    #: Expanded uncertainty of the light that it collects at a place over that in the middle of its
    #: field (vignetting, flat field), relative. Default: not assessed
    evenness_expanded_relative: Relative | None = None
    #: Expanded uncertainty of the ratio of two lights that it reads, relative: its linearity.
    #: Default: not assessed
    linearity_expanded_relative: Relative | None = None
    k: Annotated[float, Meta(ge=1, le=10)] = 2.0  #: The coverage factor of these.
    date: str = ""  #: The day of its calibration.


class VirtualSettings(Table, frozen=True):
    """In a truth file alone: how the instruments of a virtual bench read (`hilstar certify
    --virtual TRUTH.toml`).
    """

    reading_noise: Relative = 0.002  #: Relative noise of one reading of light.
    dot_noise_px: NotNegative = 0.02  #: Noise of a dot's place along each axis, tracker pixels.
    delay_noise_ms: NotNegative = 0.1  #: Noise of one edge that the photodiode sees.
    #: How fast the light changes from the first reading on.
    drift_percent_per_h: Annotated[float, Meta(ge=-100, le=100)] = 0.0
    #: How much darker a monitor just switched on is.
    cold_percent: Annotated[float, Meta(ge=-50, le=50)] = 0.0
    warm_up_min: Positive = 8.0  #: In how many minutes that falls to a third.
    #: Error of the instrument's scale, relative: it reads too much where positive.
    instrument_error: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0
    seconds_a_reading: Positive = 1.0  #: Time from one reading to the next.


class CertifySettings(Table, frozen=True):
    """What `hilstar certify` states, and holds the bench to; see [certificates](certify.md)."""

    #: The path of the bench's `certificate.json`: `serve` names it in ledger, page and FITS
    #: headers, `assess` and requirements take its uncertainty off. Default: none
    certificate: str | None = None
    who: str = ""  #: Who certifies.
    where: str = ""  #: Where.
    ambient: str = ""  #: Ambient conditions: temperature, humidity, darkness.
    traceability: str = ""  #: To what the figures are traceable, as it is printed.
    valid_days: Annotated[int, Meta(ge=1, le=3650)] = 180  #: For how many days a certificate holds.
    fields: Annotated[int, Meta(ge=1, le=20)] = 3  #: How many fields of stars are certified.
    levels: Annotated[int, Meta(ge=10, le=1000)] = 48  #: How many codes of the response are read.
    #: How often each of them is read; white twice as often.
    repeats: Annotated[int, Meta(ge=1, le=100)] = 2
    #: `"guard-band"`: a figure conforms where its whole interval is within its limit. `"simple"`:
    #: where its value is (ISO 17025, ILAC-G8).
    decision: Literal["guard-band", "simple"] = "guard-band"
    max_flux_mag: Positive | None = None  #: Limit of a star's flux. Default: no limit
    #: Limit of a star's place, each axis. Default: no limit
    max_place_arcsec: Positive | None = None
    #: Limit of a field's attitude across the boresight. Default: no limit
    max_attitude_arcsec: Positive | None = None
    max_roll_arcsec: Positive | None = None  #: Limit of it about the boresight. Default: no limit
    #: Limit of the latency's difference from `panel_delay_ms`. Default: no limit
    max_latency_ms: Positive | None = None
    #: Rate at which places are certified: stars then move along the image's x.
    rate_deg_s: NotNegative = 0.0
    #: Standard deviation of the moment of light against the predicted one, at that rate.
    jitter_ms: NotNegative = 0.0
    #: Standard uncertainty of the offset between the clocks of sender and host.
    clock_ms: NotNegative = 0.0
    #: Standard uncertainty of `flux_at_white_e_per_s`, where nothing is read. Default: not assessed
    flux_at_white_relative: Relative | None = None
    #: Its degrees of freedom: readings less one. Default: unlimited
    flux_at_white_dof: Positive | None = None
    #: Standard uncertainty of `panel_delay_ms`, where nothing is read. Default: not assessed
    panel_delay_u_ms: NotNegative | None = None
    #: How much white may still change in the ten minutes after it counts as warm. Default: not
    #: assessed
    warm_up_percent: NotNegative | None = None
    #: Half of the range of the bench's temperature while the certificate holds.
    temperature_k: NotNegative = 0.0
    #: Change of the light by temperature.
    flux_mag_per_k: Annotated[float, Meta(ge=-1, le=1)] = 0.0
    #: Change of the alignment by temperature, about x and y.
    place_arcsec_per_k: Annotated[float, Meta(ge=-100, le=100)] = 0.0
    instrument: InstrumentSettings = InstrumentSettings()
    tracker: TrackerReferenceSettings = TrackerReferenceSettings()
    virtual: VirtualSettings = VirtualSettings()
