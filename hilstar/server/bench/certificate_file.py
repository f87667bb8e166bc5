"""certificate.json: how sure a bench is, as `hilstar certify` states it and `serve`, `assess`
and requirements read it.
"""

import datetime
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import NOT_JSON, read_bytes
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.glass import say_once

KIND = "hilstar certificate 1"
MAX_BYTES = 50_000_000
ANEW = "certify the bench anew (hilstar certify --again)"
ADVICE = "give the certificate.json that `hilstar certify BENCH.toml -o DIR` wrote"


class Contribution(msgspec.Struct, frozen=True, kw_only=True):
    """What an input adds to a figure: its standard uncertainty in the figure's unit, and its
    share of the variance.
    """

    input: str
    standard_uncertainty: float
    share: float


class ByTrials(msgspec.Struct, frozen=True, kw_only=True):
    """The same figure by Supplement 1, and why its interval differs from that of first order; ""
    where it does not.
    """

    standard_uncertainty: float
    lower: float
    upper: float
    differs: str


class CertifiedFigure(msgspec.Struct, frozen=True, kw_only=True):
    """A figure with its 95 % interval. `region` is a third of the screen, a field or the screen;
    `star` a HIP number.

    `conforms` is None without a limit, and `truth` is known of a virtual bench alone.
    """

    quantity: str
    region: str
    star: int | None
    field: int | None
    value: float
    standard_uncertainty: float
    k: float
    lower: float
    upper: float
    unit: str
    dof: float | None
    limit: float | None
    conforms: bool | None
    truth: float | None
    by_trials: ByTrials | None
    contributions: list[Contribution]


class InputRow(msgspec.Struct, frozen=True, kw_only=True):
    """An input of the budget; `dof` is None where it is not limited."""

    name: str
    distribution: str
    standard_uncertainty: float
    unit: str
    dof: float | None
    source: str


class CubeToBoresight(msgspec.Struct, frozen=True, kw_only=True):
    """Where the tracker's boresight points in the reference's axes, and how sure that is.

    `boresight` is a unit vector; `q_tracker_to_reference` turns the tracker's components into the
    reference's. `cross_arcsec` is the radius about the boresight that holds it at 95 %, and
    `roll_arcsec` the half width about it; None where a part is not known, which `without` names.
    """

    reference: str
    boresight: tuple[float, float, float]
    q_tracker_to_reference: tuple[float, float, float, float]
    cross_arcsec: float | None
    roll_arcsec: float | None
    without: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The same in a sentence."""
        x, y, z = self.boresight
        where = f"x {x:+.7f}, y {y:+.7f}, z {z:+.7f} of {self.reference or 'the reference'}"
        if self.cross_arcsec is None or self.roll_arcsec is None:
            size = "its uncertainty is not known"
        else:
            size = (
                f"within {self.cross_arcsec:.3g} arcsec across and {self.roll_arcsec:.3g} about it"
                " (95 %)"
            )
        missing = f"; without {', '.join(self.without)}" if self.without else ""
        return f"{where}, {size}{missing}"


class Certificate(msgspec.Struct, frozen=True, kw_only=True):
    """A whole certificate. Times are UTC; `files` has the SHA-256 of the bench file and of each
    file that it names.
    """

    kind: str
    number: str
    made: str
    valid_until: str
    hilstar: str
    bench: str
    bench_sha256: str
    files: dict[str, str]
    monitor: dict[str, Any]
    collimator: dict[str, Any]
    read_by: str
    who: str
    where: str
    ambient: str
    traceability: str
    instrument: dict[str, Any]
    decision: str
    conforms: bool | None
    trials: int
    two_digits_stand: bool
    inputs: list[InputRow]
    figures: list[CertifiedFigure]
    not_assessed: list[str]
    measurands: dict[str, str]
    reference_sha256: str | None = None
    replaces: str | None = None
    cube: CubeToBoresight | None = None

    def expanded(self, quantities: Iterable[str]) -> float | None:
        """The largest |value| + half width of the interval of some quantities; None where it has
        none of them.
        """
        half_widths = []
        for figure in self.figures:
            if figure.quantity in set(quantities):
                half_widths.append(max(abs(figure.lower), abs(figure.upper)))
        return max(half_widths) if half_widths else None

    def late_ms(self, stated_ms: float) -> float | None:
        """How far the bench's light may be from the delay that its file states, ms, at 95 %: what
        is stated is taken into account already. None where not assessed.
        """
        off_ms = []
        for figure in self.figures:
            if figure.quantity == "latency":
                off_ms += [abs(figure.lower - stated_ms), abs(figure.upper - stated_ms)]
        return max(off_ms, default=None)

    @property
    def attitude_arcsec(self) -> tuple[float, float] | None:
        """How far the bench's own attitude may be off at 95 %, across the boresight and about
        it; None where not assessed.
        """
        cross = self.expanded(("attitude_x", "attitude_y"))
        roll = self.expanded(("attitude_z",))
        if cross is None or roll is None:
            return None
        return (cross, roll)

    @property
    def line(self) -> str:
        """The certificate for a person."""
        return f"certificate {self.number} of {self.made[:10]}, valid until {self.valid_until}"


def read_certificate(path: Path) -> Certificate:
    """A certificate. Raises InputError for a file that is none."""
    raw = read_bytes(path, ADVICE, MAX_BYTES)
    try:
        certificate = msgspec.json.decode(raw, type=Certificate)
    except NOT_JSON as error:
        raise InputError(f"{path}: is no certificate ({shortened(error)}); {ADVICE}") from error
    if certificate.kind != KIND:
        raise InputError(
            f"{path}: kind = {shortened(repr(certificate.kind))} and {KIND!r} is wanted; {ADVICE}"
        )
    return certificate


def bench_certificate(file: BenchFile, today: datetime.date | None = None) -> Certificate | None:
    """The certificate that a bench file names, None where it names none; a notice where it is not
    this bench's, or is over.

    Raises InputError for a file that is none.
    """
    name = file.config.certify.certificate
    if name is None:
        return None
    certificate = read_certificate((file.folder / name).resolve())
    if certificate.bench_sha256 != file.sha256:
        say_once(
            f"{certificate.line} is of another state of this bench file; {ANEW}",
            "[certify] certificate",
        )
    if certificate.valid_until < (today or datetime.datetime.now(datetime.UTC).date()).isoformat():
        say_once(f"{certificate.line} is over; {ANEW}", "[certify] certificate")
    return certificate


def off_by(found: Certificate) -> str:
    """How far the bench's own attitude may be off, in words."""
    if found.attitude_arcsec is None:
        return "its own attitude was not assessed"
    cross, roll = found.attitude_arcsec
    return (
        f"the bench itself is off by at most {cross:.3g} arcsec across and {roll:.3g} about the"
        " boresight (95 %)"
    )


def certificate_number(file: BenchFile) -> str:
    """The number of a bench's certificate, "" without one. Raises InputError."""
    certificate = bench_certificate(file)
    return "" if certificate is None else certificate.number
