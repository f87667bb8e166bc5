"""The options that say where images of a tracker come from: by hand, a command, a camera, a virtual
bench."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.basics.reading import exists
from hilstar.basics.resources import resource_path
from hilstar.cli.options import parse_diode
from hilstar.server.console.terminal import say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.first_light.image_sources import ImageSource
    from hilstar.instruments.calibrate.grabbed_dots import DotImages
    from hilstar.server.bench import bench_file as files

Grab = Annotated[
    str | None,
    Option(
        "--grab",
        metavar="CMD|genicam:NAME",
        help=(
            "Take the images here: a command as that of first-light ({output}, {pattern},"
            " {exposure_s}), or a camera."
        ),
    ),
]
Exposure = Annotated[
    float | None,
    Option(
        metavar="SECONDS",
        help="With --grab: the exposure; by default the bench file's.",
        min=1e-6,
        max=3600,
    ),
]
ShownTo = Annotated[
    str | None,
    Option(
        "--feed",
        metavar="ENDPOINT",
        help="With --grab: hand the frames on to who watches there (tcp://127.0.0.1:5570).",
    ),
]
EXAMPLE_TRUTH = "truth-example.toml"  # in configs


def virtual_truth(path: Path | None) -> Path | None:
    """The file of --virtual; the example that comes with hilstar is found by its name."""
    if path is not None and path.name == EXAMPLE_TRUTH and not exists(path):
        return resource_path("configs", EXAMPLE_TRUTH)
    return path


def image_source(
    file: "files.BenchFile",
    grab: str | None,
    virtual: Path | None,
    dark: Path | None,
    diode: str | None,
    seed: int,
) -> "ImageSource":
    """The source of images. Raises InputError for options that exclude each other."""
    from hilstar.instruments.calibrate.first_light.image_sources import (
        ByHand,
        GrabCamera,
        GrabCommand,
        SerialDiode,
        VirtualBench,
    )
    from hilstar.instruments.calibrate.geometric.observed import read_image
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.genicam.camera import PREFIX

    if virtual is not None:
        for name, given in (("grab", grab), ("dark", dark), ("diode", diode)):
            if given is not None:
                raise InputError(
                    f"--{name} and --virtual: a virtual bench has its own; leave one of them out"
                )
        return VirtualBench(file, read_bench_file(virtual), seed)
    if dark is not None:
        read_image(dark, file.config.tracker.resolution_px)
    if diode is None:
        recorder = None
    else:
        recorder = SerialDiode(*parse_diode(diode))
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
    file: "files.BenchFile",
    given: list[Path],
    plan: Path,
    grab: str | None,
    exposure_s: float | None,
    feed: str | None,
    overwrite: bool,
) -> "DotImages":
    """The images of a plan's dots: those given, or taken here. Raises InputError for neither or
    both.
    """
    from hilstar.instruments.calibrate.grabbed_dots import DotImages, grab_dots

    if grab is None:
        for name, value in (("--exposure", exposure_s), ("--feed", feed)):
            if value is not None:
                raise InputError(f"{name}: is for --grab; write --grab, or leave it out")
        if not given:
            raise InputError("no image of the dots: give their files, or --grab to take them")
        return DotImages(given, None)
    if given:
        raise InputError(f"{given[0]}: --grab takes the images; leave one of them out")
    with (
        closing(image_source(file, grab, None, None, None, 0)) as source,
        handed_on(feed, source),
    ):
        return grab_dots(file, source, plan, exposure_s, overwrite=overwrite, tell=say)


def photographs(
    file: "files.BenchFile", grab: str, count: int, exposure_s: float | None, folder: Path
) -> list[Path]:
    """Images of what is before the tracker, taken into `folder`. Raises InputError, MachineError.

    Their names have their time, so that they replace no others.
    """
    from hilstar.instruments.calibrate.grabbed_dots import exposure_of

    with closing(image_source(file, grab, None, None, None, 0)) as source:
        exposure_s = exposure_of(file, source, exposure_s)
        source.check_photographs()
        make_directory(folder)
        images = []
        for number in range(count):
            began = datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%S")
            images.append(source.photograph(folder / f"{began}_{number:03}", exposure_s))
            say(f"{images[-1].name}: image {number + 1} of {count}")
    return images
