"""Options that several commands have, and the check of the files that a command names."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hilstar.bench import bench_file

BenchFile = Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The bench file (docs: Bench file).")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else there.")]
Headless = Annotated[bool, typer.Option("--headless", help="Draw without a window.")]
RadecText = Annotated[str | None, typer.Option("--radec", metavar="RA,DEC,ROLL", help="Boresight and roll in degrees, ICRS.")]
QuaternionText = Annotated[str | None, typer.Option("--quaternion", metavar="W,X,Y,Z", help="q_icrs_to_cam, scalar first.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file that could not be made again.")]
Explain = Annotated[
    bool, typer.Option("--explain", help="Explain on stderr what was chosen for this scene, with its error and its saving.")
]
AtSeconds = Annotated[
    float | None,
    typer.Option("--at", metavar="S", help="Seconds after sky.epoch_utc, or of a scenario; 0 by default."),
]
RunFile = Annotated[Path, typer.Argument(metavar="RUN.mcap", help="The ledger of serve or replay.")]
ScenarioFile = Annotated[
    Path | None, typer.Option("--scenario", metavar="FILE.toml", help="Faults on request: what is wrong in the sky, and when.")
]
UNSAID = "What the log itself does not say"
KernelFiles = Annotated[
    list[Path] | None,
    typer.Option("--kernel", metavar="FILE", help="A SPICE kernel; may be repeated.", rich_help_panel=UNSAID),
]
TopicName = Annotated[
    str | None, typer.Option("--topic", metavar="NAME", help="The topic, where a bag has several.", rich_help_panel=UNSAID)
]
BodyName = Annotated[
    str | None,
    typer.Option("--body", metavar="NAME", help="The body or frame, where a log has several.", rich_help_panel=UNSAID),
]
ReferenceName = Annotated[
    str | None,
    typer.Option(
        "--reference",
        metavar="FRAME",
        help="The frame that attitudes refer to, or what its axes are: icrs, enu, ned.",
        rich_help_panel=UNSAID,
    ),
]
EpochUtc = Annotated[
    str | None,
    typer.Option("--epoch-utc", metavar="TIME", help="The UTC at the log's time zero.", rich_help_panel=UNSAID),
]
PlaceText = Annotated[
    str | None,
    typer.Option(
        "--place", metavar="LAT,LON,HEIGHT", help="Where the vehicle is: degrees and metres, WGS84.", rich_help_panel=UNSAID
    ),
]
MountingText = Annotated[
    str | None,
    typer.Option(
        "--mounting", metavar="W,X,Y,Z", help="q_body_to_cam, for a log of the body's attitude.", rich_help_panel=UNSAID
    ),
]
MAX_SEED = 2**63 - 1  # what a FITS header holds
LOG_HELP = "CSV (t_s,qw,qx,qy,qz), JSON lines, CCSDS AEM, MCAP (a ledger), a SPICE CK, a ROS bag or a PX4 ULog."


def check_files(
    inputs: Iterable[Path | None],
    outputs: Iterable[Path | None],
    file: bench_file.BenchFile | None = None,
    kept: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Refuse (InputError), before anything is done, outputs that are inputs, or one file, and `kept` where it is there.

    Inputs are also the bench file and all that it names; `kept` is the output that cannot be made again.
    """
    from hilstar.files import check_outputs, files_named_in, refuse_existing, refuse_writer

    named = [] if file is None else files_named_in(file.path, file.text)
    check_outputs([*inputs, *named], [*outputs, kept])
    if kept is not None:
        refuse_writer(kept)
    refuse_existing(kept, overwrite)
