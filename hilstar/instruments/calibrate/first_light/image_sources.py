"""Patterns on the monitor, and where the images of them come from: a command, a person, or the
virtual bench.
"""

import dataclasses
import datetime
import hashlib
import itertools
import logging
import math
import shlex
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from hilstar.attitude.wire.shown_frames import FrameHead, FrameSender, ShownFrame
from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.basics.errors import (
    HilstarError,
    InputError,
    MachineError,
    NoDisplayError,
    shortened,
    without_display,
)
from hilstar.basics.files import written
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.programs import MAX_OUTPUT_BYTES, Child
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.calibration import primary_lights
from hilstar.display.identity import MonitorIdentity
from hilstar.display.quantise import LitLight
from hilstar.display.render.backend import ScreenView
from hilstar.display.render.presenter import Presenter, level_texture, window_context
from hilstar.display.window.this_monitor import identity_here
from hilstar.instruments.calibrate.geometric.observed import read_image, saturated_pixels
from hilstar.instruments.calibrate.latency import Edges, capture_edges, edges_of, swap_to_square_ms
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.optics import (
    DisplayColours,
    Primary,
    TwinOptics,
    seen_primaries,
)
from hilstar.instruments.simulate.simulator import TrackerBackground
from hilstar.optics.scan import Orientation
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.frame_files import png_of, write_codes_png, write_fits
from hilstar.server.bench.measured_on import check_monitor
from hilstar.server.bench.monitor import calibration_source, orientation_of
from hilstar.server.frame_feed import lit_codes
from hilstar.server.genicam.camera import (
    PREFIX,
    CameraError,
    CameraImage,
    GenicamCamera,
    chosen_format,
)
from hilstar.server.screen.gate import Timing, pass_gate
from hilstar.server.screen.screen import Screen, marker_light
from hilstar.tracker.detector import Detector

if TYPE_CHECKING:
    from hilstar.display.window.window import Window

CodeImage = npt.NDArray[np.uint16]
ENDINGS = (".png", ".fits", ".fit", ".fts")
PATTERN_FILE = "pattern.png"
KIND = "code"  # a square that toggles leaves pairs of frames open
POLL_S = 0.02
SETTLE_S = 0.25  # for a panel that is slow to change
SHOW_YOURSELF = "show the patterns yourself: name {pattern} in --grab"
# A pattern that stays is handed on again so often, for a watcher that came late.
HANDED_ON_AGAIN_S = 0.5
GRAB_TIMEOUT_S = 120.0
STILL_S = 0.5  # a file that has not grown for so long is complete
SWAP_JITTER_NS = 20_000
MASKS_KEPT = 8  # masks of patterns: one step repeats this many in other codes
# of their images together: eight of a whole detector of 4096 x 4096 pixels would take 0.5 GB
MASKS_KEPT_BYTES = 64_000_000


@dataclass(frozen=True, slots=True)
class Pattern:
    """Codes (h, w) or (h, w, 3) over the monitor's image, before it is turned as the screen is
    mounted, and a name.

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
    if orientation.flip_x:
        screen = screen[:, ::-1]
    return screen[::-1] if orientation.flip_y else screen


def off_screen(screen: CodeImage, orientation: Orientation) -> CodeImage:
    """The inverse of `on_screen`."""
    screen = screen[::-1] if orientation.flip_y else screen
    if orientation.flip_x:
        screen = screen[:, ::-1]
    return np.rot90(screen, orientation.quarter_turns)


class NoImage(InputError):
    """An image did not come. Those taken before it are good and need not be taken again."""


class ImageSource:
    """Shows patterns to the tracker and returns its images; by default without a display, a dark
    image or a photodiode.

    `identity` is a text that changes when the source does; `sets_exposure` says whether `look` may
    ask for another exposure than the bench file's, `by_hand` whether a person saves each image.
    `monitor` is the display's before its window was on it, None where this program has no display,
    and `forced` what is wrong with it and was shown by --force.
    """

    identity: str
    sets_exposure: bool
    by_hand = False
    monitor: MonitorIdentity | None = None
    forced: Sequence[str] = ()

    def find_monitor(self, file: BenchFile, today: datetime.date, *, force: bool) -> None:
        """Compare the display's monitor with the one of the bench's files. Raises InputError,
        MachineError unless `force`.
        """

    def gate(self, file: BenchFile) -> Timing | None:
        """The display's timing, None where this program has no display. Raises MachineError."""
        return None

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Show a pattern on the screen as it is mounted; the tracker's image, `stem` with an
        ending. Raises NoImage.
        """
        raise NotImplementedError

    def photograph(self, stem: Path, exposure_s: float) -> Path:
        """The tracker's image of whatever is before it, `stem` with an ending. Raises NoImage."""
        raise NotImplementedError

    def check_photographs(self) -> None:
        """Refuse (InputError) a source that has no `photograph`."""

    def pixels(self, path: Path, resolution_px: tuple[int, int]) -> FloatArray:
        """The pixels (h, w) of an image that this source took, DN. Raises InputError for one
        that cannot be read.
        """
        return read_image(path, resolution_px)

    def unlit(self, stem: Path) -> Path | None:
        """The tracker's image with the monitor switched off, at the bench file's exposure; None
        where there is none.
        """
        return None

    def diode(self, file: BenchFile, seconds: float) -> "DiodeRecording | None":
        """Record the display's square by a photodiode; None where there is none. Raises
        InputError, MachineError.
        """
        return None

    def clock_ns(self) -> int:
        """The clock of a warm-up."""
        return time.monotonic_ns()

    def hold(self, file: BenchFile, pattern: Pattern, seconds: float) -> None:
        """Go on showing a pattern for `seconds`."""
        time.sleep(seconds)

    def hand_on(self, frames: "PatternFrames") -> None:
        """Hand the patterns to watchers, too. Raises InputError without a display."""
        raise InputError("--feed: this session shows nothing here; leave --feed out")

    def close(self) -> None:
        """Free the display."""


