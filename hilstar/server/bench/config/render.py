"""The table [render]. Words in braces are filled in by reference.py."""

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.basics.toml_tables import Table
from hilstar.display.quantise import Quantisation
from hilstar.server.bench.config.values import Magnitude, NotNegative, Positive, Sigma

# White, where the file gives none. demo.toml, 200 random fields: the brightest code of 8 bits is
# 100 in the median (38 with Sirius for white), `verify` sees flux 0.065 mag off at 95 % (0.41), and
# 13 stars clip, one of them in 5 % of fields.
DEFAULT_BRIGHTEST_V_MAG = 1.5
# The limits of [verify]. README's bench keeps them at 8 bits by `exact`: 0.022 mag and 0.088 px,
# the worst star of its catalogue by the worst of six centroiders. At 12 bits `round` does: 0.019
# and 0.025.
DEFAULT_TOLERANCE_MAG, DEFAULT_TOLERANCE_PX = 0.05, 0.1
# What the default was when benches that leave nothing to it got their hashes, which they keep.
HASHED_TOLERANCE = 0.02
MAX_JUDGED_FRAMES = 16  # without `cycle_frames`; errors of longer exposures are smaller still


class RenderSettings(Table, frozen=True):
    """From electrons to code values."""

    # results/tradeoff.csv, quantisation: `exact` is 9 times as right as `round`, which does where a
    # panel has levels enough.
    #: How light becomes codes. {QUANTISERS}`"auto"`: `round` where that keeps the tolerance, else
    #: `exact` unless it would be late ([from light to codes](the-light.md#from-light-to-codes)).
    quantisation: Literal[Quantisation, "auto"] = "auto"
    #: Time of an average field's frame by `round` and by `exact`, for `auto` of every command, in
    #: place of measuring it; `--explain` prints the line. Default: measured, or tabulated
    codes_ms: Annotated[
        tuple[Positive, Positive] | None, Meta(extra={"form": "[round, exact]"})
    ] = None
    #: Lets the codes of r, g and b differ by one: seven times as many levels, by `[weights]` of the
    #: calibration file; formulas assume Rec. 709's.
    bit_stealing: bool = False
    #: What the primaries are mixed for: `"white"`, one code for all; `"star"`, each star's own
    #: mixture, by `[monitor.primaries]`; `"depth"`, as `bit_stealing` ([colour](colour.md)).
    #: Default: `"depth"` with `bit_stealing`, else `"star"` with `[tracker.detector] bayer`, else
    #: `"white"`
    colour: Literal["white", "star", "depth"] | None = None
    #: Frames of the tracker's exposure, by which `budget`, `--explain` and `first-light` judge
    #: `temporal`. The codes do not depend on it. Default: as many as `exposure_s` has, at most
    #: {MAX_JUDGED_FRAMES}
    cycle_frames: Annotated[int, Meta(ge=1, le=256)] | None = None
    #: Gaussian sigma of a star on the monitor, in monitor pixels.
    sprite_sigma_px: Sigma = (0.85, 0.85)
    #: How a star is drawn: `"gaussian"`, for a tracker with its objective; `"tracker"`, by the PSF
    #: of `[tracker.optics]`, for a bare detector ([real glass](optics.md#the-display)).
    psf: Literal["gaussian", "tracker"] = "gaussian"
    #: Full scale: the light of one monitor pixel at the white code, in the tracker's electrons per
    #: second. `hilstar calibrate scale` measures it. Default: set by `brightest_v_mag`
    flux_at_white_e_per_s: Positive | None = None
    #: Full scale, where `flux_at_white_e_per_s` is not given: the peak pixel of the brightest star
    #: whose V is not below this. Brighter stars clip, and are listed. Default:
    #: `{DEFAULT_BRIGHTEST_V_MAG}`
    brightest_v_mag: Magnitude | None = None
    #: `"auto"`: the cheapest codes, sprites and paths whose worst errors together keep the
    #: tolerance; `--explain` has a table.
    effort: Literal["full", "auto"] = "full"
    #: Flux error that any star of the catalogue may have, all parts together, for `"auto"`: at
    #: rest and, where frames turn, up to 1 deg/s. The default is what 8 bits keep down to six
    #: magnitudes under white.
    tolerance_mag: Positive = DEFAULT_TOLERANCE_MAG
    #: Centroid error that a star may have, monitor pixels, likewise: by the worst of six
    #: centroiders, or by that of `[verify] centroider`.
    tolerance_px: Positive = DEFAULT_TOLERANCE_PX
    # results/timing.csv: 69 arcsec at 2 deg/s without, 0.1 with it.
    #: Whether stars are drawn along their paths, each row at its own moment. `"auto"`: on a screen
    #: only. `"on"`: headless too. `"off"`: never.
    motion: Literal["auto", "on", "off"] = "auto"
    #: Stars that move less than this, from the light of the middle row to the end of the frame's
    #: light, are drawn as points where they are at the middle of that row's light.
    motion_above_px: NotNegative = 0.01
    #: Which GPU draws headless frames: index in EGL's list, or part of its name (`hilstar doctor`).
    #: A window's is its display's. Default: the first of EGL's list
    gpu: Annotated[int, Meta(ge=0)] | str | None = None
