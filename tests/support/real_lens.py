"""A strongly bent lens of 17 degrees before a tilted screen, as a geometry file, and its truth
by textbook formulas alone.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from tests.support.benches import bench_text

SIZE = (1920, 1080)
LINES = """kind = "hilstar geometry 1"
resolution_px = [1920, 1080]
focal_length_px = 6120.0
principal_point_px = [974.5, 524.0]
q_cam_to_mon = [0.99998, 0.003, -0.004, 0.0038]
tilt_deg = [1.0, -0.6]
k1 = 0.6
k2 = -1.5
p1 = 1e-3
p2 = -2e-3
"""
BENCH = bench_text(
    {
        "tracker": {"transmission": None},
        "monitor": {"resolution_px": list(SIZE), "bits": 10},
        "collimator": {"focal_length_mm": 350, "geometry": "geometry.toml"},
        "sky": {"faintest_v_mag": 7},
        "render": {"quantisation": "exact"},
    }
)


def write_lens_bench(folder: Path, text: str = BENCH) -> Path:
    """A bench file and its geometry file, with a residual field of degree 5."""
    rng = np.random.default_rng(4)
    degree = np.add.outer(np.arange(6), np.arange(6))
    squares = [np.where(degree <= 5, rng.normal(0, 0.5, (6, 6)), 0).tolist() for _ in range(2)]
    (folder / "geometry.toml").write_text(
        f"{LINES}\n[field]\nx_px = {squares[0]}\ny_px = {squares[1]}\n"
    )
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def true_places_px(folder: Path, cam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where directions (n, 3) in cam are shown, px, by the geometry file; NaN for those that do
    not reach the screen.
    """
    lens = tomllib.loads((folder / "geometry.toml").read_text())
    w, *v = np.array(lens["q_cam_to_mon"]) / np.linalg.norm(lens["q_cam_to_mon"])
    mon = cam + 2 * np.cross(v, np.cross(v, cam) + w * cam)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.where(mon[:, 2:] > 0, mon[:, :2] / mon[:, 2:], np.nan).T
    r2 = x**2 + y**2
    radial = 1 + lens["k1"] * r2 + lens["k2"] * r2**2
    # Beyond 15 degrees is far off this screen; there k2 would bring light back.
    radial = np.where(r2 < np.tan(np.radians(15)) ** 2, radial, np.nan)
    bent_x = x * radial + 2 * lens["p1"] * x * y + lens["p2"] * (r2 + 2 * x**2)
    bent_y = y * radial + lens["p1"] * (r2 + 2 * y**2) + 2 * lens["p2"] * x * y
    a, b = np.radians(lens["tilt_deg"])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    axes = about_y @ about_x
    rays = np.column_stack([bent_x, bent_y, np.ones_like(bent_x)])
    hits = rays * (axes[2, 2] / (rays @ axes[:, 2]))[:, None] - [0, 0, 1]
    px, py = (
        lens["focal_length_px"] * (hits @ axes[:, k]) + lens["principal_point_px"][k]
        for k in (0, 1)
    )
    s, t = ((2 * p - size + 1) / size for p, size in ((px, SIZE[0]), (py, SIZE[1])))
    s, t = np.clip(s, -1.1, 1.1), np.clip(t, -1.1, 1.1)
    dx, dy = (
        np.polynomial.chebyshev.chebval2d(s, t, np.array(lens["field"][name]))
        for name in ("x_px", "y_px")
    )
    return px + dx, py + dy