def complete_images(folder: Path) -> dict[str, Path]:
    """The images in a directory by name without ending, except the newest, which may be
    incomplete.
    """
    images = []
    for path in folder.glob("*"):
        if path.suffix in ENDINGS and path.name != PATTERN_FILE:
            images.append(path)
    images.sort(key=lambda path: path.stat().st_mtime_ns)
    return {path.stem: path for path in images[:-1]}


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

    def watch(self, display: "PatternDisplay", file: BenchFile, seconds: float) -> DiodeRecording:
        """Show the square for `seconds` and record. Raises InputError without edges,
        MachineError, Stopped.
        """
        with ThreadPoolExecutor(1) as pool:
            listening: list[Future[Edges]] = []

            def begin() -> Callable[[], bool]:
                listening.append(pool.submit(capture_edges, self.port, self.baud, seconds))
                return listening[0].done

            monitor = replace(file.config.monitor, photodiode=KIND)
            shown = display.blink(
                dataclasses.replace(file, config=replace(file.config, monitor=monitor)), begin
            )
            return DiodeRecording(shown, listening[0].result())


log = logging.getLogger(__name__)


class Stopped(HilstarError):
    """Somebody closed the window. The session continues there when it is run again."""

    exit_code = 1


def _go_on(window: "Window", stopped: bool) -> None:
    if window.gone is not None:
        raise MachineError(window.gone)
    if window.closing or stopped:
        raise Stopped("stopped at the display; run the same command again to go on")


def _presenter(
    file: BenchFile, window: "Window", codes: CodeImage
) -> tuple[Presenter, Callable[[], None]]:
    """A presenter of codes (h, w) or (h, w, 3) for the window, and the function that frees its
    texture.
    """
    monitor = file.config.monitor
    triples = None
    if codes.ndim == 3:
        # a colour as one number, of which the distinct ones are found at once
        packed = codes.astype(np.int64) @ np.array([1 << 32, 1 << 16, 1])
        colours, levels = np.unique(packed, return_inverse=True)
        red = colours >> 32
        green = colours >> 16 & 0xFFFF
        blue = colours & 0xFFFF
        triples = np.stack([red, green, blue], axis=1).astype(np.uint16)
        codes = levels.reshape(codes.shape[:2]).astype(np.uint16)
    view = ScreenView(
        monitor.resolution_px,
        window.size_px,
        monitor.bits,
        orientation_of(monitor),
        triples=triples,
    )
    texture = level_texture(window_context(), codes)
    return Presenter(texture, view), texture.release


class PatternFrames:
    """Hands the patterns that are shown to watchers, as a run hands on its frames."""

    def __init__(self, sender: FrameSender) -> None:
        self._sender = sender
        self._number = 0

    def send(self, file: BenchFile, codes: CodeImage, lit_ns: int) -> None:
        """Hand on codes (h, w) or (h, w, 3) that are lit since `lit_ns`, where somebody watches."""
        if not self._sender.look():
            return
        height, width = codes.shape[:2]
        lit, values = lit_codes(codes)
        self._number += 1
        channels = 1
        if codes.ndim == 3:
            channels = 3
        head = FrameHead(
            frame=self._number,
            lit_ns=lit_ns,
            width=width,
            height=height,
            bits=file.config.monitor.bits,
            channels=channels,
            bench_sha256=file.sha256,
        )
        self._sender.put_frame(ShownFrame(head, lit, values))


