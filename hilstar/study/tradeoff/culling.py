"""The trade-off of culling: how the stars in view are found among all."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.bench.cameras import ideal_monitor
from hilstar.scene.camera import Camera
from hilstar.scene.psf import footprint_px
from hilstar.scene.sprites import pack_sprites
from hilstar.sky.stars import CELL_DEG, Stars, cell_grid
from hilstar.study.tradeoff.demo import (
    ATTITUDES,
    NO_LIMIT_V_MAG,
    SIGMA_PX,
    demo_config,
    random_attitudes,
    stars_to,
    turn_to_image,
)
from hilstar.study.tradeoff.table import Figure, Trial, Trials

STAR_COLUMNS = ("hip", "vectors", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")
CELLS_DEG = (1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)


def culling(stack: ExitStack, quick: bool) -> Trials:
    """How the stars in view are found among all: stars missed over ATTITUDES fields, and stars tested that are not in view."""
    del stack
    camera, stars = ideal_monitor(demo_config()), stars_to(NO_LIMIT_V_MAG)
    turns = [turn_to_image(q, camera) for q in random_attitudes(10 if quick else ATTITUDES)]
    in_view = [set(stars.hip[_scan(stars, turn, camera)[0]].tolist()) for turn in turns]
    finders: dict[str, tuple[Stars, Finder]] = {
        "scan, every star projected": (stars, _scan),
        "scan of angles": (stars, _scan_angles),
        **{f"cells of {deg:g} deg": (in_cells(stars, deg), _by_cells) for deg in sorted({*CELLS_DEG, CELL_DEG})},
        "cells of 10 deg, by centres only": (in_cells(stars, 10.0, by_centres=True), _by_cells),
    }
    trials = []
    for name, (sorted_stars, finder) in finders.items():
        missed, vain = 0, 0
        for turn, wanted in zip(turns, in_view, strict=True):
            seen, looked_at = finder(sorted_stars, turn, camera)
            missed += len(wanted - set(sorted_stars.hip[seen].tolist()))
            vain += looked_at - len(wanted)
        work = partial(finder, sorted_stars, turns[0], camera)
        own = name == f"cells of {CELL_DEG:g} deg"
        trials.append(Trial(name, missed, vain / len(turns), work, own, finder is _scan))
    return Trials(
        "culling",
        f"{len(stars)} stars to the {len(in_view[0])} sprites of Orion",
        Figure(f"stars missed in {len(turns)} fields", "stars", 0.1),
        Figure("tested but not in view, mean", "stars"),
        "a smaller cell passes on fewer stars in a rich field, a larger one costs less in a sparse one",
        trials,
    )


# Which stars (places in `Stars`) are in view, and how many were tested.
Finder = Callable[[Stars, FloatArray, Camera], tuple[IntArray, int]]


def in_cells(stars: Stars, cell_deg: float, by_centres: bool = False) -> Stars:
    """The stars in cells of another size; `by_centres` takes a cell for a point."""
    grid = cell_grid(stars.vectors, cell_deg)
    columns = {name: getattr(stars, name)[grid.order] for name in STAR_COLUMNS}
    if by_centres:
        grid = replace(grid, cos_radius=np.ones_like(grid.cos_radius), sin_radius=np.zeros_like(grid.sin_radius))
    return replace(stars, **columns, grid=grid)


def _by_cells(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    """The road of `make_sprites`."""
    margin_px = footprint_px(SIGMA_PX) / 2 + 1
    near = stars.grid.near(turn[2], camera.field_radius_rad(margin_px), camera.edges(margin_px) @ turn)
    return _project(stars, near, turn, camera), len(near)


def _scan(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    return _project(stars, np.arange(len(stars)), turn, camera), len(stars)


def _scan_angles(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    radius_rad = camera.field_radius_rad(footprint_px(SIGMA_PX) / 2 + 1)
    return _project(stars, np.flatnonzero(stars.vectors @ turn[2] >= np.cos(radius_rad)), turn, camera), len(stars)


def _project(stars: Stars, near: IntArray, turn: FloatArray, camera: Camera) -> IntArray:
    x_px, y_px = camera.project(stars.vectors[near] @ turn.T)
    return pack_sprites(x_px, y_px, stars.electrons_per_s[near], near, camera.resolution_px, footprint_px(SIGMA_PX)).star
