"""Where images of a tracker come from: a person, a command, a camera, or a virtual bench."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.basics.reading import exists
from hilstar.basics.resources import resource_path
from hilstar.cli.declare import option, struct
from hilstar.cli.options import feed_option, overwrite_option, parse_diode, seed_option
from hilstar.server.console.terminal import say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.first_light.image_sources import ImageSource, SerialDiode
    from hilstar.instruments.calibrate.grabbed_dots import DotImages
    from hilstar.server.bench import bench_file as files

EXAMPLE_TRUTH = "truth-example.toml"  # in configs


def exposure_option() -> Any:
    """The option of the exposure of images that are taken."""
    return option(
        "SECONDS", "With --grab: the exposure; by default the bench file's.", min=1e-6, max=3600
    )


def grab_option() -> Any:
    """The option of a command or a camera that takes images of dots."""
    return option(
        "CMD|genicam:NAME",
        "Take the images here: a command as that of first-light ({output}, {pattern},"
        " {exposure_s}), or a camera.",
    )


@struct
class ImageOptions:
    """Where images of a tracker come from that sees the bench: a person, a command, a camera, or a
    virtual bench.
    """

    grab: str | None = option(
        "CMD|genicam:NAME",
        "Command that takes the tracker's image: {output} is the file to write; {pattern}, where"
        " the command shows the pattern itself, a picture of it; {exposure_s}, where it can be"
        " set, the exposure. Or a camera: genicam: and its serial number, VENDOR-MODEL or address.",
    )
    virtual: Path | None = option(
        "TRUTH.toml",
        "Without hardware: a bench file that says how the bench really is. truth-example.toml comes"
        " with hilstar (in configs), for the bench of configs/demo.toml.",
    )
    dark: Path | None = option(
        "FILE", "The tracker's image with the monitor switched off, for the monitor's black level."
    )
    diode: str | None = option(
        "serial:/dev/ttyX@BAUD", "Photodiode before the display's square, for its delay."
    )
    feed: str | None = feed_option()
    seed: int = seed_option("With --virtual: seed of the tracker's noise.")

    def truth(self) -> Path | None:
        """The file of --virtual; the example that comes with hilstar is found by its name."""
        path = self.virtual
        if path is not None and path.name == EXAMPLE_TRUTH and not exists(path):
            return resource_path("configs", EXAMPLE_TRUTH)
        return path


@struct
class DotOptions:
    """Where the images of dots come from, where they are no files."""

    grab: str | None = grab_option()
    exposure: float | None = exposure_option()
    feed: str | None = option(
        "ENDPOINT",
        "With --grab: hand the frames on to who watches there (tcp://127.0.0.1:5570).",
    )
    overwrite: bool = overwrite_option()
    dark: Path | None = option(
        "FILE", "A dark frame, taken from each image; with --grab one is taken, too."
    )


def image_source(file: "files.BenchFile", images: ImageOptions) -> "ImageSource":
    """The source of images. Raises InputError for options that exclude each other."""
    from hilstar.instruments.calibrate.first_light.image_sources import SerialDiode, VirtualBench
    from hilstar.instruments.calibrate.geometric.observed import read_image
    from hilstar.server.bench.bench_file import read_bench_file

    truth = images.truth()
    if truth is not None:
        given = {"--grab": images.grab, "--dark": images.dark, "--diode": images.diode}
        for name, value in given.items():
            if value is not None:
                raise InputError(
                    f"{name} and --virtual: a virtual bench has its own; leave one of them out"
                )
        return VirtualBench(file, read_bench_file(truth), images.seed)
    if images.dark is not None:
        read_image(images.dark, file.config.tracker.resolution_px)
    recorder = None
    if images.diode is not None:
        recorder = SerialDiode(*parse_diode(images.diode))
    return real_source(file, images.grab, images.dark, recorder)


def real_source(
    file: "files.BenchFile",
    grab: str | None,
    dark: Path | None = None,
    recorder: "SerialDiode | None" = None,
) -> "ImageSource":
    """The images of a real tracker: by a person without `grab`, else a camera or a command.
    Raises InputError.
    """
    from hilstar.instruments.calibrate.first_light.image_sources import (
        ByHand,
        GrabCamera,
        GrabCommand,
    )
    from hilstar.server.genicam.camera import PREFIX

    if grab is None:
        return ByHand(dark, recorder)
    if grab.startswith(PREFIX):
        return GrabCamera(file, grab.removeprefix(PREFIX), dark, recorder)
    return GrabCommand(grab, dark, recorder)


@contextmanager
def handed_on(endpoint: str | None, source: "ImageSource") -> Iterator[None]:
    """The source's patterns handed on at an endpoint, if there is one. Raises InputError."""
    if endpoint is None:
        yield
        return
    from hilstar.attitude.wire.shown_frames import FrameSender
    from hilstar.instruments.calibrate.first_light.image_sources import PatternFrames

    with FrameSender(endpoint) as sender:
        source.hand_on(PatternFrames(sender))
        say(f"frames: {sender.endpoint}")
        yield


def dot_images(
    file: "files.BenchFile", given: list[Path], plan: Path, dots: DotOptions
) -> "DotImages":
    """The images of a plan's dots: those given, or taken here. Raises InputError for neither or
    both.
    """
    from hilstar.instruments.calibrate.grabbed_dots import DotImages, grab_dots

    if dots.grab is None:
        for name, value in (("--exposure", dots.exposure), ("--feed", dots.feed)):
            if value is not None:
                raise InputError(f"{name}: is for --grab; write --grab, or leave it out")
        if not given:
            raise InputError("no image of the dots: give their files, or --grab to take them")
        return DotImages(given, dots.dark)
    if given:
        raise InputError(f"{given[0]}: --grab takes the images; leave one of them out")
    with closing(real_source(file, dots.grab)) as source, handed_on(dots.feed, source):
        grabbed = grab_dots(file, source, plan, dots.exposure, overwrite=dots.overwrite, tell=say)
    # a dark frame that was named is used in place of the one that was taken
    return grabbed._replace(dark=dots.dark or grabbed.dark)


def photographs(
    file: "files.BenchFile", grab: str, count: int, exposure_s: float | None, folder: Path
) -> list[Path]:
    """Images of what is before the tracker, taken into `folder`. Raises InputError, MachineError.

    Their names have their time, so that they replace no others.
    """
    from hilstar.instruments.calibrate.grabbed_dots import exposure_of

    with closing(real_source(file, grab)) as source:
        exposure_s = exposure_of(file, source, exposure_s)
        source.check_photographs()
        make_directory(folder)
        images = []
        for number in range(count):
            began = datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%S")
            images.append(source.photograph(folder / f"{began}_{number:03}", exposure_s))
            say(f"{images[-1].name}: image {number + 1} of {count}")
    return images
