"""hilstar campaign: many cases of a bench, over every core and machine."""

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory
from hilstar.cli import running
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.options import json_option, output_option, parse_memory
from hilstar.cli.running import DisplayOptions, PageOptions
from hilstar.server.console.terminal import erases_lines, print_found, progress, say

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from hilstar.instruments.campaign.cluster import Cluster, Scheduler
    from hilstar.instruments.campaign.pool import Pool
    from hilstar.instruments.campaign.run import Campaign
    from hilstar.instruments.campaign.store import Directory
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.console.listener import PageListener

    Workers = AbstractContextManager[Pool | Cluster]

CENTROIDS = "centroids"  # the solver without another one
LINE_S = 10.0  # between lines of progress where stderr is no terminal


@struct
class CaseOptions:
    """Who is tested by the cases of a plan, and on how many cores."""

    workers: int | None = option(
        "N", "Processes on this machine; by default one a core.", min=1, max=1024
    )
    solver: str = option(
        "SOLVER",
        'What is tested: "centroids", "python:MODULE:FUNCTION", or a command with {image} that'
        " prints a quaternion; not on a real bench.",
        default=CENTROIDS,
    )
    solver_timeout: float = option(
        "SECONDS", "Time limit of one image, s.", default=10.0, min=0.01, max=86400
    )

    def processes(self) -> int:
        """The number of worker processes on this machine."""
        return self.workers or len(os.sched_getaffinity(0))


@struct
class CampaignOptions:
    """The options of `hilstar campaign`."""

    plan: Path = argument("PLAN.toml", "What varies, and how (docs: Campaigns).")
    output: Path = output_option("DIR", "Directory of the campaign; it goes on where it was.")
    scheduler: str | None = option(
        "tcp://HOST:PORT", "A Dask scheduler, whose workers run the cases; off loopback with TLS."
    )
    tls_ca_file: Path | None = option(
        "FILE", "With --scheduler tls://HOST:PORT: the CA's certificates, PEM, as Dask's."
    )
    tls_cert: Path | None = option("FILE", "This side's certificate, PEM.")
    tls_key: Path | None = option("FILE", "Its key, where the certificate's file has none.")
    images: Literal["fits"] | None = option("", "Keep the images, with their truth.")
    memory: str | None = option(
        "SIZE", "For this process and its workers together, such as 4GB: as many run as fit."
    )
    strict: bool = switch("Exit with code 1 where one of the plan's requirements is not met.")
    as_json: bool = json_option()


def campaign(
    options: CampaignOptions, cases: CaseOptions, display: DisplayOptions, page: PageOptions
) -> None:
    """Run a plan's cases over every core, or a cluster, into one Parquet table, a row a case."""
    from hilstar.instruments.campaign.run import Campaign
    from hilstar.instruments.campaign.store import Directory

    check_directory("-o", options.output)
    cluster = _scheduler(options, cases)
    memory_bytes = None
    if options.memory is not None:
        memory_bytes = parse_memory(options.memory)
    keeps_images = options.images is not None
    this = Campaign(options.plan, options.output, cases.solver, cases.solver_timeout, keeps_images)
    of_tracker = {
        "--workers": cases.workers is not None,
        "--scheduler": options.scheduler is not None,
        "--memory": options.memory is not None,
        "--images": keeps_images,
        "--solver": cases.solver != CENTROIDS,
    }
    of_bench = display.given()
    of_bench["--console"] = page.console is not None
    check_through("campaign", "through =", this.on_bench, of_bench, of_tracker)
    directory = Directory(options.output)
    try:
        directory.claim(this.about())
        if not directory.table.exists() and this.on_bench:
            with running.page_listener(page) as listener:
                show_cases(this, directory, display, listener)
        elif not directory.table.exists():
            run_cases(this, directory, _workers(this, cluster, cases.processes(), memory_bytes))
        results = _results(this, directory)
    finally:
        directory.close()
    print_found(options.as_json, results.summary, results.lines)
    if options.strict and results.not_met:
        raise typer.Exit(1)


def _scheduler(options: CampaignOptions, cases: CaseOptions) -> "Scheduler | None":
    """The cluster of the command line, checked; None where this machine runs the cases. Raises
    InputError.
    """
    from hilstar.instruments.campaign.cluster import Scheduler

    keys = (options.tls_ca_file, options.tls_cert, options.tls_key)
    if options.scheduler is None:
        if any(keys):
            raise InputError(
                "campaign --tls-*: is for a cluster; write --scheduler tls://HOST:PORT beside it"
            )
        return None
    if cases.workers is not None or options.memory is not None:
        raise InputError(
            "campaign --scheduler: the cluster's workers are its own; leave out --workers and"
            " --memory"
        )
    scheduler = Scheduler(options.scheduler, *keys)
    scheduler.check()
    return scheduler


