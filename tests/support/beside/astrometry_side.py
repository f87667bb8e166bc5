"""astrometry.net's solver (BSD-3 and GPL, Debian's package): attitudes, handedness and distortion of
hilstar's exposures, by an index of hilstar's own star table.

The solver knows nothing but pixels: it finds stars in the image by its own code, matches them to
the index, and fits a TAN or a SIP header of its own.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import hilstar
from hilstar.api import OpenBench
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import two_digits
from hilstar.basics.errors import MachineError
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.optics.camera import Camera
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.frame_files import world_coordinates
from tests.support.beside.steps import Beside, Step

SOLVER, INDEXER = "solve-field", "build-astrometry-index"
SIDE_PX, FOCAL_MM, PITCH_UM = 1024, 70.0, 13.0
ATTITUDES = ((84.057, -1.2, 0.0), (283.021, 35.349, 30.0), (130.0, -58.0, 77.0))
BENCH: dict[str, dict[str, Any]] = {
    "tracker": {
        "aperture_mm": 30,
        "focal_length_mm": FOCAL_MM,
        "pixel_pitch_um": PITCH_UM,
        "resolution_px": [SIDE_PX, SIDE_PX],
        "quantum_efficiency": "ccd47-20",
        "psf_sigma_px": [0.8, 0.8],
        "exposure_s": 0.2,
        "detector": {"gain_e_per_dn": 4.0, "read_noise_e": 8.0, "bits": 16, "full_well_e": 3e5},
    },
    "background": {"electrons_per_px": 40.0},
    "sky": {"faintest_v_mag": 7.5},
    "monitor": {"resolution_px": [320, 240], "pixel_pitch_um": 57.65},
    "collimator": {"focal_length_mm": 60},
}
RADIAL = -0.2  # k1 of a lens: 2.6 px at the corner
# Quads of 1.5 to 6 degrees, in cells of 7 degrees, of stars brighter than the image's faintest.
INDEX_V_MAG, INDEX_OPTIONS = 7.0, ("-N", "8", "-l", "90", "-u", "360", "-n", "20", "-r", "120")
GRID = 21
ALL_STARS = 1  # the order of a polynomial without bends, which the solver fits to all its stars
# What is solved: the step, of an exposure or of the truth's places, and the polynomial's order.
BY_CENTROIDS = "a fit to all its centroids"
CASES = (
    ("exposures with noise, its quad of four", "image", 0),
    (BY_CENTROIDS, "image", ALL_STARS),
    ("hilstar's places, its quad of four", "places", 0),
    ("hilstar's places, a fit to all", "places", ALL_STARS),
)
LENS_CASES = (
    ("without its SIP", "places", ALL_STARS),
    ("an exposure with noise, SIP of order 3", "image", 3),
    ("hilstar's places, SIP of order 3", "places", 3),
    ("hilstar's places, SIP of order 5", "places", 5),
)
MATCHED_PX = 1.5


@dataclass(frozen=True, slots=True)
class Solution:
    """A header that the solver wrote, held beside the attitude and the camera that were drawn."""

    across_arcsec: float
    about_arcsec: float
    distortion_px: float
    same_hand: bool
    expected_across_arcsec: float = 0.0
    expected_about_arcsec: float = 0.0


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Solve three attitudes of a pinhole and one of a lens; a `quick` run solves one and one, by
    what tests/authority asks for. Raises MachineError without the solver.
    """
    version = solver_version()
    config = make_index(folder)
    attitudes, cases, lens_cases = ATTITUDES, CASES, LENS_CASES
    if quick:
        attitudes, cases, lens_cases = ATTITUDES[:1], CASES[1::2], LENS_CASES[::2]
    with hilstar.load(BENCH) as bench:
        found = {}
        for step, source, order in cases:
            found[step] = [solved(bench, config, folder, at, source, order) for at in attitudes]
    steps: list[Step] = []
    for subject, name in (
        ("attitude: across the boresight", "across_arcsec"),
        ("attitude: about the boresight", "about_arcsec"),
    ):
        for step, solutions in found.items():
            size = rms([getattr(one, name) for one in solutions])
            steps.append(Step(subject, "arcsec rms", step, size))
            if step == BY_CENTROIDS:
                size = rms([getattr(one, f"expected_{name}") for one in solutions])
                compared = "for comparison: what its centroids' errors do"
                steps.append(Step(subject, "arcsec rms", compared, size))
    with hilstar.load(bench_of(folder / "lens.toml")) as bench:
        bent = {}
        for step, source, order in lens_cases:
            bent[step] = solved(bench, config, folder, ATTITUDES[1], source, order)
    subject, unit = "distortion of a lens, over the image", "px rms"
    steps += [Step(subject, unit, step, one.distortion_px) for step, one in bent.items()]
    every = [*bent.values(), *(one for solutions in found.values() for one in solutions)]
    if not all(one.same_hand for one in every):
        raise ValueError("the solver's sky and the one drawn are mirrored")
    beside = Beside("astrometry.net", version, "", tuple(steps))
    across = two_digits(beside.size("attitude: across the boresight", "hilstar's places, a fit"))
    finding = (
        f"astrometry.net's solver finds the attitudes drawn, unmirrored: to {across} arcsec across"
        " the boresight by hilstar's places"
    )
    return replace(beside, finding=finding)


