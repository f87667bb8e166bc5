"""hilstar certify: how sure a bench is, stated and dated; and whether it has moved since."""

import datetime
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import typer

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory, temporary_folder, write_whole
from hilstar.basics.reading import exists
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.image_source import ImageOptions, handed_on, image_source
from hilstar.cli.options import bench_argument, check_files, json_option, output_option
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.warm_up import WarmUp
    from hilstar.instruments.certify.check import CheckFigure
    from hilstar.instruments.certify.readings import Reader
    from hilstar.server.bench import bench_file as files

CERTIFICATE, REFERENCE, PAGE = "certificate.json", "reference.json", "index.html"


@struct
class CertifyOptions:
    """The options of `hilstar certify`."""

    bench_file: Path = bench_argument()
    output: Path = output_option("DIR", "Directory of the certificate and its checks.")
    check: bool = switch("Has the bench moved since its certificate? A minute's readings.")
    again: bool = switch("Certify anew, in place of the certificate in DIR.")
    whole: bool = switch(
        "With --virtual: draw every image of the tracker; else only figures are drawn."
    )
    warm_up: float = option(
        "MINUTES", "Watch white for up to so long, until it is stable.", default=0.0, min=0, max=240
    )
    quick: bool = switch("Few trials: first order is enough where the model is linear.")
    as_json: bool = json_option()


def certify(options: CertifyOptions, images: ImageOptions) -> None:
    """State how sure a bench is: the light, places, attitude and latency of stars, with the
    uncertainty of each.

    Without --grab and --virtual nothing is read, and the calibration files say it. DIR has
    index.html and certificate.json.
    """
    from hilstar.server.bench.bench_file import read_bench_file

    check_directory("-o", options.output)
    file = read_bench_file(options.bench_file)
    truth = images.truth()
    check_files([truth, images.dark], [], file)
    _refuse_unused(options, images)
    if (options.check or options.warm_up) and images.grab is None and truth is None:
        raise InputError("--check: reads the bench; write --grab CMD, or --virtual TRUTH.toml")
    now = datetime.datetime.now(datetime.UTC)
    make_directory(options.output)
    with ExitStack() as stack:
        reader = _reader(stack, file, options, images)
        if options.check and reader is not None:
            _check(file, reader, options, now)
        else:
            _certify(file, reader, options, now)


def _refuse_unused(options: CertifyOptions, images: ImageOptions) -> None:
    """Refuse (InputError) the options of a real bench for a virtual one, and the reverse."""
    if images.virtual is None:
        if options.whole:
            raise InputError("--whole: is for --virtual; leave it out")
        return
    of_real_bench = {
        "--grab": images.grab,
        "--dark": images.dark,
        "--diode": images.diode,
        "--feed": images.feed,
    }
    for flag, value in of_real_bench.items():
        if value is not None:
            raise InputError(f"{flag}: a virtual bench has its own; leave it out")


def _certify(
    file: "files.BenchFile",
    reader: "Reader | None",
    options: CertifyOptions,
    now: datetime.datetime,
) -> None:
    """Write a certificate, its page and the reference of its checks. Raises InputError."""
    from hilstar.display.identity import sha256_of
    from hilstar.instruments.certify.certificate import certify as certified
    from hilstar.instruments.certify.check import largest_changes
    from hilstar.instruments.certify.page import text_lines, write_certificate_page
    from hilstar.server.bench.certificate_file import read_certificate

    output = options.output
    path = output / CERTIFICATE
    replaces = None
    if exists(path):
        if not options.again:
            raise InputError(
                f"{path}: exists; write --again to certify anew in its place, --check to check it,"
                " or another -o"
            )
        replaces = read_certificate(path).number
    warmed = None
    if reader is not None:
        watched = _watched(file, reader, options)
        if watched is not None:
            say(watched.line)
            if watched.law != "none":
                warmed = watched.bound
    checked = largest_changes(output)
    with busy("certifying"):
        certificate, reference = certified(
            file,
            reader,
            now,
            quick=options.quick,
            warm_up=warmed,
            checked=checked,
            replaces=replaces,
        )
    raw = msgspec.json.format(msgspec.json.encode(certificate))
    digest = sha256_of(raw)
    if reference is not None:
        write_whole(output / REFERENCE, reference)
    write_whole(path, raw)
    write_certificate_page(output / PAGE, certificate, digest)
    fields = {**msgspec.to_builtins(certificate), "sha256": digest, "page": str(output / PAGE)}
    rows = text_lines(certificate, digest, output)
    print_found(options.as_json, fields, (f"{name:26}{text}" for name, text in rows))


