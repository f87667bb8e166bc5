"""hilstar tracker: the virtual tracker as a process of its own, before a display that runs."""

import dataclasses
import math
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.process.interrupts import is_command, stop_on_signal
from hilstar.basics.units import NS_PER_S
from hilstar.cli.completion import offered
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import (
    bench_argument,
    check_files,
    json_option,
    parse_numbers,
    parse_share,
    seed_option,
)
from hilstar.server.console.terminal import print_json, say

if TYPE_CHECKING:
    import numpy as np

    from hilstar.instruments.simulate.answer_link import AnswerLink
    from hilstar.instruments.simulate.live_exposure import LiveTracker, Solve, WatchedFrames
    from hilstar.instruments.simulate.tracker_process import Planted
    from hilstar.server.answers.answer import Answer
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.gige.camera import GigECamera

SOLVER_S = 10.0  # for a command
NICE = 5  # behind a display on this machine, which has 0
MAX_RATE_HZ, USUAL_RATE_HZ = 1000.0, 10.0
# of planted errors: more than any tracker's, and arithmetic still holds them
MAX_ARCSEC, MAX_S, MAX_PPM = 1e5, 1e5, 1e4
SILENT = re.compile(r"(\d+(?:\.\d*)?)s?(?:@(\d+(?:\.\d*)?)s?)?")
PLANTED = "Errors to plant"  # a panel of the help
planted = partial(option, rich_help_panel=PLANTED)


@struct
class TrackerOptions:
    """The options of `hilstar tracker`."""

    bench_file: Path = bench_argument()
    watch: str = option("ENDPOINT", "Where serve or replay --feed sends its frames from.")
    answer: str | None = option(
        "TARGET",
        "Where answers go: tcp://HOST:PORT (ZeroMQ), udp://HOST:PORT or serial:/dev/ttyX@BAUD."
        " Needed without --camera.",
    )
    camera: str | None = option(
        "[ADDRESS]",
        "Be a GigE Vision camera at an address of this machine, 127.0.0.2 by default: its client"
        " gets the exposures.",
    )
    allow: list[str] | None = option(
        "ADDRESS", "Who may use the camera; this machine alone by default. May be repeated."
    )
    rate: float | None = option(
        "HZ", "Answers per second; by default 10, or one an exposure where that is less."
    )
    solver: str | None = option(
        "truth|tetra3|CMD",
        "Who finds the attitude when none is expected: tetra3 (the extra hilstar[solve], the"
        ' default where it is installed), a command such as "solve {image}",'
        " python:MODULE:FUNCTION, or the true one each time.",
        autocompletion=offered(("truth", "tetra3")),
    )
    form: str = option(
        "packet|json",
        "The format of the answers.",
        "--format",
        default="packet",
        autocompletion=offered(("packet", "json")),
    )
    connect: bool = switch("Connect the ZeroMQ answers instead of binding: [answers] bind = true.")
    bias: str = planted("X,Y,Z", "Arcsec about cam x, y and z.", default="0,0,0")
    fov_error: float = planted(
        "ARCSEC",
        "One sigma about x and y of waves of 400 px, and 4 times that about z.",
        default=0.0,
        min=0,
        max=MAX_ARCSEC,
    )
    pixel_error: float = planted(
        "ARCSEC", "The same, of waves of one pixel.", default=0.0, min=0, max=MAX_ARCSEC
    )
    wrong: str = planted("SHARE", "Of the answers that are any attitude, such as 1%.", default="0")
    silent: str | None = planted(
        "S[@T]", "Say nothing for S seconds, from T (5) after the first exposure."
    )
    babble: bool = switch("Send garbage between answers.", rich_help_panel=PLANTED)
    latency: float = planted(
        "SECONDS", "From mid-exposure to the answer, at least.", default=0.0, min=0, max=MAX_S
    )
    clock_drift: float = planted("PPM", "Of its own clock.", default=0.0, min=-MAX_PPM, max=MAX_PPM)
    clock_offset: float = planted(
        "SECONDS", "Of its own clock.", default=0.0, min=-MAX_S, max=MAX_S
    )
    seed: int = seed_option("Seed of noise and errors.")
    duration: float | None = option(
        "SECONDS", "Seconds from the first frame; by default until Ctrl-C.", min=0, max=1e8
    )
    record: Path | None = option(
        "FILE.csv", "Write its answers as telemetry, too, as assess reads it."
    )
    as_json: bool = json_option()


