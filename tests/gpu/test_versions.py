"""OpenGL from 3.3 on: the newest is asked for, and what is said of it is so. Mesa gives the version that it is told to give."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.support.benches import SMALL_BENCH
from tests.support.commands import HILSTAR
from tests.support.waiting import PATIENCE_S

LOOK = """
import hilstar, json, pathlib, sys
from hilstar.rotation import from_radec_roll_deg
found = {}
for codes in ("round", "dither", "exact", "temporal", "auto"):
    pathlib.Path("bench.toml").write_text(sys.argv[1] + f'\\n[render]\\nquantisation = "{codes}"\\n')
    with hilstar.load("bench.toml") as bench:
        lit = int((bench.frame(from_radec_roll_deg(84.0, -1.0, 0.0)).levels > 0).sum())
        found[codes] = [bench.renderer.gl_version[:3], bench.renderer.path, bench.config.render.quantisation, lit]
print(json.dumps(found))
"""
WITH_COMPUTE = {
    "round": "compute shaders",
    "dither": "points",
    "exact": "compute shaders",
    "temporal": "compute shaders",
}
WITHOUT = {"round": "points", "dither": "points", "exact": "NumPy", "temporal": "NumPy"}


def at_version(version: str, command: list[str], folder) -> str:
    environment = os.environ | {"MESA_GL_VERSION_OVERRIDE": version}
    ran = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, timeout=PATIENCE_S, check=True)
    return ran.stdout


@pytest.mark.usefixtures("on_llvmpipe")
@pytest.mark.parametrize(
    ("version", "paths"), [("3.3", WITHOUT), ("4.2", WITHOUT), ("4.3", WITH_COMPUTE), ("4.5", WITH_COMPUTE)]
)
def test_the_newest_version_is_taken_and_each_path_is_named(tmp_path, version, paths):
    found = json.loads(at_version(version, [sys.executable, "-c", LOOK, SMALL_BENCH], tmp_path))
    assert {codes: path for codes, (_, path, _, _) in found.items() if codes != "auto"} == paths
    assert {shown for shown, _, _, _ in found.values()} == {version}
    assert all(lit > 0 for _, _, _, lit in found.values())
    _, path, chosen, _ = found["auto"]
    assert path == paths[chosen]


@pytest.mark.usefixtures("on_llvmpipe")
@pytest.mark.parametrize(("version", "exact"), [("3.3", "NumPy (slow"), ("4.5", "compute shaders")])
def test_doctor_says_by_what_codes_are_chosen(tmp_path, version, exact):
    said = at_version(version, [*HILSTAR, "doctor"], tmp_path)
    assert f"exact and temporal by {exact}" in said
