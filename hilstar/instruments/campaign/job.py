"""What a process of a campaign is given and gives back, and what has to be the same in all."""

import functools
import hashlib
from pathlib import Path

import msgspec
import numpy as np
import scipy

import hilstar
from hilstar.basics.reading import CHUNK_BYTES, open_regular
from hilstar.basics.resources import resource_path
from hilstar.instruments.campaign.plan import SCENARIO, TRACKER_PSF, Plan
from hilstar.instruments.campaign.store import Row
from hilstar.server.bench.config import GAUSSIAN

WORDS = {
    "hilstar": "hilstar {0}, and the campaign is of {1}; install that version there",
    "code_sha256": (
        "hilstar's code {0:.12} under the same version, and the campaign is of {1:.12}; install the"
        " same there"
    ),
    "numpy": "NumPy {0}, and the campaign is of {1}; install that version there",
    "scipy": "SciPy {0}, and the campaign is of {1}; install that version there",
    "gl_renderer": (
        "the renderer {0}, and the campaign is of {1}: frames differ in their last bits; use"
        " machines of one kind"
    ),
}


class Identity(msgspec.Struct, frozen=True):
    """Everything by which rows could differ between machines: program, libraries and renderer."""

    hilstar: str
    code_sha256: str
    numpy: str
    scipy: str
    gl_renderer: str


def difference(found: Identity, wanted: Identity) -> str | None:
    """The first difference of a worker's identity, in words; None where there is none."""
    for name, name_text in WORDS.items():
        if getattr(found, name) != getattr(wanted, name):
            return "has " + name_text.format(getattr(found, name), getattr(wanted, name))
    return None


class Job(msgspec.Struct, frozen=True):
    """The message that starts a worker: the plan and the bench as they were read, the solver,
    and the place of images.
    """

    plan_path: str
    plan_text: str
    bench_path: str
    bench_text: str
    bench_sha256: str
    files_sha256: str
    solver: str
    solver_folder: str
    timeout_s: float
    directory: str
    images: bool


class Answered(msgspec.Struct, frozen=True):
    """The rows of some cases, the seconds that they took, and the worker's peak of memory."""

    rows: list[Row]
    seconds: float
    peak_bytes: int


def peak_bytes() -> int:
    """This process's peak of memory (Linux: VmHWM)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) * 1024
    return 0


@functools.cache
def code_sha256() -> str:
    """The digest of hilstar's code: its Python files and its shaders."""
    digest = hashlib.sha256()
    package = Path(hilstar.__file__).parent
    shaders = resource_path("shaders", "star.vert").parent
    for root, pattern in ((package, "*.py"), (shaders, "*")):
        for path in sorted(root.rglob(pattern)):
            if path.is_file():
                digest.update(
                    path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes()
                )
    return digest.hexdigest()


def identity_of(gl_renderer: str) -> Identity:
    """The identity of this process with a renderer."""
    return Identity(
        hilstar.__version__, code_sha256(), np.__version__, scipy.__version__, gl_renderer
    )


def files_sha256(plan: Plan, folder: Path) -> str:
    """The digest of the files that a plan names beside its bench: its log, and its scenarios.
    Raises InputError.
    """
    digest = hashlib.sha256()
    varied = [
        str(name)
        for parameter in plan.vary
        if parameter.key == SCENARIO
        for name in parameter.values or ()
        if name
    ]
    if plan.centroids.psf in (TRACKER_PSF, GAUSSIAN):
        psf_files = []
    else:
        psf_files = [plan.centroids.psf]
    for name in [*([plan.attitudes.log] if plan.attitudes.log else []), *varied, *psf_files]:
        with open_regular(folder / name, "give the path of a file") as file:
            while chunk := file.read(CHUNK_BYTES):
                digest.update(chunk)
    return digest.hexdigest()