class PatternDisplay(Closing):
    """The window on the bench's display, opened with the first pattern. Free it with `close`, or
    use it as a context. `frames` hands the patterns to watchers.
    """

    def __init__(self) -> None:
        self.frames: PatternFrames | None = None
        self._window: Window | None = None
        self._screen_px = (0, 0)
        self.force = False
        self.forced: list[str] = []

    def gate(self, file: BenchFile) -> Timing:
        """Measure the display as `serve` does. Raises MachineError where it is not as the bench
        file has it.
        """
        self.close()
        try:
            window = self._window_for(file)
            with open_bench(file, window_context()) as bench:
                screen = Screen(window, bench)
                timing = pass_gate(screen, self.force)
                self.forced += screen.forced
                return timing
        except NoDisplayError:
            raise
        except MachineError as error:
            raise MachineError(
                f"{str(error).removesuffix('; or add --force')}; or {SHOW_YOURSELF}"
            ) from error

    def show_until(
        self,
        file: BenchFile,
        pattern: Pattern,
        done: Callable[[], bool],
        on_key: Callable[[str], object] = lambda key: None,
    ) -> None:
        """Show a pattern until `done()`, first called when the panel has settled; `on_key` gets the
        keys pressed.

        Raises Stopped where the window is closed, MachineError where the display goes away.
        """
        window = self._window_for(file)
        if pattern.later:
            pause_s = 0.5 / file.config.monitor.refresh_hz
        else:
            pause_s = POLL_S
        shown = [_presenter(file, window, codes) for codes in pattern.frames]
        start_s = time.monotonic()
        number = 0
        handed_on_s = -math.inf
        window.keys.clear()  # keys pressed during the pattern before
        try:
            while time.monotonic() - start_s < SETTLE_S or not done():
                place = number % len(shown)
                shown[place][0].present()
                window.swap()
                now_s = time.monotonic()
                is_due = bool(pattern.later) or now_s - handed_on_s > HANDED_ON_AGAIN_S
                if self.frames is not None and is_due:
                    self.frames.send(file, pattern.frames[place], time.monotonic_ns())
                    handed_on_s = now_s
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
        """Show the photodiode's square on black; the square's changes. Raises Stopped,
        MachineError.

        `begin` is called once the display has been timed, and returns a function that says when to
        stop.
        """
        window = self._window_for(file)
        period_s = 1.0 / file.config.monitor.refresh_hz
        swap_ns: list[int] = []
        light: list[int] = []
        with open_bench(file, window_context()) as bench:
            screen = Screen(window, bench)
            pass_gate(screen, self.force)
            bench.draw(None)
            due_s = time.monotonic()
            done = begin()
            while not done():
                light.append(screen.present(len(light)) or 0)
                if not screen.clock.paced_by_screen:
                    due_s += period_s
                    time.sleep(max(due_s - time.monotonic(), 0.0))
                swap_ns.append(screen.swap())
                _go_on(window, screen.closing)
        return edges_of(np.array(swap_ns, dtype=np.int64), np.array(light, dtype=np.int64))

    def _window_for(self, file: BenchFile) -> "Window":
        from hilstar.display.window.window import Window, WindowSettings

        monitor = file.config.monitor
        screen_px = orientation_of(monitor).screen_px(monitor.resolution_px)
        if self._window is None or self._screen_px != screen_px:
            self.close()
            settings = WindowSettings(screen_px, monitor.bits, monitor.display)
            with without_display(SHOW_YOURSELF):
                self._window = Window(settings)
            self._screen_px = screen_px
        self._window.make_current()
        return self._window

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None


class _ShownHere(ImageSource):
    """An image source before this program's own display; `dark` is the tracker's image with the
    monitor switched off.
    """

    _shows = False  # whether a command shows the patterns

    def __init__(self, dark: Path | None = None, diode: SerialDiode | None = None) -> None:
        self._display = PatternDisplay()
        self._dark = dark
        self._diode = diode
        self.forced = self._display.forced

    def find_monitor(self, file: BenchFile, today: datetime.date, *, force: bool) -> None:
        if self._shows:
            return
        self._display.force = force
        monitor_check = check_monitor(file, identity_here(file.config.monitor.display), today)
        monitor_check.refuse(force)
        self.monitor = monitor_check.now
        self._display.forced += monitor_check.told(log)

    def gate(self, file: BenchFile) -> Timing | None:
        return None if self._shows else self._display.gate(file)

    def hand_on(self, frames: PatternFrames) -> None:
        if self._shows:
            super().hand_on(frames)
        self._display.frames = frames

    def unlit(self, stem: Path) -> Path | None:
        return self._dark

    def diode(self, file: BenchFile, seconds: float) -> DiodeRecording | None:
        if self._diode is None:
            return None
        return self._diode.watch(self._display, file, seconds)

    def hold(self, file: BenchFile, pattern: Pattern, seconds: float) -> None:
        if self._shows:
            super().hold(file, pattern, seconds)
        else:
            end_s = time.monotonic() + seconds
            self._display.show_until(file, pattern, lambda: time.monotonic() > end_s)

    def close(self) -> None:
        self._display.close()