class _Results(NamedTuple):
    """What --json has of a campaign, its lines, and whether a requirement is not met."""

    summary: dict[str, Any]
    lines: list[str]
    not_met: bool


def _results(this: "Campaign", directory: "Directory") -> _Results:
    """Write charts, statistics and verdicts of a campaign that has its table."""
    from hilstar.instruments.campaign.page import PAGE_FILE
    from hilstar.instruments.campaign.results import lines_of, write_results

    summary = write_results(directory.table, this.maker.file, this.plan.seed)
    lines = lines_of(summary)
    if this.on_bench:
        from hilstar.instruments.campaign.bench_results import bench_lines, bench_summary

        summary |= bench_summary(directory.table)
        lines += bench_lines(summary)
    not_met = False
    if this.plan.require:
        from hilstar.instruments.campaign.requirements import NOT_MET
        from hilstar.instruments.campaign.requirements_page import (
            summary_of,
            verdict_of,
            write_requirements,
        )

        verdicts = write_requirements(this.plan, this.path, directory.table, this.maker.file)
        not_met = verdict_of(verdicts) == NOT_MET
        summary["requirements"] = [summary_of(requirement) for requirement in verdicts]
        lines += [requirement.words for requirement in verdicts]
    lines.append(f"{'page':20}{directory.table.with_name(PAGE_FILE)}")
    return _Results(summary, lines, not_met)


def check_through(
    command: str,
    setting: str,
    on_bench: bool,
    of_bench: dict[str, bool],
    of_tracker: dict[str, bool],
) -> None:
    """Refuse (InputError) options that mean nothing for a plan's `through`; `setting` is how the
    plan or the command writes it.
    """
    if on_bench:
        meaningless = of_tracker
        through = "tracker or display"
    else:
        meaningless = of_bench
        through = "bench"
    for name, given in meaningless.items():
        if given:
            raise InputError(f"{command} {name}: is for {setting} {through}; leave it out")


def show_cases(
    this: "Campaign",
    directory: "Directory",
    display: running.DisplayOptions,
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
            if not count:
                begun = done
            now_s = time.monotonic()
            count = min(done, this.cases)
            advance(count)
            if listener is not None and now_s - said_s >= LINE_S and count > begun:
                said_s = now_s
                left_s = (this.cases - count) * (now_s - started_s) / (count - begun)
                notices.tell("campaign", f"{count} of {this.cases} cases, {left_s:.0f} s left")

        @contextmanager
        def opened(file: "BenchFile") -> Iterator[OpenDisplay]:
            with (
                running.shown_bench(file, display, timed=True) as (bench, screen),
                running.optional_frames(display.feed, bench, screen) as feed,
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

        if not this.show(directory, opened, notices, on_done):
            say(
                f"hilstar: {count} of {this.cases} cases are done; the same command goes on from"
                " there"
            )
            raise KeyboardInterrupt


def _workers(
    this: "Campaign", scheduler: "Scheduler | None", workers: int, memory_bytes: int | None
) -> "Workers":
    """A cluster's workers, or this machine's cores."""
    from hilstar.instruments.campaign.pool import Pool

    if scheduler is None:
        return Pool(this.job, this.identity, workers, memory_bytes)
    from hilstar.instruments.campaign.cluster import Cluster

    return Cluster(scheduler, this.job, this.identity, say)


def run_cases(this: "Campaign", directory: "Directory", opened: "Workers") -> None:
    """Run the missing cases on workers, which a context manager opens and frees."""
    count = 0
    with telling(this.cases) as advance:

        def on_done(done: int) -> None:
            nonlocal count
            count = done
            advance(done)

        try:
            with opened as workers:
                this.run(directory, workers, on_done)
        except KeyboardInterrupt:
            say(
                f"hilstar: {count} of {this.cases} cases are done; the same command goes on from"
                " there"
            )
            raise


@contextmanager
def telling(
    cases: int, clock_s: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[int], None]]:
    """Progress with the time left: a bar on a terminal that can erase it, elsewhere a line every
    ten seconds.
    """
    if erases_lines():
        with progress("cases", cases) as advance:
            yield advance
        return
    first: tuple[int, float] | None = None
    last_s = clock_s()

    def line(done: int) -> None:
        nonlocal first, last_s
        now_s = clock_s()
        first = first or (done, now_s)
        if now_s - last_s >= LINE_S and done > first[0]:
            last_s = now_s
            a_second = (done - first[0]) / (now_s - first[1])
            say(
                f"hilstar: {done} of {cases} cases, {a_second:.3g} a second,"
                f" {(cases - done) / a_second:.0f} s left"
            )

    yield line
