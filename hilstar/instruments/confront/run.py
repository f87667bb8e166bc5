"""hilstar confront: photographs in, a tracker's bench file and the verdict out."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.instruments.confront.excess import split_excess
from hilstar.instruments.confront.images import Photograph, paged, read_photographs
from hilstar.instruments.confront.judge import Judge, Verdict
from hilstar.instruments.confront.measured_bench import (
    NAMES,
    fixed_camera,
    read_tracker_file,
    write_tracker,
)
from hilstar.instruments.confront.page import page_pictures, write_page
from hilstar.instruments.confront.report import Confronted, failures_of, lines_of, words_of
from hilstar.instruments.confront.session import run_session
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import tracker_camera

OUTPUTS = ("index.html", "stars.csv", "sources.csv", *NAMES)
# photographs in memory, with their backgrounds 0.5 GB; those beyond lie in files
MEMORY_PX = 20_000_000
STAR_COLUMNS = (
    "image",
    "hip",
    "x_px",
    "y_px",
    "x_predicted_px",
    "y_predicted_px",
    "dn",
    "dn_predicted",
    "v_mag",
    "b_v_mag",
    "flags",
)


def confront(
    bench: Path,
    images: Sequence[Path],
    output: Path,
    *,
    start: FloatArray | None = None,
    at_ns: int | None = None,
    fixed: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> Confronted:
    """Confront photographs with a bench's tracker and write DIR's files. Raises InputError: what
    is wrong, and what to do.
    """
    file, has_screen = read_tracker_file(bench)
    photos: list[Photograph] = []
    for path in images:
        read = read_photographs(path, file.config.tracker.resolution_px, at_ns)
        if sum(photograph.dn.size for photograph in (*photos, *read)) > MEMORY_PX:
            read = [replace(photograph, dn=paged(photograph.dn)) for photograph in read]
        photos += read
    full = max(photo.full_dn for photo in photos)
    photos = [replace(photo, full_dn=full) for photo in photos]
    names = [photo.name for photo in photos]
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise InputError(f"{twice}: two images have this name; give each a name of its own")
    if fixed:
        held = fixed_camera(file, max(photo.step_dn for photo in photos))
    else:
        held = None
    try:
        session = run_session(file, photos, _base(file, photos), start, fixed=held)
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"{photos[0].path}: its levels allow no fit ({error}); give raw frames, 8 to 16 bits of"
            " grey"
        ) from error
    make_directory(output)
    if fixed and has_screen:
        tracker = bench
    else:
        tracker = write_tracker(output, session, has_screen)
    judge = Judge(session, tracker)
    verdicts = []
    pictures = []
    try:
        for number in range(len(photos)):
            verdict = judge.of(number)
            pictures.append(page_pictures(session, verdict))
            nothing = np.empty((0, 0))
            verdicts.append(replace(verdict, predicted=nothing, residual=nothing))
            tell(f"{verdict.shot.photo.name}: {words_of(verdict)}")
        defects = int(judge.hot.sum()), int(judge.dead.sum())
        hot = np.argwhere(judge.hot)
    finally:
        judge.close()
    excess = split_excess(session, verdicts)
    notes = list(
        dict.fromkeys(
            [*(f"{p.name}: {note}" for p in photos for note in p.notes), *session.pixels.notes]
        )
    )
    result = Confronted(
        session,
        tuple(verdicts),
        excess,
        tuple(lines_of(session, verdicts, excess, defects)),
        tuple(failures_of(verdicts)),
        tuple(notes),
        tuple(
            str(output / name)
            for name in OUTPUTS
            if name not in NAMES or not (fixed and has_screen)
        ),
        defects,
    )
    _write_tables(output, verdicts, hot)
    write_page(output / "index.html", result, pictures)
    return result


def _base(file: BenchFile, photos: Sequence[Photograph]) -> Camera:
    """The camera as the bench file guesses it, of these photographs' size: a mosaic's planes
    have half of the pixels.
    """
    camera = tracker_camera(file.config.tracker, file.folder)
    size = photos[0].size_px
    if any(photo.size_px != size for photo in photos):
        raise InputError("the images have different sizes; give frames of one camera")
    if size == camera.resolution_px:
        return replace(camera, lens=None)
    times = size[0] / camera.resolution_px[0]
    middle = (size[0] - 1) / 2, (size[1] - 1) / 2
    return Camera(size, camera.focal_length_px * times, middle, camera.cam_to_image)


def _write_tables(output: Path, verdicts: Sequence[Verdict], hot: Any) -> None:
    def text(value: float) -> str:
        return f"{value:.4f}" if math.isfinite(value) else ""

    stars = [
        (
            v.shot.photo.name,
            r.hip,
            *map(text, r.figures),
            " ".join(flag.replace(" ", "-") for flag in r.flags),
        )
        for v in verdicts
        for r in v.stars
    ]
    write_csv(output / "stars.csv", STAR_COLUMNS, stars)
    sources = [
        (v.shot.photo.name, f"{s.x_px:.3f}", f"{s.y_px:.3f}", f"{s.snr:.2f}", s.explained_by)
        for v in verdicts
        for s in v.sources
    ]
    # defects under the threshold of sources are listed once, of no image
    sources += [("", f"{x}", f"{y}", "", "a hot pixel") for y, x in hot[:1000].tolist()]
    write_csv(output / "sources.csv", ("image", "x_px", "y_px", "snr", "explained_by"), sources)
