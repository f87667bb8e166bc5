"""Solvers: an image in, an attitude out.

There are three: the centroider alone, whose stars the truth identifies; a Python function
(`python:MODULE:FUNCTION`); and a command that gets an image and prints a quaternion.
"""

import contextlib
import json
import math
import re
import shlex
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, did_you_mean, one_line, shortened
from hilstar.basics.files import temporary_folder
from hilstar.basics.process.programs import MAX_OUTPUT_BYTES, Child
from hilstar.basics.process.user_code import UserCodeError, user_function
from hilstar.basics.rotation import multiply, normalise
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.campaign.plan import TRACKER_PSF, Centroiding
from hilstar.instruments.campaign.solver_answer import CentroidErrors, SolverAnswer
from hilstar.instruments.simulate.glass import told_psf
from hilstar.instruments.simulate.live_exposure import LiveTracker
from hilstar.instruments.simulate.pictures import write_dn_picture
from hilstar.instruments.simulate.simulator import Exposure, Simulator
from hilstar.instruments.simulate.star_finder import crowded, nearest
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.formats import reported_stars
from hilstar.server.bench.cameras import flight_camera, tracker_psf
from hilstar.server.bench.config import GAUSSIAN
from hilstar.server.bench.config.hardware import TrackerOptics
from hilstar.server.bench.star_glass import StarGlass, star_glass
from hilstar.tracker.centroiders import Places, psf_places
from hilstar.tracker.centroids import (
    CentroidSettings,
    LocalBackground,
    estimate_background,
    find_stars,
    noisiest_background,
)
from hilstar.tracker.identify import wahba
from hilstar.tracker.mosaic import software_image, software_psf_px

MAX_NORM_ERROR = 1e-3  # a quaternion is unit but for its decimals
MIN_STARS = 2  # for an attitude
FORM = "write --solver python:MODULE:FUNCTION"
IMAGE, PICTURE = "{image}", "{png}"
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
MAX_OUTPUT_CHARACTERS = 100_000
CENTROIDS = "centroids"


class SolverFault(Exception):
    """A solver failed: it raised, ended with an error, took too long, or gave an answer that is
    no attitude.
    """


SolvedTracker = Simulator | DisplayTracker | LiveTracker  # whose images are solved


class WholeAnswer(msgspec.Struct, frozen=True):
    """What a function may return in the place of a quaternion."""

    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    stamp_s: float = 0.0
    centroids: list[list[float | None]] | None = None


class Solver(Protocol):
    """Anything that solves an image. Raises SolverFault."""

    def solve(self, exposure: Exposure, tracker: SolvedTracker) -> SolverAnswer:
        """The attitude of one exposure."""
        ...


def checked_attitude(numbers: object, who: str) -> FloatArray:
    """An answer as a unit quaternion (4,), scalar first. Raises SolverFault where it is none."""
    try:
        q = np.asarray(numbers, dtype=np.float64)
    except (TypeError, ValueError):
        q = np.zeros(0)
    if q.shape != (4,) or not np.isfinite(q).all():
        raise SolverFault(
            f"{who}: answered {shortened(numbers)}; four numbers w, x, y, z are wanted"
        )
    norm = float(np.linalg.norm(q))
    if abs(norm - 1) > MAX_NORM_ERROR:
        raise SolverFault(f"{who}: answered a quaternion of norm {norm:.6g}; a unit one is wanted")
    return np.asarray(q / norm)


