"""hilstar confront: photographs in, a tracker's bench file and the verdict out."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
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
from hilstar.instruments.confront.page import Pictures, page_pictures, write_page
from hilstar.instruments.confront.report import Confronted, failures_of, lines_of, words_of
from hilstar.instruments.confront.session import Advance, Session, run_session
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import tracker_camera

RESULTS = ("index.html", "stars.csv", "sources.csv")
OUTPUTS = (*RESULTS, *NAMES)
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
SOURCE_COLUMNS = ("image", "x_px", "y_px", "snr", "explained_by")
MAX_HOT_ROWS = 1000
# done by time, once the simulator is ready, and the photographs are judged
SIMULATOR_PERCENT, JUDGED_PERCENT = 88, 94


@dataclass(frozen=True, slots=True)
class _Judgement:
    """The verdicts on all photographs, their pictures, and the detector's defects: rows and columns
    of hot pixels (n, 2), and the counts of hot and dead ones.
    """

    verdicts: tuple[Verdict, ...]
    pictures: tuple[Pictures, ...]
    hot: IntArray
    defects: tuple[int, int]


def confront(
    bench: Path,
    images: Sequence[Path],
    output: Path,
    *,
    start: FloatArray | None = None,
    at_ns: int | None = None,
    fixed: bool = False,
    tell: Callable[[str], None] = lambda line: None,
    advance: Advance = lambda percent: None,
) -> Confronted:
    """Confront photographs with a bench's tracker and write DIR's files. Raises InputError: what
    is wrong, and what to do.

    `tell` is given a line for each photograph, and `advance` what is done, percent.
    """
    file, has_screen = read_tracker_file(bench)
    photos = _read(file, images, at_ns)
    fixed_optics = None
    if fixed:
        fixed_optics = fixed_camera(file, max(photo.step_dn for photo in photos))
    try:
        session = run_session(
            file, photos, _base(file, photos), start, fixed=fixed_optics, advance=advance
        )
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"{photos[0].path}: its levels allow no fit ({error}); give raw frames, 8 to 16 bits of"
            " grey"
        ) from error
    make_directory(output)
    tracker, names = _judged_by(bench, output, session, has_screen=has_screen)
    judgement = _judge(session, tracker, tell, advance)
    excess = split_excess(session, judgement.verdicts)
    lines = lines_of(session, judgement.verdicts, excess, judgement.defects)
    result = Confronted(
        session=session,
        verdicts=judgement.verdicts,
        excess=excess,
        lines=tuple(lines),
        failures=tuple(failures_of(judgement.verdicts)),
        notes=_notes(photos, session),
        written=tuple(str(output / name) for name in names),
        defects=judgement.defects,
    )
    _write_stars(output / "stars.csv", judgement.verdicts)
    _write_sources(output / "sources.csv", judgement)
    write_page(output / "index.html", result, judgement.pictures)
    advance(100)
    return result


def _judged_by(
    bench: Path, output: Path, session: Session, *, has_screen: bool
) -> tuple[Path, tuple[str, ...]]:
    """The bench file of the tracker that photographs are held against, and the names of what is
    written: that of a fixed camera before a screen is its own, any other is written.
    """
    if session.fixed and has_screen:
        return bench, RESULTS
    return write_tracker(output, session, has_screen), OUTPUTS


def _read(file: BenchFile, images: Sequence[Path], at_ns: int | None) -> list[Photograph]:
    """The photographs, all with the full scale of the largest; a mosaic's planes are one each.

    Raises InputError where two have one name, by which tables and pages know them.
    """
    photos: list[Photograph] = []
    pixels = 0
    for path in images:
        read = read_photographs(path, file.config.tracker.resolution_px, at_ns)
        pixels += sum(photo.dn.size for photo in read)
        if pixels > MEMORY_PX:
            read = [replace(photo, dn=paged(photo.dn)) for photo in read]
        photos += read
    names: set[str] = set()
    for photo in photos:
        if photo.name in names:
            raise InputError(
                f"{photo.name}: two images have this name; give each a name of its own"
            )
        names.add(photo.name)
    full_dn = max(photo.full_dn for photo in photos)
    return [replace(photo, full_dn=full_dn) for photo in photos]


def _judge(
    session: Session, tracker: Path, tell: Callable[[str], None], advance: Advance
) -> _Judgement:
    """Judge each photograph by what `simulate` predicts of it with a tracker file."""
    judge = Judge(session, tracker)
    verdicts = []
    pictures = []
    nothing = np.empty((0, 0))
    count = len(session.shots)
    try:
        for number in range(count):
            judged_percent = (JUDGED_PERCENT - SIMULATOR_PERCENT) * number // count
            advance(SIMULATOR_PERCENT + judged_percent)
            verdict = judge.of(number)
            pictures.append(page_pictures(session, verdict))
            # its images take as much memory as all that stays of it
            verdicts.append(replace(verdict, predicted=nothing, residual=nothing))
            tell(f"{verdict.shot.photo.name}: {words_of(verdict)}")
    finally:
        judge.close()
    defects = int(judge.hot.sum()), int(judge.dead.sum())
    return _Judgement(tuple(verdicts), tuple(pictures), np.argwhere(judge.hot), defects)


def _notes(photos: Sequence[Photograph], session: Session) -> tuple[str, ...]:
    """What was assumed of photographs and of the detector, once each."""
    notes = []
    for photo in photos:
        notes += [f"{photo.name}: {note}" for note in photo.notes]
    return tuple(dict.fromkeys([*notes, *session.pixels.notes]))


def _base(file: BenchFile, photos: Sequence[Photograph]) -> Camera:
    """The camera as the bench file guesses it, of these photographs' size: a mosaic's planes
    have half of the pixels.
    """
    camera = tracker_camera(file.config.tracker, file.folder)
    size_px = photos[0].size_px
    if any(photo.size_px != size_px for photo in photos):
        raise InputError("the images have different sizes; give frames of one camera")
    if size_px == camera.resolution_px:
        return replace(camera, lens=None)
    width, height = size_px
    focal_length_px = camera.focal_length_px * (width / camera.resolution_px[0])
    middle_px = (width - 1) / 2, (height - 1) / 2
    return Camera(size_px, focal_length_px, middle_px, camera.cam_to_image)


def _write_stars(path: Path, verdicts: Sequence[Verdict]) -> None:
    rows: list[tuple[object, ...]] = []
    for verdict in verdicts:
        for star in verdict.stars:
            figures = [_text(value) for value in star.figures]
            flags = [flag.replace(" ", "-") for flag in star.flags]
            rows.append((verdict.shot.photo.name, star.hip, *figures, " ".join(flags)))
    write_csv(path, STAR_COLUMNS, rows)


def _text(value: float) -> str:
    """A number for a table, empty where it is not known."""
    if math.isfinite(value):
        return f"{value:.4f}"
    return ""


def _write_sources(path: Path, judgement: _Judgement) -> None:
    rows: list[tuple[object, ...]] = []
    for verdict in judgement.verdicts:
        name = verdict.shot.photo.name
        for source in verdict.sources:
            x = f"{source.x_px:.3f}"
            y = f"{source.y_px:.3f}"
            rows.append((name, x, y, f"{source.snr:.2f}", source.explained_by))
    # defects under the threshold of sources are listed once, of no image
    for y_px, x_px in judgement.hot[:MAX_HOT_ROWS].tolist():
        rows.append(("", f"{x_px}", f"{y_px}", "", "a hot pixel"))
    write_csv(path, SOURCE_COLUMNS, rows)
