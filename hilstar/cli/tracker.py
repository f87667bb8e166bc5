"""hilstar tracker: the virtual tracker as a process of its own, before a display that runs."""

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.process.interrupts import is_command, stop_on_signal
from hilstar.cli import options
from hilstar.server.console.terminal import print_json, say

if TYPE_CHECKING:
    from hilstar.instruments.simulate.live_exposure import LiveTracker, Solve
    from hilstar.server.answers.answer import Answer

SOLVER_S = 10.0  # for a command
NICE = 5
MAX_RATE_HZ, USUAL_RATE_HZ = 1000.0, 10.0
MAX_ARCSEC, MAX_S, MAX_PPM = 1e5, 1e5, 1e4
SILENT = re.compile(r"(\d+(?:\.\d*)?)s?(?:@(\d+(?:\.\d*)?)s?)?")
planted = partial(Option, rich_help_panel="Errors to plant")


def tracker(
    bench_file: options.BenchFile,
    watch: Annotated[
        str,
        Option(metavar="ENDPOINT", help="Where serve or replay --frames sends its frames from."),
    ],
    answer: Annotated[
        str,
        Option(
            metavar="TARGET",
            help="tcp://HOST:PORT (ZeroMQ), udp://HOST:PORT or serial:/dev/ttyX@BAUD.",
        ),
    ],
    rate: Annotated[
        float | None,
        Option(
            metavar="HZ",
            help="Answers per second; by default 10, or one an exposure where that is less.",
        ),
    ] = None,
    solver: Annotated[
        str | None,
        Option(
            metavar="truth|tetra3|CMD",
            help=(
                "Who finds the attitude when none is expected: tetra3 (the extra hilstar[solve],"
                " the default where it is"
                ' installed), a command such as "solve {image}", python:MODULE:FUNCTION, or the'
                " true one each time."
            ),
        ),
    ] = None,
    form: Annotated[
        str, Option("--format", metavar="packet|json", help="The format of the answers.")
    ] = "packet",
    connect: Annotated[
        bool,
        Option(
            "--connect",
            help="Connect the ZeroMQ answers instead of binding: [answers] bind = true.",
        ),
    ] = False,
    bias: Annotated[str, planted(metavar="X,Y,Z", help="Arcsec about cam x, y and z.")] = "0,0,0",
    fov_error: Annotated[
        float,
        planted(
            metavar="ARCSEC",
            min=0,
            max=MAX_ARCSEC,
            help="One sigma about x and y of waves of 400 px, and 4 times that about z.",
        ),
    ] = 0.0,
    pixel_error: Annotated[
        float,
        planted(metavar="ARCSEC", min=0, max=MAX_ARCSEC, help="The same, of waves of one pixel."),
    ] = 0.0,
    wrong: Annotated[
        str, planted(metavar="SHARE", help="Of the answers that are any attitude, such as 1%.")
    ] = "0",
    silent: Annotated[
        str | None,
        planted(
            metavar="S[@T]", help="Say nothing for S seconds, from T (5) after the first exposure."
        ),
    ] = None,
    babble: Annotated[bool, planted("--babble", help="Send garbage between answers.")] = False,
    latency: Annotated[
        float,
        planted(metavar="S", help="From mid-exposure to the answer, at least.", min=0, max=MAX_S),
    ] = 0.0,
    clock_drift: Annotated[
        float, planted(metavar="PPM", help="Of its own clock.", min=-MAX_PPM, max=MAX_PPM)
    ] = 0.0,
    clock_offset: Annotated[
        float, planted(metavar="S", help="Of its own clock.", min=-MAX_S, max=MAX_S)
    ] = 0.0,
    seed: Annotated[int, Option(help="Seed of noise and errors.", min=0, max=options.MAX_SEED)] = 0,
    duration: Annotated[
        float | None,
        Option(
            metavar="S",
            help="Seconds from the first frame; by default until Ctrl-C.",
            min=0,
            max=1e8,
        ),
    ] = None,
    record: Annotated[
        Path | None,
        Option(metavar="FILE.csv", help="Write its answers as telemetry, too, as assess reads it."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """The bench's virtual tracker before the running display: it watches the frames, and answers
    in real time.
    """
    if is_command():
        stand_back()
    import numpy as np

    from hilstar.attitude.wire.shown_frames import FrameWatch
    from hilstar.instruments.simulate.answer_link import FORMATS, AnswerLink
    from hilstar.instruments.simulate.live_exposure import LiveTracker
    from hilstar.instruments.simulate.tracker_process import Planted, TrackerProcess
    from hilstar.server.bench.bench_file import read_bench_file

    if form not in FORMATS:
        raise InputError(f"--format {form}: write {' or '.join(FORMATS)}")
    file = read_bench_file(bench_file)
    options.check_files([], [record], file)
    bias_arcsec = options.parse_numbers(bias, 3, "--bias", "X,Y,Z in arcsec")
    if max(map(abs, bias_arcsec)) > MAX_ARCSEC:
        raise InputError(f"--bias {bias}: write at most {MAX_ARCSEC:g} arcsec")
    repeating, silence = (fov_error, pixel_error), parse_silent(silent)
    share = options.parse_share(wrong, "--wrong")
    errors = Planted(
        tuple(bias_arcsec), *repeating, share, *silence, latency, clock_drift, clock_offset
    )
    rate_hz, stop = checked_rate(rate, file.config.tracker.exposure_s), threading.Event()
    noise, chance, garbage = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(3))
    with (
        FrameWatch(watch) as frames,
        LiveTracker(file, noise) as live,
        AnswerLink(answer, form, connect, garbage if babble else None) as link,
        recorded(record) as row,
        stop_on_signal(stop),
    ):
        live.lost_in_space = solver_of(solver, live)
        say(
            f"{frames.verb.replace('a sender', 'frames')} {watch}; answers {rate_hz:g} Hz, {form},"
            f" to {link.endpoint}"
        )
        process = TrackerProcess(live, frames, errors, rate_hz, chance)

        def send(said: "Answer") -> None:
            link.send(said)
            row(said)

        process.run(send, stop, float("inf") if duration is None else duration)
        told = process.tally.summary() | {
            "frames": {
                "received": live.frames.received,
                "missing": live.frames.missing,
                "refused": frames.refused,
            },
            "link": {"endpoint": link.endpoint, "sent": link.sent, "babbled": link.babbled},
        }
    tell(told, as_json)


def stand_back() -> None:
    """Take one core, and that after a display on this machine: the process stands for another
    machine.
    """
    for name in ("OMP_NUM_THREADS", "LP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with suppress(OSError):
        os.nice(NICE)


def tell(told: dict[str, Any], as_json: bool) -> None:
    """Print what was answered."""
    if as_json:
        print_json(told)
        return
    cpu, latency = told["cpu_ms"], told["latency_ms"]
    modes = ", ".join(f"{count} {mode}" for mode, count in told["modes"].items()) or "none"
    typer.echo(
        f"{'answers':20}{told['answers']}, {told['valid']} valid ({modes}), {told['passed_over']}"
        " exposures passed over"
    )
    typer.echo(
        f"{'frames':20}{told['frames']['received']} received, {told['frames']['missing']} missing"
    )
    if cpu.p50 is not None:
        typer.echo(
            f"{'an answer':20}{cpu.p50:.0f} ms of one core, {latency.p50:.0f} ms after mid-exposure"
            " (median)"
        )
    if told["own_bias_arcsec"] is not None:
        for name in ("bias", "sigma"):
            figures = ", ".join(f"{value:.2f}" for value in told[f"own_{name}_arcsec"])
            typer.echo(f"{'own ' + name:20}{figures} arcsec about x, y, z")


def parse_silent(text: str | None) -> tuple[float, float]:
    """Length and beginning, s, of --silent. Raises InputError."""
    from hilstar.instruments.simulate.tracker_process import SILENT_AFTER_S

    if text is None:
        return 0.0, SILENT_AFTER_S
    match = SILENT.fullmatch(text)
    if match is None:
        raise InputError(
            f"--silent {text}: write seconds, and when they begin where that is not 5 s, such as 5s"
            " or 5s@20s"
        )
    return float(match[1]), SILENT_AFTER_S if match[2] is None else float(match[2])


def checked_rate(rate_hz: float | None, exposure_s: float) -> float:
    """The rate of answers. Raises InputError where exposures would overlap, or collect nothing."""
    if not exposure_s:
        raise InputError(
            "[tracker] exposure_s = 0: the tracker collects no light; write a longer exposure"
        )
    fastest_hz = min(1 / exposure_s, MAX_RATE_HZ)
    if rate_hz is None:
        return min(USUAL_RATE_HZ, fastest_hz)
    if not 0.01 <= rate_hz <= fastest_hz * (1 + 1e-9):
        raise InputError(
            f"--rate {rate_hz:g}: write 0.01 to {fastest_hz:g} Hz; an exposure takes {exposure_s:g}"
            " s ([tracker] exposure_s)"
        )
    return rate_hz


def solver_of(text: str | None, live: "LiveTracker") -> "Solve | None":
    """Who finds attitudes lost in space; None: the true one is taken. Raises InputError."""
    import numpy as np

    from hilstar.tracker.identify import LostInSpace

    if text == "truth":
        return None
    if text is None:
        from importlib.util import find_spec

        if find_spec("tetra3rs") is None:
            say(
                "the extra hilstar[solve] is not installed: stars are identified by the true"
                " attitude, as by --solver truth"
            )
            return None
    if text in {None, "tetra3"}:
        camera, stars = live.camera, live.stars
        vectors = stars.directions(np.arange(len(stars.rates_e_per_s)))
        database = LostInSpace(
            vectors, stars.v_mag[: len(vectors)], camera.focal_length_px, camera.resolution_px
        )
        return lambda found, dn: database.solve(found.rays[:, :2] / found.rays[:, 2:], found.flux_e)
    return by_image(text or "", live)


def by_image(text: str, live: "LiveTracker") -> "Solve":
    """A campaign's solver of images: a command, or a function. Raises InputError."""
    import numpy as np

    from hilstar.instruments.campaign.plan import Centroiding
    from hilstar.instruments.campaign.solvers import CENTROIDS, SolverFault, choose_solver
    from hilstar.instruments.simulate.simulator import EXPOSURE_DTYPE, Exposure
    from hilstar.optics.layers.view import View

    if text == CENTROIDS:
        raise InputError(
            "--solver centroids: is a campaign's; write truth, which identifies its stars by the"
            " true attitude"
        )
    solver = choose_solver(text, Centroiding(), live.file.folder, SOLVER_S)
    nowhere, told = View(np.array([1.0, 0.0, 0.0, 0.0])), set[str]()

    def solve(found: Any, dn: Any) -> Any:
        try:
            return solver.solve(
                Exposure(nowhere, dn, np.zeros((0, 0)), np.zeros(0, dtype=EXPOSURE_DTYPE)), live
            ).q_icrs_to_cam
        except SolverFault as fault:
            if str(fault) not in told:
                say(f"hilstar: {fault}")
                told.add(str(fault))
            return None

    return solve


@contextmanager
def recorded(path: Path | None) -> Iterator[Any]:
    """A function that writes an answer as a row of telemetry; it does nothing without a file."""
    if path is None:
        yield lambda said: None
        return
    with path.open("w", encoding="ascii") as file:
        file.write("t_s,qw,qx,qy,qz,valid\n")

        def row(said: "Answer") -> None:
            q = said.q_icrs_to_cam
            numbers = ",,," if q is None else ",".join(repr(float(value)) for value in q)
            file.write(f"{(said.t_ns or 0) / 1e9:.9f},{numbers},{int(q is not None)}\n")

        yield row
