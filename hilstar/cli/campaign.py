"""hilstar campaign: many cases of a bench, over every core and machine."""

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory
from hilstar.cli import running
from hilstar.cli.options import Headless, Json, parse_memory
from hilstar.server.console.terminal import print_found, progress, say

if TYPE_CHECKING:
    from hilstar.instruments.campaign.cluster import Scheduler
    from hilstar.instruments.campaign.run import Campaign
    from hilstar.instruments.campaign.store import Directory
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.console.listener import PageListener

CENTROIDS = "centroids"  # the solver without another one
LINE_S = 10.0  # between lines of progress where stderr is no terminal


def campaign(
    plan: Annotated[
        Path, Argument(metavar="PLAN.toml", help="What varies, and how (docs: Campaigns).")
    ],
    output: Annotated[
        Path,
        Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Directory of the campaign; it goes on where it was.",
        ),
    ],
    workers: Annotated[
        int | None,
        Option(
            metavar="N", help="Processes on this machine; by default one a core.", min=1, max=1024
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(
            metavar="tcp://HOST:PORT",
            help="A Dask scheduler, whose workers run the cases; off loopback with TLS.",
        ),
    ] = None,
    tls_ca_file: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="With --scheduler tls://HOST:PORT: the CA's certificates, PEM, as Dask's.",
        ),
    ] = None,
    tls_cert: Annotated[
        Path | None, Option(metavar="FILE", help="This side's certificate, PEM.")
    ] = None,
    tls_key: Annotated[
        Path | None, Option(metavar="FILE", help="Its key, where the certificate's file has none.")
    ] = None,
    solver: Annotated[
        str,
        Option(
            metavar="SOLVER",
            help=(
                'What is tested: "centroids", "python:MODULE:FUNCTION", or a command with {image}'
                " that prints a quaternion."
            ),
        ),
    ] = CENTROIDS,
    solver_timeout: Annotated[
        float, Option(metavar="SECONDS", help="Time limit of one image, s.", min=0.01, max=86400)
    ] = 10.0,
    images: Annotated[
        Literal["fits"] | None, Option(help="Keep the images, with their truth.")
    ] = None,
    memory: Annotated[
        str | None,
        Option(
            metavar="SIZE",
            help="For this process and its workers together, such as 4GB: as many run as fit.",
        ),
    ] = None,
    headless: Headless = False,
    windowed: running.Windowed = False,
    force: running.Force = False,
    feed: running.Feed = None,
    console: running.Console = None,
    token: running.Token = None,
    console_name: running.ConsoleName = None,
    strict: Annotated[
        bool,
        Option(
            "--strict", help="Exit with code 1 where one of the plan's requirements is not met."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Run a plan's cases over every core, or a cluster, into one Parquet table, a row a case."""
    from hilstar.instruments.campaign.cluster import Scheduler
    from hilstar.instruments.campaign.run import Campaign
    from hilstar.instruments.campaign.store import Directory

    check_directory("-o", output)
    if scheduler is not None and (workers is not None or memory is not None):
        raise InputError(
            "campaign --scheduler: the cluster's workers are its own; leave out --workers and"
            " --memory"
        )
    pooled = {
        "--workers": workers is not None,
        "--scheduler": scheduler is not None,
        "--memory": memory is not None,
    }
    pooled |= {"--images": images is not None, "--solver": solver != CENTROIDS}
    cluster = None if scheduler is None else Scheduler(scheduler, tls_ca_file, tls_cert, tls_key)
    if cluster is not None:
        cluster.check()
    elif tls_ca_file or tls_cert or tls_key:
        raise InputError(
            "campaign --tls-*: is for a cluster; write --scheduler tls://HOST:PORT beside it"
        )
    memory_bytes = None if memory is None else parse_memory(memory)
    this = Campaign(plan, output, solver, solver_timeout, images is not None)
    of_bench = {"--headless": headless, "--windowed": windowed, "--force": force}
    of_bench |= {"--feed": feed is not None, "--console": console is not None}
    check_through("campaign", "through =", this.on_bench, of_bench, pooled)
    directory = Directory(output)
    try:
        directory.claim(this.about())
        if not directory.table.exists() and this.on_bench:
            shown_bench = partial(
                running.shown_bench, headless=headless, windowed=windowed, force=force, timed=True
            )
            with running.page_listener(console, False, token, console_name) as listener:
                show_cases(this, directory, shown_bench, feed, listener)
        elif not directory.table.exists():
            run_cases(
                this, directory, cluster, workers or len(os.sched_getaffinity(0)), memory_bytes
            )
        # charts and statistics, once there is a table
        from hilstar.instruments.campaign.page import PAGE_FILE
        from hilstar.instruments.campaign.results import lines_of, write_results

        summary = write_results(directory.table, this.maker.file, this.plan.seed)
        lines, not_met = lines_of(summary), False
        if this.on_bench:
            from hilstar.instruments.campaign.bench_results import bench_lines, bench_summary

            summary |= bench_summary(directory.table)
            lines += bench_lines(summary)
        if this.plan.require:
            from hilstar.instruments.campaign.requirements import NOT_MET
            from hilstar.instruments.campaign.requirements_page import (
                summary_of,
                write_requirements,
            )

            verdicts = write_requirements(this.plan, this.path, directory.table, this.maker.file)
            not_met = any(requirement.verdict == NOT_MET for requirement in verdicts)
            summary["requirements"] = [summary_of(requirement) for requirement in verdicts]
            lines += [requirement.words for requirement in verdicts]
    finally:
        directory.close()
    lines.append(f"{'page':20}{directory.table.with_name(PAGE_FILE)}")
    print_found(as_json, summary, lines)
    if strict and not_met:
        raise typer.Exit(1)


def check_through(
    command: str,
    setting: str,
    on_bench: bool,
    of_bench: dict[str, bool],
    of_tracker: dict[str, bool],
) -> None:
    """Refuse (InputError) options that mean nothing for the plan's `through`, which is written as
    `setting` in a plan or in a command.
    """
    for name, given in (of_tracker if on_bench else of_bench).items():
        if given:
            through = "tracker or display" if on_bench else "bench"
            raise InputError(f"{command} {name}: is for {setting} {through}; leave it out")


def show_cases(
    this: "Campaign",
    directory: "Directory",
    shown_bench: Callable[["BenchFile"], AbstractContextManager[tuple[Any, Any]]],
    endpoint: str | None,
    listener: "PageListener | None",
) -> None:
    """Show the missing cases to the real tracker, with progress on the terminal and on the page."""
    from hilstar.basics.notices import Notices
    from hilstar.instruments.campaign.bench_run import OpenDisplay
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.console.run_status import RunSource, RunStatus
    from hilstar.server.record.ledger import LedgerSwitch

    count = 0
    begun = 0
    notices = Notices()
    started_s = time.monotonic()
    said_s = time.monotonic()
    where = str(this.path)

    with telling(this.cases) as advance:

        def on_done(done: int) -> None:
            nonlocal count, begun, said_s
            begun = begun if count else done
            now_s = time.monotonic()
            count = min(done, this.cases)
            advance(count)
            if listener is not None and now_s - said_s >= LINE_S and count > begun:
                said_s = now_s
                left_s = (this.cases - count) * (now_s - started_s) / (count - begun)
                notices.tell("campaign", f"{count} of {this.cases} cases, {left_s:.0f} s left")

        @contextmanager
        def display(file: "BenchFile") -> Iterator[OpenDisplay]:
            with (
                shown_bench(file) as (bench, screen),
                running.optional_frames(endpoint, bench, screen) as feed,
            ):
                ledger = LedgerSwitch()
                renderer = bench.renderer.gl_renderer
                refresh_hz = bench.config.monitor.refresh_hz
                source = RunSource(where, renderer, refresh_hz, math.inf, running.forced_on(screen))
                parts = running.page_parts(bench, notices, ledger, screen)
                page = RunDescription("campaign", "campaign", where)
                status = RunStatus(source, ledger)
                with running.followed(listener, False, page, parts, status, frames=feed) as (
                    sink,
                    follower,
                    _,
                ):
                    yield OpenDisplay(bench, screen, sink, follower)

        if not this.show(directory, display, notices, on_done):
            say(
                f"hilstar: {count} of {this.cases} cases are done; the same command goes on from"
                " there"
            )
            raise KeyboardInterrupt


def run_cases(
    this: "Campaign",
    directory: "Directory",
    scheduler: "Scheduler | None",
    workers: int,
    memory_bytes: int | None,
) -> None:
    """Run the missing cases on a cluster or on this machine's cores."""
    from hilstar.instruments.campaign.pool import Pool

    count = 0
    with telling(this.cases) as advance:

        def on_done(done: int) -> None:
            nonlocal count
            count = done
            advance(done)

        try:
            if scheduler is not None:
                from hilstar.instruments.campaign.cluster import Cluster

                with Cluster(scheduler, this.job, this.identity, say) as cluster:
                    this.run(directory, cluster, on_done)
            else:
                with Pool(this.job, this.identity, workers, memory_bytes) as pool:
                    this.run(directory, pool, on_done)
        except KeyboardInterrupt:
            say(
                f"hilstar: {count} of {this.cases} cases are done; the same command goes on from"
                " there"
            )
            raise


@contextmanager
def telling(cases: int) -> Iterator[Callable[[int], None]]:
    """Progress with the time left: a bar on a terminal, elsewhere a line every ten seconds."""
    if sys.stderr is not None and sys.stderr.isatty():
        with progress("cases", cases) as advance:
            yield advance
        return
    first: tuple[int, float] | None = None
    last_s = time.monotonic()

    def line(done: int) -> None:
        nonlocal first, last_s
        now_s = time.monotonic()
        first = first or (done, now_s)
        if now_s - last_s >= LINE_S and done > first[0]:
            last_s = now_s
            a_second = (done - first[0]) / (now_s - first[1])
            say(
                f"hilstar: {done} of {cases} cases, {a_second:.3g} a second,"
                f" {(cases - done) / a_second:.0f} s left"
            )

    yield line