class GrabCommand(_ShownHere):
    """Images by a command. It writes the file {output}; {pattern} is a picture of what the screen
    has to show.

    Without {pattern} the session shows the pattern itself; with {exposure_s} it may choose the
    exposure. `dark` is an image with the monitor switched off. Raises InputError for a command
    without {output}.
    """

    def __init__(
        self, command: str, dark: Path | None = None, diode: SerialDiode | None = None
    ) -> None:
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise InputError(
                f"--grab {command}: {error}; write it as on a command line, quotes in pairs"
            ) from error
        if not any("{output}" in word for word in self._words):
            raise InputError(
                f"--grab {command}: has no {{output}}; write where your command takes the file's"
                " name"
            )
        self._shows = any("{pattern}" in word for word in self._words)
        self.sets_exposure = any("{exposure_s}" in word for word in self._words)
        self.identity = f"grab: {command}"
        super().__init__(dark, None if self._shows else diode)

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Run the command while the pattern is shown. Raises NoImage with the last line of its
        stderr where it fails.
        """
        if self._shows and pattern.later:
            raise InputError(
                "a frame of `temporal` is many pictures: leave {pattern} out of --grab, and show"
                " them here"
            )
        if not self._shows:
            return self._taken(
                stem, exposure_s, lambda done: self._display.show_until(file, pattern, done)
            )
        monitor = file.config.monitor
        shown = on_screen(pattern.codes, orientation_of(monitor))
        write_codes_png(stem.parent / PATTERN_FILE, shown, monitor.bits)
        return self._taken(stem, exposure_s, _wait)

    def photograph(self, stem: Path, exposure_s: float) -> Path:
        """Run the command. Raises NoImage as `look` does."""
        return self._taken(stem, exposure_s, _wait)

    def check_photographs(self) -> None:
        """Refuse (InputError) a command that shows patterns."""
        if self._shows:
            raise InputError("--grab: has {pattern}, and nothing is shown here; leave it out")

    def _taken(
        self, stem: Path, exposure_s: float, meanwhile: Callable[[Callable[[], bool]], None]
    ) -> Path:
        output = stem.with_name(stem.name + ".png")
        command = self._words
        for name, value in (
            ("output", str(output)),
            ("pattern", str(stem.parent / PATTERN_FILE)),
            ("exposure_s", f"{exposure_s:.9g}"),
        ):
            command = [word.replace(f"{{{name}}}", value) for word in command]
        # an interrupted attempt may have left one, and a command that writes nothing must fail
        output.unlink(missing_ok=True)
        _run(command, output, meanwhile)
        return output


class BlackImages:
    """Tells the first image that is 0 everywhere, of a lit pattern and of a black one."""

    def __init__(self) -> None:
        self._told_black: set[bool] = set()

    def tell(self, dn: CodeImage, name: str, *, lit: bool) -> None:
        """Take in an image (h, w), DN, of a pattern that is lit or not."""
        if dn.any() or lit in self._told_black:
            return
        self._told_black.add(lit)
        if lit:
            advice = "look at the lens cap, the exposure and the camera's black level"
        else:
            advice = "a black level above 0 would show the noise of dark pixels"
        log.warning("%s: every pixel is 0; %s", name, advice)


class GrabCamera(_ShownHere):
    """Images of a GenICam camera (see `server.genicam`), set as `[tracker.camera]` says.

    Raises MachineError where Aravis or the camera is not there, InputError for features that it
    does not take.
    """

    sets_exposure = True

    def __init__(
        self,
        file: BenchFile,
        name: str,
        dark: Path | None = None,
        diode: SerialDiode | None = None,
    ) -> None:
        super().__init__(dark, diode)
        tracker = file.config.tracker
        self.identity = f"grab: {PREFIX}{name}"
        self._black_images = BlackImages()
        self._camera = GenicamCamera(name)
        try:
            about = self._camera.about
            own_format = chosen_format(about["formats"], tracker.detector.bits)
            form = tracker.camera.pixel_format or own_format
            self._camera.set({"PixelFormat": form} | tracker.camera.settings())
        except HilstarError:
            self._camera.close()
            raise
        log.warning("the tracker's images are %s %s's, %s", about["vendor"], about["model"], form)

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """The camera's image of a pattern: a PNG of 16 bits. Raises NoImage."""
        image = self._taken(
            stem.name, exposure_s, lambda done: self._display.show_until(file, pattern, done)
        )
        self._black_images.tell(image.dn, stem.name, lit=any(map(np.any, pattern.frames)))
        path = stem.with_name(stem.name + ".png")
        picture = png_of(image.dn)
        written(path, lambda output: output.write(picture))
        return path

    def photograph(self, stem: Path, exposure_s: float) -> Path:
        """The camera's image as FITS, with its exposure and when it began. Raises NoImage."""
        image = self._taken(stem.name, exposure_s, _wait)
        self._black_images.tell(image.dn, stem.name, lit=True)
        path = stem.with_name(stem.name + ".fits")
        write_photograph(path, image)
        return path

    def _taken(
        self, name: str, exposure_s: float, meanwhile: Callable[[Callable[[], bool]], None]
    ) -> CameraImage:
        images: list[CameraImage] = []
        begun = False

        def done() -> bool:
            # The exposure begins after the first call: by then the panel shows the pattern.
            nonlocal begun
            if not begun:
                self._camera.begin(exposure_s)
                begun = True
            image = self._camera.image()
            if image is not None:
                images.append(image)
            return bool(images)

        try:
            meanwhile(done)
        except CameraError as error:
            raise NoImage(str(error)) from error
        image = images[0]
        clipped = saturated_pixels(image.dn)
        if clipped:
            log.warning(
                "%s: %d pixels are saturated at %d",
                name,
                clipped,
                image.dn.max(),
            )
        if image.incomplete:
            log.warning("%s: taken again after %d incomplete images", name, image.incomplete)
        return image

    def close(self) -> None:
        """Close the display and let the camera go."""
        super().close()
        self._camera.close()


