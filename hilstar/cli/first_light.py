"""hilstar first-light: the first day on a bench, step by step; it resumes where it stopped."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from typer import Option

from hilstar.basics.errors import InputError, did_you_mean
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.completion import offered
from hilstar.cli.image_source import handed_on, image_source, virtual_truth
from hilstar.cli.options import (
    BenchFile,
    Json,
    check_files,
    seed_option,
)
from hilstar.cli.running import Console, ConsoleName, Control, Feed, Force, Token, page_listener
from hilstar.server.console.terminal import print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.first_light.image_sources import Pattern
    from hilstar.server.bench import bench_file as files
    from hilstar.server.console.listener import PageListener

PATCHES, FORCED, WARM_UP_MIN, SECONDS = 96, "forced", 30.0, 60.0
MAX_AVERAGE = 1000  # images that verify averages


def steps() -> Iterable[str]:
    """The steps that --again takes."""
    from hilstar.instruments.calibrate.first_light.session import NAMES

    return NAMES


def first_light(
    bench_file: BenchFile,
    output: Annotated[
        Path,
        Option(
            "-o",
            "--output",
            metavar="SESSION",
            help="Directory of the session; an existing session is resumed.",
        ),
    ],
    grab: Annotated[
        str | None,
        Option(
            metavar="CMD|genicam:NAME",
            help=(
                "Command that takes the tracker's image: {output} is the file to write; {pattern},"
                " where the command shows"
                " the pattern itself, a picture of it; {exposure_s}, where it can be set, the"
                " exposure. Or a camera: genicam: and its serial number, VENDOR-MODEL or address."
            ),
        ),
    ] = None,
    virtual: Annotated[
        Path | None,
        Option(
            metavar="TRUTH.toml",
            help=(
                "Without hardware: a bench file that says how the bench really is."
                " truth-example.toml comes with hilstar"
                " (in configs), for the bench of configs/demo.toml."
            ),
        ),
    ] = None,
    dark: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help=(
                "The tracker's image with the monitor switched off, for the monitor's black level."
            ),
        ),
    ] = None,
    diode: Annotated[
        str | None,
        Option(
            metavar="serial:/dev/ttyX@BAUD",
            help="Photodiode before the display's square, for its delay.",
        ),
    ] = None,
    patches: Annotated[
        int | None,
        Option(
            metavar="N",
            help="At most so many readings of the monitor's response, 0 for none. [96; by hand 0]",
            min=0,
        ),
    ] = None,
    warm_up: Annotated[
        float | None,
        Option(
            metavar="MINUTES",
            help=(
                "At most so long is white watched until it is stable to 0.2 %, 0 for not at all."
                " [with --virtual 30, else 0]"
            ),
            min=0,
            max=1440,
        ),
    ] = None,
    average: Annotated[
        int | None,
        Option(
            metavar="N",
            help=(
                "Images of each field of stars that verify averages [as many as their noise asks"
                " for, 25 at most; by hand 1]."
            ),
            min=1,
            max=MAX_AVERAGE,
        ),
    ] = None,
    feed: Feed = None,
    again: Annotated[
        list[str] | None,
        Option(
            metavar="STEP",
            help="Do this step again; may be given often.",
            autocompletion=offered(steps),
        ),
    ] = None,
    seed: Annotated[int, seed_option("With --virtual: seed of the tracker's noise.")] = 0,
    force: Force = False,
    console: Console = None,
    control: Control = False,
    token: Token = None,
    console_name: ConsoleName = None,
    as_json: Json = False,
) -> None:
    """Bring up a bench: mounting, focus, warm-up, geometry, light, full scale, delay and
    verification, with a page at the end.

    Sets the bench file's keys; SESSION keeps the file as it was, the calibration files,
    session.json and first-light.html.
    """
    from hilstar.instruments.calibrate.first_light.page import write_page
    from hilstar.instruments.calibrate.first_light.session import (
        BEFORE_FILE,
        NAMES,
        FirstLightSession,
        alone_in,
    )
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.server.sync import beat_line

    wrong = [name for name in again or [] if name not in NAMES]
    if wrong:
        raise InputError(
            f"--again {wrong[0]}: {did_you_mean(wrong[0], NAMES)}write one of {', '.join(NAMES)}"
        )
    check_directory("-o", output)
    file = read_bench_file(bench_file)
    virtual = virtual_truth(virtual)
    check_files([virtual, dark], [], file)
    by_hand = grab is None and virtual is None
    if patches is None:
        readings = 0 if by_hand else PATCHES
    else:
        readings = patches
    if by_hand and warm_up:
        raise InputError(
            "--warm-up: a person cannot save an image every ten seconds; give --grab CMD, or leave"
            " it out"
        )
    watched_s = SECONDS * (
        (0.0 if virtual is None else WARM_UP_MIN) if warm_up is None else warm_up
    )
    with (
        page_listener(console, control, token, console_name) as listener,
        closing(image_source(file, grab, virtual, dark, diode, seed)) as source,
        handed_on(feed, source),
        alone_in(make_directory(output)),
        _shown(listener, control, file) as (tell, watch),
    ):
        source.find_monitor(file, datetime.now(UTC).date(), force=force)
        for line in source.forced:
            tell(f"{FORCED:12} {line}")
        session = FirstLightSession(
            output,
            file,
            source,
            readings,
            watch,
            watched_s=watched_s,
            frames=average or 0,
            progress=say,
        )
        code = session.run(frozenset(again or []), tell)
        beats = beat_line(session.beat())
        if beats is not None:
            tell(beats)
        page = write_page(output, session.as_file(), output / BEFORE_FILE)
    session_file = session.as_file()
    lines = [f"{record.name:12} {record.verdict:8} {record.line}" for record in session_file.steps]
    print_found(
        as_json,
        msgspec.to_builtins(session_file) | {"page": str(page)},
        [*lines, f"{'page':12} {page}"],
    )
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
