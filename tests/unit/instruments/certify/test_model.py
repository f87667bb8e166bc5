"""Which stars a certificate stands on, and an attitude by stars that lie on one line."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from msgspec import structs

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.certify.model import (
    Deviations,
    Figures,
    thirds,
    true_deviations,
    usable_stars,
)
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.camera import Camera
from tests.support.planted_certify import reference_star, stated_bench

# A screen of 800 by 600 px, of whose columns a tracker sees 250 to 550: it stands aside by none.
SCREEN = Camera((800, 600), 2000.0, (399.5, 299.5), np.eye(3))
SEEN_PX, EDGE_PX = 300, 10
NARROW = BenchGeometry(
    SCREEN,
    Camera(
        (SEEN_PX + 2 * EDGE_PX, 560), 2000.0, ((SEEN_PX + 2 * EDGE_PX - 1) / 2, 279.5), np.eye(3)
    ),
)


def test_thirds_are_of_what_the_tracker_sees():
    x_px = np.array([0.0, 255.0, 345.0, 355.0, 445.0, 455.0, 545.0, 799.0])
    assert thirds(NARROW, x_px).tolist() == [0, 0, 0, 1, 1, 2, 2, 2]
    apart = BenchGeometry(SCREEN, Camera((9, 9), 2000.0, (4.0, 4.0), np.eye(3)))
    assert thirds(apart, np.array([0.0, 300.0, 799.0])).tolist() == [0, 1, 2]


# Of each row: place, whether it is drawn, clipped and of the catalogue, and whether it is usable.
# A PSF of 2 px: stars nearer than 18 px share pixels, and eight and one belong to each.
ROWS = (
    (300.0, 100.0, True, False, True, True),
    (300.0, 120.0, True, False, True, True),
    (350.0, 200.0, True, False, True, False),  # 17 px from the next
    (367.0, 200.0, True, False, True, False),
    (400.0, 300.0, False, False, True, False),
    (450.0, 300.0, True, True, True, False),
    (500.0, 300.0, True, False, False, False),  # a planet
    (545.0, 300.0, True, False, True, True),
    (551.0, 400.0, True, False, True, False),  # within ten pixels of the tracker's edge
    (240.0, 400.0, True, False, True, False),
    (400.0, np.nan, True, False, True, False),
)


def test_stars_stand_alone_whole_on_the_screen_and_in_the_tracker():
    kind = [("x_px", "f4"), ("y_px", "f4"), ("drawn", "?"), ("clipped", "?")]
    rows = np.array([row[:4] for row in ROWS], dtype=kind)
    of_catalogue = np.array([row[4] for row in ROWS])
    assert usable_stars(rows, of_catalogue, 2.0, NARROW).tolist() == [row[5] for row in ROWS]


def test_a_star_at_the_screen_s_edge_has_all_of_its_pixels():
    """Eight to each side, and one more."""
    kind = [("x_px", "f4"), ("y_px", "f4"), ("drawn", "?"), ("clipped", "?")]
    at_px = [
        (8.9, 300),
        (9.1, 200),
        (300, 8.9),
        (400, 9.1),
        (300, 590.1),
        (500, 589.9),
        (790.1, 99),
    ]
    rows = np.array([(x, y, True, False) for x, y in at_px], dtype=kind)
    wide = BenchGeometry(SCREEN, Camera((900, 700), 2000.0, (449.5, 349.5), np.eye(3)))
    wanted = [False, True, False, True, False, True, False]
    every = np.ones(len(rows), dtype=bool)
    assert usable_stars(rows, every, 2.0, wide).tolist() == wanted


@pytest.mark.parametrize("turn_arcsec", [(3.0, -5.0, 40.0), (-20.0, 7.0, -90.0)])
def test_stars_on_one_line_tell_a_turn_and_no_mirror(turn_arcsec):
    """Of directions in one plane a mirror fits as well as a rotation does."""
    tangents = 0.05 * np.array([[-1.0, -0.4], [0.0, 0.0], [0.5, 0.2], [1.5, 0.6]])
    rays = np.column_stack([tangents, np.ones(4)])
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    figures = Figures(
        stated_bench("[certify]\nrate_deg_s = 0.0\n"),
        [reference_star(direction=direction) for direction in directions],
    )
    turned = directions @ to_matrix(from_rotation_vector(np.array(turn_arcsec) / ARCSEC_PER_RAD)).T
    moved = ARCSEC_PER_RAD * (turned[:, :2] / turned[:, 2:] - tangents)
    off = Deviations(np.ones((1, 1)), np.zeros((1, 4)), moved[None], np.zeros(1), np.zeros(1))
    found = figures.of(off)[0]
    for axis, arcsec in zip("xyz", turn_arcsec, strict=True):
        number = figures.names.index((f"attitude_{axis}", -1, "arcsec"))
        assert found[number] == pytest.approx(arcsec, abs=1e-4)


def test_a_true_delay_is_that_of_the_truth_s_panel():
    file = stated_bench("[certify]\nrate_deg_s = 1.0\n")
    monitor = structs.replace(file.config.monitor, panel_delay_ms=12.5)
    truth = dataclasses.replace(file, config=structs.replace(file.config, monitor=monitor))
    figures = Figures(file, [reference_star(direction=np.array([0.0, 0.0, 1.0]))])
    assert file.config.monitor.panel_delay_ms != 12.5
    off = true_deviations(figures, truth)
    assert (off.delay_ms.tolist(), off.late_ms.tolist()) == ([12.5], [0.0])
    assert off.place_arcsec == pytest.approx(np.zeros((1, 1, 2)))