def tracker(options: TrackerOptions) -> None:
    """The bench's virtual tracker before the running display: it watches the frames, and answers
    in real time.
    """
    if is_command():
        stand_back()
    import numpy as np

    from hilstar.attitude.wire.shown_frames import FrameWatch
    from hilstar.instruments.simulate.answer_link import FORMATS
    from hilstar.instruments.simulate.live_exposure import LiveTracker
    from hilstar.instruments.simulate.tracker_process import TrackerProcess
    from hilstar.server.bench.bench_file import read_bench_file

    if options.form not in FORMATS:
        raise InputError(f"--format {options.form}: write {' or '.join(FORMATS)}")
    if options.answer is None and options.camera is None:
        raise InputError("nothing is to be given: write --answer TARGET, --camera, or both")
    file = read_bench_file(options.bench_file)
    check_files([], [options.record], file)
    errors = planted_errors(options)
    rate_hz = checked_rate(options.rate, file.config.tracker.exposure_s)
    stop = threading.Event()
    seeds = np.random.SeedSequence(options.seed).spawn(3)
    noise, chance, garbage = (np.random.default_rng(seed) for seed in seeds)
    babbler = garbage if options.babble else None
    seconds = math.inf if options.duration is None else options.duration
    with (
        FrameWatch(options.watch) as frames,
        LiveTracker(file, noise) as live,
        answer_link(options, babbler) as link,
        open_camera(options.camera, options.allow or [], file, rate_hz) as gige,
        recorded(options.record) as row,
        stop_on_signal(stop),
    ):
        outlets = []
        if link is not None:
            live.lost_in_space = solver_of(options.solver, live)
            outlets.append(f"answers {rate_hz:g} Hz, {options.form}, to {link.endpoint}")
        if gige is not None:
            outlets.append(f"a GigE Vision camera at {options.camera}")
        watching = f"{frames.verb.replace('a sender', 'frames')} {options.watch}"
        say("; ".join([watching, *outlets]))
        process = TrackerProcess(live, frames, errors, rate_hz, chance, gige)

        def send(answered: "Answer") -> None:
            if link is not None:
                link.send(answered)
            row(answered)

        process.run(None if link is None else send, stop, seconds)
        summary = process.tally.summary() | counts_of(live.frames, frames.refused, link, gige)
    tell(summary, options.as_json)


def planted_errors(options: TrackerOptions) -> "Planted":
    """The errors that the command line plants. Raises InputError."""
    from hilstar.instruments.simulate.tracker_process import Planted

    x_arcsec, y_arcsec, z_arcsec = parse_numbers(options.bias, 3, "--bias", "X,Y,Z in arcsec")
    if max(abs(x_arcsec), abs(y_arcsec), abs(z_arcsec)) > MAX_ARCSEC:
        raise InputError(f"--bias {options.bias}: write at most {MAX_ARCSEC:g} arcsec")
    silent_s, silent_from_s = parse_silent(options.silent)
    return Planted(
        (x_arcsec, y_arcsec, z_arcsec),
        options.fov_error,
        options.pixel_error,
        parse_share(options.wrong, "--wrong"),
        silent_s,
        silent_from_s,
        options.latency,
        options.clock_drift,
        options.clock_offset,
    )


def counts_of(
    frames: "WatchedFrames",
    refused: int,
    link: "AnswerLink | None",
    gige: "GigECamera | None",
) -> dict[str, Any]:
    """What came, what of it was refused, and what was sent, as `--json` has it."""
    counts: dict[str, Any] = {
        "frames": {
            "received": frames.received,
            "missing": frames.missing,
            "refused": refused,
        }
    }
    if link is not None:
        counts["link"] = {
            "endpoint": link.endpoint,
            "sent": link.sent,
            "babbled": link.babbled,
        }
    if gige is not None:
        sent = gige.counts
        heard = gige.channel.counts
        counts["camera"] = dataclasses.asdict(sent) | dataclasses.asdict(heard)
    return counts


