"""Stars and sprites where a test wants them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import Stars, make_stars


def stars_at(
    vectors: np.ndarray,
    electrons_per_s: np.ndarray,
    v_mag: npt.ArrayLike = 0.0,
    hip: npt.ArrayLike | None = None,
) -> Stars:
    """Stars of 5000 K in the directions `vectors` (n, 3), ICRS; numbered from 0 on without `hip`."""
    n = len(vectors)
    zero = np.zeros(n)
    columns: dict[str, npt.NDArray[np.generic]] = {
        "hip": np.asarray(range(n) if hip is None else hip, dtype=np.int32),
        "v_mag": zero + np.asarray(v_mag, dtype=float),
        "ra_deg": zero,
        "dec_deg": zero,
    }
    catalog = plain_catalog("HIP", n, columns)
    vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return make_stars(catalog, vectors, np.full(n, 5000.0), electrons_per_s)


def sprites_at(pixels: np.ndarray, electrons_per_s: np.ndarray, footprint: int) -> FrameLight:
    """Sprites centred on pixel positions (n, 2), with the light of each."""
    data = np.empty(len(pixels), dtype=SPRITE_DTYPE)
    whole = np.floor(pixels + (0.5 if footprint % 2 else 0.0))
    data["pixel"] = whole
    data["fraction_px"] = pixels - whole
    data["electrons_per_s"] = electrons_per_s
    return FrameLight(
        data, footprint, np.arange(len(pixels)), pixels[:, 0].copy(), pixels[:, 1].copy()
    )


def random_sprites(
    count: int,
    rng: np.random.Generator,
    size_px: tuple[int, int],
    footprint: int,
    decades: tuple[float, float] = (0, 7),
    margin_px: float = 5.0,
) -> FrameLight:
    """Sprites all over an image and a margin about it, of many magnitudes."""
    low_px = np.full(2, -margin_px)
    pixels = rng.uniform(low_px, size_px - low_px, size=(count, 2))
    return sprites_at(pixels, 10.0 ** rng.uniform(*decades, count), footprint)
