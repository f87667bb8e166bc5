"""The `hilstar` command: words in, calls to the bench, words out. No physics, no GL."""

from __future__ import annotations

import logging
import math
import os
import sys
import threading
import time
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
import typer

from hilstar.console import fail, print_json, progress, report, say
from hilstar.errors import HilstarError, InputError

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Stars for a star tracker on a bench: attitudes in, frames of code values out.",
)

BenchFile = Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The bench file; see configs/README.md.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else there.")]
Headless = Annotated[bool, typer.Option("--headless", help="Draw without a window.")]
RadecText = Annotated[str | None, typer.Option("--radec", metavar="RA,DEC,ROLL", help="Boresight and roll in degrees, ICRS.")]
QuaternionText = Annotated[str | None, typer.Option("--quaternion", metavar="W,X,Y,Z", help="q_icrs_to_cam, scalar first.")]
INTERRUPTED = 130
LISTEN_SLICE_S = 0.1  # between looks at whether a signal has come


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Where the pictures go.")] = Path("hilstar-demo"),
    duration: Annotated[float, typer.Option(help="Seconds to serve.", min=0.5, max=600)] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of the slew's jitter.", min=0)] = 1,
    as_json: Json = False,
) -> None:
    """The main job in one command: real stars, an attitude streamed over a real ZeroMQ socket, frames out."""
    from hilstar.bench.demo import run_demo

    with progress("serving", duration * 60) as advance:
        result = run_demo(output, duration, np.random.default_rng(seed), lambda shown: advance(shown.number + 1))
    report(result.summary, as_json)
    if not as_json:
        typer.echo(f"{'pictures':20}{output}/frame_*_codes.png (what the monitor gets), _preview.png (stretched)")


@app.command()
def frame(
    bench_file: BenchFile,
    radec: RadecText = None,
    quaternion: QuaternionText = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.fits", help="Linear image.")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="OUT.csv", help="A row for each star in view.")] = None,
    codes: Annotated[Path | None, typer.Option(metavar="OUT.png", help="The code values.")] = None,
    preview: Annotated[Path | None, typer.Option(metavar="OUT.png", help="A stretched picture for a person.")] = None,
    as_json: Json = False,
) -> None:
    """Draw one frame into files."""
    from hilstar.bench import output as files
    from hilstar.bench.assembly import load

    q = attitude_of("frame", radec, quaternion)
    targets = [path for path in (output, truth, codes, preview) if path is not None]
    if not targets:
        raise InputError("frame: nothing to write; add -o OUT.fits, --truth OUT.csv or --codes OUT.png")
    with load(bench_file) as bench:
        shot = bench.frame(q)
        if output is not None:
            files.write_frame_fits(output, bench, shot)
        if truth is not None:
            files.write_truth_csv(truth, shot)
        if codes is not None:
            files.write_codes_png(codes, shot.codes, bench.config.monitor.bits)
        if preview is not None:
            files.write_preview_png(preview, shot.codes)
        clipped = shot.truth["hip"][shot.truth["clipped"]].tolist()
        summary = {
            "stars": len(shot.truth),
            "electrons_per_s": float(shot.linear.sum(dtype=np.float64)),
            "flux_at_white_e_per_s": bench.flux_at_white_e_per_s,
            "clipped": clipped,
            "written": [str(path) for path in targets],
            "gl_renderer": bench.renderer.gl_renderer,
        }
    if as_json:
        print_json(summary)
    else:
        names = f", clipped: HIP {', '.join(map(str, clipped))}" if clipped else ""
        typer.echo(f"{len(shot.truth)} stars{names}; wrote {', '.join(summary['written'])}")


@app.command()
def serve(
    bench_file: BenchFile,
    headless: Headless = False,
    duration: Annotated[float | None, typer.Option(help="Seconds to run; until Ctrl-C by default.", min=0, max=1e8)] = None,
    frames: Annotated[int | None, typer.Option(help="Frames to draw.", min=1)] = None,
    as_json: Json = False,
) -> None:
    """Show the live attitude stream."""
    from hilstar.bench.assembly import load
    from hilstar.bench.server import Limit, open_link
    from hilstar.bench.server import serve as serve_stream

    need_headless("serve", headless)
    with load(bench_file) as bench, open_link(bench.config.attitude) as link:
        refresh_hz = bench.config.monitor.refresh_hz
        slots = math.inf if duration is None else round(duration * refresh_hz)
        limit = Limit(slots, math.inf if frames is None else frames)
        verb = "bound to" if bench.config.attitude.bind else "connected to"
        say(f"{verb} {link.endpoint}, {refresh_hz:g} Hz, {bench.renderer.gl_renderer}")
        with progress("serving", min(limit.slots, limit.frames)) as advance:
            summary = serve_stream(bench, link, limit, lambda shown: advance(shown.number + 1))
    report(summary, as_json)


