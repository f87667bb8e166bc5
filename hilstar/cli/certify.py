"""hilstar certify: how sure a bench is, stated and dated; and whether it has moved since."""

import datetime
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory, write_whole
from hilstar.basics.reading import exists
from hilstar.cli.image_source import ShownTo, handed_on, image_source, virtual_truth
from hilstar.cli.options import BenchFile, Json, check_files, seed_option
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.certify.readings import Reader
    from hilstar.server.bench import bench_file as files

CERTIFICATE, REFERENCE, PAGE = "certificate.json", "reference.json", "index.html"


def certify(
    bench_file: BenchFile,
    output: Annotated[
        Path,
        Option(
            "-o", "--output", metavar="DIR", help="Directory of the certificate and its checks."
        ),
    ],
    check: Annotated[
        bool,
        Option("--check", help="Has the bench moved since its certificate? A minute's readings."),
    ] = False,
    again: Annotated[
        bool, Option("--again", help="Certify anew, in place of the certificate in DIR.")
    ] = False,
    grab: Annotated[
        str | None,
        Option(
            metavar="CMD|genicam:NAME",
            help=(
                "Command that takes the tracker's image, as that of first-light ({output},"
                " {pattern}), or a camera."
            ),
        ),
    ] = None,
    virtual: Annotated[
        Path | None,
        Option(
            metavar="TRUTH.toml",
            help="Without hardware: a bench file that says how the bench really is.",
        ),
    ] = None,
    whole: Annotated[
        bool,
        Option(
            "--whole",
            help="With --virtual: draw every image of the tracker; else only figures are drawn.",
        ),
    ] = False,
    dark: Annotated[
        Path | None,
        Option(
            metavar="FILE", help="With --grab: the tracker's image with the monitor switched off."
        ),
    ] = None,
    diode: Annotated[
        str | None,
        Option(
            metavar="serial:/dev/ttyX@BAUD",
            help="With --grab: photodiode before the display's square.",
        ),
    ] = None,
    warm_up: Annotated[
        float,
        Option(
            "--warm-up",
            metavar="MINUTES",
            min=0,
            max=240,
            help="Watch white for up to so long, until it is stable.",
        ),
    ] = 0.0,
    feed: ShownTo = None,
    quick: Annotated[
        bool, Option("--quick", help="Few trials: first order is enough where the model is linear.")
    ] = False,
    seed: Annotated[int, seed_option("With --virtual: seed of the readings' noise.")] = 0,
    as_json: Json = False,
) -> None:
    """State how sure a bench is: the light, places, attitude and latency of stars, with the
    uncertainty of each.

    Without --grab and --virtual nothing is read, and the calibration files say it. DIR has
    index.html and certificate.json.
    """
    from hilstar.server.bench.bench_file import read_bench_file

    check_directory("-o", output)
    file = read_bench_file(bench_file)
    virtual = virtual_truth(virtual)
    check_files([virtual, dark], [], file)
    for name, given in (
        ("--grab", grab),
        ("--whole", whole or None),
        ("--dark", dark),
        ("--diode", diode),
        ("--feed", feed),
    ):
        if given is not None and (virtual is not None) != (name == "--whole"):
            raise InputError(
                f"{name}:"
                f" {'is for --virtual' if name == '--whole' else 'a virtual bench has its own'};"
                " leave it out"
            )
    if (check or warm_up) and grab is None and virtual is None:
        raise InputError("--check: reads the bench; write --grab CMD, or --virtual TRUTH.toml")
    now = datetime.datetime.now(datetime.UTC)
    with ExitStack() as ended:
        reader = _reader(
            ended,
            file,
            make_directory(output),
            grab,
            virtual,
            whole,
            dark,
            diode,
            feed,
            seed,
            check,
            again,
        )
        if check and reader is not None:
            _check(file, reader, output, now, warm_up, as_json)
        else:
            _certify(file, reader, output, now, again, quick, warm_up, as_json)


