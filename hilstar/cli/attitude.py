"""hilstar attitude: where a log or a live stream points, in terms that a person can check."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hilstar.basics.errors import InputError
from hilstar.basics.resources import resource_path
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.options import LOG_HELP, LogStatements, json_option
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.attitude.logs.entries import Stated
    from hilstar.attitude.wire.packet import AttitudeSample
    from hilstar.attitude.wire.source import Conventions
    from hilstar.server.bench.bench_file import BenchFile

SHOWN_STARS = 3


@struct
class AttitudeOptions:
    """The options of `hilstar attitude`."""

    source: Path = argument(
        "INPUT", f"{LOG_HELP} Or a bench file (.toml): its live stream is awaited."
    )
    time: str | None = option(
        "T",
        "Seconds after the log's first sample, or a date and time as the log has them; by default"
        " its first sample.",
    )
    bench: Path | None = option(
        "BENCH.toml", "Whose tracker, mounting and sky to use; by default the demo's tracker."
    )
    wait: float = option(
        "SECONDS", "How long to wait for a live stream.", default=10.0, min=0.1, max=1e6
    )
    explain: bool = switch(
        "Explain what the source's numbers mean: frames, scalar order, time scale."
    )
    as_json: bool = json_option()


def attitude(options: AttitudeOptions, statements: LogStatements) -> None:
    """Say where a log or a live stream points: quaternion, RA, Dec, roll, and the brightest
    stars in view.
    """
    from hilstar.server.bench.bench_file import dated, read_bench_file

    source = options.source
    is_live = source.suffix.lower() == ".toml"
    if is_live:
        first = read_bench_file(source)
        _refuse_of_stream(source, statements)
    else:
        first = read_bench_file(options.bench or resource_path("configs", "demo.toml"))
    file = first
    if is_live and options.bench is not None:
        file = read_bench_file(options.bench)
    stated = statements.stated(first.config)
    if is_live:
        pointing = _live(first, options.time, options.wait)
        for _, line in pointing.conventions.mounting_notices(stated.mounting):
            say(line)
    else:
        pointing = _of_log(source, options.time, stated)
    conventions = pointing.conventions
    file = dated(file, conventions.scale, pointing.sample.t_ns)
    meaning = conventions.lines(stated.mounting)
    fields = {"source": conventions.source, "held": pointing.held}
    fields |= _pointing(pointing.sample, file)
    lines = _lines(fields)
    if options.explain:
        lines = [*meaning, *lines]
    fields["conventions"] = meaning
    print_found(options.as_json, fields, lines)


def _refuse_of_stream(source: Path, statements: LogStatements) -> None:
    """Refuse (InputError) what is stated of a log where there is a live stream, whose bench file
    has keys for it.
    """
    keys = {
        "--mounting": (statements.mounting, "[tracker] q_body_to_cam"),
        "--convention": (statements.convention, "[attitude] convention"),
    }
    for flag, (value, key) in keys.items():
        if value is not None:
            raise InputError(f"{flag} {value}: write it into {source} as {key}")
    statements.refuse(f"it is for a log, and {source} names a live stream; leave it out")


class _Pointing(NamedTuple):
    """An attitude, what its numbers mean, and whether it was held in a gap of a log."""

    sample: "AttitudeSample"
    conventions: "Conventions"
    held: bool = False


def _live(file: "BenchFile", time: str | None, patience_s: float) -> _Pointing:
    """The first attitude of a live stream. Raises InputError."""
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
        return _Pointing(sample, link.conventions)


def _of_log(path: Path, time: str | None, stated: "Stated") -> _Pointing:
    """The attitude of a log at a time; the first without one. Raises InputError."""
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
    return _Pointing(sample, log.conventions, held)


def _pointing(sample: "AttitudeSample", file: "BenchFile") -> dict[str, Any]:
    """An attitude and the brightest stars of its sky, by the keys of --json."""
    import numpy as np

    from hilstar.basics.rotation import to_radec_roll_deg
    from hilstar.optics.layers.view import View
    from hilstar.server.bench.star_light import brightest_seen

    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(sample.q_icrs_to_cam)
    stars = brightest_seen(file, View(sample.q_icrs_to_cam, t_ns=sample.t_ns), SHOWN_STARS)
    rate_deg_s = None
    if sample.rate_cam_rad_s is not None:
        rate_deg_s = np.degrees(sample.rate_cam_rad_s).tolist()
    tracker = {
        "file": file.path.name,
        "resolution_px": list(file.config.tracker.resolution_px),
    }
    return {
        "t_ns": sample.t_ns,
        "q_icrs_to_cam": sample.q_icrs_to_cam.tolist(),
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "roll_deg": roll_deg,
        "rate_deg_s": rate_deg_s,
        "tracker": tracker,
        "stars": stars,
    }


def _lines(fields: dict[str, Any]) -> list[str]:
    """The same as lines of text."""
    from hilstar.basics.rotation import turn_text

    held = " (held: in a gap of the log)" if fields["held"] else ""
    components = ", ".join(f"{component:.7f}" for component in fields["q_icrs_to_cam"])
    ra = turn_text(fields["ra_deg"])
    roll = turn_text(fields["roll_deg"])
    lines = [
        f"q_icrs_to_cam {components}, t_ns {fields['t_ns']}{held}",
        f"RA {ra}, Dec {fields['dec_deg']:.4f}, roll {roll} deg",
    ]
    if fields["rate_deg_s"] is not None:
        rates = ", ".join(f"{rate_deg_s:z.6f}" for rate_deg_s in fields["rate_deg_s"])
        lines.append(f"rate {rates} deg/s about x, y, z of the camera")
    if not fields["stars"]:
        lines.append("no star of the catalogue is in view")
    width, height = fields["tracker"]["resolution_px"]
    for star in fields["stars"]:
        name = star.name or f"HIP {star.hip}"
        lines.append(
            f"{name}, V {star.v_mag:.2f}, in {star.constellation}: x {star.x_px:.0f},"
            f" y {star.y_px:.0f} of {width} x {height} px, {star.from_boresight_deg:.2f} deg from"
            " the middle"
        )
    return lines
