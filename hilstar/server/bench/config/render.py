"""The table [render]. Words in braces are filled in by reference.py."""

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.basics.toml_tables import Table
from hilstar.display.quantise import Quantisation
from hilstar.server.bench.config.values import Magnitude, NotNegative, Positive, Sigma

# White, where the file gives none. demo.toml, 200 random fields: the brightest code of 8 bits is
# 100 in the median (38 with Sirius for white), `verify` sees flux 0.065 mag off at 95 % (0.41), and
# 13 stars clip, one of them in 8 % of fields.
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
    #: How light becomes codes. {QUANTISERS}`"auto"`: `round` where all errors together stay within
    #: the tolerance, else `exact`, unless an average field, turning at 1 deg/s, would take it more
    #: than half a refresh and would not take `round` as long; `--explain` of `frame`, `serve` and
    #: `replay` says which. `serve` and `replay` in real time measure that when they start; lockstep
    #: and all other commands take the time on two cores without a GPU.
    quantisation: Literal[Quantisation, "auto"] = "auto"
    #: What a frame of an average field takes by `round` and by `exact`, for `auto` of every
    #: command: nothing is measured then. `--explain` of a run that measured prints the line to
    #: write. Default: measured, or tabulated
    codes_ms: Annotated[
        tuple[Positive, Positive] | None, Meta(extra={"form": "[round, exact]"})
    ] = None
    #: Lets the codes of r, g and b differ by one: seven times as many levels, weighted as the
    #: tracker sees the primaries: by `[weights]` of the calibration file. Formulas, such as sRGB,
    #: assume Rec. 709's, a photometer's, and `serve`, `replay` and `budget` say so.
    bit_stealing: bool = False
    #: What the primaries are mixed for. `"white"`: one code for all three. `"star"`: each star's
    #: light is the mixture that is nearest to its own as the tracker sees it: with the same
    #: electrons in each channel of three; of one channel with the same electrons and the same mean
    #: wavelength of those, as far as the primaries reach ([colour](colour.md)). It needs
    #: `[monitor.primaries]`. `"depth"`: as `bit_stealing = true`. Default: `"depth"` with
    #: `bit_stealing`, else `"star"` with `[tracker.detector] bayer`, else `"white"`
    colour: Literal["white", "star", "depth"] | None = None
    #: Frames of the tracker's exposure, by which `budget`, `--explain` and `first-light` judge
    #: `temporal`. The codes do not depend on it. Default: as many as `exposure_s` has, at most
    #: {MAX_JUDGED_FRAMES}
    cycle_frames: Annotated[int, Meta(ge=1, le=256)] | None = None
    #: Gaussian sigma of a star on the monitor, in monitor pixels.
    sprite_sigma_px: Sigma = (0.85, 0.85)
    #: How a star is drawn: `"gaussian"`, of `sprite_sigma_px`, for a tracker that brings its
    #: objective. `"tracker"`: by the point spread function of `[tracker.optics]`, for a detector
    #: without its objective; the virtual tracker before the display has none then. See [real
    #: glass](optics.md#the-display).
    psf: Literal["gaussian", "tracker"] = "gaussian"
    #: Full scale: the light of one monitor pixel at the white code, in the tracker's electrons per
    #: second. `hilstar calibrate scale` measures it. Default: set by `brightest_v_mag`
    flux_at_white_e_per_s: Positive | None = None
    #: Full scale, where `flux_at_white_e_per_s` is not given: the peak pixel of the brightest star
    #: whose V is not below this. Brighter stars clip, and are listed. Default:
    #: `{DEFAULT_BRIGHTEST_V_MAG}`
    brightest_v_mag: Magnitude | None = None
    #: `"auto"`: the cheapest combination of codes, sprites and paths whose worst errors together
    #: are within the tolerance; `--explain` of `frame`, `serve` and `replay` has a table of what
    #: was chosen. `"full"`: no such economy.
    effort: Literal["full", "auto"] = "full"
    #: Flux error that any star of the catalogue may have at any phase, at rest and, where frames
    #: turn, at 1 deg/s, all parts together, for `effort = "auto"` and `quantisation = "auto"`. The
    #: default is what 8 bits keep down to V =
    #: 7.5, six magnitudes under white.
    tolerance_mag: Positive = DEFAULT_TOLERANCE_MAG
    #: Centroid error that a star may have, monitor pixels, likewise: by the worst of six
    #: centroiders, or by that of `[verify] centroider`.
    tolerance_px: Positive = DEFAULT_TOLERANCE_PX
    # results/timing.csv: 69 arcsec at 2 deg/s without, 0.1 with it.
    #: Whether stars are drawn along their paths, each row at its own moment. `"auto"`: on a screen
    #: only. `"on"`: headless too. `"off"`: never.
    motion: Literal["auto", "on", "off"] = "auto"
    #: Stars that move less than this, from the light of the middle row to the end of the frame's
    #: light, are drawn as points at one moment.
    motion_above_px: NotNegative = 0.01
    #: Which GPU draws headless frames: its index in EGL's list, or a part of its name. `hilstar
    #: doctor` lists them. A window is drawn by its display's GPU. Default: the first of EGL's list
    gpu: Annotated[int, Meta(ge=0)] | str | None = None
