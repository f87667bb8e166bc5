"""LOST (UWCubeSat, MIT): the places of its star generator, the sign of its roll, and its solver on
hilstar's exposures.

LOST projects its own catalogue (the Bright Star Catalogue, J2000) by its own quaternions. It is
built with `make release LOST_DISABLE_ASAN=1`; the environment's LOST names its folder. The places
stand in tests/data/lost_places.csv, for where it is not at hand.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

import hilstar
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import two_digits
from hilstar.basics.errors import MachineError
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.optics.camera import Camera
from tests.support.beside.astrometry_side import BENCH, FOCAL_MM, PITCH_UM, rms
from tests.support.beside.steps import Beside, Step

ROOT = Path(__file__).resolve().parents[3]
FIXED = ROOT / "tests" / "data" / "lost_places.csv"
COLUMNS = "hr,ra_deg,dec_deg,x_px,y_px"
RA_DEG, DEC_DEG, ROLL_DEG, FOV_DEG, SIDE_PX = 283.021, 35.349, 30.0, 24.0, 1024
EPOCH_JYEAR = 2000.0
SAME_ARCSEC = 20.0
PRINTED_DIGITS = 6
STEP_ARCSEC = (1.5, 1.0)  # 0.1 s of right ascension and 1 arcsec of declination
CORNER_PX = 0.5
PLACES = "places of its generator"
SOLVED = "attitude its solver finds"
# Options of its README for a star catalogue of pairs to 15 degrees.
DATABASE = (
    *("database", "--max-stars", "5000", "--kvector", "--kvector-min-distance", "0.2"),
    *("--kvector-max-distance", "15", "--kvector-distance-bins", "10000", "--output", "stars.dat"),
)
ATTITUDES = ((84.057, -1.2, 0.0), (283.021, 35.349, 30.0), (130.0, -58.0, 77.0))


@dataclass(frozen=True, slots=True)
class LostPlaces:
    """Stars of LOST's catalogue (n,): HR numbers, places of J2000, and where its generator has them,
    px from the corner of the first pixel.
    """

    hr: FloatArray
    ra_deg: FloatArray
    dec_deg: FloatArray
    x_px: FloatArray
    y_px: FloatArray

    @property
    def directions(self) -> FloatArray:
        """Unit vectors (n, 3), ICRS."""
        ra, dec = np.radians(self.ra_deg), np.radians(self.dec_deg)
        return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)


def run(folder: Path, *, quick: bool = False) -> Beside:
    """Generate, compare and solve by a built LOST. Raises MachineError without one."""
    lost = lost_folder()
    version = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"],
        cwd=lost,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    write_places(folder / FIXED.name, generated(lost), version)
    places = read_places(folder / FIXED.name)
    steps = [*place_steps(places)]
    if not quick:
        steps += solver_steps(lost, folder)
    beside = Beside("LOST", version, "", tuple(steps))
    left = two_digits(beside.size(PLACES, "by LOST's own catalogue"))
    finding = (
        f"LOST's generator has all {len(places.hr)} stars where hilstar has them, to {left} arcsec by"
        " its own catalogue: its roll turns the other way"
    )
    return Beside("LOST", version, finding, tuple(steps))


def lost_folder() -> Path:
    """The folder of a built LOST. Raises MachineError where the environment names none."""
    folder = Path(os.environ.get("LOST", "lost"))
    if not (folder / "lost").exists():
        raise MachineError(
            "LOST is not there; build UWCubeSat/lost with make release LOST_DISABLE_ASAN=1, and give"
            " its folder as the environment's LOST"
        )
    return folder.resolve()


def generated(lost: Path) -> LostPlaces:
    """What LOST's generator has for the attitude."""
    given = {"ra": RA_DEG, "de": DEC_DEG, "roll": ROLL_DEG}
    words = ["./lost", "pipeline", "--generate", "1", "--fov", f"{FOV_DEG:g}"]
    for name, value in given.items():
        words += [f"--generate-{name}", f"{value:g}"]
    words += ["--generate-centroids-only", "--generate-cutoff-mag", "100"]
    words += ["--print-expected-centroids", "-"]
    told = subprocess.run(words, cwd=lost, capture_output=True, text=True, check=True).stdout
    stars: dict[str, dict[str, float]] = {}
    for number, name, value in re.findall(r"expected_centroid_(\d+)_(x|y|id) (\S+)", told):
        stars.setdefault(number, {})[name] = float(value)
    rows = [(star["id"], star["x"], star["y"]) for star in stars.values()]
    hr, x_px, y_px = np.array(sorted(rows)).T
    catalogue: dict[int, tuple[float, float]] = {}
    for line in (lost / "bright-star-catalog.tsv").read_text().splitlines():
        ra_deg, dec_deg, number, *_ = line.split("|")
        catalogue[int(number)] = float(ra_deg), float(dec_deg)
    ra_deg, dec_deg = np.array([catalogue[int(number)] for number in hr]).T
    return LostPlaces(hr, ra_deg, dec_deg, x_px, y_px)


