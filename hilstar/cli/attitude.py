"""hilstar attitude: where a log or a live stream points, in terms that a person can check."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.resources import resource_path
from hilstar.cli import options
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.attitude.logs.entries import Stated
    from hilstar.attitude.wire.packet import AttitudeSample
    from hilstar.attitude.wire.source import Conventions
    from hilstar.server.bench.bench_file import BenchFile

SHOWN_STARS = 3


@options.log_statements
def attitude(
    source: Annotated[
        Path,
        Argument(
            metavar="INPUT",
            help=f"{options.LOG_HELP} Or a bench file (.toml): its live stream is awaited.",
        ),
    ],
    time: Annotated[
        str | None,
        Option(
            "--time",
            metavar="T",
            help=(
                "Seconds after the log's first sample, or a date and time as the log has them; by"
                " default its first sample."
            ),
        ),
    ] = None,
    bench: Annotated[
        Path | None,
        Option(
            metavar="BENCH.toml",
            help="Whose tracker, mounting and sky to use; by default the demo's tracker.",
        ),
    ] = None,
    wait: Annotated[
        float,
        Option(metavar="SECONDS", help="How long to wait for a live stream.", min=0.1, max=1e6),
    ] = 10.0,
    statements: options.LogStatements = options.NOTHING_STATED,
    explain: Annotated[
        bool,
        Option(
            "--explain",
            help="Explain what the source's numbers mean: frames, scalar order, time scale.",
        ),
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Say where a log or a live stream points: quaternion, RA, Dec, roll, and the brightest
    stars in view.
    """
    from hilstar.server.bench.bench_file import dated, read_bench_file

    live = source.suffix.lower() == ".toml"
    first = read_bench_file(source if live else bench or resource_path("configs", "demo.toml"))
    if live and bench is not None:
        file = read_bench_file(bench)
    else:
        file = first
    if live:
        written = "write it into"
        if statements.mounting is not None:
            raise InputError(
                f"--mounting {statements.mounting}: {written} {source} as [tracker] q_body_to_cam"
            )
        if statements.convention is not None:
            raise InputError(
                f"--convention {statements.convention}: {written} {source} as [attitude] convention"
            )
        statements.refuse(f"it is for a log, and {source} names a live stream; leave it out")
    stated = statements.stated(first.config)
    if live:
        sample, conventions, held = _live(first, time, wait)
        for _, line in conventions.mounting_notices(stated.mounting):
            say(line)
    else:
        sample, conventions, held = _of_log(source, time, stated)
    file = dated(file, conventions.scale, sample.t_ns)
    fields = {"source": conventions.source, "held": held, **_pointing(sample, file)}
    meaning = conventions.lines(stated.mounting)
    print_found(
        as_json, fields | {"conventions": meaning}, [*(meaning if explain else ()), *_lines(fields)]
    )


class _Found(NamedTuple):
    sample: "AttitudeSample"
    conventions: "Conventions"
    held: bool = False


def _live(file: "BenchFile", time: str | None, patience_s: float) -> _Found:
    from hilstar.server.open_link import first_attitude, open_link

    if time is not None:
        raise InputError(
            f"--time {time}: a live stream has only its present; leave --time out, or give a log"
        )
    with open_link(file.config, file.folder) as link:
        if link.steps:
            raise InputError(
                f"{file.path}: [attitude] lockstep wants a frame for each attitude; use hilstar"
                " serve --explain"
            )
        with busy(f"waiting for an attitude, {patience_s:g} s at most"):
            sample = first_attitude(link, patience_s)
        return _Found(sample, link.conventions)


def _of_log(path: Path, time: str | None, stated: "Stated") -> _Found:
    from hilstar.attitude.clock.timeline import Policy
    from hilstar.attitude.logs.log_file import log_timeline, open_log, time_in_log
    from hilstar.attitude.wire.packet import AttitudeSample

    with busy("reading the log"):
        log = open_log(path, stated)
        joins = log.joins()
    for _, line in [*log.told, *joins.told]:
        say(line)
    t_ns = time_in_log(path, log.samples, time)
    state = log_timeline(log.samples, Policy(0, 0), joins).at(t_ns)
    if state is None:
        raise AssertionError("a log has samples")
    held = state.rate_cam_rad_s is None and state.age_ns > 0
    sample = AttitudeSample(t_ns, state.q_icrs_to_cam, state.rate_cam_rad_s, state.sequence)
    return _Found(sample, log.conventions, held)


def _pointing(sample: "AttitudeSample", file: "BenchFile") -> dict[str, Any]:
    import numpy as np

    from hilstar.basics.rotation import to_radec_roll_deg
    from hilstar.optics.layers.view import View
    from hilstar.server.bench.star_light import brightest_seen

    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(sample.q_icrs_to_cam)
    stars = brightest_seen(file, View(sample.q_icrs_to_cam, t_ns=sample.t_ns), SHOWN_STARS)
    rate = sample.rate_cam_rad_s
    return {
        "t_ns": sample.t_ns,
        "q_icrs_to_cam": sample.q_icrs_to_cam.tolist(),
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "roll_deg": roll_deg,
        "rate_deg_s": None if rate is None else np.degrees(rate).tolist(),
        "tracker": {
            "file": file.path.name,
            "resolution_px": list(file.config.tracker.resolution_px),
        },
        "stars": stars,
    }


def _lines(told: dict[str, Any]) -> list[str]:
    from hilstar.basics.rotation import turn_text

    q = ", ".join(f"{c:.7f}" for c in told["q_icrs_to_cam"])
    width, height = told["tracker"]["resolution_px"]
    lines = [
        f"q_icrs_to_cam {q}, t_ns {told['t_ns']}"
        + (" (held: in a gap of the log)" if told["held"] else ""),
        (
            f"RA {turn_text(told['ra_deg'])}, Dec {told['dec_deg']:.4f}, roll"
            f" {turn_text(told['roll_deg'])} deg"
        ),
    ]
    if told["rate_deg_s"] is not None:
        lines.append(
            "rate "
            + ", ".join(f"{c:z.6f}" for c in told["rate_deg_s"])
            + " deg/s about x, y, z of the camera"
        )
    if not told["stars"]:
        lines.append("no star of the catalogue is in view")
    for star in told["stars"]:
        where = (
            f"x {star.x_px:.0f}, y {star.y_px:.0f} of {width} x {height} px,"
            f" {star.from_boresight_deg:.2f} deg from the middle"
        )
        lines.append(
            f"{star.name or f'HIP {star.hip}'}, V {star.v_mag:.2f}, in {star.constellation}:"
            f" {where}"
        )
    return lines