def rms(values: Sequence[float]) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def bench_of(lens: Path) -> dict[str, dict[str, Any]]:
    """The bench behind a lens, whose file is written."""
    lens.write_text(f"k1 = {RADIAL}\n")
    tracker = {**BENCH["tracker"], "distortion": str(lens.resolve())}
    return {**BENCH, "tracker": tracker}


def solver_version() -> str:
    """The version of the solver that is installed. Raises MachineError where it is not."""
    if shutil.which(SOLVER) is None or shutil.which(INDEXER) is None:
        raise MachineError(f"{SOLVER} is not installed; apt-get install astrometry.net")
    told = subprocess.run([SOLVER, "--help"], capture_output=True, text=True, check=False)
    found = re.search(r"Revision ([\d.]+)", told.stdout + told.stderr)
    return found[1] if found else "of an unknown version"


def make_index(folder: Path) -> Path:
    """An index of hilstar's stars to INDEX_V_MAG, where it has them on the date of the bench."""
    with hilstar.load(BENCH) as bench:
        stars = bench.stars
        bright = np.flatnonzero(stars.v_mag < INDEX_V_MAG)
        bright = bright[np.argsort(stars.v_mag[bright])]
        x, y, z = stars.vectors[bright].T
        columns = {
            "RA": np.degrees(np.arctan2(y, x)) % 360,
            "DEC": np.degrees(np.arcsin(z)),
            "MAG": stars.v_mag[bright],
        }
    catalogue, index = folder / "catalogue.fits", folder / "index.fits"
    Table(columns).write(catalogue, overwrite=True)
    command = [INDEXER, "-i", str(catalogue), "-o", str(index), "-S", "MAG", "-I", "5801"]
    subprocess.run([*command, *INDEX_OPTIONS, "-E"], check=True, capture_output=True)
    text = f"inparallel\nadd_path {folder}\nindex {index}\n"
    (folder / "solver.cfg").write_text(text)
    return folder / "solver.cfg"


def solved(
    bench: OpenBench,
    config: Path,
    folder: Path,
    radec_roll_deg: tuple[float, float, float],
    source: str,
    order: int,
) -> Solution:
    """What the solver makes of an exposure ("image"), or of the "places" of hilstar's truth, with a
    polynomial of an order; 0: of its quad alone.
    """
    q = from_radec_roll_deg(*radec_roll_deg)
    exposure = bench.simulate(q, seed=58)
    camera = tracker_camera(bench.config.tracker, bench.file.folder)
    path = folder / f"{source}.fits"
    options = ["--no-plots", "--overwrite", "--config", str(config), "--new-fits", "none"]
    options += ["--scale-units", "degwidth", "--scale-low", "9", "--scale-high", "13"]
    options += ["--crpix-center", "--cpulimit", "60"]
    # two programs that take out lines and crowds of stars, of which there are none: the answer is
    # the same without, in a third of the time
    options += ["--no-remove-lines", "--uniformize", "0"]
    options += ["--tweak-order", str(order)] if order else ["--no-tweak"]
    if source == "image":
        fits.PrimaryHDU(exposure.dn).writeto(path, overwrite=True)
    else:
        write_places(path, exposure.truth)
        options += ["--width", str(SIDE_PX), "--height", str(SIDE_PX), "--sort-column", "FLUX"]
    answer = folder / f"{source}.wcs"
    answer.unlink(missing_ok=True)
    subprocess.run(
        [SOLVER, *options, "--wcs", str(answer), str(path)],
        check=True,
        capture_output=True,
        cwd=folder,
    )
    if not answer.exists():
        raise MachineError(f"{SOLVER} found no solution of {source} at {radec_roll_deg}")
    solution = beside_truth(fits.getheader(answer), camera, q)
    if source == "places":
        return solution
    across, about = by_centroids(fits.getdata(folder / f"{source}.corr"), exposure.truth, camera)
    return replace(solution, expected_across_arcsec=across, expected_about_arcsec=about)