def write_photograph(path: Path, image: CameraImage) -> None:
    """Write a camera's image as FITS, its first row at the top. Raises InputError where that cannot
    be done.
    """
    from astropy.io import fits

    begun = np.datetime64(image.begun_utc_ns, "ns").astype("datetime64[us]")
    hdu = fits.PrimaryHDU(image.dn)
    hdu.header["DATE-OBS"] = str(begun), "UTC, the exposure's start"
    hdu.header["EXPTIME"] = image.exposure_s, "s"
    hdu.header["ROWORDER"] = "TOP-DOWN"
    if image.bayer:
        hdu.header["BAYERPAT"] = image.bayer
    write_fits(path, hdu)


def _run(words: list[str], output: Path, meanwhile: Callable[[Callable[[], bool]], None]) -> None:
    started: list[Child] = []
    end_s = time.monotonic() + GRAB_TIMEOUT_S

    def done() -> bool:
        # The command starts at the first call: by then the panel shows the pattern.
        if not started:
            try:
                started.append(ended.enter_context(Child(words, keeps_stdout=False)))
            except OSError as error:
                raise NoImage(
                    f"--grab: {words[0]} cannot be run ({error.strerror}); write a command that can"
                ) from error
        return started[0].poll() is not None or time.monotonic() > end_s

    with ExitStack() as ended:
        meanwhile(done)
        child = started[0]
        code = started[0].poll()
    command = shortened(shlex.join(words))
    if child.too_much:
        raise NoImage(
            f"--grab: {command} printed more than {MAX_OUTPUT_BYTES // 1_000_000} MB on stderr; let"
            " it say less"
        )
    if code is None:
        raise NoImage(
            f"--grab: {command} took over {GRAB_TIMEOUT_S:.0f} s; run it by hand to see why"
        )
    if code:
        lines = child.err.strip().splitlines()
        why = f": {shortened(lines[-1])}" if lines else ""
        raise NoImage(f"--grab: {command} ended with code {code}{why}")
    if not output.is_file() or not output.stat().st_size:
        raise NoImage(
            f"--grab: {command} wrote no image; it has to write {{output}}, as PNG or FITS"
        )


def _wait(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.005)


