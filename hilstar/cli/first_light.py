"""hilstar first-light: the first day on a bench, step by step; it resumes where it stopped."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import typer

from hilstar.basics.errors import InputError, did_you_mean
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.completion import offered
from hilstar.cli.declare import option, struct
from hilstar.cli.image_source import ImageOptions, handed_on, image_source
from hilstar.cli.options import (
    bench_argument,
    check_files,
    force_option,
    json_option,
    output_option,
)
from hilstar.cli.running import ActingPageOptions, page_listener
from hilstar.server.console.terminal import print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.first_light.image_sources import Pattern
    from hilstar.server.bench import bench_file as files
    from hilstar.server.console.listener import PageListener

PATCHES = 96  # readings of the response, where no person has to save each image
WARM_UP_MIN = 30.0  # of a virtual bench, whose minutes pass at once
FORCED = "forced"  # name of a line
S_PER_MIN = 60.0
MAX_AVERAGE = 1000  # images that verify averages


def steps() -> Iterable[str]:
    """The steps that --again takes."""
    from hilstar.instruments.calibrate.first_light.steps import NAMES

    return NAMES


@struct
class FirstLightOptions:
    """The options of `hilstar first-light`."""

    bench_file: Path = bench_argument()
    output: Path = output_option(
        "SESSION", "Directory of the session; an existing session is resumed."
    )
    patches: int | None = option(
        "N",
        "At most so many readings of the monitor's response, 0 for none. [96; by hand 0]",
        min=0,
    )
    warm_up: float | None = option(
        "MINUTES",
        "At most so long is white watched until it is stable to 0.2 %, 0 for not at all. [with"
        " --virtual 30, else 0]",
        min=0,
        max=1440,
    )
    average: int | None = option(
        "N",
        "Images of each field of stars that verify averages [as many as their noise asks for, 25"
        " at most; by hand 1].",
        min=1,
        max=MAX_AVERAGE,
    )
    again: list[str] | None = option(
        "STEP", "Do this step again; may be given often.", autocompletion=offered(steps)
    )
    force: bool = force_option()
    as_json: bool = json_option()


def first_light(options: FirstLightOptions, images: ImageOptions, page: ActingPageOptions) -> None:
    """Bring up a bench: mounting, focus, warm-up, geometry, light, full scale, delay and
    verification, with a page at the end.

    Sets the bench file's keys; SESSION keeps the file as it was, the calibration files,
    session.json and first-light.html.
    """
    from hilstar.instruments.calibrate.first_light.page import write_page
    from hilstar.instruments.calibrate.first_light.session import (
        BEFORE_FILE,
        FirstLightSession,
        alone_in,
    )
    from hilstar.instruments.calibrate.first_light.steps import NAMES
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.sync import beat_line

    wrong = [name for name in options.again or [] if name not in NAMES]
    if wrong:
        raise InputError(
            f"--again {wrong[0]}: {did_you_mean(wrong[0], NAMES)}write one of {', '.join(NAMES)}"
        )
    check_directory("-o", options.output)
    file = read_bench_file(options.bench_file)
    check_files([images.truth(), images.dark], [], file)
    by_hand = images.grab is None and images.virtual is None
    readings = options.patches
    if readings is None:
        readings = 0 if by_hand else PATCHES
    if by_hand and options.warm_up:
        raise InputError(
            "--warm-up: a person cannot save an image every ten seconds; give --grab CMD, or leave"
            " it out"
        )
    warm_up_min = options.warm_up
    if warm_up_min is None:
        warm_up_min = 0.0 if images.virtual is None else WARM_UP_MIN
    with (
        page_listener(page) as listener,
        closing(image_source(file, images)) as source,
        handed_on(images.feed, source),
        alone_in(make_directory(options.output)),
        _shown(listener, page.control, file) as (tell, watch),
    ):
        source.find_monitor(file, datetime.now(UTC).date(), force=options.force)
        for line in source.forced:
            tell(f"{FORCED:12} {line}")
        session = FirstLightSession(
            options.output,
            file,
            source,
            readings,
            watch,
            watched_s=S_PER_MIN * warm_up_min,
            frames=options.average or 0,
            progress=say,
        )
        code = session.run(frozenset(options.again or []), tell)
        beats = beat_line(session.beat())
        if beats is not None:
            tell(beats)
        session_page = write_page(options.output, session.as_file(), options.output / BEFORE_FILE)
    session_file = session.as_file()
    lines = [f"{record.name:12} {record.verdict:8} {record.line}" for record in session_file.steps]
    lines.append(f"{'page':12} {session_page}")
    fields = msgspec.to_builtins(session_file)
    fields["page"] = str(session_page)
    print_found(options.as_json, fields, lines)
    if code:
        raise typer.Exit(code)


@contextmanager
def _shown(
    listener: "PageListener | None", control: bool, file: "files.BenchFile"
) -> "Iterator[tuple[Callable[[str], None], Callable[[Pattern], object]]]":
    """The audience of a session's lines and patterns: the terminal and, if there is one, the
    page.
    """
    if listener is None:
        yield say, lambda pattern: None
        return
    from hilstar.server.console.publisher import session_page

    with session_page(listener, control, file) as feed:

        def tell(line: str) -> None:
            say(line)
            feed.say(line)

        yield tell, feed.show
