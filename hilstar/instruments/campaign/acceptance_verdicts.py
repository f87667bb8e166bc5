"""What an acceptance is of, and what it gives: a verdict for each clause, a result for each set."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.acceptance_plan import AcceptancePlan, CaseSet, ClauseTable
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.requirements import RequirementVerdict, bench_error
from hilstar.instruments.campaign.solvers import CENTROIDS
from hilstar.instruments.campaign.sweep import LevelCount
from hilstar.server.bench.alignment import cube_to_boresight
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.certificate_file import Certificate, CubeToBoresight, bench_certificate

NOT_TESTED = "not tested"
LEDGER = "ledger.csv"


@dataclass(frozen=True, slots=True)
class ClauseVerdict:
    """A clause with its verdict; `untested` says why it has none, "" where it has. `together` is
    the verdict of a clause that is not met with the doubt shared by all clauses, "" of another.
    """

    clause: ClauseTable
    verdict: RequirementVerdict | None
    unit: str
    untested: str = ""
    together: str = ""

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        return NOT_TESTED if self.verdict is None else self.verdict.verdict


@dataclass(slots=True)
class SetResult:
    """What a set of cases gave: the cases of its table, or the levels of its sweep; where each
    campaign is, and how many cases failed by reason.
    """

    case_set: CaseSet
    cases: Columns | None = None
    levels: list[LevelCount] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    failed: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CostOfSet:
    """How many cases a set has at most, and how long they take, s."""

    case_set: CaseSet
    cases: int
    seconds: float


class AcceptedBench:
    """A plan, the bench that it is run on, and where its results stand. Raises InputError."""

    def __init__(self, plan: AcceptancePlan, bench: Path, directory: Path, solver: str) -> None:
        self.plan = plan
        self.directory = directory
        self.solver = solver
        self.file: BenchFile = read_bench_file(bench)
        self.on_bench = plan.through == "bench"
        self.certificate: Certificate | None = None
        if self.on_bench:
            self.certificate = bench_certificate(self.file)

    @property
    def scale(self) -> Scale:
        """The scale of the tracker's image."""
        tracker = self.file.config.tracker
        focal_px = tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um
        return Scale(focal_px, tracker.resolution_px)

    @property
    def own_error(self) -> tuple[tuple[float, float] | None, float]:
        """How far the bench's own attitude may be off at 95 %, arcsec across and about, and its
        own time, s; None and 0 where no certificate says it.
        """
        return bench_error(self.file, self.certificate)

    @property
    def solver_text(self) -> str:
        """What was tested, in words."""
        if self.on_bench:
            return "the real tracker's answers"
        if self.solver == CENTROIDS:
            return f"{CENTROIDS}: the virtual tracker, whose stars are named by the truth"
        return self.solver

    @cached_property
    def cube(self) -> CubeToBoresight | None:
        """From the reference to the tracker's boresight; None without [alignment]."""
        return cube_to_boresight(self.file, self.certificate)