class ByHand(_ShownHere):
    """Images that a person saves. Each pattern stays on the display until its file is complete."""

    identity = "by hand"
    by_hand = True
    sets_exposure = True

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """Wait for a complete image of the pattern."""
        if exposure_s == file.config.tracker.exposure_s:
            exposed = ""
        else:
            exposed = f", exposed for {exposure_s:.4g} s,"
        asked = (
            f"now save the tracker's image{exposed} as {stem}.png (or .fits); q on the display ends"
        )
        self._display.show_until(
            file, pattern, _once_asked(asked, lambda: _saved(stem) is not None)
        )
        return _saved(stem) or stem

    def look_or_key(
        self, file: BenchFile, pattern: Pattern, stem: Path, keys: Mapping[str, str]
    ) -> Path | str:
        """The image of the pattern, or the key that says how it looks; `keys` has their
        meanings.
        """
        legend = "\n".join(f"    {key}  {meaning}" for key, meaning in keys.items())
        asked = (
            f"now press on the display what the tracker sees, or save its image as {stem}.png (or"
            f" .fits):\n{legend}"
        )
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


class VirtualBench(ImageSource):
    """A bench as a truth file describes it: lens, mounting, light, and the tracker's focus and
    noise.

    Free it with `close`. Raises InputError for a truth that cannot stand in for the bench.
    """

    def __init__(self, bench: BenchFile, truth: BenchFile, seed: int) -> None:
        self.truth = truth
        self._seed = seed
        self.sets_exposure = True
        self.identity = f"virtual: sha256 {truth.sha256}, seed {seed}"
        refuse_other_bench(bench, truth)
        config = truth.config
        with open_bench(truth) as real:
            self._panel = real.panel
            camera = real.camera
            psf = real.tracker_psf
            self._mosaic = DisplayColours.of(real)
            self._primaries_seen = seen_primaries(real)
        tracker = config.tracker
        self.geometry = BenchGeometry(camera, tracker_camera(tracker, truth.folder))
        self._optics = TwinOptics(self.geometry, psf)
        self._detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)
        glow_e_per_s = self._mosaic.grey(self._optics.glow_e_per_s(self._panel))
        background = TrackerBackground(config, truth.folder, self.geometry.tracker, refuse=False)
        # As the detector takes it, which is half of float64: three of these are kept, of up to 16
        # million pixels.
        self._glow_e_per_s: Float32Array = glow_e_per_s.astype(np.float32)
        self._sky_e_per_s: Float32Array = np.asarray(
            background.steady_e / tracker.exposure_s, dtype=np.float32
        )
        self._masks = MaskImages(tracker.resolution_px, MASKS_KEPT * len(self._primaries_seen))
        self._last: tuple[bytes, Float32Array] | None = None
        self._newest: tuple[Path, CodeImage] | None = None
        self._on_for_ns = 0
        if bench.config.render.bit_stealing:
            _ = self._primaries  # refused now where they are not known

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """The tracker's image of a pattern: a PNG of 16 bits."""
        mine = orientation_of(file.config.monitor)
        its = orientation_of(self.truth.config.monitor)
        frames = []
        for codes in pattern.frames:
            frames.append(np.ascontiguousarray(off_screen(on_screen(codes, mine), its)))
        # the frames in turn for as long as the exposure lasts; a single one has the same mean
        shown = 1
        if len(frames) > 1:
            shown = max(1, round(exposure_s * file.config.monitor.refresh_hz))
        in_exposure = itertools.islice(itertools.cycle(frames), shown)
        image = self._image_e_per_s(list(in_exposure))
        half_ns = round(
            NS_PER_S * max(exposure_s, self.truth.config.certify.virtual.seconds_a_reading) / 2
        )
        light = image + self._glow_e_per_s
        light *= np.float32(self._warmth((self._on_for_ns + half_ns) / NS_PER_S))
        self._on_for_ns += 2 * half_ns
        return self._exposed(light, exposure_s, stem)

    def unlit(self, stem: Path) -> Path | None:
        """The tracker's image of a monitor that is switched off."""
        return self._exposed(
            np.zeros_like(self._glow_e_per_s), self.truth.config.tracker.exposure_s, stem
        )

    def _warmth(self, on_for_s: float) -> float:
        """Light relative to that of a warm monitor, by the truth's [certify.virtual]; the first
        pattern switches it on.
        """
        virtual = self.truth.config.certify.virtual
        cold = virtual.cold_percent / 100 * math.exp(-on_for_s / (60 * virtual.warm_up_min))
        return 1 - cold + virtual.drift_percent_per_h / 100 * on_for_s / 3600

    def clock_ns(self) -> int:
        """Time since the monitor was switched on: each image takes the truth's
        `seconds_a_reading`.
        """
        return self._on_for_ns

    def hold(self, file: BenchFile, pattern: Pattern, seconds: float) -> None:
        """Let the clock go on."""
        self._on_for_ns += round(NS_PER_S * seconds)

    def diode(self, file: BenchFile, seconds: float) -> DiodeRecording | None:
        """A simulated photodiode: the true panel's delay and scan-out, with a little jitter."""
        return virtual_diode(
            file, self.truth, seconds, np.random.default_rng((self._seed, zlib.crc32(b"diode")))
        )

    def _exposed(self, light_e_per_s: Float32Array, exposure_s: float, stem: Path) -> Path:
        """Expose the virtual tracker, and write its image: taken again it has the same noise."""
        mean_e = light_e_per_s + self._sky_e_per_s
        mean_e *= np.float32(exposure_s)
        name = Path(stem.parent.name) / stem.name
        rng = np.random.default_rng((self._seed, zlib.crc32(str(name).encode())))
        pixels = self._detector.expose(mean_e, exposure_s, rng)
        image = png_of(pixels)
        path = stem.with_name(stem.name + ".png")
        written(path, lambda file: file.write(image))
        self._newest = path, pixels
        return path

    def pixels(self, path: Path, resolution_px: tuple[int, int]) -> FloatArray:
        """As of any source; the newest image need not be read from its file, which takes longer
        than to write it.
        """
        if self._newest is not None and self._newest[0] == path:
            return self._newest[1].astype(np.float64)
        return super().pixels(path, resolution_px)

    def _image_e_per_s(self, frames: list[CodeImage]) -> Float32Array:
        """The light of frames shown in turn, on the detector (h, w); a pattern that is seen
        again is not drawn again.
        """
        # Of 33 million pixels of an 8K screen, dots are some ten thousand.
        lit = [lit_codes(codes) for codes in frames]
        digest = hashlib.blake2b()
        for place, codes in lit:
            digest.update(place.data)
            digest.update(codes.data)
        if self._last is not None and self._last[0] == digest.digest():
            return self._last[1]
        lights = mean_light([self._lights(place.astype(np.intp), codes) for place, codes in lit])
        images = [self._primary_image(light, number) for number, light in enumerate(lights)]
        image = images[0]
        if len(images) > 1 or self._mosaic.bayer is not None:
            image = self._mosaic.shown(np.array(images)).astype(np.float32)
        self._last = digest.digest(), image
        return image

    def _primary_image(self, light: LitLight, number: int) -> Float32Array:
        """The light of a primary on the detector, of lit pixels' light relative to white.

        A pattern with one level is drawn once and scaled for others.
        """
        brightest = float(light.e_per_s.max(initial=0.0))
        primary = self._primaries_seen[number]
        if not brightest:
            return np.zeros_like(self._glow_e_per_s)
        if not (light.e_per_s == brightest).all():
            return self._drawn(light, primary).astype(np.float32)
        key = hashlib.blake2b(light.place.data).digest() + bytes([number])
        if key not in self._masks:
            unit = LitLight(light.place, np.ones(len(light.place)))
            self._masks.keep(key, self._drawn(unit, primary))
        return self._masks.image(key, brightest)

    def _drawn(self, light: LitLight, primary: Primary) -> FloatArray:
        """Light relative to white (n,) on the detector (h, w), electrons per second."""
        white_e_per_s: FloatArray | float = self._panel.flux_at_white_e_per_s
        if self._panel.uniformity is not None:
            white_e_per_s = white_e_per_s * self._panel.uniformity.ravel()[light.place].astype(
                np.float64
            )
        return self._optics.image_e_per_s(
            LitLight(light.place, light.e_per_s * white_e_per_s), primary
        )

    def _lights(
        self, place: IntArray, codes: npt.NDArray[np.unsignedinteger[Any]]
    ) -> list[LitLight]:
        """Light above black of lit pixels' codes (n,) or (n, 3), relative to white at the screen's
        brightest place; of each primary where the truth drives them apart, else of all together.
        """
        apart = len(self._primaries_seen) > 1
        if codes.ndim == 1 and not apart:
            return [LitLight(place, self._panel.response.light[codes])]
        by_primary = np.broadcast_to(codes.T, (3, len(place)))
        lights = []
        for table, its in zip(self._primaries, by_primary, strict=True):
            lights.append(LitLight(place, table[its]))
        if apart:
            return lights
        return [LitLight(place, np.sum([light.e_per_s for light in lights], axis=0))]

    @cached_property
    def _primaries(self) -> FloatArray:
        if self._panel.primaries:
            white = self._panel.flux_at_white_e_per_s
            return np.array(
                [
                    primary.response.light * (primary.flux_at_white_e_per_s / white)
                    for primary in self._panel.primaries
                ]
            )
        monitor = self.truth.config.monitor
        return primary_lights(calibration_source(monitor, self.truth.folder), monitor.bits)

    def close(self) -> None:
        """Free the GL context."""
        self._optics.close()


