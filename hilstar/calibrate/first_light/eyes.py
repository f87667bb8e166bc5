"""Where a session's images come from: a command of the user's own, a person who saves them, or the twin (see virtual)."""

from __future__ import annotations

import logging
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable
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


class Eyes(Protocol):
    """Shows patterns to the tracker and brings back its images."""

    @property
    def identity(self) -> str:
        """What the images come from, in words that change when it does."""

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where this program has no display. Raises MachineError."""

    def look(self, file: BenchFile, pattern: Pattern, stem: Path) -> Path:
        """Show a pattern as the bench file's screen is mounted; the tracker's image, `stem` with an ending.

        Raises InputError where no image comes.
        """

    def close(self) -> None:
        """Let go of the display."""


class Grabber:
    """Images by a command: {output} is the file that it has to write, {pattern} a picture of what the screen has to show.

    Without {pattern} the session shows it itself. Raises InputError for a command that has no {output}.
    """

    def __init__(self, command: str) -> None:
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise InputError(f"--grab {command}: {error}; write it as on a command line, quotes in pairs") from error
        if not any("{output}" in word for word in self._words):
            raise InputError(f"--grab {command}: has no {{output}}; write where your command takes the file's name")
        self._shows = any("{pattern}" in word for word in self._words)
        self.identity = f"grab: {command}"
        self._display = Display()

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where the command shows the patterns."""
        return None if self._shows else self._display.gate(file)

    def look(self, file: BenchFile, pattern: Pattern, stem: Path) -> Path:
        """Run the command while the pattern is shown. Raises InputError with the last line of its stderr where it fails."""
        output = stem.with_name(stem.name + ".png")
        shown = stem.parent / PATTERN_FILE
        if self._shows:
            monitor = file.config.monitor
            write_codes_png(shown, on_screen(pattern.codes, orientation_of(monitor)), monitor.bits)
            self._run(output, shown, _wait)
        else:
            self._run(output, shown, lambda done: self._display.show_until(file, pattern, done))
        return output

    def _run(self, output: Path, shown: Path, meanwhile: Callable[[Callable[[], bool]], None]) -> None:
        words = [word.replace("{output}", str(output)).replace("{pattern}", str(shown)) for word in self._words]
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

    def close(self) -> None:
        """Close the window."""
        self._display.close()


def _check(words: list[str], output: Path, code: int | None, said: str) -> None:
    """Refuse (InputError) a command that did not end, failed, or wrote no image."""
    command = shortened(shlex.join(words))
    if code is None:
        raise InputError(f"--grab: {command} took over {GRAB_TIMEOUT_S:.0f} s; run it by hand to see why")
    if code:
        lines = said.strip().splitlines()
        why = f": {shortened(lines[-1])}" if lines else ""
        raise InputError(f"--grab: {command} ended with code {code}{why}")
    if not output.is_file() or not output.stat().st_size:
        raise InputError(f"--grab: {command} wrote no image; it has to write {{output}}, as PNG or FITS")


def _start(words: list[str], said: IO[bytes]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said)
    except OSError as error:
        raise InputError(f"--grab: {words[0]} cannot be run ({error.strerror}); write a command that can") from error


def _wait(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.005)


class Hands:
    """Images that a person saves: each pattern stays on the display until its file is there."""

    identity = "by hand"

    def __init__(self) -> None:
        self._display = Display()

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing."""
        return self._display.gate(file)

    def look(self, file: BenchFile, pattern: Pattern, stem: Path) -> Path:
        """Wait for the image of the pattern, complete."""
        log.warning("now save the tracker's image as %s.png (or .fits); q on the display ends", stem)
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
