"""The benchmark's scenes: a given number of stars in view, from the catalogue and, where it has too few, random ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.frame import Bench
from hilstar.errors import InputError
from hilstar.rotation import to_matrix
from hilstar.scene.sprites import pack_sprites
from hilstar.sky.stars import Stars, cell_grid

# A cap this much wider than the monitor's own: culling must have something to throw away.
SKY_BEYOND = 1.5
STAR_COLUMNS = ("hip", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")


@dataclass(frozen=True, slots=True)
class Scene:
    """Stars, and how many of those in view are the catalogue's."""

    stars: Stars
    catalogue_count: int


def scene(bench: Bench, every: Stars, q_icrs_to_cam: FloatArray, count: int, rng: np.random.Generator) -> Scene:
    """A scene with exactly `count` stars in view: the brightest of `every`, and past those random ones in and around the view.

    The random ones are as bright as random stars of the fainter half of `every`. Raises InputError where `every` is empty.
    """
    if not len(every):
        raise InputError("bench: the bench file leaves no star to show; write a larger [sky] faintest_v_mag")
    seen = bench.sprites(q_icrs_to_cam, every).star
    ranked = seen[np.argsort(every.v_mag[seen], kind="stable")]
    if len(ranked) >= count:
        kept = every.v_mag <= every.v_mag[ranked[count - 1]]
        kept[ranked[count:]] = False
        return Scene(_sorted(every, np.flatnonzero(kept), every.vectors[kept]), count)
    vectors = _directions(bench, q_icrs_to_cam, count - len(ranked), rng)
    faint = np.flatnonzero(every.v_mag >= np.median(every.v_mag))
    sources = np.concatenate([np.arange(len(every)), rng.choice(faint, len(vectors))])
    return Scene(_sorted(every, sources, np.concatenate([every.vectors, vectors])), len(ranked))


def _sorted(every: Stars, sources: IntArray, vectors: FloatArray) -> Stars:
    """Stars at `vectors` (n, 3) that are otherwise those of `every` at `sources` (n,), by cell."""
    grid = cell_grid(vectors)
    columns = {name: getattr(every, name)[sources[grid.order]] for name in STAR_COLUMNS}
    return replace(every, vectors=np.asfortranarray(vectors[grid.order]), grid=grid, **columns)


def _directions(bench: Bench, q: FloatArray, wanted: int, rng: np.random.Generator) -> FloatArray:
    """ICRS unit vectors, even over a cap around the view, of which `wanted` are in view."""
    camera, footprint_px = bench.camera, bench.renderer.footprint_px
    cos_cap = np.cos(min(SKY_BEYOND * camera.field_radius_rad(footprint_px), np.pi))
    tries = 4 * wanted
    while True:
        z, turn = 1 - rng.uniform(size=tries) * (1 - cos_cap), rng.uniform(0, 2 * np.pi, tries)
        across = np.sqrt(1 - z**2)
        vectors = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
        x_px, y_px = camera.project(vectors)
        seen = pack_sprites(x_px, y_px, z, np.arange(tries), camera.resolution_px, footprint_px).star
        if len(seen) >= wanted:
            return np.asarray(vectors[: seen[wanted - 1] + 1] @ (camera.cam_to_image @ to_matrix(q)))
        tries *= 2