def _certify(
    file: "files.BenchFile",
    reader: "Reader | None",
    output: Path,
    now: datetime.datetime,
    again: bool,
    quick: bool,
    warm_up: float,
    as_json: bool,
) -> None:
    from hilstar.display.identity import sha256_of
    from hilstar.instruments.certify.certificate import certify as certified
    from hilstar.instruments.certify.check import largest_changes, watch
    from hilstar.instruments.certify.page import text_lines, write_certificate_page
    from hilstar.server.bench.certificate_file import read_certificate

    path = output / CERTIFICATE
    replaces = None
    if exists(path):
        if not again:
            raise InputError(
                f"{path}: exists; write --again to certify anew in its place, --check to check it,"
                " or another -o"
            )
        replaces = read_certificate(path).number
    warmed = None
    if warm_up and reader is not None:
        watched = watch(reader, 2**file.config.monitor.bits - 1, warm_up, output / "warm-up")
        say(watched.line)
        warmed = None if watched.law == "none" else watched.bound
    checked = largest_changes(output)
    with busy("certifying"):
        certificate, reference = certified(
            file, reader, now, quick=quick, warm_up=warmed, checked=checked, replaces=replaces
        )
    raw = msgspec.json.format(msgspec.json.encode(certificate))
    digest = sha256_of(raw)
    if reference is not None:
        write_whole(output / REFERENCE, reference)
    write_whole(path, raw)
    write_certificate_page(output / PAGE, certificate, digest)
    fields = {**msgspec.to_builtins(certificate), "sha256": digest, "page": str(output / PAGE)}
    print_found(
        as_json,
        fields,
        (f"{name:26}{text}" for name, text in text_lines(certificate, digest, output)),
    )


def _check(
    file: "files.BenchFile",
    reader: "Reader",
    output: Path,
    now: datetime.datetime,
    warm_up: float,
    as_json: bool,
) -> None:
    from hilstar.instruments.certify.check import (
        by_bench_file,
        compare,
        read_reference,
        record,
        take_check,
        watch,
    )
    from hilstar.server.bench.certificate_file import read_certificate

    reference = read_reference(output / REFERENCE)
    since = "the bench file"
    if exists(output / CERTIFICATE):
        since = read_certificate(output / CERTIFICATE).number
    elif reference is None:
        say(
            f"{output}: has no certificate; the check is against the bench file (hilstar certify"
            f" {file.path.name} -o {output})"
        )
    if warm_up:
        warmed = watch(reader, 2**file.config.monitor.bits - 1, warm_up, output / "warm-up")
    else:
        warmed = None
    figures = compare(file, reference or by_bench_file(file), take_check(file, reader))
    rows = record(output, now, since, figures)
    good = all(figure.in_tolerance for figure in figures)
    lines = []
    for figure in figures:
        u = f"{figure.value:+.4g} +- {(figure.upper - figure.lower) / 2:.2g} {figure.unit}"
        lines.append(
            f"{figure.quantity:16}{u:28}{'in' if figure.in_tolerance else 'OUT OF'} tolerance"
            f" ({figure.threshold:.2g})"
        )
    lines += [f"{'since':16}{since}", *([] if warmed is None else [f"{'warm-up':16}{warmed.line}"])]
    if good:
        verdict = "the bench is as certified"
    else:
        verdict = "the bench has moved: certify it --again"
    lines.append(f"{'verdict':16}{verdict}")
    fields = {
        "certificate": since,
        "in_tolerance": good,
        "checks": len({row["made"] for row in rows}),
    }
    print_found(as_json, fields | {"figures": figures, "warm_up": warmed}, lines)
    if not good:
        raise typer.Exit(1)


def _reader(
    ended: ExitStack,
    file: "files.BenchFile",
    output: Path,
    grab: str | None,
    virtual: Path | None,
    whole: bool,
    dark: Path | None,
    diode: str | None,
    feed: str | None,
    seed: int,
    check: bool,
    again: bool,
) -> "Reader | None":
    from hilstar.basics.files import temporary_folder
    from hilstar.instruments.certify.check import checks_in
    from hilstar.instruments.certify.readings import ImageReader, VirtualReader
    from hilstar.server.bench.bench_file import read_bench_file

    if virtual is None:
        truth = None
    else:
        truth = read_bench_file(virtual)
    if truth is None and grab is None:
        return None
    if truth is not None and not whole:
        return VirtualReader(file, truth, seed, checks_in(output) + 1 if check else 0)
    source = ended.enter_context(closing(image_source(file, grab, virtual, dark, diode, seed)))
    ended.enter_context(handed_on(feed, source))
    source.find_monitor(file, datetime.datetime.now(datetime.UTC).date(), force=again)
    source.gate(file)
    folder = ended.enter_context(temporary_folder("certify"))
    say(f"images by {source.identity}")
    return ImageReader(file, source, folder, truth=truth)
