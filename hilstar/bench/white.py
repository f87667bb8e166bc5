"""What is said of a bench's light before a run: stars brighter than full scale, and what its white is assumed to be made of."""

from __future__ import annotations

import numpy as np

from hilstar.bench.frame import Bench
from hilstar.scene.psf import peak_share
from hilstar.scene.sprites import CLIP_TOLERANCE

NAMED_STARS = 5


def clipping_hip(bench: Bench) -> list[int | str]:
    """What clips when centred on a pixel of the screen's darkest part, brightest first: HIP numbers, and names of bodies."""
    peak_e_per_s = bench.stars.electrons_per_s * peak_share(bench.config.render.sprite_sigma_px)
    order = np.argsort(-peak_e_per_s, kind="stable")
    clips = peak_e_per_s[order] > bench.flux_at_white_e_per_s * bench.darkest * (1 + CLIP_TOLERANCE)
    return bench.stars.designations(order[clips])


def named(found: list[int | str], count: int) -> str:
    """ "Moon, HIP 32349, 27989 and 3 more", or "none"."""
    if not found:
        return "none"
    bodies, hips = ([one for one in found if isinstance(one, kind)] for kind in (str, int))
    shown = [*bodies, *hips][:count]
    more = "" if len(found) <= count else f" and {len(found) - count} more"
    first_hip = len(bodies)
    return ", ".join(f"HIP {one}" if k == first_hip else str(one) for k, one in enumerate(shown)) + more


def clipping_line(bench: Bench) -> str | None:
    """One line that names the stars that clip, for the start of a run; None if none does."""
    found, render = clipping_hip(bench), bench.config.render
    if not found:
        return None
    bodies = bool(bench.stars.bodies)
    one, many = ("star or body", "stars and bodies") if bodies else ("star", "stars")
    stars = f"1 {one} of the sky is" if len(found) == 1 else f"{len(found)} {many} of the sky are"
    key = "flux_at_white_e_per_s" if render.brightest_v_mag is None else f"brightest_v_mag = {render.brightest_v_mag:g}"
    return f"{stars} brighter than white and clip in view: {named(found, NAMED_STARS)} ([render] {key})"


def shares_line(bench: Bench) -> str | None:
    """One line where bit stealing weighs the primaries by a formula's shares of white, which are no tracker's; else None."""
    calibration = bench.calibration
    if not bench.config.render.bit_stealing or not calibration.is_formula or calibration.weights is None:
        return None
    shares = ", ".join(f"{share:g}" for share in calibration.weights)
    return (
        f'[render] bit_stealing with calibration = "{calibration.name}" assumes that the tracker sees white as {shares} of red,'
        " green and blue, as a photometer does; measure it (hilstar first-light), or write a calibration file with [weights]"
    )
