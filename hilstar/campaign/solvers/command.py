"""A solver that is a command: it gets an image, and prints a quaternion."""

from __future__ import annotations

import contextlib
import json
import re
import shlex
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilstar.campaign.solvers.answer import Answer, SolverFault, Tracker, checked_attitude
from hilstar.campaign.solvers.function import tracker_facts
from hilstar.errors import InputError, did_you_mean, one_line
from hilstar.files import temporary_folder
from hilstar.process.child import MAX_OUTPUT_BYTES, Child
from hilstar.twin.exposure_files import write_dn_picture
from hilstar.twin.simulator import Exposure

IMAGE, PICTURE = "{image}", "{png}"
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
MAX_OUTPUT_CHARACTERS = 100_000


class CommandSolver:
    """Runs a command for each image, without a shell: {image} is a FITS file of its DN alone, {png} a 16-bit PNG of them.

    Other words in braces are the tracker's: {fov_deg}, {focal_length_px}, {width_px}, {height_px}. The last line of its output
    that has four numbers, or a JSON object with "q", is q_icrs_to_cam, scalar first; exit code 0 without one says that there is
    no attitude, and any other code is a fault. Raises InputError for a template without an image.
    """

    def __init__(self, template: str, folder: Path, timeout_s: float) -> None:
        try:
            self._words = shlex.split(template)
        except ValueError as error:
            raise InputError(f"--solver {template}: {error}; write a command with {IMAGE}, or {PICTURE}, in it") from error
        if not any(IMAGE in word or PICTURE in word for word in self._words):
            raise InputError(
                f"--solver {template}: names no image; {did_you_mean(template, ['centroids'])}write centroids, "
                f"python:MODULE:FUNCTION, or a command with {IMAGE}"
                f' in it, such as "solve {IMAGE}"'
            )
        self._folder, self._timeout_s = folder, timeout_s

    def solve(self, exposure: Exposure, tracker: Tracker) -> Answer:
        """The command's answer. Raises SolverFault where it fails, takes too long or prints what is no attitude."""
        with temporary_folder("solver") as folder:
            image, picture = folder / "image.fits", folder / "image.png"
            if any(IMAGE in word for word in self._words):
                write_plain_fits(image, exposure.dn)
            if any(PICTURE in word for word in self._words):
                write_dn_picture(picture, exposure.dn)
            places = _places(tracker) | {IMAGE: str(image), PICTURE: str(picture)}
            words = [_filled(word, places) for word in self._words]
            code, out, err = _run(words, self._folder, self._timeout_s)
        if code:
            said = err.strip().splitlines()[-1:] or ["it said nothing on stderr"]
            line = said[0].replace(str(image), IMAGE).replace(str(picture), PICTURE).replace(str(folder), "")
            raise SolverFault(one_line(f"the solver ended with code {code}: {line}"))
        q = printed_attitude(out)
        return Answer(None, "the solver found no attitude") if q is None else Answer(checked_attitude(q, "the solver"))


def printed_attitude(text: str) -> object | None:
    """The quaternion in a program's output: its last line with four numbers, or what its JSON object has as "q"; or None."""
    for line in reversed(text[-MAX_OUTPUT_CHARACTERS:].splitlines()):
        if line.lstrip().startswith("{"):
            with contextlib.suppress(ValueError, RecursionError):
                said = json.loads(line)
                if "q" in said:
                    q: object = said["q"]
                    return q
                continue
        if re.fullmatch(r"[\s,;\[\]()\d.eE+-]+", line):
            numbers = NUMBER.findall(line)
            if len(numbers) == 4:
                return [float(number) for number in numbers]
    return None


def write_plain_fits(path: Path, dn: npt.NDArray[np.uint16]) -> None:
    """The DN and nothing else: neither where the tracker looks nor what is in view."""
    from astropy.io import fits

    fits.PrimaryHDU(dn).writeto(path)


def _places(tracker: Tracker) -> dict[str, str]:
    facts = tracker_facts(tracker)
    width, height = facts["resolution_px"]
    return {
        "{fov_deg}": f"{facts['fov_deg']:.9g}",
        "{focal_length_px}": f"{facts['focal_length_px']:.9g}",
        "{width_px}": str(width),
        "{height_px}": str(height),
    }


def _filled(word: str, places: dict[str, str]) -> str:
    for name, text in places.items():
        word = word.replace(name, text)
    return word


def _run(words: list[str], folder: Path, timeout_s: float) -> tuple[int, str, str]:
    """Run a command in a group of its own, which ends with it. Raises SolverFault."""
    try:
        child = Child(words, folder)
    except OSError as error:
        raise SolverFault(f"the solver cannot be started: {words[0]} ({error.strerror})") from error
    with child:
        code = child.wait(timeout_s)
        if child.too_much:
            most = f"{MAX_OUTPUT_BYTES // 1_000_000} MB"
            raise SolverFault(f"the solver printed more than {most} and was ended; let it print the quaternion alone")
        if code is None:
            raise SolverFault(f"the solver took longer than {timeout_s:g} s")
    return code, child.out, child.err
