"""hilstar tracker: the virtual tracker as a process of its own, before a display that runs."""

import dataclasses
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
from hilstar.cli.completion import offered
from hilstar.server.console.terminal import print_json, say

if TYPE_CHECKING:
    import numpy as np

    from hilstar.attitude.wire.shown_frames import FrameWatch
    from hilstar.instruments.simulate.answer_link import AnswerLink
    from hilstar.instruments.simulate.live_exposure import LiveTracker, Solve
    from hilstar.server.answers.answer import Answer
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.gige.camera import GigECamera

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
        Option(metavar="ENDPOINT", help="Where serve or replay --feed sends its frames from."),
    ],
    answer: Annotated[
        str | None,
        Option(
            metavar="TARGET",
            help=(
                "Where answers go: tcp://HOST:PORT (ZeroMQ), udp://HOST:PORT or"
                " serial:/dev/ttyX@BAUD. Needed without --camera."
            ),
        ),
    ] = None,
    camera: Annotated[
        str | None,
        Option(
            metavar="[ADDRESS]",
            help=(
                "Be a GigE Vision camera at an address of this machine, 127.0.0.2 by default: its"
                " client gets the exposures."
            ),
        ),
    ] = None,
    allow: Annotated[
        list[str] | None,
        Option(
            metavar="ADDRESS",
            help="Who may use the camera; this machine alone by default. May be repeated.",
        ),
    ] = None,
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
            autocompletion=offered(("truth", "tetra3")),
            help=(
                "Who finds the attitude when none is expected: tetra3 (the extra hilstar[solve],"
                " the default where it is"
                ' installed), a command such as "solve {image}", python:MODULE:FUNCTION, or the'
                " true one each time."
            ),
        ),
    ] = None,
    form: Annotated[
        str,
        Option(
            "--format",
            metavar="packet|json",
            help="The format of the answers.",
            autocompletion=offered(("packet", "json")),
        ),
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
        planted(
            metavar="SECONDS", help="From mid-exposure to the answer, at least.", min=0, max=MAX_S
        ),
    ] = 0.0,
    clock_drift: Annotated[
        float, planted(metavar="PPM", help="Of its own clock.", min=-MAX_PPM, max=MAX_PPM)
    ] = 0.0,
    clock_offset: Annotated[
        float, planted(metavar="SECONDS", help="Of its own clock.", min=-MAX_S, max=MAX_S)
    ] = 0.0,
    seed: Annotated[int, options.seed_option("Seed of noise and errors.")] = 0,
    duration: Annotated[
        float | None,
        Option(
            metavar="SECONDS",
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
    from hilstar.instruments.simulate.answer_link import FORMATS
    from hilstar.instruments.simulate.live_exposure import LiveTracker
    from hilstar.instruments.simulate.tracker_process import Planted, TrackerProcess
    from hilstar.server.bench.bench_file import read_bench_file

    if form not in FORMATS:
        raise InputError(f"--format {form}: write {' or '.join(FORMATS)}")
    if answer is None and camera is None:
        raise InputError("nothing is to be given: write --answer TARGET, --camera, or both")
    file = read_bench_file(bench_file)
    options.check_files([], [record], file)
    bias_arcsec = options.parse_numbers(bias, 3, "--bias", "X,Y,Z in arcsec")
    if max(map(abs, bias_arcsec)) > MAX_ARCSEC:
        raise InputError(f"--bias {bias}: write at most {MAX_ARCSEC:g} arcsec")
    repeating = (fov_error, pixel_error)
    silence = parse_silent(silent)
    share = options.parse_share(wrong, "--wrong")
    errors = Planted(
        tuple(bias_arcsec), *repeating, share, *silence, latency, clock_drift, clock_offset
    )
    rate_hz = checked_rate(rate, file.config.tracker.exposure_s)
    stop = threading.Event()
    noise, chance, garbage = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(3))
    with (
        FrameWatch(watch) as frames,
        LiveTracker(file, noise) as live,
        answer_link(answer, form, connect, garbage if babble else None) as link,
        open_camera(camera, allow or [], file, rate_hz) as gige,
        recorded(record) as row,
        stop_on_signal(stop),
    ):
        outlets = []
        if link is not None:
            live.lost_in_space = solver_of(solver, live)
            outlets.append(f"answers {rate_hz:g} Hz, {form}, to {link.endpoint}")
        if gige is not None:
            outlets.append(f"a GigE Vision camera at {camera}")
        watching = f"{frames.verb.replace('a sender', 'frames')} {watch}"
        say("; ".join([watching, *outlets]))
        process = TrackerProcess(live, frames, errors, rate_hz, chance, gige)

        def send(answered: "Answer") -> None:
            if link is not None:
                link.send(answered)
            row(answered)

        seconds = float("inf") if duration is None else duration
        process.run(None if link is None else send, stop, seconds)
        summary = process.tally.summary() | counts_of(live, frames, link, gige)
    tell(summary, as_json)


def counts_of(
    live: "LiveTracker",
    frames: "FrameWatch",
    link: "AnswerLink | None",
    gige: "GigECamera | None",
) -> dict[str, Any]:
    """What came and what was sent, as `--json` has it."""
    counts: dict[str, Any] = {
        "frames": {
            "received": live.frames.received,
            "missing": live.frames.missing,
            "refused": frames.refused,
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
    target: str | None, form: str, connect: bool, babbler: "np.random.Generator | None"
) -> Iterator["AnswerLink | None"]:
    """The link of answers, None without a target. Raises InputError."""
    from hilstar.instruments.simulate.answer_link import AnswerLink

    if target is None:
        yield None
        return
    with AnswerLink(target, form, connect, babbler) as link:
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
        camera = live.camera
        stars = live.stars
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
    nowhere = View(np.array([1.0, 0.0, 0.0, 0.0]))
    told_kinds = set[str]()

    def solve(found: Any, dn: Any) -> Any:
        try:
            return solver.solve(
                Exposure(nowhere, dn, np.zeros((0, 0)), np.zeros(0, dtype=EXPOSURE_DTYPE)), live
            ).q_icrs_to_cam
        except SolverFault as fault:
            if str(fault) not in told_kinds:
                say(f"hilstar: {fault}")
                told_kinds.add(str(fault))
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
            if q is None:
                numbers = ",,,"
            else:
                numbers = ",".join(repr(float(value)) for value in q)
            file.write(f"{(said.t_ns or 0) / 1e9:.9f},{numbers},{int(q is not None)}\n")

        yield row