def by_centroids(matches: Any, truth: Any, camera: Camera) -> tuple[float, float]:
    """What the errors of the solver's matched centroids do to an attitude by least squares, arcsec:
    rms of an axis across the boresight, and about it.
    """
    places = np.stack([matches["field_x"], matches["field_y"]]).astype(np.float64) - 1
    true = np.stack([truth["x_px"], truth["y_px"]])
    apart = np.hypot(*(places[:, :, None] - true[:, None, :]))
    star = apart.argmin(axis=1)
    near = apart.min(axis=1) < MATCHED_PX
    errors = (places - true[:, star])[:, near]
    x, y = true[:, star][:, near] - np.array(camera.principal_point_px)[:, None]
    zero, one = np.zeros_like(x), np.ones_like(x)
    terms = np.concatenate([np.stack([one, zero, -y, x]), np.stack([zero, one, x, y])], axis=1).T
    shift_x, shift_y, turn, _ = np.linalg.lstsq(terms, errors.ravel(), rcond=None)[0]
    across = np.hypot(shift_x, shift_y) / np.sqrt(2) / camera.focal_length_px
    return float(across * ARCSEC_PER_RAD), float(abs(turn) * ARCSEC_PER_RAD)


def write_places(path: Path, truth: Any) -> None:
    """The truth's places as a list of stars: pixels of FITS, which count from 1."""
    x_px, y_px, light = truth["x_px"], truth["y_px"], truth["electrons_per_s"]
    inside = (np.abs(x_px - 511.5) < SIDE_PX / 2) & (np.abs(y_px - 511.5) < SIDE_PX / 2)
    columns = {"X": x_px[inside] + 1, "Y": y_px[inside] + 1, "FLUX": light[inside]}
    Table(columns).write(path, overwrite=True)


def beside_truth(header: fits.Header, camera: Camera, q_icrs_to_cam: FloatArray) -> Solution:
    """The turn that takes the solver's sky to the one drawn, at a grid of pixels; and its
    distortion, where the best attitude and scale are taken out.
    """
    x_px, y_px = camera.grid_px(GRID)
    # the solver's header has no image, whose axes Astropy counts
    header["NAXIS"] = 2
    header["NAXIS1"] = header["NAXIS2"] = SIDE_PX
    wcs = WCS(header)
    ra, dec = np.radians(wcs.all_pix2world(x_px, y_px, 0))
    theirs = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    rays = camera.rays(x_px, y_px)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = theirs @ to_matrix(q_icrs_to_cam).T  # in cam, by the attitude that was drawn
    u, _, vt = np.linalg.svd(rays.T @ seen)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    vector = (
        np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    )
    places = np.stack(camera.project(seen @ turn.T))
    true = np.stack([x_px, y_px])
    middle = true.mean(axis=1, keepdims=True)
    scale = ((true - middle) * (places - middle)).sum() / ((places - middle) ** 2).sum()
    apart = (true - middle) - scale * (places - places.mean(axis=1, keepdims=True))
    ours = WCS(fits.Header(world_coordinates(replace(camera, lens=None), q_icrs_to_cam)))
    hands = [np.linalg.det(one.pixel_scale_matrix) for one in (wcs, ours)]
    return Solution(
        float(np.hypot(vector[0], vector[1]) / np.sqrt(2) * ARCSEC_PER_RAD),
        float(abs(vector[2]) * ARCSEC_PER_RAD),
        float(np.sqrt((apart**2).sum(axis=0).mean() / 2)),
        bool(hands[0] * hands[1] > 0),
    )