@app.command()
def replay(
    bench_file: BenchFile,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="CSV (t_s,qw,qx,qy,qz) or JSON lines.")],
    speed: Annotated[Literal["realtime", "max"], typer.Option(help="As on a monitor, or every frame at once.")] = "realtime",
    headless: Headless = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write each frame there.")] = None,
    as_json: Json = False,
) -> None:
    """Show an attitude log."""
    from hilstar.attitude.logs import read_log
    from hilstar.bench.assembly import load
    from hilstar.bench.recorder import FrameRecorder
    from hilstar.bench.server import replay as replay_log
    from hilstar.bench.server import replay_frame_count

    need_headless("replay", headless)
    samples = read_log(log)
    with (
        load(bench_file) as bench,
        FrameRecorder(output, bench) as record,
        progress("replaying", replay_frame_count(bench, samples)) as advance,
    ):

        def sink(shown: Any) -> None:
            record(shown)
            advance(shown.number + 1)

        summary = replay_log(bench, samples, speed == "realtime", sink)
    report(summary, as_json)


@app.command()
def send(
    log: Annotated[Path | None, typer.Argument(metavar="[LOG]", help="CSV (t_s,qw,qx,qy,qz) or JSON lines.")] = None,
    spin: Annotated[str | None, typer.Option(metavar="AXIS,DEG_PER_S", help="A constant turn instead of a log.")] = None,
    to: Annotated[str, typer.Option(metavar="tcp://HOST:PORT", help="Where to send.")] = "tcp://127.0.0.1:5560",
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Packets a second; a log's own by default.")] = None,
    connect: Annotated[bool, typer.Option("--connect", help="Connect (for bind = true in the bench) instead of bind.")] = False,
    radec: RadecText = None,
    count: Annotated[int | None, typer.Option(help="Stop after so many packets.", min=1)] = None,
    wait: Annotated[float, typer.Option(help="Seconds to wait for a listener.", min=0, max=1e6)] = 30.0,
) -> None:
    """Send a log or a spin: the test instrument."""
    from itertools import islice

    from hilstar.attitude.links import ZmqSender
    from hilstar.attitude.logs import read_log
    from hilstar.bench.sender import log_samples, parse_radec, parse_spin, parse_target, spin_samples
    from hilstar.bench.sender import send as send_samples
    from hilstar.bench.server import stop_on_signal

    if (log is None) == (spin is None):
        raise InputError("send: give a LOG or --spin AXIS,DEG_PER_S, one of them")
    if rate is not None and not 1e-3 <= rate <= 10_000:
        raise InputError(f"--rate {rate:g}: write packets a second, 0.001 to 10000")
    if spin is not None:
        samples = spin_samples(parse_spin(spin), rate or 100.0, parse_radec(radec or "84.057,-1.2,0"))
        total = math.inf
    else:
        recorded = read_log(log or Path())
        samples, total = log_samples(recorded, rate), len(recorded) if rate is None else math.inf
    stop = threading.Event()
    with ZmqSender(parse_target(to), bind=not connect) as sender, stop_on_signal(stop):
        say(f"waiting for a listener on {sender.endpoint}")
        if not heard(sender, wait, stop):
            say("nobody listens yet; sending all the same")
        with progress("sending", min(total, count or math.inf)) as advance:
            sent = send_samples(sender, islice(samples, count), stop, advance)
    say(f"{sent} packets sent")


@app.command()
def simulate(
    bench_file: BenchFile,
    radec: RadecText = None,
    quaternion: QuaternionText = None,
    rate: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="The camera turns: deg/s about its axes.")] = None,
    log: Annotated[Path | None, typer.Option(metavar="LOG", help="Frames along a log, into the directory -o.")] = None,
    frames: Annotated[int | None, typer.Option(help="With --log: so many, evenly; each sample by default.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Of the frame's noise.", min=0)] = 0,
    noise: Annotated[Literal["full", "none"], typer.Option(help="All of the detector's noise, or none.")] = "full",
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.fits", help="DN, uint16.")] = None,
    png: Annotated[Path | None, typer.Option(metavar="OUT.png", help="A stretched picture for a person.")] = None,
    as_json: Json = False,
) -> None:
    """The virtual tracker's image of the sky, with noise."""
    from hilstar.bench import output as files
    from hilstar.bench.sender import parse_rate
    from hilstar.bench.simulation import Simulator

    if log is not None:
        if output is None or radec or quaternion or rate or png:
            raise InputError("simulate --log LOG: give -o DIR, and no --radec, --quaternion, --rate or --png")
        simulate_log(bench_file, log, frames, (noise, seed), output)
        return
    if output is None and png is None:
        raise InputError("simulate: nothing to write; add -o OUT.fits or --png OUT.png")
    q = attitude_of("simulate", radec, quaternion)
    rate_rad_s = parse_rate(rate) if rate else np.zeros(3)
    with Simulator(bench_file) as simulator:
        rng = None if noise == "none" else np.random.default_rng(seed)
        exposure = simulator.expose(simulator.motion(q, rate_rad_s), rng)
        if output is not None:
            files.write_exposure_fits(output, simulator, exposure, noise, seed)
        if png is not None:
            files.write_exposure_png(png, exposure.dn)
        summary = {
            "stars": len(exposure.truth),
            "clipped": exposure.truth["hip"][exposure.truth["clipped"]].tolist(),
            "dn": {"min": int(exposure.dn.min()), "mean": float(exposure.dn.mean()), "max": int(exposure.dn.max())},
            "written": [str(path) for path in (output, png) if path is not None],
            "gl_renderer": simulator.renderer.gl_renderer,
        }
    if as_json:
        print_json(summary)
    else:
        dn = summary["dn"]
        typer.echo(f"{summary['stars']} stars, DN {dn['min']} to {dn['max']}; wrote {', '.join(summary['written'])}")


