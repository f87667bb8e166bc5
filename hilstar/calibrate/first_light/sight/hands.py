"""Images that a person saves, and one key that a person presses."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from hilstar.bench.bench_file import BenchFile
from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.calibrate.first_light.sight.diode import SerialDiode, Watched
from hilstar.calibrate.first_light.sight.display import Display
from hilstar.calibrate.first_light.sight.eyes import ENDINGS
from hilstar.run.screen.gate import Timing

STILL_S = 0.5  # a file that has not grown for so long is complete
log = logging.getLogger(__name__)


class Hands:
    """Images that a person saves: each pattern stays on the display until its file is there."""

    identity = "by hand"
    sets_exposure = True

    def __init__(self, dark: Path | None = None, diode: SerialDiode | None = None) -> None:
        self._display, self._dark, self._diode = Display(), dark, diode

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing."""
        return self._display.gate(file)

    def unlit(self, stem: Path) -> Path | None:
        """The image that the user gave, if any."""
        return self._dark

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Wait for the image of the pattern, complete."""
        exposed = "" if exposure_s == file.config.tracker.exposure_s else f", exposed for {exposure_s:.4g} s,"
        asked = f"now save the tracker's image{exposed} as {stem}.png (or .fits); q on the display ends"
        self._display.show_until(file, pattern, _once_asked(asked, lambda: _saved(stem) is not None))
        return _saved(stem) or stem

    def look_or_key(self, file: BenchFile, pattern: Pattern, stem: Path, keys: Mapping[str, str]) -> Path | str:
        """The image of the pattern, or the key that tells how it was seen: `keys` has what each of them means."""
        legend = "\n".join(f"    {key}  {meaning}" for key, meaning in keys.items())
        asked = f"now press on the display what the tracker sees, or save its image as {stem}.png (or .fits):\n{legend}"
        pressed: list[str] = []

        def done() -> bool:
            return bool(pressed) or _saved(stem) is not None

        def press(key: str) -> None:
            if key in keys:
                pressed.append(key)

        self._display.show_until(file, pattern, _once_asked(asked, done), press)
        return pressed[0] if pressed else _saved(stem) or stem

    def diode(self, file: BenchFile, seconds: float) -> Watched | None:
        """By the photodiode that the user named."""
        return None if self._diode is None else self._diode.watch(self._display, file, seconds)

    def close(self) -> None:
        """Close the window."""
        self._display.close()


def _once_asked(words: str, done: Callable[[], bool]) -> Callable[[], bool]:
    """`done`, which says what is wanted when it is first asked: by then the panel shows the pattern."""
    asked = False

    def asked_and_done() -> bool:
        nonlocal asked
        if not asked:
            log.warning(words)
            asked = True
        return done()

    return asked_and_done


def _saved(stem: Path) -> Path | None:
    """The image, once it is complete."""
    return next((path for path in (stem.with_name(stem.name + end) for end in ENDINGS) if _is_complete(path)), None)


def _is_complete(path: Path) -> bool:
    try:
        status = path.stat()
    except OSError:
        return False
    return status.st_size > 0 and time.time() - status.st_mtime > STILL_S