class CentroidSolver:
    """Finds stars, and matches each star of the truth, brightest first, with the nearest find
    within 3 px.

    `folder` is that of the PSF's file, where `settings` name one.
    """

    def __init__(self, settings: Centroiding, folder: Path = Path()) -> None:
        self._wanted = settings
        self._folder = folder
        self._told: tuple[str, Psf, StarGlass | None] | None = None

    def solve(self, exposure: Exposure, tracker: SolvedTracker) -> SolverAnswer:
        """Centroid errors, and the attitude by the matched stars."""
        wanted = self._wanted
        psf = tracker.canvas.psf
        detector = tracker.config.tracker.detector
        if wanted.centroider == "psf" and detector.bayer is not None:
            raise InputError(
                '[centroids] centroider = "psf": pixels of a mosaic have a PSF each; leave it out,'
                " or bayer"
            )
        width_px = software_psf_px(psf.width_px, detector)
        settings = CentroidSettings(
            threshold_sigma=wanted.threshold_sigma,
            minimum_pixels=wanted.minimum_pixels,
            window=wanted.window,
            window_sigma_px=wanted.window_sigma_px or max(1.0, *width_px),
            psf_sigma_px=width_px if wanted.remove_s_curve else None,
        )
        truth, (height, width) = exposure.rows, exposure.dn.shape
        image, background = _image_to_search(exposure, tracker)
        stars = find_stars(image, settings, background)
        with np.errstate(invalid="ignore"):
            off_x, off_y = (
                np.abs(truth[name] - (side - 1) / 2)
                for name, side in (("x_px", width), ("y_px", height))
            )
            truth = truth[(off_x <= width / 2) & (off_y <= height / 2) & truth["drawn"]]
        # The truth is in order of light: of stars with one find, the brightest has it.
        index = nearest(stars, truth["x_px"], truth["y_px"])
        first = np.isin(np.arange(len(index)), np.unique(index, return_index=True)[1])
        is_matched = first & (index >= 0)
        if len(stars):
            good = is_matched & ~truth["clipped"] & ~stars.at_edge[index]
        else:
            good = is_matched
        flux = truth["electrons_per_s"]
        if len(truth):
            good &= ~crowded(truth["x_px"], truth["y_px"], flux, settings.radius_px, psf)
        x_px = truth["x_px"][good]
        y_px = truth["y_px"][good]
        matched = int(is_matched.sum())
        dx_px = stars.x_px[index[good]] - x_px
        dy_px = stars.y_px[index[good]] - y_px
        if wanted.centroider == "psf":
            places = self._fitted(
                exposure, tracker, truth[good], (stars.x_px[index[good]], stars.y_px[index[good]])
            )
            dx_px = places[0] - x_px
            dy_px = places[1] - y_px
        counts = len(truth), len(stars), matched, len(stars) - matched
        errors = CentroidErrors(*counts, dx_px, dy_px, truth["v_mag"][good], truth[good])
        inner = np.flatnonzero(~stars.at_edge)
        reported = tuple(
            ReportedStar(float(stars.x_px[k]), float(stars.y_px[k]), float(stars.flux[k]))
            for k in inner
        )
        if len(x_px) < MIN_STARS:
            why = f"{len(x_px)} stars stand alone, and an attitude takes {MIN_STARS}"
            return SolverAnswer(None, why, errors, stars=reported)
        true = normalise(tracker.camera.rays(x_px, y_px))
        known = flight_camera(tracker.config.tracker, tracker.file.folder, tracker.camera)
        rays = normalise(known.rays(x_px + dx_px, y_px + dy_px))
        # Weights are the stars' light, the inverse of photon noise's variance.
        q = multiply(wahba(rays, true, flux[good]), exposure.view.q_icrs_to_cam)
        return SolverAnswer(q, "", errors, stars=reported)

    def _fitted(
        self, exposure: Exposure, tracker: SolvedTracker, truth: npt.NDArray[np.void], first: Places
    ) -> Places:
        """Places (n,) of stars by the PSF that is told, from where a window found them; their
        spectra are known.
        """
        psf, glass = self._told_by(tracker)
        pixels = np.rint(first[1]).astype(np.intp), np.rint(first[0]).astype(np.intp)
        reach = psf.footprint_px // 2 + 1
        image, background = _image_to_search(exposure, tracker)
        padded = np.pad(image - background.level, 2 * reach)
        near = np.arange(reach, 3 * reach + 1)
        stamps = padded[
            (pixels[0][:, None] + near)[:, :, None], (pixels[1][:, None] + near)[:, None, :]
        ]
        shares = None
        if glass is not None and self._wanted.psf_spectrum == "star":
            shares = glass.shares_of(tracker.stars, truth["hip"])
        psf_stamp = told_psf(psf, pixels, len(near), shares)
        x_px, y_px = psf_places(stamps, psf_stamp, (first[0] - pixels[1], first[1] - pixels[0]))
        return pixels[1] + x_px, pixels[0] + y_px

    def _told_by(self, tracker: SolvedTracker) -> tuple[Psf, StarGlass | None]:
        wanted = self._wanted
        psf = tracker.canvas.psf
        if wanted.psf == TRACKER_PSF:
            return psf, tracker.glass if isinstance(tracker, Simulator) else None
        if wanted.psf == GAUSSIAN:
            return GaussianPsf(psf.width_px), None
        if self._told is None or self._told[0] != tracker.file.sha256:
            optics = TrackerOptics(psf=str(self._folder / wanted.psf), focus_um=wanted.psf_focus_um)
            stated_psf = tracker_psf(
                msgspec.structs.replace(tracker.config.tracker, optics=optics), tracker.file.folder
            )
            simulated = isinstance(tracker, Simulator)
            if simulated:
                glass = star_glass(tracker.file, stated_psf)
            else:
                glass = None
            self._told = tracker.file.sha256, stated_psf, glass
        return self._told[1:]


