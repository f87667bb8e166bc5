"""The table of docs/optics.md: what each centroider loses by a wrong PSF. `python tools/centroider_table.py`, two minutes.

The glass is a pupil of its own with coma, astigmatism, field curvature, axial and lateral colour; no noise but the ADC's steps.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.bench.bench_file import read_bench_file
from hilstar.campaign.plan import Centroiding
from hilstar.campaign.solvers import CentroidSolver
from hilstar.optics.psf_file import write_glass
from hilstar.optics.zernike import glass_of_pupil
from hilstar.rotation import from_radec_roll_deg
from hilstar.twin.glass_errors import split_errors
from hilstar.twin.simulator import Simulator

SIZE = 512
FIELDS = [
    (84.0, -1.0),
    (56.0, 24.0),
    (190.0, -60.0),
    (270.0, -25.0),
    (310.0, 42.0),
    (130.0, -45.0),
    (100.0, 10.0),
    (250.0, -40.0),
]
BENCH = f"""
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [{SIZE}, {SIZE}]
quantum_efficiency = "ccd47-20"
exposure_s = 0.1
[tracker.optics]
psf = "psf.fits"
[tracker.detector]
gain_e_per_dn = 1.0
full_well_e = 1e6
bits = 16
[sky]
faintest_v_mag = 7.0
[monitor]
resolution_px = [640, 480]
pixel_pitch_um = 57.65
[collimator]
focal_length_mm = 350
"""
LENS = f"""
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [{SIZE}, {SIZE}]
wavelengths_nm = [450, 575, 700, 850]
focuses_um = [0, 20]
points = 5
half_px = 6
lateral_per_nm = 2e-6
"""
TERMS = {"W131": (500, 0.0), "W222": (400, 0.0), "W220": (300, 0.0), "W020": (600, 1.0)}
WAYS: dict[str, dict[str, Any]] = {
    "a window": {},
    "the nearest Gaussian": {"centroider": "psf", "psf": "gaussian"},
    "the PSF 20 um out of focus": {"centroider": "psf", "psf": "psf.fits", "psf_focus_um": 20.0},
    "the PSF of a lens without coma": {"centroider": "psf", "psf": "no_coma.fits"},
    "the PSF without stars' spectra": {"centroider": "psf", "psf_spectrum": "mean"},
    "the PSF": {"centroider": "psf"},
}


def lens(path: Path, without: str = "") -> None:
    """Write the glass, without one of its terms."""
    terms = "".join(
        f'[[terms]]\nkind = "{kind}"\nnm = {nm}\nper_nm = {per_nm}\n' for kind, (nm, per_nm) in TERMS.items() if kind != without
    )
    path.with_suffix(".toml").write_text(LENS + terms)
    write_glass(path, glass_of_pupil(path.with_suffix(".toml"), None, 1e-3))


def main() -> int:
    """Print the table in Markdown."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lens(folder / "psf.fits")
        lens(folder / "no_coma.fits", "W131")
        (folder / "bench.toml").write_text(BENCH)
        with Simulator(read_bench_file(folder / "bench.toml")) as tracker:
            shots = [
                tracker.expose(tracker.view(from_radec_roll_deg(*radec, 20.0 * k), np.zeros(3)), None)
                for k, radec in enumerate(FIELDS)
            ]
            print(f"widths {tracker.canvas.psf.width_px} px", file=sys.stderr)
            print("| fitted by | stars | in all | distortion | colour | rest |\n| --- | --- | --- | --- | --- | --- |")
            for way, keys in WAYS.items():
                solver = CentroidSolver(Centroiding(**keys), folder)
                found = [seen.star_errors for seen in (solver.solve(shot, tracker) for shot in shots) if seen.star_errors]
                star = np.concatenate([one.star for one in found])
                errors = np.concatenate([np.stack([one.dx_px, one.dy_px], axis=1) for one in found])
                good = star["v_mag"] < 6.0
                places = np.stack([star["x_px"], star["y_px"]], axis=1)[good]
                rms = split_errors(places, star["bv"][good], errors[good], (SIZE, SIZE)).rms_px()
                cells = " | ".join(f"{rms[part]:.4f}" for part in ("total", "distortion", "colour", "psf"))
                print(f"| {way} | {good.sum()} | {cells} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
