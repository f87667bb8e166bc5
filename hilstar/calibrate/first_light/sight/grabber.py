"""Images by a command of the user's own, for each pattern."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.frame_files import write_codes_png
from hilstar.bench.orientation import orientation_of
from hilstar.calibrate.first_light.patterns import Pattern, on_screen
from hilstar.calibrate.first_light.sight.diode import SerialDiode, Watched
from hilstar.calibrate.first_light.sight.display import Display
from hilstar.calibrate.first_light.sight.eyes import PATTERN_FILE, NoImage
from hilstar.errors import InputError, shortened
from hilstar.process.child import MAX_OUTPUT_BYTES, Child
from hilstar.run.screen.gate import Timing

GRAB_TIMEOUT_S = 120.0


class Grabber:
    """Images by a command: {output} is the file that it has to write, {pattern} a picture of what the screen has to show.

    Without {pattern} the session shows it itself; with {exposure_s} it may choose the exposure. `dark` is the image with the
    monitor switched off. Raises InputError for a command that has no {output}.
    """

    def __init__(self, command: str, dark: Path | None = None, diode: SerialDiode | None = None) -> None:
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise InputError(f"--grab {command}: {error}; write it as on a command line, quotes in pairs") from error
        if not any("{output}" in word for word in self._words):
            raise InputError(f"--grab {command}: has no {{output}}; write where your command takes the file's name")
        self._shows = any("{pattern}" in word for word in self._words)
        self.sets_exposure = any("{exposure_s}" in word for word in self._words)
        self._dark, self._diode = dark, diode
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
        if self._shows and pattern.later:
            raise InputError("a frame of `temporal` is many pictures: leave {pattern} out of --grab, and show them here")
        if self._shows:
            monitor = file.config.monitor
            write_codes_png(shown, on_screen(pattern.codes, orientation_of(monitor)), monitor.bits)
            _run(words, output, _wait)
        else:
            _run(words, output, lambda done: self._display.show_until(file, pattern, done))
        return output

    def diode(self, file: BenchFile, seconds: float) -> Watched | None:
        """By the photodiode that the user named, on this program's own display."""
        return None if self._diode is None or self._shows else self._diode.watch(self._display, file, seconds)

    def close(self) -> None:
        """Close the window."""
        self._display.close()


def _filled(word: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        word = word.replace(name, value)
    return word


def _run(words: list[str], output: Path, meanwhile: Callable[[Callable[[], bool]], None]) -> None:
    started: list[Child] = []
    end_s = time.monotonic() + GRAB_TIMEOUT_S

    def done() -> bool:
        # Begun when it is first asked: by then the panel shows the pattern.
        if not started:
            started.append(ended.enter_context(_start(words)))
        return started[0].poll() is not None or time.monotonic() > end_s

    with ExitStack() as ended:
        meanwhile(done)
        child, code = started[0], started[0].poll()
    _check(words, output, child, code)


def _check(words: list[str], output: Path, child: Child, code: int | None) -> None:
    """Refuse (NoImage) a command that did not end, failed, or wrote no image."""
    command = shortened(shlex.join(words))
    if child.too_much:
        raise NoImage(f"--grab: {command} printed more than {MAX_OUTPUT_BYTES // 1_000_000} MB on stderr; let it say less")
    if code is None:
        raise NoImage(f"--grab: {command} took over {GRAB_TIMEOUT_S:.0f} s; run it by hand to see why")
    if code:
        lines = child.err.strip().splitlines()
        why = f": {shortened(lines[-1])}" if lines else ""
        raise NoImage(f"--grab: {command} ended with code {code}{why}")
    if not output.is_file() or not output.stat().st_size:
        raise NoImage(f"--grab: {command} wrote no image; it has to write {{output}}, as PNG or FITS")


def _start(words: list[str]) -> Child:
    try:
        return Child(words, keeps_stdout=False)
    except OSError as error:
        raise NoImage(f"--grab: {words[0]} cannot be run ({error.strerror}); write a command that can") from error


def _wait(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.005)
