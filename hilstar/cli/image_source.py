"""The options that say where images of a tracker come from: by hand, a command, a camera, a virtual
bench."""

from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.basics.errors import InputError
from hilstar.basics.reading import exists
from hilstar.basics.resources import resource_path
from hilstar.cli.options import (
    parse_diode,
)

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.first_light.image_sources import ImageSource
    from hilstar.server.bench import bench_file as files

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