class MaskImages:
    """At most `count` images (h, w) of patterns with one level on a detector of `size_px` (width,
    height), each as the rectangle that has light; the oldest go first.
    """

    def __init__(self, size_px: tuple[int, int], count: int) -> None:
        self._shape = size_px[::-1]
        self._count = count
        self._parts: dict[bytes, tuple[slice, slice, Float32Array]] = {}

    def __contains__(self, key: bytes) -> bool:
        return key in self._parts

    def keep(self, key: bytes, image: FloatArray) -> None:
        """Keep an image (h, w), in place of older ones."""
        rows = _extent(np.asarray(image.any(axis=1)))
        columns = _extent(np.asarray(image.any(axis=0)))
        self._parts[key] = rows, columns, image[rows, columns].astype(np.float32)
        while len(self._parts) > 1 and self._is_full():
            oldest = next(iter(self._parts))
            del self._parts[oldest]

    def _is_full(self) -> bool:
        """Whether there are more images than are kept, or too large ones."""
        size_bytes = sum(part.nbytes for _, _, part in self._parts.values())
        return len(self._parts) > self._count or size_bytes > MASKS_KEPT_BYTES

    def image(self, key: bytes, level: float) -> Float32Array:
        """A pattern's image at a level relative to that of the image that is kept."""
        rows, columns, part = self._parts[key]
        image = np.zeros(self._shape, dtype=np.float32)
        np.multiply(part, np.float32(level), out=image[rows, columns])
        return image