def _watched(file: "files.BenchFile", reader: "Reader", options: CertifyOptions) -> "WarmUp | None":
    """The warm-up of the monitor's white; None without --warm-up."""
    from hilstar.instruments.certify.check import watch

    if not options.warm_up:
        return None
    white = 2**file.config.monitor.bits - 1
    return watch(reader, white, options.warm_up, options.output / "warm-up")


def _check(
    file: "files.BenchFile", reader: "Reader", options: CertifyOptions, now: datetime.datetime
) -> None:
    """Compare readings of now with those of the certificate, else with the bench file; exit code 1
    where one is out of its tolerance.
    """
    from hilstar.instruments.certify.check import (
        by_bench_file,
        compare,
        read_reference,
        record,
        take_check,
    )
    from hilstar.server.bench.certificate_file import read_certificate

    output = options.output
    reference = read_reference(output / REFERENCE)
    since = "the bench file"
    if exists(output / CERTIFICATE):
        since = read_certificate(output / CERTIFICATE).number
    elif reference is None:
        say(
            f"{output}: has no certificate; the check is against the bench file (hilstar certify"
            f" {file.path.name} -o {output})"
        )
    warmed = _watched(file, reader, options)
    figures = compare(file, reference or by_bench_file(file), take_check(file, reader))
    rows = record(output, now, since, figures)
    unmoved = all(figure.in_tolerance for figure in figures)
    verdict = "the bench has moved: certify it --again"
    if unmoved:
        verdict = "the bench is as certified"
    lines = [_figure_line(figure) for figure in figures]
    lines.append(f"{'since':16}{since}")
    if warmed is not None:
        lines.append(f"{'warm-up':16}{warmed.line}")
    lines.append(f"{'verdict':16}{verdict}")
    fields = {
        "certificate": since,
        "in_tolerance": unmoved,
        "checks": len({row["made"] for row in rows}),
        "figures": figures,
        "warm_up": warmed,
    }
    print_found(options.as_json, fields, lines)
    if not unmoved:
        raise typer.Exit(1)


def _figure_line(figure: "CheckFigure") -> str:
    """A figure of a check, with its uncertainty and its tolerance."""
    half_width = (figure.upper - figure.lower) / 2
    value = f"{figure.value:+.4g} +- {half_width:.2g} {figure.unit}"
    within = "in" if figure.in_tolerance else "OUT OF"
    return f"{figure.quantity:16}{value:28}{within} tolerance ({figure.threshold:.2g})"


def _reader(
    stack: ExitStack, file: "files.BenchFile", options: CertifyOptions, images: ImageOptions
) -> "Reader | None":
    """The reader of the bench, open until `stack` is closed; None without a camera and a virtual
    bench. Raises InputError, MachineError.
    """
    from hilstar.instruments.certify.check import checks_in
    from hilstar.instruments.certify.readings import ImageReader, VirtualReader
    from hilstar.server.bench.bench_file import read_bench_file

    truth = None
    truth_file = images.truth()
    if truth_file is not None:
        truth = read_bench_file(truth_file)
    if truth is None and images.grab is None:
        return None
    if truth is not None and not options.whole:
        # each check draws other figures than the certificate and the checks before it
        draw = checks_in(options.output) + 1 if options.check else 0
        return VirtualReader(file, truth, images.seed, draw)
    source = stack.enter_context(closing(image_source(file, images)))
    stack.enter_context(handed_on(images.feed, source))
    today = datetime.datetime.now(datetime.UTC).date()
    source.find_monitor(file, today, force=options.again)
    source.gate(file)
    folder = stack.enter_context(temporary_folder("certify"))
    say(f"images by {source.identity}")
    return ImageReader(file, source, folder, truth=truth)
