"""What a session asks of whatever looks at the bench, and the images of an attempt that was interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from hilstar.bench.bench_file import BenchFile
from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.calibrate.first_light.sight.diode import Watched
from hilstar.errors import InputError
from hilstar.run.screen.gate import Timing

ENDINGS = (".png", ".fits", ".fit", ".fts")
PATTERN_FILE = "pattern.png"


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

    def diode(self, file: BenchFile, seconds: float) -> Watched | None:
        """What a photodiode sees of the square on the display; None where there is none. Raises InputError, MachineError."""

    def close(self) -> None:
        """Let go of the display."""


def complete_images(folder: Path) -> dict[str, Path]:
    """The images in a directory by their names without ending, but for the newest, which may have been cut short."""
    found = [path for path in folder.glob("*") if path.suffix in ENDINGS and path.name != PATTERN_FILE]
    found.sort(key=lambda path: path.stat().st_mtime_ns)
    return {path.stem: path for path in found[:-1]}
