"""OpenGL from 3.3 on: the newest is asked for, and what is said of it is so. Mesa gives the
version that it is told to give.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.benches import SMALL_BENCH
from tests.support.commands import run_started

LOOK = """
import hilstar, json, pathlib, sys
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.render.context import described
found = {}
for codes in ("round", "dither", "exact", "temporal", "auto"):
    pathlib.Path("bench.toml").write_text(sys.argv[1] + f'\\n[render]\\nquantisation = "{codes}"\\n')
    with hilstar.load("bench.toml") as bench:
        lit = int((bench.frame(from_radec_roll_deg(84.0, -1.0, 0.0)).levels > 0).sum())
        found[codes] = [bench.renderer.gl_version[:3], bench.renderer.path, bench.config.render.quantisation, lit]
print(json.dumps([found, described()]))
"""
WITH_COMPUTE = {
    "round": "CPU",
    "dither": "points",
    "exact": "CPU, then compute shaders",
    "temporal": "CPU, then compute shaders",
}
WITHOUT = {"round": "CPU", "dither": "points", "exact": "NumPy", "temporal": "NumPy"}


def at_version(version: str, program: str, *words: str, folder: Path, way: str = "") -> Any:
    """What a program prints as JSON."""
    environment = os.environ | {"MESA_GL_VERSION_OVERRIDE": version, "HILSTAR_DRAW": way}
    ran = run_started([sys.executable, "-c", program, *words], folder, env=environment)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


@pytest.mark.usefixtures("on_llvmpipe")
@pytest.mark.parametrize(
    ("version", "paths"),
    [("3.3", WITHOUT), ("4.2", WITHOUT), ("4.3", WITH_COMPUTE), ("4.5", WITH_COMPUTE)],
)
def test_the_newest_version_is_taken_and_each_path_is_named(tmp_path, version, paths):
    found, doctor_s_line = at_version(version, LOOK, SMALL_BENCH, folder=tmp_path)
    assert {codes: path for codes, (_, path, _, _) in found.items() if codes != "auto"} == paths
    assert {shown for shown, _, _, _ in found.values()} == {version}
    assert all(lit > 0 for _, _, _, lit in found.values())
    _, path, chosen, _ = found["auto"]
    assert path == paths[chosen]
    exact = "compute shaders" if paths == WITH_COMPUTE else "NumPy (slow"
    assert f"exact and temporal by {exact}" in doctor_s_line


APART = """
import json
import numpy as np
from dataclasses import replace
from hilstar.display.quantise import Panel
from hilstar.display.response import srgb_response
from hilstar.display.render.backend import Target
from hilstar.display.render.numpy_backend import headless_context, open_backend
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import sprites_at
rng, psf, grey = np.random.default_rng(36), GaussianPsf((0.85, 0.85)), srgb_response(8)
places = np.stack(np.meshgrid(np.arange(12, 308, 24), np.arange(12, 230, 24)), -1).reshape(-1, 2)
places = places + rng.uniform(-0.5, 0.5, (len(places), 2))
sprites = sprites_at(places, 10.0 ** rng.uniform(2.5, 4.5, len(places)), psf.footprint_px)
light = sprites.data["electrons_per_s"][:, None] * rng.dirichlet([1, 1, 1], len(places))
sprites = replace(sprites, primaries=light.astype(np.float32))
panels = tuple(Panel(grey, 1e4 * share) for share in (0.3, 0.5, 0.2))
stripes, together = np.array([(-1 / 3, 0), (0, 0), (1 / 3, 0)]), 0.4 + 0.6 * np.eye(3)
found, context = {}, headless_context()
for codes in ("round", "dither", "exact"):
    target = Target((320, 240), psf, grey, 1e4, codes, primaries=panels, places_px=stripes, together=together)
    each = [open_backend(target, context), open_backend(target, None)]
    for one in each:
        one.draw(sprites)
    drawn, oracle = (one.levels().astype(int) for one in each)
    found[codes] = [int((drawn != oracle).sum()), int(abs(drawn - oracle).max()), int((oracle > 0).sum())]
print(json.dumps(found))
"""
# Of lit pixels, against the oracle: choices of `exact` have ties that the last bit decides, and the
# next primary follows.
OTHER = {"round": 0.0, "dither": 1e-3, "exact": 0.03}


@pytest.mark.usefixtures("on_llvmpipe")
@pytest.mark.parametrize("version", ["3.3", "4.5"])
def test_stars_of_three_primaries_have_the_oracle_s_codes(version):
    """By points, for on the CPU both are the same code."""
    found = at_version(version, APART, folder=Path.cwd(), way="gl")
    for codes, (other, most, lit) in found.items():
        assert lit > 5000 and other <= OTHER[codes] * lit and most <= 1, codes