def _image_to_search(
    exposure: Exposure, tracker: SolvedTracker
) -> tuple[npt.NDArray[Any], LocalBackground]:
    """The software's image (h, w) of an exposure, DN, and its background.

    Where a display's black glows over a part of the field, that is taken off, as a tracker takes
    its dark frame: else no star on it is found.
    """
    image = software_image(exposure.dn, tracker.config.tracker.detector)
    dark_dn = None
    if isinstance(tracker, DisplayTracker):
        dark_dn = tracker.dark_dn(exposure.view.exposure_s)
    if dark_dn is None:
        return image, estimate_background(image)
    above = image - dark_dn
    return above, noisiest_background(above)


class FunctionSolver:
    """Calls `function(image, tracker)` with DN, uint16 (height, width), and the facts of the
    tracker's optics.

    It returns q_icrs_to_cam (w, x, y, z), or None where it finds none; or a dictionary of `q` and,
    where it tells them, `rate` (rad/s, cam), `stamp_s` and `centroids` ([x_px, y_px, dn, hip]). The
    module stands in `folder`.
    Raises InputError where there is no such function.
    """

    def __init__(self, name: str, folder: Path, timeout_s: float) -> None:
        self.name = name
        self._timeout_s = timeout_s
        try:
            self._function = user_function(name, folder)
        except UserCodeError as error:
            raise InputError(f"--solver {name}: {one_line(str(error))}; {FORM}") from error

    def solve(self, exposure: Exposure, tracker: SolvedTracker) -> SolverAnswer:
        """The function's answer. Raises SolverFault where it raises, takes too long, or its
        answer is no attitude.
        """
        try:
            with time_limit(self._timeout_s):
                answer = self._function(given_image(exposure, tracker), tracker_facts(tracker))
        except TimeoutError as error:
            raise SolverFault(f"the solver took longer than {self._timeout_s:g} s") from error
        except Exception as error:
            raise SolverFault(
                one_line(f"the solver raised {type(error).__name__}: {error}")
            ) from error
        if isinstance(answer, dict):
            return whole_answer(answer, "the solver")
        if answer is None:
            return SolverAnswer(None, "the solver found no attitude")
        return SolverAnswer(checked_attitude(answer, "the solver"))


def whole_answer(told: dict[str, Any], who: str) -> SolverAnswer:
    """An answer of several parts. Raises SolverFault for one that is none."""
    try:
        answer = msgspec.convert(told, WholeAnswer, strict=False)
    except msgspec.ValidationError as error:
        raise SolverFault(f"{who}: {shortened(error)}; see docs/campaign.md") from error
    stars = None
    if answer.centroids is not None:
        stars = reported_stars(answer.centroids)
    rate_rad_s = None
    if answer.rate is not None:
        rate_rad_s = np.array(answer.rate)
    if answer.q is None:
        return SolverAnswer(None, f"{who} found no attitude", stars=stars)
    q = checked_attitude(answer.q, who)
    return SolverAnswer(q, rate_cam_rad_s=rate_rad_s, stamp_s=answer.stamp_s, stars=stars)


def given_image(exposure: Exposure, tracker: SolvedTracker) -> npt.NDArray[np.uint16]:
    """The DN (height, width) that a solver gets, its own: of a mosaic as `[tracker.detector]
    solver_image` says.
    """
    return np.asarray(
        np.rint(software_image(exposure.dn, tracker.config.tracker.detector)), dtype=np.uint16
    )