def write_places(path: Path, places: LostPlaces, commit: str) -> None:
    """Write the fixed file, whose head says whose it is."""
    lines = [
        f"# Places by the star generator of LOST (github.com/UWCubeSat/lost, commit {commit}),",
        "# Copyright (c) 2020 Mark Polyakov, Karen Haining, Muki Kiboigo; MIT licence.",
        f"# Attitude RA {RA_DEG}, Dec {DEC_DEG}, roll {ROLL_DEG:g} deg; {FOV_DEG:g} deg on"
        f" {SIDE_PX} px; written by python tools/beside.py lost.",
        COLUMNS,
    ]
    for hr, ra, dec, x, y in zip(
        places.hr, places.ra_deg, places.dec_deg, places.x_px, places.y_px, strict=True
    ):
        lines.append(f"{hr:.0f},{ra:.6f},{dec:.6f},{x:g},{y:g}")
    path.write_text("\n".join(lines) + "\n")


def read_places(path: Path) -> LostPlaces:
    """The places of a fixed file."""
    table = np.genfromtxt(path, delimiter=",", skip_header=4)
    return LostPlaces(*table.T)


def place_steps(places: LostPlaces) -> Iterator[Step]:
    """Hilstar's own stars of J2000 by LOST's attitude, and then what stands between."""
    focal_px = SIDE_PX / 2 / np.tan(np.radians(FOV_DEG / 2))
    middle_px = (SIDE_PX - 1) / 2
    camera = Camera((SIDE_PX, SIDE_PX), float(focal_px), (middle_px, middle_px), np.eye(3))
    lost_px = np.stack([places.x_px, places.y_px])
    stars = same_stars(places)

    def apart(directions: FloatArray, roll_deg: float, corner_px: float) -> FloatArray:
        matrix = to_matrix(from_radec_roll_deg(RA_DEG, DEC_DEG, roll_deg))
        ours_px = np.stack(camera.project(directions @ matrix.T))
        off_px = lost_px - ours_px - corner_px
        return np.asarray(off_px / focal_px * ARCSEC_PER_RAD)

    unit = "arcsec rms an axis"
    both = apart(stars, ROLL_DEG, 0.0)
    yield Step(PLACES, unit, "as both come", rms(both.ravel().tolist()))
    turned = apart(stars, -ROLL_DEG, 0.0)
    yield Step(PLACES, unit, "with LOST's roll the other way", rms(turned.ravel().tolist()))
    centred = apart(stars, -ROLL_DEG, CORNER_PX)
    yield Step(PLACES, unit, "and pixels from their centres", rms(centred.ravel().tolist()))
    across = STEP_ARCSEC[0] * np.cos(np.radians(places.dec_deg))
    rounding = np.sqrt((np.mean(across**2) + STEP_ARCSEC[1] ** 2) / 24)
    yield Step(PLACES, unit, "for comparison: its catalogue's rounding", float(rounding))
    own = apart(places.directions, -ROLL_DEG, CORNER_PX)
    yield Step(PLACES, unit, "by LOST's own catalogue", rms(own.ravel().tolist()))
    digit_px = 10.0 ** (np.floor(np.log10(lost_px)) + 1 - PRINTED_DIGITS)
    printed = rms(digit_px.ravel().tolist()) / np.sqrt(12) / focal_px * ARCSEC_PER_RAD
    yield Step(PLACES, unit, "for comparison: the six digits that it prints", float(printed))


def same_stars(places: LostPlaces) -> FloatArray:
    """Hilstar's star nearest to each of LOST's (n, 3). Raises ValueError where one has none."""
    with hilstar.load(
        {**BENCH, "sky": {"epoch_jyear": EPOCH_JYEAR, "faintest_v_mag": 9.0}}
    ) as bench:
        vectors = np.asarray(bench.stars.vectors)
    tree = cKDTree(vectors)
    apart, star = tree.query(places.directions)
    if apart.max() * ARCSEC_PER_RAD > SAME_ARCSEC:
        raise ValueError(f"HR {places.hr[apart.argmax()]:.0f} is not among hilstar's stars")
    return np.asarray(vectors[star])


def solver_steps(lost: Path, folder: Path) -> Iterator[Step]:
    """Attitudes that LOST finds of hilstar's noisy exposures, by examples/lost_solver.py."""
    subprocess.run(["./lost", *DATABASE], cwd=lost, capture_output=True, check=True)
    fov_deg = 2 * np.degrees(np.arctan(SIDE_PX * PITCH_UM * 1e-3 / FOCAL_MM / 2))
    solver = ROOT / "examples" / "lost_solver.py"
    across: list[float] = []
    about: list[float] = []
    with hilstar.load({**BENCH, "sky": {"epoch_jyear": EPOCH_JYEAR}}) as bench:
        for number, at in enumerate(ATTITUDES):
            q = from_radec_roll_deg(*at)
            picture = folder / f"lost_{number}.png"
            Image.fromarray(bench.simulate(q, seed=58).dn).save(picture, compress_level=1)
            words = [sys.executable, str(solver), str(lost), str(picture.resolve()), f"{fov_deg}"]
            told = subprocess.run(words, capture_output=True, text=True, check=True).stdout
            if not told:
                raise ValueError(f"LOST finds no attitude at {at}")
            found = np.array(told.split(), dtype=np.float64)
            turn = to_matrix(found) @ to_matrix(q).T
            vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0]]) / 2
            across += (vector * ARCSEC_PER_RAD).tolist()
            about.append(float((turn[1, 0] - turn[0, 1]) / 2 * ARCSEC_PER_RAD))
    yield Step(SOLVED, "arcsec rms", "across the boresight", rms(across))
    yield Step(SOLVED, "arcsec rms", "about it", rms(about))
