"""Patterns on the monitor, and where the images of them come from: a command, a person, or the virtual bench."""

from __future__ import annotations

import dataclasses
import logging
import shlex
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench, orientation_of
from hilstar.bench.frame_files import write_codes_png
from hilstar.calibrate.latency import Edges, capture_edges, edges_of
from hilstar.errors import HilstarError, InputError, MachineError, shortened
from hilstar.process.closing import Closing
from hilstar.process.programs import MAX_OUTPUT_BYTES, Child
from hilstar.render.backend import ScreenView
from hilstar.render.context import leave_contexts
from hilstar.render.presenter import Presenter, level_texture, window_context
from hilstar.run.screen.gate import Timing, pass_gate
from hilstar.run.screen.screen import Screen
from hilstar.scene.frame_motion import Orientation

if TYPE_CHECKING:
    from hilstar.monitor.window.window import Window

CodeImage = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Pattern:
    """Codes (h, w) or (h, w, 3) over the monitor's image, before it is turned as the screen is mounted, and a name.

    `later` has further frames, one per refresh, before the pattern repeats.
    """

    name: str
    codes: CodeImage
    later: tuple[CodeImage, ...] = ()

    @property
    def frames(self) -> tuple[CodeImage, ...]:
        """All frames of one repetition."""
        return (self.codes, *self.later)


def black(resolution_px: tuple[int, int]) -> CodeImage:
    """Code 0 everywhere."""
    width, height = resolution_px
    return np.zeros((height, width), dtype=np.uint16)


def on_screen(codes: CodeImage, orientation: Orientation) -> CodeImage:
    """Turn an image as the screen is mounted, as shaders/present.frag does."""
    screen = np.rot90(codes, -orientation.quarter_turns)
    screen = screen[:, ::-1] if orientation.flip_x else screen
    return screen[::-1] if orientation.flip_y else screen


def off_screen(screen: CodeImage, orientation: Orientation) -> CodeImage:
    """The inverse of `on_screen`."""
    screen = screen[::-1] if orientation.flip_y else screen
    screen = screen[:, ::-1] if orientation.flip_x else screen
    return np.rot90(screen, orientation.quarter_turns)


ENDINGS = (".png", ".fits", ".fit", ".fts")
PATTERN_FILE = "pattern.png"


class NoImage(InputError):
    """An image did not come. Those taken before it are good and need not be taken again."""


class ImageSource:
    """Shows patterns to the tracker and returns its images; by default without a display, a dark image or a photodiode.

    `identity` is a text that changes when the source does; `sets_exposure` says whether `look` may ask for another exposure
    than the bench file's.
    """

    identity: str
    sets_exposure: bool

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where this program has no display. Raises MachineError."""
        return None

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Show a pattern as the bench file's screen is mounted; the tracker's image, `stem` with an ending.

        Raises NoImage where none comes.
        """
        raise NotImplementedError

    def unlit(self, stem: Path) -> Path | None:
        """The tracker's image with the monitor switched off, at the bench file's exposure; None where there is none."""
        return None

    def diode(self, file: BenchFile, seconds: float) -> DiodeRecording | None:
        """Record the display's square by a photodiode; None where there is none. Raises InputError, MachineError."""
        return None

    def close(self) -> None:
        """Let go of the display."""


def complete_images(folder: Path) -> dict[str, Path]:
    """The images in a directory by name without ending, except the newest, which may be incomplete."""
    found = [path for path in folder.glob("*") if path.suffix in ENDINGS and path.name != PATTERN_FILE]
    found.sort(key=lambda path: path.stat().st_mtime_ns)
    return {path.stem: path for path in found[:-1]}


KIND = "code"  # a square that toggles leaves pairs of frames open


@dataclass(frozen=True, slots=True)
class DiodeRecording:
    """The square's changes at their swaps, and the edges that the photodiode saw."""

    shown: Edges
    seen: Edges


@dataclass(frozen=True, slots=True)
class SerialDiode:
    """A photodiode's device on a serial port."""

    port: str
    baud: int

    def watch(self, display: PatternDisplay, file: BenchFile, seconds: float) -> DiodeRecording:
        """Show the square for `seconds` and record. Raises InputError without edges, MachineError, Stopped."""
        with ThreadPoolExecutor(1) as pool:
            listening: list[Future[Edges]] = []

            def begin() -> Callable[[], bool]:
                listening.append(pool.submit(capture_edges, self.port, self.baud, seconds))
                return listening[0].done

            monitor = replace(file.config.monitor, photodiode=KIND)
            shown = display.blink(dataclasses.replace(file, config=replace(file.config, monitor=monitor)), begin)
            return DiodeRecording(shown, listening[0].result())


