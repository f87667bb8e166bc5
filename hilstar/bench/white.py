"""Which stars of a bench are brighter than full scale."""

from __future__ import annotations

import numpy as np

from hilstar.bench.frame import Bench
from hilstar.scene.clipping import CLIP_TOLERANCE
from hilstar.scene.psf import peak_share

NAMED_STARS = 5


def clipping_hip(bench: Bench) -> list[int]:
    """The HIP numbers of the stars that clip when centred on a pixel of the screen's darkest part, brightest first."""
    peak_e_per_s = bench.stars.electrons_per_s * peak_share(bench.config.render.sprite_sigma_px)
    order = np.argsort(-peak_e_per_s, kind="stable")
    clips = peak_e_per_s[order] > bench.flux_at_white_e_per_s * bench.darkest * (1 + CLIP_TOLERANCE)
    return [int(hip) for hip in bench.stars.hip[order[clips]]]


def named(hips: list[int], count: int) -> str:
    """ "HIP 32349, 27989 and 3 more", or "none"."""
    if not hips:
        return "none"
    more = "" if len(hips) <= count else f" and {len(hips) - count} more"
    return "HIP " + ", ".join(map(str, hips[:count])) + more


def clipping_line(bench: Bench) -> str | None:
    """One line that names the stars that clip, for the start of a run; None if none does."""
    hips, render = clipping_hip(bench), bench.config.render
    if not hips:
        return None
    stars = "1 star of the sky is" if len(hips) == 1 else f"{len(hips)} stars of the sky are"
    key = "flux_at_white_e_per_s" if render.brightest_v_mag is None else f"brightest_v_mag = {render.brightest_v_mag:g}"
    return f"{stars} brighter than white and clip in view: {named(hips, NAMED_STARS)} ([render] {key})"