def simulate_log(
    bench_file: Path, log: Path, frames: int | None, noise_and_seed: tuple[Literal["full", "none"], int], output: Path
) -> None:
    """The virtual tracker along a log."""
    from hilstar.attitude.logs import read_log
    from hilstar.bench.batch import log_motions, simulate_motions
    from hilstar.bench.config import read_config

    motions = log_motions(read_log(log), frames, read_config(bench_file).tracker.exposure_s)
    with progress("exposing", len(motions)) as advance:
        simulate_motions(bench_file, motions, *noise_and_seed, output, advance)
    typer.echo(f"{len(motions)} exposures in {output}")


@app.command()
def study(
    what: Annotated[Literal["models", "outputs", "stability"], typer.Argument(help="Which charts.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where they go.")],
    as_json: Json = False,
) -> None:
    """Charts and tables: brightness models, the thesis's outputs, and where methods fail."""
    from hilstar.bench.output import make_directory

    make_directory(output)
    with progress(f"study {what}", math.inf):
        lines, right = study_lines(what, output)
    if as_json:
        print_json({"study": what, "right": right, "findings": lines, "directory": str(output)})
    else:
        typer.echo("\n".join([*lines, f"figures and tables in {output}"]))


def study_lines(what: str, output: Path) -> tuple[list[str], bool]:
    """Run a study; what it found, and whether everything was right."""
    if what == "models":
        from hilstar.study.models import run as run_models

        return [f"{finding.figure}: {finding.text}" for finding in run_models(output)], True
    if what == "outputs":
        from hilstar.study.outputs import run as run_outputs

        return run_outputs(output), True
    from hilstar.study.stability import run as run_stability

    places = run_stability(output)
    lines = [f"{'right' if p.right else 'WRONG'}  {p.case}: {p.happens} ({p.why})" for p in places]
    return lines, all(place.right for place in places)


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say what GL, displays, links and files are there, and what is missing."""
    from hilstar.bench.doctor import examine

    result = examine()
    if as_json:
        print_json(result)
    else:
        for check in result["checks"]:
            mark = "ok" if check["ok"] else "MISSING" if check["required"] else "none"
            typer.echo(f"{mark:8}{check['name']:12}{check['detail']}")
    if not result["ok"]:
        raise typer.Exit(3)


def heard(sender: Any, wait_s: float, stop: threading.Event) -> bool:
    """True once somebody listens; also when stopped, which then ends the sending at once."""
    deadline_s = time.monotonic() + wait_s
    while not stop.is_set():
        if sender.wait_for_listener(min(LISTEN_SLICE_S, max(0.0, deadline_s - time.monotonic()))):
            return True
        if time.monotonic() >= deadline_s:
            return False
    return True


def attitude_of(command: str, radec: str | None, quaternion: str | None) -> Any:
    """The one attitude that the command line gives."""
    from hilstar.attitude.quaternion import from_radec_roll_deg
    from hilstar.bench.assembly import checked_quaternion
    from hilstar.bench.sender import parse_numbers, parse_radec

    if (radec is None) == (quaternion is None):
        raise InputError(f"{command}: give the attitude with --radec RA,DEC,ROLL or --quaternion W,X,Y,Z, one of them")
    if radec is not None:
        return from_radec_roll_deg(*parse_radec(radec))
    return checked_quaternion(parse_numbers(quaternion or "", 4, "--quaternion", "W,X,Y,Z"))


def need_headless(command: str, headless: bool) -> None:
    """There is no window in this version."""
    if not headless:
        raise InputError(f"{command}: there is no window in this version; add --headless")


def main() -> NoReturn:
    """Run the command line; every refusal is one line on stderr and the exit code of the design's section 5."""
    logging.basicConfig(format="hilstar: %(message)s", stream=sys.stderr)
    try:
        code = app(standalone_mode=False) or 0
        if code == INTERRUPTED:  # typer turns Ctrl-C into this code, and says nothing
            fail("stopped", INTERRUPTED)
        sys.exit(code)
    except HilstarError as error:
        fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        fail("stopped", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has gone: nothing is left to say, and Python must not try at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        # typer's usage errors have no public base class in all its versions; they can format themselves.
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        fail(f"{message()} (see hilstar --help)", InputError.exit_code)


if __name__ == "__main__":
    main()
