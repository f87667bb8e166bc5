"""Where a session's images come from: a command of the user's own, a person who saves them, or the twin (see virtual)."""

from __future__ import annotations

import logging
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Protocol

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.frame_files import write_codes_png
from hilstar.bench.orientation import orientation_of
from hilstar.calibrate.first_light.display import Display
from hilstar.calibrate.first_light.patterns import Pattern, on_screen
from hilstar.errors import InputError, shortened
from hilstar.run.screen.gate import Timing

GRAB_TIMEOUT_S = 120.0
STILL_S = 0.5  # a file that has not grown for so long is complete
ENDINGS = (".png", ".fits", ".fit", ".fts")
PATTERN_FILE = "pattern.png"
log = logging.getLogger(__name__)


class NoImage(InputError):
    """The image did not come: what was taken before it is good, and need not be taken again."""


class Eyes(Protocol):
    """Shows patterns to the tracker and brings back its images."""

    @property
    def identity(self) -> str:
        """What the images come from, in words that change when it does."""

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where this program has no display. Raises MachineError."""

    @property
    def sets_exposure(self) -> bool:
        """Whether `look` may ask for another exposure than the bench file's."""

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Show a pattern as the bench file's screen is mounted; the tracker's image, `stem` with an ending.

        Raises NoImage where none comes.
        """

    def unlit(self, stem: Path) -> Path | None:
        """The tracker's image with the monitor switched off, at the bench file's exposure; None where there is none."""

    def close(self) -> None:
        """Let go of the display."""


class Grabber:
    """Images by a command: {output} is the file that it has to write, {pattern} a picture of what the screen has to show.

    Without {pattern} the session shows it itself; with {exposure_s} it may choose the exposure. `dark` is the image with the
    monitor switched off. Raises InputError for a command that has no {output}.
    """

    def __init__(self, command: str, dark: Path | None = None) -> None:
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise InputError(f"--grab {command}: {error}; write it as on a command line, quotes in pairs") from error
        if not any("{output}" in word for word in self._words):
            raise InputError(f"--grab {command}: has no {{output}}; write where your command takes the file's name")
        self._shows = any("{pattern}" in word for word in self._words)
        self.sets_exposure = any("{exposure_s}" in word for word in self._words)
        self._dark = dark
        self.identity = f"grab: {command}"
        self._display = Display()

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where the command shows the patterns."""
        return None if self._shows else self._display.gate(file)

    def unlit(self, stem: Path) -> Path | None:
        """The image that the user gave, if any."""
        return self._dark

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Run the command while the pattern is shown. Raises NoImage with the last line of its stderr where it fails."""
        output = stem.with_name(stem.name + ".png")
        shown = stem.parent / PATTERN_FILE
        values = {"{output}": str(output), "{pattern}": str(shown), "{exposure_s}": f"{exposure_s:.9g}"}
        words = [_filled(word, values) for word in self._words]
        output.unlink(missing_ok=True)  # of an attempt that was interrupted: a command that writes nothing shall not pass
        if self._shows:
            monitor = file.config.monitor
            write_codes_png(shown, on_screen(pattern.codes, orientation_of(monitor)), monitor.bits)
            _run(words, output, _wait)
        else:
            _run(words, output, lambda done: self._display.show_until(file, pattern, done))
        return output

    def close(self) -> None:
        """Close the window."""
        self._display.close()


def _filled(word: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        word = word.replace(name, value)
    return word


def _run(words: list[str], output: Path, meanwhile: Callable[[Callable[[], bool]], None]) -> None:
    started: list[subprocess.Popen[bytes]] = []
    end_s = time.monotonic() + GRAB_TIMEOUT_S

    def done() -> bool:
        # Begun when it is first asked: by then the panel shows the pattern.
        if not started:
            started.append(_start(words, said))
        return started[0].poll() is not None or time.monotonic() > end_s

    with tempfile.TemporaryFile() as said:
        try:
            meanwhile(done)
            said.seek(0)
            _check(words, output, started[0].poll(), said.read().decode(errors="replace"))
        finally:
            for process in started:
                process.kill()
                process.wait()


def _check(words: list[str], output: Path, code: int | None, said: str) -> None:
    """Refuse (NoImage) a command that did not end, failed, or wrote no image."""
    command = shortened(shlex.join(words))
    if code is None:
        raise NoImage(f"--grab: {command} took over {GRAB_TIMEOUT_S:.0f} s; run it by hand to see why")
    if code:
        lines = said.strip().splitlines()
        why = f": {shortened(lines[-1])}" if lines else ""
        raise NoImage(f"--grab: {command} ended with code {code}{why}")
    if not output.is_file() or not output.stat().st_size:
        raise NoImage(f"--grab: {command} wrote no image; it has to write {{output}}, as PNG or FITS")


def _start(words: list[str], said: IO[bytes]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said)
    except OSError as error:
        raise NoImage(f"--grab: {words[0]} cannot be run ({error.strerror}); write a command that can") from error


def _wait(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.005)


class Hands:
    """Images that a person saves: each pattern stays on the display until its file is there."""

    identity = "by hand"
    sets_exposure = True

    def __init__(self, dark: Path | None = None) -> None:
        self._display, self._dark = Display(), dark

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing."""
        return self._display.gate(file)

    def unlit(self, stem: Path) -> Path | None:
        """The image that the user gave, if any."""
        return self._dark

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Wait for the image of the pattern, complete."""
        exposed = "" if exposure_s == file.config.tracker.exposure_s else f", exposed for {exposure_s:.4g} s,"
        log.warning("now save the tracker's image%s as %s.png (or .fits); q on the display ends", exposed, stem)
        found: list[Path] = []

        def done() -> bool:
            found[:] = [path for path in (stem.with_name(stem.name + end) for end in ENDINGS) if _is_complete(path)]
            return bool(found)

        self._display.show_until(file, pattern, done)
        return found[0]

    def close(self) -> None:
        """Close the window."""
        self._display.close()


def _is_complete(path: Path) -> bool:
    try:
        status = path.stat()
    except OSError:
        return False
    return status.st_size > 0 and time.time() - status.st_mtime > STILL_S


def complete_images(folder: Path) -> dict[str, Path]:
    """The images in a directory by their names without ending, but for the newest, which may have been cut short."""
    found = [path for path in folder.glob("*") if path.suffix in ENDINGS and path.name != PATTERN_FILE]
    found.sort(key=lambda path: path.stat().st_mtime_ns)
    return {path.stem: path for path in found[:-1]}