def _extent(is_lit: BoolArray) -> slice:
    """From the first to the last that is lit (n,)."""
    lit = np.flatnonzero(is_lit)
    if not len(lit):
        return slice(0, 0)
    return slice(lit[0], lit[-1] + 1)


def mean_light(frames: list[list[LitLight]]) -> list[LitLight]:
    """The mean of frames' light of each primary."""
    if len(frames) == 1:
        return frames[0]
    means = []
    for lights in zip(*frames, strict=True):
        places = np.concatenate([light.place for light in lights])
        place, order = np.unique(places, return_inverse=True)
        total = np.bincount(order, np.concatenate([light.e_per_s for light in lights]))
        means.append(LitLight(place, total / len(frames)))
    return means


def virtual_diode(
    file: BenchFile, truth: BenchFile, seconds: float, rng: np.random.Generator
) -> DiodeRecording:
    """Edges of a true panel's delay and scan-out, with the jitter of swaps and of the truth's
    `[certify.virtual]`.
    """
    frames = int(seconds * file.config.monitor.refresh_hz)
    period_ns = NS_PER_S / file.config.monitor.refresh_hz
    jitter_ns = rng.normal(0, SWAP_JITTER_NS, frames)
    swap_ns = np.rint(np.arange(frames) * period_ns + jitter_ns).astype(np.int64)
    levels = np.array([marker_light(number, KIND) for number in range(frames)])
    shown = edges_of(swap_ns, levels)
    monitor = replace(truth.config.monitor, photodiode_px=file.config.monitor.photodiode_px)
    delay_ms = monitor.panel_delay_ms + swap_to_square_ms(monitor)
    noise_ms = rng.normal(0, truth.config.certify.virtual.delay_noise_ms, len(shown.host_ns))
    late_ns = np.rint((delay_ms + noise_ms) * NS_PER_MS).astype(np.int64)
    return DiodeRecording(shown, Edges(shown.host_ns + late_ns, shown.level))


def refuse_other_bench(bench: BenchFile, truth: BenchFile) -> None:
    """Refuse (InputError) a truth whose screen or tracker does not match the bench file's."""
    mine = bench.config
    its = truth.config
    screens = [orientation_of(c.monitor).screen_px(c.monitor.resolution_px) for c in (mine, its)]
    if screens[0] != screens[1]:
        sizes = "{} x {} px and the bench file's is {} x {}".format(*screens[1], *screens[0])
        raise InputError(
            f"{truth.path}: [monitor] resolution_px: its screen is {sizes}; write the same screen"
        )
    if mine.monitor.bits != its.monitor.bits:
        raise InputError(
            f"{truth.path}: [monitor] bits = {its.monitor.bits} and the bench file says"
            f" {mine.monitor.bits}"
        )
    if mine.tracker.resolution_px != its.tracker.resolution_px:
        raise InputError(
            f"{truth.path}: [tracker] resolution_px is not the bench file's; write the same tracker"
        )
    if its.render.bit_stealing:
        raise InputError(
            f"{truth.path}: [render] bit_stealing is for the bench that shows; leave it out of the"
            " truth"
        )
