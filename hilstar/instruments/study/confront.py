"""What the simulator gets right and wrong of photographs: each camera fitted, each image held
out of the fit of the others.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.charts import BLUE, MUTED, ORANGE, SMALL_PT, chart
from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.instruments.confront.report import Confronted
from hilstar.instruments.confront.run import confront
from hilstar.instruments.study.engine import values, write_rows

ENDINGS = frozenset({".fits", ".fit", ".fz", ".tif", ".tiff", ".png", ".jpg", ".jpeg"})
MIN_HELD_OUT = 3  # images of a camera: two fit it, one tests it
ERRORS = {"px": "px per axis", "mag": "mag"}  # of a row, by the end of its fields, and their units
NOTE = "Bars: with a camera that all images of it fitted. Points: with the camera of the others."
FORM = "a folder for each camera: guess.toml, which holds its [tracker], and its images"


@dataclass(frozen=True, slots=True)
class PhotographRow:
    """One image: errors of its stars to V = 6.5 in a fit of all images, and when it is held out.

    NaN where not measured.
    """

    camera: str
    image: str
    stars: int = 0
    rms_px: float = math.nan
    rms_mag: float = math.nan
    background_chi2: float = math.nan
    sources: int = 0
    unexplained: int = 0
    missing: int = 0
    linearity: float = math.nan
    held_out_px: float = math.nan
    held_out_mag: float = math.nan
    refused: str = ""


def run(directory: Path, images: Path, quick: bool = False) -> list[str]:
    """Confront every camera's images, write `confront.csv`, its chart and a page for each camera; a
    line for each image.

    With `quick` no image is held out. Raises InputError where `images` has no cameras.
    """
    guesses = {*images.glob("guess.toml"), *images.glob("*/guess.toml")}
    if not guesses:
        raise InputError(f"{images}: has no guess.toml; give {FORM}")
    rows = []
    for guess in sorted(guesses, key=lambda path: path.parent):
        camera = guess.parent
        rows += confront_camera(camera, directory / camera.name, quick)
    write_rows(directory / "confront.csv", rows)
    draw(directory / "confront", rows)
    lines = []
    for row in rows:
        lines.append(line_of(row))
    return lines


def confront_camera(folder: Path, output: Path, quick: bool) -> list[PhotographRow]:
    """The images of one camera: fitted together, and each held out."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    if not paths:
        raise InputError(f"{folder}: has no image; give {FORM}")
    make_directory(output)
    refused = []
    fitted = None
    while paths and fitted is None:
        try:
            fitted = confront(folder / "guess.toml", paths, output)
        except InputError as error:
            wrong = wrong_images(str(error), paths)
            why = re.sub(r"\S*/", "", str(error)).split(": ", 1)[-1]
            for path in wrong:
                refused.append(PhotographRow(folder.name, path.name, refused=why))
            paths = [path for path in paths if path not in wrong]
    if fitted is None:
        return refused
    count = len(fitted.verdicts)
    rows = []
    for number in range(count):
        rows.append(row_of(folder.name, fitted, number))
    if not quick and count == len(paths) >= MIN_HELD_OUT:
        for number, row in enumerate(rows):
            rows[number] = held_out(row, folder, output, paths)
    return rows + refused


def wrong_images(refusal: str, paths: Sequence[Path]) -> Sequence[Path]:
    """The image that a refusal names, or all of them."""
    for path in paths:
        if str(path) in refusal or refusal.startswith(path.name):
            return [path]
    return paths


def row_of(camera: str, confronted: Confronted, number: int) -> PhotographRow:
    """The figures of one image of a confrontation."""
    verdict = confronted.verdicts[number]
    session = confronted.session
    return PhotographRow(
        camera=camera,
        image=verdict.shot.photo.name,
        stars=verdict.counted,
        rms_px=verdict.rms_px,
        rms_mag=verdict.rms_mag,
        background_chi2=verdict.background_chi2,
        sources=len(verdict.sources),
        unexplained=len(verdict.unexplained),
        missing=len(verdict.missing),
        linearity=session.power * session.light.linearity,
    )


def held_out(
    row: PhotographRow, folder: Path, output: Path, paths: Sequence[Path]
) -> PhotographRow:
    """The row with its errors by a camera that the other images fit."""
    own_path = next((path for path in paths if path.name == row.image), None)
    if own_path is None:
        return row
    folders = output / "held_out" / own_path.stem
    others = folders / "fit"
    test = folders / "test"
    for place in (folders.parent, folders, others, test):
        make_directory(place)
    other_paths = [path for path in paths if path != own_path]
    try:
        confront(folder / "guess.toml", other_paths, others)
        confronted = confront(others / "tracker.toml", [own_path], test, fixed=True)
    except InputError:  # too few stars without it: nothing is held out
        return row
    verdict = confronted.verdicts[0]
    return replace(row, held_out_px=verdict.rms_px, held_out_mag=verdict.rms_mag)


def line_of(row: PhotographRow) -> str:
    """One image in words."""
    name = f"{row.camera}/{row.image}"
    if row.refused:
        return f"{name}: refused: {row.refused}"
    errors = f"{row.rms_px:.3f} px and {row.rms_mag:.3f} mag"
    sources = f"{row.unexplained} of {row.sources} sources unexplained"
    line = (
        f"{name}: {row.stars} stars to V = 6.5 within {errors}, background chi2"
        f" {row.background_chi2:.2f}, {sources}, DN go as light to the power {row.linearity:.2f}"
    )
    if math.isnan(row.held_out_px):
        return line
    return f"{line}; held out {row.held_out_px:.3f} px, {row.held_out_mag:.3f} mag"


def short_name(row: PhotographRow, rows: Sequence[PhotographRow]) -> str:
    """An image's name without the words that all images of its camera share."""
    parts = Path(row.image).stem.split("_")
    others = []
    for other in rows:
        if other.camera == row.camera and other.image != row.image:
            others.append(set(Path(other.image).stem.split("_")))
    if not others:
        return " ".join(parts)
    shared = set.intersection(*others)
    return " ".join(word for word in parts if word not in shared)


def draw(path: Path, rows: Sequence[PhotographRow]) -> None:
    """Bars of the errors of places and light in each image, and points of those when it is held
    out.
    """
    measured = [row for row in rows if not row.refused]
    if not measured:
        return
    best = min(row.rms_px for row in measured)
    worst = max(row.rms_px for row in measured)
    of = f"{len(measured)} photograph{'s' * (len(measured) > 1)}"
    finding = f"{of}: stars to V = 6.5 are {best:.2f} to {worst:.2f} px off their places"
    places = np.arange(len(measured))
    layout: dict[str, Any] = {"share_x": False, "height_inch": 1.6 + 0.3 * len(measured)}
    with chart(path, finding, 1, 2, note=NOTE, **layout) as panels:
        for axes, (kind, unit) in zip(panels, ERRORS.items(), strict=True):
            axes.barh(places, values(measured, f"rms_{kind}"), color=BLUE, height=0.6)
            axes.plot(values(measured, f"held_out_{kind}"), places, "o", color=ORANGE, ms=5)
            axes.set(xlabel=f"rms [{unit}]", xlim=(0, None))
            axes.set_yticks(places, [])
            axes.invert_yaxis()
        labels = []
        for row in measured:
            labels.append(f"{row.camera}, {short_name(row, measured)}")
        panels[0].set_yticks(places, labels, fontsize=SMALL_PT, color=MUTED)