POLL_S = 0.02
SETTLE_S = 0.25  # for a panel that is slow to change
SHOW_YOURSELF = "or show the patterns yourself: name {pattern} in --grab"


class Stopped(HilstarError):
    """Somebody closed the window. The session continues there when it is run again."""

    exit_code = 1


def _go_on(window: Window, stopped: bool) -> None:
    if window.gone is not None:
        raise MachineError(window.gone)
    if window.closing or stopped:
        raise Stopped("stopped at the display; run the same command again to go on")


def _presenter(file: BenchFile, window: Window, codes: CodeImage) -> tuple[Presenter, Callable[[], None]]:
    """A presenter of codes (h, w) or (h, w, 3) for the window, and the function that frees its texture."""
    monitor, triples = file.config.monitor, None
    if codes.ndim == 3:
        packed = codes.astype(np.int64) @ np.array([1 << 32, 1 << 16, 1])
        colours, levels = np.unique(packed, return_inverse=True)
        triples = np.stack([colours >> 32, colours >> 16 & 0xFFFF, colours & 0xFFFF], axis=1).astype(np.uint16)
        codes = levels.reshape(codes.shape[:2]).astype(np.uint16)
    view = ScreenView(monitor.resolution_px, window.size_px, monitor.bits, orientation_of(monitor), triples=triples)
    texture = level_texture(window_context(), codes)
    return Presenter(texture, view), texture.release


class PatternDisplay(Closing):
    """The window on the bench's display, opened with the first pattern. Free it with `close`, or use it as a context."""

    def __init__(self) -> None:
        self._window: Window | None = None
        self._screen_px = (0, 0)

    def gate(self, file: BenchFile) -> Timing:
        """Measure the display as `serve` does. Raises MachineError where it is not as the bench file has it."""
        self.close()
        try:
            window = self._window_for(file)
            with open_bench(file, window_context()) as bench:
                return pass_gate(Screen(window, bench), force=False)
        except MachineError as error:
            raise MachineError(f"{str(error).removesuffix('; or add --force')}; {SHOW_YOURSELF}") from error

    def show_until(
        self, file: BenchFile, pattern: Pattern, done: Callable[[], bool], on_key: Callable[[str], object] = lambda key: None
    ) -> None:
        """Show a pattern until `done()`, first called when the panel has settled; `on_key` gets the keys pressed.

        Raises Stopped where the window is closed, MachineError where the display goes away.
        """
        window = self._window_for(file)
        pause_s = 0.5 / file.config.monitor.refresh_hz if pattern.later else POLL_S
        shown = [_presenter(file, window, codes) for codes in pattern.frames]
        start_s, number = time.monotonic(), 0
        window.keys.clear()  # keys pressed during the pattern before
        try:
            while time.monotonic() - start_s < SETTLE_S or not done():
                shown[number % len(shown)][0].present()
                window.swap()
                number += 1
                window.look_at_events()
                _go_on(window, bool({"q", "escape"} & set(window.keys)))
                while window.keys:
                    on_key(window.keys.popleft())
                time.sleep(pause_s)
        finally:
            for _, release in shown:
                release()

    def blink(self, file: BenchFile, begin: Callable[[], Callable[[], bool]]) -> Edges:
        """Show the photodiode's square on black; the square's changes. Raises Stopped, MachineError.

        `begin` is called once the display has been timed, and returns a function that says when to stop.
        """
        window = self._window_for(file)
        period_s = 1.0 / file.config.monitor.refresh_hz
        swap_ns: list[int] = []
        light: list[int] = []
        with open_bench(file, window_context()) as bench:
            screen = Screen(window, bench)
            pass_gate(screen, force=False)
            bench.draw(None)
            due_s, done = time.monotonic(), begin()
            while not done():
                light.append(screen.present(len(light)) or 0)
                if not screen.clock.paced_by_screen:
                    due_s += period_s
                    time.sleep(max(due_s - time.monotonic(), 0.0))
                swap_ns.append(screen.swap())
                _go_on(window, screen.closing)
        return edges_of(np.array(swap_ns, dtype=np.int64), np.array(light, dtype=np.int64))

    def _window_for(self, file: BenchFile) -> Window:
        from hilstar.monitor.window.window import Window, WindowSettings

        monitor = file.config.monitor
        screen_px = orientation_of(monitor).screen_px(monitor.resolution_px)
        leave_contexts()  # contexts made without a window since
        if self._window is None or self._screen_px != screen_px:
            self.close()
            self._window = Window(WindowSettings(screen_px, monitor.bits, monitor.display))
            self._screen_px = screen_px
        self._window.make_current()
        return self._window

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None


