"""What the simulator gets right and wrong of photographs: each camera fitted, each image held
out of the fit of the others.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.basics.charts import BLUE, MUTED, ORANGE, SMALL_PT, chart, write_records
from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.instruments.confront.report import Confronted
from hilstar.instruments.confront.run import confront

ENDINGS = frozenset({".fits", ".fit", ".fz", ".tif", ".tiff", ".png", ".jpg", ".jpeg"})
MIN_HELD_OUT = 3  # images of a camera: two fit it, one tests it
FORM = "a folder for each camera: guess.toml, which holds its [tracker], and its images"


@dataclass(frozen=True, slots=True)
class PhotographFound:
    """One image: how far stars to V = 6.5 are off, alone and by a camera that other images
    fitted; NaN where not measured.
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
    cameras = sorted(
        folder.parent for folder in {*images.glob("guess.toml"), *images.glob("*/guess.toml")}
    )
    if not cameras:
        raise InputError(f"{images}: has no guess.toml; give {FORM}")
    camera_rows = [
        row for folder in cameras for row in confront_camera(folder, directory / folder.name, quick)
    ]
    write_records(directory / "confront.csv", camera_rows)
    draw(directory / "confront", camera_rows)
    return [line_of(row) for row in camera_rows]


def confront_camera(folder: Path, output: Path, quick: bool) -> list[PhotographFound]:
    """The images of one camera, together and each by the others."""
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
            # the image that the message names, or all of them
            text = str(error)
            named = [path for path in paths if str(path) in text or text.startswith(path.name)]
            wrong = named[:1] or paths
            why = re.sub(r"\S*/", "", text).split(": ", 1)[-1]
            for path in wrong:
                refused.append(PhotographFound(folder.name, path.name, refused=why))
            paths = [path for path in paths if path not in wrong]
    if fitted is None:
        return refused
    rows = [row_of(folder.name, fitted, number) for number in range(len(fitted.verdicts))]
    names = [path.name for path in paths]
    if not quick and len(rows) == len(paths) >= MIN_HELD_OUT:
        rows = [held_out(row, folder, output, paths) if row.image in names else row for row in rows]
    return rows + refused


def row_of(camera: str, found: Confronted, number: int) -> PhotographFound:
    """The figures of one image of a confrontation."""
    verdict = found.verdicts[number]
    session = found.session
    return PhotographFound(
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
    row: PhotographFound, folder: Path, output: Path, paths: Sequence[Path]
) -> PhotographFound:
    """The row with what a camera of the other images leaves of this one."""
    own_path = next(path for path in paths if path.name == row.image)
    others = output / "held_out" / own_path.stem / "fit"
    test = output / "held_out" / own_path.stem / "test"
    for place in (output / "held_out", others.parent, others, test):
        make_directory(place)
    try:
        confront(folder / "guess.toml", [path for path in paths if path != own_path], others)
        verdict = confront(others / "tracker.toml", [own_path], test, fixed=True).verdicts[0]
    except InputError:  # too few stars without it: nothing is held out
        return row
    return replace(row, held_out_px=verdict.rms_px, held_out_mag=verdict.rms_mag)


def line_of(row: PhotographFound) -> str:
    """One image in words."""
    name = f"{row.camera}/{row.image}"
    if row.refused:
        return f"{name}: refused: {row.refused}"
    line = (
        f"{name}: {row.stars} stars to V = 6.5 within {row.rms_px:.3f} px and {row.rms_mag:.3f}"
        f" mag, background chi2 {row.background_chi2:.2f}, {row.unexplained} of {row.sources}"
        f" sources unexplained, DN go as light to the power {row.linearity:.2f}"
    )
    if math.isnan(row.held_out_px):
        return line
    return f"{line}; held out {row.held_out_px:.3f} px, {row.held_out_mag:.3f} mag"


def short_name(row: PhotographFound, rows: Sequence[PhotographFound]) -> str:
    """The words of an image's name that not all images of its camera share, whole."""
    parts = Path(row.image).stem.split("_")
    others = []
    for other in rows:
        if other.camera == row.camera and other.image != row.image:
            others.append(set(Path(other.image).stem.split("_")))
    if not others:
        return " ".join(parts)
    shared = set.intersection(*others)
    return " ".join(word for word in parts if word not in shared)


def draw(path: Path, found: Sequence[PhotographFound]) -> None:
    """Bars of what is left of places and light in each image, and points of what is left when it
    is held out.
    """
    rows = [row for row in found if not row.refused]
    if not rows:
        return
    best = min(row.rms_px for row in rows)
    worst = max(row.rms_px for row in rows)
    of = f"{len(rows)} photograph{'s' * (len(rows) > 1)}"
    finding = f"{of}: stars to V = 6.5 are {best:.2f} to {worst:.2f} px off their places"
    note = (
        "Bars: with a camera that all images of it fitted. Points: with the camera of the others."
    )
    places = np.arange(len(rows))
    with chart(
        path, finding, 1, 2, note=note, share_x=False, height_inch=1.6 + 0.3 * len(rows)
    ) as panels:
        for axes, kind, unit in zip(panels, ("px", "mag"), ("px per axis", "mag"), strict=True):
            axes.barh(places, [getattr(row, f"rms_{kind}") for row in rows], color=BLUE, height=0.6)
            axes.plot(
                [getattr(row, f"held_out_{kind}") for row in rows], places, "o", color=ORANGE, ms=5
            )
            axes.set(xlabel=f"rms [{unit}]", xlim=(0, None))
            axes.set_yticks(places, [])
            axes.invert_yaxis()
        labels = [f"{row.camera}, {short_name(row, rows)}" for row in rows]
        panels[0].set_yticks(places, labels, fontsize=SMALL_PT, color=MUTED)