@contextmanager
def answer_link(
    options: TrackerOptions, babbler: "np.random.Generator | None"
) -> Iterator["AnswerLink | None"]:
    """The link of answers, None without a target. Raises InputError."""
    from hilstar.instruments.simulate.answer_link import AnswerLink

    if options.answer is None:
        yield None
        return
    with AnswerLink(options.answer, options.form, options.connect, babbler) as link:
        yield link


@contextmanager
def open_camera(
    address: str | None, allow: list[str], file: "BenchFile", rate_hz: float
) -> Iterator["GigECamera | None"]:
    """The tracker as a camera at an address, None without one. Raises InputError."""
    if address is None:
        yield None
        return
    from hilstar import __version__
    from hilstar.attitude.wire.endpoint import AllowedSenders
    from hilstar.basics.notices import Notices
    from hilstar.server.gige.camera import GigECamera, camera_address
    from hilstar.server.gige.registers import CameraIdentity, CameraSettings

    place = camera_address(address)
    allowed = AllowedSenders(allow or file.config.attitude.allow)
    if not allowed and not place.is_loopback:
        raise InputError(
            f"--camera {address} is open to other machines, and nothing says which may use it;"
            " write --allow ADDRESS, such as --allow 192.168.1.20"
        )
    tracker = file.config.tracker
    width_px, height_px = tracker.resolution_px
    bits = tracker.detector.bits
    settings = CameraSettings(width_px, height_px, bits, tracker.exposure_s, rate_hz)
    identity = CameraIdentity(place, "virtual tracker", __version__, file.sha256[:15])
    with GigECamera(identity, settings, allowed, Notices()) as gige:
        yield gige


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
    cpu = told["cpu_ms"]
    latency = told["latency_ms"]
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
    """The solver of attitudes lost in space; None where the true attitude is taken. Raises
    InputError.
    """
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
        camera = live.camera
        stars = live.stars
        vectors = stars.directions(np.arange(len(stars.rates_e_per_s)))
        database = LostInSpace(
            vectors, stars.v_mag[: len(vectors)], camera.focal_length_px, camera.resolution_px
        )

        def solve(stars: Any, dn: Any) -> Any:
            on_plane = stars.rays[:, :2] / stars.rays[:, 2:]
            return database.solve(on_plane, stars.flux_e)

        return solve
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
    nowhere = View(np.array([1.0, 0.0, 0.0, 0.0]))
    no_light = np.zeros((0, 0))
    no_stars = np.zeros(0, dtype=EXPOSURE_DTYPE)
    faults = set[str]()

    def solve(stars: Any, dn: Any) -> Any:
        exposure = Exposure(nowhere, dn, no_light, no_stars)  # an image without its truth
        try:
            return solver.solve(exposure, live).q_icrs_to_cam
        except SolverFault as fault:
            # a solver fails at ten images a second, for one reason
            if str(fault) not in faults:
                say(f"hilstar: {fault}")
                faults.add(str(fault))
            return None

    return solve


@contextmanager
def recorded(path: Path | None) -> Iterator[Any]:
    """A function that writes an answer as a row of telemetry; it does nothing without a file."""
    if path is None:
        yield lambda answer: None
        return
    with path.open("w", encoding="ascii") as file:
        file.write("t_s,qw,qx,qy,qz,valid\n")

        def row(answer: "Answer") -> None:
            t_s = (answer.t_ns or 0) / NS_PER_S
            q = answer.q_icrs_to_cam
            if q is None:
                file.write(f"{t_s:.9f},,,,,0\n")
            else:
                numbers = ",".join(repr(float(value)) for value in q)
                file.write(f"{t_s:.9f},{numbers},1\n")

        yield row
