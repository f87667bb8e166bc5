"""The table of docs/optics.md: what each centroider loses by a wrong PSF. `python -m
tools.centroider_table` in the checkout.

The glass is that of tests/support/glass.py: coma, field curvature, axial and lateral colour in
closed form. No noise.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.campaign.plan import Centroiding
from hilstar.instruments.campaign.solvers import CentroidSolver
from hilstar.instruments.simulate.glass import split_errors
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.glass.psf_file import glass_of, write_glass
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.glass import SIDE_PX, stack

FIELDS = 16
FAINTEST_V_MAG, WRONG_PX = 5.5, 1.0  # farther off, a window has gone to a neighbour
TRACKER = {
    "resolution_px": [SIDE_PX, SIDE_PX],
    "focal_length_mm": 12,
    "exposure_s": 0.2,
    "transmission": None,
}
DETECTOR = {"gain_e_per_dn": 1.0, "full_well_e": 1e6, "bits": 16}
PSF = {"centroider": "psf"}
WAYS: dict[str, dict[str, Any]] = {
    "a window": {},
    "the nearest Gaussian": {**PSF, "psf": "gaussian"},
    "the PSF of the middle of the field": {**PSF, "psf": "middle.fits"},
    "the PSF 20 um out of focus": {**PSF, "psf": "psf.fits", "psf_focus_um": 20.0},
    "the PSF 10 um out of focus": {**PSF, "psf": "psf.fits", "psf_focus_um": 10.0},
    "the PSF without stars' spectra": {**PSF, "psf_spectrum": "mean"},
    "the PSF": PSF,
}


def main() -> int:
    """Print the table in Markdown."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_glass(folder / "psf.fits", glass_of(stack(5, focuses_um=(0.0, 10.0, 20.0))))
        write_glass(folder / "middle.fits", glass_of(stack(1)))
        tables: dict[str, dict[str, Any]] = {
            "tracker": TRACKER,
            "tracker.optics": {"psf": "psf.fits"},
            "tracker.detector": DETECTOR,
        }
        (folder / "bench.toml").write_text(bench_text(tables))
        rng = np.random.default_rng(1)
        with Simulator(read_bench_file(folder / "bench.toml")) as tracker:
            looks = zip(
                rng.uniform(0, 360, FIELDS),
                np.degrees(np.arcsin(rng.uniform(-1, 1, FIELDS))),
                strict=True,
            )
            views = [
                tracker.view(from_radec_roll_deg(ra, dec, 20.0 * k), np.zeros(3))
                for k, (ra, dec) in enumerate(looks)
            ]
            shots = [tracker.expose(view, None) for view in views]
            print(
                "| fitted by | stars | in all | distortion | colour | rest |\n| --- | --- | --- |"
                " --- | --- | --- |"
            )
            for way, keys in WAYS.items():
                solver = CentroidSolver(Centroiding(**keys), folder)
                found = [
                    seen.star_errors
                    for seen in (solver.solve(shot, tracker) for shot in shots)
                    if seen.star_errors
                ]
                star = np.concatenate([one.star for one in found])
                errors = np.concatenate([np.stack([one.dx_px, one.dy_px], axis=1) for one in found])
                good = (star["v_mag"] < FAINTEST_V_MAG) & (np.hypot(*errors.T) < WRONG_PX)
                places = np.stack([star["x_px"], star["y_px"]], axis=1)[good]
                rms = split_errors(
                    places, star["bv"][good], errors[good], (SIDE_PX, SIDE_PX)
                ).rms_px()
                cells = " | ".join(
                    f"{rms[part]:.4f}" for part in ("total", "distortion", "colour", "psf")
                )
                print(f"| {way} | {good.sum()} | {cells} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