def tracker_facts(tracker: SolvedTracker) -> dict[str, Any]:
    """The facts of its optics that a tracker's software knows; nothing about its attitude."""
    settings = tracker.config.tracker
    width, height = settings.resolution_px
    focal_length_px = settings.focal_length_mm * 1e3 / settings.pixel_pitch_um
    return {
        "resolution_px": (width, height),
        "focal_length_px": focal_length_px,
        "principal_point_px": settings.principal_point_px or ((width - 1) / 2, (height - 1) / 2),
        "fov_deg": math.degrees(2 * math.atan(width / 2 / focal_length_px)),
        "psf_sigma_px": tracker.canvas.psf.width_px,
        "exposure_s": settings.exposure_s,
        "epoch_jyear": tracker.config.sky.epoch_jyear,
    }


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the main thread after `seconds`; another thread cannot be
    interrupted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def too_long(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class CommandSolver:
    """Runs a command for each image, without a shell: {image} is a FITS file of its DN alone, {png}
    a 16-bit PNG of them.

    Other words in braces are the tracker's: {fov_deg}, {focal_length_px}, {width_px}, {height_px}.
    The last line of output with four numbers, or with a JSON object that has "q", is q_icrs_to_cam,
    scalar first. Exit code 0 without such a line means no attitude; any other code is a fault.
    Raises InputError for a template without an image.
    """

    def __init__(self, template: str, folder: Path, timeout_s: float) -> None:
        try:
            self._words = shlex.split(template)
        except ValueError as error:
            raise InputError(
                f"--solver {template}: {error}; write a command with {IMAGE}, or {PICTURE}, in it"
            ) from error
        if not any(IMAGE in word or PICTURE in word for word in self._words):
            raise InputError(
                f"--solver {template}: names no image; {did_you_mean(template, ['centroids'])}write"
                " centroids,"
                f' python:MODULE:FUNCTION, or a command with {IMAGE} in it, such as "solve {IMAGE}"'
            )
        self._folder = folder
        self._timeout_s = timeout_s

    def solve(self, exposure: Exposure, tracker: SolvedTracker) -> SolverAnswer:
        """The command's answer. Raises SolverFault where it fails, takes too long, or its answer
        is no attitude.
        """
        from astropy.io import fits

        facts = tracker_facts(tracker)
        with temporary_folder("solver") as folder:
            image = folder / "image.fits"
            picture = folder / "image.png"
            if any(IMAGE in word for word in self._words):
                # the DN alone: no pointing, and no truth
                fits.PrimaryHDU(given_image(exposure, tracker)).writeto(image)
            if any(PICTURE in word for word in self._words):
                write_dn_picture(picture, given_image(exposure, tracker))
            command = filled_words(self._words, facts, image, picture)
            try:
                child = Child(command, self._folder)
            except OSError as error:
                raise SolverFault(
                    f"the solver cannot be started: {command[0]} ({error.strerror})"
                ) from error
            with child:
                code = child.wait(self._timeout_s)
                if child.too_much:
                    most = f"{MAX_OUTPUT_BYTES // 1_000_000} MB"
                    raise SolverFault(
                        f"the solver printed more than {most} and was ended; let it print the"
                        " quaternion alone"
                    )
                if code is None:
                    raise SolverFault(f"the solver took longer than {self._timeout_s:g} s")
        if code:
            line = last_words(child.err)
            for place, name in ((image, IMAGE), (picture, PICTURE), (folder, "")):
                line = line.replace(str(place), name)
            raise SolverFault(one_line(f"the solver ended with code {code}: {line}"))
        q = printed_attitude(child.out)
        if q is None:
            return SolverAnswer(None, "the solver found no attitude")
        return SolverAnswer(checked_attitude(q, "the solver"))


def filled_words(
    words: Sequence[str], facts: dict[str, Any], image: Path, picture: Path
) -> list[str]:
    """A command's words with what stands in braces filled in."""
    width_px, height_px = facts["resolution_px"]
    texts = {
        "{fov_deg}": f"{facts['fov_deg']:.9g}",
        "{focal_length_px}": f"{facts['focal_length_px']:.9g}",
        "{width_px}": str(width_px),
        "{height_px}": str(height_px),
        IMAGE: str(image),
        PICTURE: str(picture),
    }
    filled = list(words)
    for place, text in texts.items():
        filled = [word.replace(place, text) for word in filled]
    return filled


def last_words(said: str) -> str:
    """The last line of what a program said on stderr."""
    lines = said.strip().splitlines()
    if lines:
        return lines[-1]
    return "it said nothing on stderr"


def printed_attitude(text: str) -> object | None:
    """The quaternion in a program's output: its last line with four numbers, or what its JSON
    object has as "q"; or None.
    """
    for line in reversed(text[-MAX_OUTPUT_CHARACTERS:].splitlines()):
        if line.lstrip().startswith("{"):
            with contextlib.suppress(ValueError, RecursionError):
                answer = json.loads(line)
                if "q" in answer:
                    q: object = answer["q"]
                    return q
                continue
        if re.fullmatch(r"[\s,;\[\]()\d.eE+-]+", line):
            numbers = NUMBER.findall(line)
            if len(numbers) == 4:
                return [float(number) for number in numbers]
    return None


def choose_solver(
    text: str, settings: Centroiding, folder: Path, timeout_s: float, plan_folder: Path = Path()
) -> Solver:
    """The solver that `text` names, with relative names in `folder`, those of the plan in
    `plan_folder`.

    Raises InputError for an unknown one.
    """
    if text == CENTROIDS:
        return CentroidSolver(settings, plan_folder)
    if text.startswith("python:"):
        return FunctionSolver(text, folder, timeout_s)
    return CommandSolver(text, folder, timeout_s)