GRAB_TIMEOUT_S = 120.0


class _ShownHere(ImageSource):
    """An image source before this program's own display; `dark` is the tracker's image with the monitor switched off."""

    def __init__(self, dark: Path | None = None, diode: SerialDiode | None = None) -> None:
        self._display, self._dark, self._diode = PatternDisplay(), dark, diode

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing."""
        return self._display.gate(file)

    def unlit(self, stem: Path) -> Path | None:
        """The image that the user gave, if any."""
        return self._dark

    def diode(self, file: BenchFile, seconds: float) -> DiodeRecording | None:
        """Record the user's photodiode."""
        return None if self._diode is None else self._diode.watch(self._display, file, seconds)

    def close(self) -> None:
        """Close the window."""
        self._display.close()


class GrabCommand(_ShownHere):
    """Images by a command. It writes the file {output}; {pattern} is a picture of what the screen has to show.

    Without {pattern} the session shows the pattern itself; with {exposure_s} it may choose the exposure. `dark` is an image
    with the monitor switched off. Raises InputError for a command without {output}.
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
        self.identity = f"grab: {command}"
        super().__init__(dark, None if self._shows else diode)

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where the command shows the patterns."""
        return None if self._shows else super().gate(file)

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Run the command while the pattern is shown. Raises NoImage with the last line of its stderr where it fails."""
        output = stem.with_name(stem.name + ".png")
        shown = stem.parent / PATTERN_FILE
        words = self._words
        for name, value in (("output", str(output)), ("pattern", str(shown)), ("exposure_s", f"{exposure_s:.9g}")):
            words = [word.replace(f"{{{name}}}", value) for word in words]
        output.unlink(missing_ok=True)  # an interrupted attempt may have left one, and a command that writes nothing must fail
        if self._shows and pattern.later:
            raise InputError("a frame of `temporal` is many pictures: leave {pattern} out of --grab, and show them here")
        if self._shows:
            monitor = file.config.monitor
            write_codes_png(shown, on_screen(pattern.codes, orientation_of(monitor)), monitor.bits)
            _run(words, output, _wait)
        else:
            _run(words, output, lambda done: self._display.show_until(file, pattern, done))
        return output


def _run(words: list[str], output: Path, meanwhile: Callable[[Callable[[], bool]], None]) -> None:
    started: list[Child] = []
    end_s = time.monotonic() + GRAB_TIMEOUT_S

    def done() -> bool:
        # The command starts at the first call: by then the panel shows the pattern.
        if not started:
            try:
                started.append(ended.enter_context(Child(words, keeps_stdout=False)))
            except OSError as error:
                raise NoImage(f"--grab: {words[0]} cannot be run ({error.strerror}); write a command that can") from error
        return started[0].poll() is not None or time.monotonic() > end_s

    with ExitStack() as ended:
        meanwhile(done)
        child, code = started[0], started[0].poll()
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


def _wait(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.005)


STILL_S = 0.5  # a file that has not grown for so long is complete
log = logging.getLogger(__name__)


class ByHand(_ShownHere):
    """Images that a person saves. Each pattern stays on the display until its file is complete."""

    identity = "by hand"
    sets_exposure = True

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Wait for a complete image of the pattern."""
        exposed = "" if exposure_s == file.config.tracker.exposure_s else f", exposed for {exposure_s:.4g} s,"
        asked = f"now save the tracker's image{exposed} as {stem}.png (or .fits); q on the display ends"
        self._display.show_until(file, pattern, _once_asked(asked, lambda: _saved(stem) is not None))
        return _saved(stem) or stem

    def look_or_key(self, file: BenchFile, pattern: Pattern, stem: Path, keys: Mapping[str, str]) -> Path | str:
        """The image of the pattern, or the key that says how it looks; `keys` has their meanings."""
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


def _once_asked(words: str, done: Callable[[], bool]) -> Callable[[], bool]:
    """`done` with a message at its first call: by then the panel shows the pattern."""
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
    for path in (stem.with_name(stem.name + end) for end in ENDINGS):
        with suppress(OSError):
            status = path.stat()
            if status.st_size > 0 and time.time() - status.st_mtime > STILL_S:
                return path
    return None
