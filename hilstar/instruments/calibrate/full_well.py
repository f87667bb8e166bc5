"""Whether a tracker's images are cut off below the level at which its bench file has it saturate.

A full well that is not stated, or stated too large, makes flat dots, which a fit takes for wide
ones before a sharp lens. Light of m electrons scatters by sqrt(m) from pixel to pixel. Pixels at
the full well do not: their levels are alike but for the read noise. So the brightest pixels say
where the well is full, whatever the file states.
"""

import math

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.tracker.settings import DetectorSettings

STATED_SHARE = 0.9  # of the stated saturation: from there on the statement itself holds
# Bright pixels are those within 6 sigmas of their own shot noise under the brightest. Of an even
# light 13 % of them are within a sixth of a sigma of their median; where the gain is stated 40
# times too small, still less than three quarters.
BRIGHT_SIGMAS, ALIKE_SIGMAS, ALIKE_SHARE = 6.0, 1 / 6, 0.75
MIN_ALIKE = 30  # pixels
MIN_SIGMA_DN = 3.0  # under it a sixth of a sigma to either side is less than one level


def cut_off_dn(
    light: FloatArray, dark: FloatArray, floor_dn: float, detector: DetectorSettings
) -> float | None:
    """The level at which an image is cut off under the stated saturation; None where its brightest
    pixels scatter as light does, or it cannot be told.

    `light` (n,), DN, are its pixels without the hot ones, `dark` (h, w) its dark frame, whose
    median is `floor_dn`.
    """
    top_dn = float(light.max(initial=0.0))
    if top_dn >= STATED_SHARE * detector.saturation_dn:
        return None
    sigma_dn = math.sqrt(max(top_dn - floor_dn, 0.0) / detector.gain_e_per_dn)
    if sigma_dn < MIN_SIGMA_DN:
        return None
    bright = light[light > top_dn - BRIGHT_SIGMAS * sigma_dn]
    level_dn = float(np.median(bright))
    alike = int((np.abs(bright - level_dn) < ALIKE_SIGMAS * sigma_dn).sum())
    if alike < max(MIN_ALIKE, ALIKE_SHARE * len(bright)):
        return None
    # an image without noise has no scatter to be missed
    if not dark.std():
        return None
    return level_dn


def check_full_well(
    light: FloatArray, dark: FloatArray, floor_dn: float, detector: DetectorSettings
) -> None:
    """Refuse (InputError) an image that is cut off under the stated saturation, with the full well
    that its level is; see `cut_off_dn`.
    """
    level_dn = cut_off_dn(light, dark, floor_dn, detector)
    if level_dn is None:
        return
    full_well_e = (level_dn - floor_dn) * detector.gain_e_per_dn
    rounded_e = float(f"{full_well_e:.3g}")
    raise InputError(
        f"the tracker's images are cut off at {level_dn:.0f} DN, and the bench file has them"
        f" saturate at {detector.saturation_dn:.0f}; write [tracker.detector] full_well_e ="
        f" {rounded_e:.10g}, or gain_e_per_dn as it is"
    )
