"""NumPy draws what OpenGL draws by points: eleven benches, three frames of each."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

import hilstar
from hilstar.basics.units import NS_PER_S
from hilstar.display.quantise import shown_light
from hilstar.display.render.numpy_backend import NumpyBackend
from tools import same_codes

pytestmark = pytest.mark.usefixtures("by_points")  # on the CPU both are the same code

EVERY, FRAMES = 4, 3  # of a log of ten attitudes: of bodies one before each of three
LINEAR = 1e-6  # of a frame's brightest pixel, from stars: float32 and the GPU's erf
BLOCK_PX = 16  # two stars wide: their light, whichever pixels show it
# Lit pixels that may have another level. Without a choice between pixels only light within rounding
# of a threshold has one. `exact` and `temporal` have many choices that are as good (see
# test_exact_scenes): of points few are taken otherwise,
# of paths, whose sprites hand their errors on, many.
TIES, CHOICES, PATHS = 1e-3, 0.12, 0.5
OTHER = {
    "round": TIES,
    "bit stealing": TIES,
    "dither": TIES,
    "exact": CHOICES,
    "temporal": CHOICES,
    "lens": CHOICES,
    "lcd-example": CHOICES,
    "effort": CHOICES,
    "satellites": PATHS,
    "motion": PATHS,
}


# How much the errors of blocks of light may differ. With `effort` OpenGL cuts the wings of all
# stars within the tolerance, by some levels next to a star over white; NumPy's `exact` has them
# whole, as where OpenGL lacks compute shaders.
# OpenGL's `exact` makes up for what the dark wings of a path take (0.0017 mag of a star of one turn
# of 1 deg/s at 12 bits), NumPy's does not: trails' blocks differ by it, their levels hardly.
ERRORS, CUT_ERRORS, PATH_ERRORS = 0.12, 0.4, 0.2


def opened(name: str, folder) -> hilstar.Bench:
    """The bench of tools/same_codes.py, with its files."""
    text = same_codes.toml_of(name)
    if name == "bodies":  # NumPy takes 5 s for a disc that fills the whole monitor
        text = text.replace("[640, 480]", "[200, 150]")
    files = {
        "geometry.toml": same_codes.GEOMETRY,
        "station.tle": same_codes.STATION,
        "others.tle": same_codes.OTHERS,
    }
    for file, content in {"bench.toml": text, **files}.items():
        (folder / file).write_text(content)
    same_codes.write_log(folder / "log.csv", name)
    return hilstar.load(folder / "bench.toml")


def both(name: str, folder):
    """The panel, and for each frame its light by OpenGL and NumPy and its levels by both."""
    with opened(name, folder) as bench:
        rows = list(csv.DictReader((folder / "log.csv").read_text().splitlines()))
        by_numpy = replace(bench, renderer=NumpyBackend(bench.renderer.target))
        frames = []
        for number, row in enumerate(rows[::EVERY][:FRAMES]):
            q, rate = (
                np.array([float(row[key]) for key in keys])
                for keys in (("qw", "qx", "qy", "qz"), ("rx", "ry", "rz"))
            )
            sprites = bench.light(bench.view(q, rate, round(float(row["t_s"]) * NS_PER_S)))
            drawn = []
            for one in (bench, by_numpy):
                levels = one.draw_sprites(sprites, number).levels.astype(int)
                drawn += [one.renderer.linear().astype(float), levels]
            frames.append(drawn)
        assert bench.renderer.gl_error() == "GL_NO_ERROR"
        return bench.panel, frames


def blocks(image):
    """Sums over squares of BLOCK_PX."""
    height, width = (size // BLOCK_PX * BLOCK_PX for size in image.shape)
    return (
        image[:height, :width]
        .reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
        .sum(axis=(1, 3))
    )


@pytest.mark.parametrize("name", OTHER)
def test_stars_have_the_same_light_and_levels(name, tmp_path):
    panel, frames = both(name, tmp_path)
    other = lit = 0
    errors = []
    for gl_light, gl, light, levels in frames:
        assert np.abs(light - gl_light).max() < LINEAR * gl_light.max()
        other, lit = other + int((levels != gl).sum()), lit + int((gl > 0).sum())
        assert np.abs(levels - gl).max() <= (8 if name == "effort" else 1)
        wanted = np.minimum(light, panel.flux_at_white_e_per_s)
        errors.append(
            [np.square(blocks(shown_light(found, panel) - wanted)).sum() for found in (gl, levels)]
        )
    assert lit > 1000 and other <= OTHER[name] * lit
    gl_error, error = np.sqrt(np.sum(errors, axis=0))
    bounds = {"effort": CUT_ERRORS, "satellites": PATH_ERRORS}
    assert error == pytest.approx(gl_error, rel=bounds.get(name, ERRORS))


def test_discs_have_the_light_of_opengl_within_its_own_error(tmp_path):
    _, frames = both("bodies", tmp_path)
    for gl_light, gl, light, levels in frames:
        assert np.abs(light - gl_light).max() <= 0.01 * gl_light.max()
        assert light.sum() == pytest.approx(gl_light.sum(), rel=2e-3)
        assert np.abs(levels - gl).max() <= 4
        assert (levels != gl).sum() <= 0.1 * (gl > 0).sum()
