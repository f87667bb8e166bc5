"""A campaign before the real tracker (`through = "bench"`): the display shows each case, and
`[answers]` says what it answered.

One process and one frame loop, which never waits for the tracker. Laws:

1. The order of the cases is drawn from the seed. Those that need another renderer stand together. A
   check case, always the same attitude, comes before each `check_every` of them and at the end.
2. A case has its row once it is over, and not before: one that a kill interrupts is shown again, in
   its place in the order.
3. An answer belongs to a case whose frames alone were lit over its exposure. Until a case's first
   right answer, one that fits the case before better than this one is late, and counts for neither.
4. A tracker that falls silent within a case is waited for, up to `silent_s` after its last message.
   The case then begins again.
"""

import csv
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import write_csv
from hilstar.basics.errors import MachineError
from hilstar.basics.files import write_whole
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import stop_on_signal
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S
from hilstar.instruments.campaign.case_motion import AXES, CaseMotion
from hilstar.instruments.campaign.cases import Case, CaseMaker, Q, first_row
from hilstar.instruments.campaign.plan import SCENARIO, Design, Plan
from hilstar.instruments.campaign.store import Directory, Journal, Row
from hilstar.instruments.campaign.tally import FrameLists, StarLists, spread_row
from hilstar.optics.layers.fault_kinds import Now as FaultNow
from hilstar.optics.layers.view import View
from hilstar.server.answers.answer import Answer, AnswerSource
from hilstar.server.answers.judge import AnswerJudge, AnswerRules, Judged
from hilstar.server.answers.pairing import LitFrame, LitFrames, residual_arcsec
from hilstar.server.answers.stars import ShownStars
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.fault_views import display_view
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.scenario import Timetable
from hilstar.server.loop import FaultyFrames, FrameLoop, Limit
from hilstar.server.pacer import FrameSink, Moment, Pacer, Shown, ignore
from hilstar.server.run_progress import Follower, Running
from hilstar.server.screen.screen import DisplayPacer, Screen

RENDERER_TABLES = ("sky", "render", "spacecraft")  # whose keys need another renderer
ORDER_STREAM = 4  # stream of a plan's seed for the order of its cases
BRIGHTEST = 5  # reported stars whose light is a case's signal
MAX_SILENCE_S = 1.0  # at the end of a case: a tracker that said nothing for longer is silent
NO_ANSWER = "no-answer"
RUNS, NOW, CHECKS = "runs.csv", "now.json", "checks.csv"
CHECK_COLUMNS = (
    "check",
    "begun_utc",
    "run",
    "answers",
    *(f"error_{axis}_arcsec" for axis in AXES),
    "signal_mag",
)


class OpenDisplay(NamedTuple):
    """An open bench with its screen (None: headless), a sink for its frames, who follows the run,
    and the clock that paces frames without a screen.
    """

    bench: Bench
    screen: Screen | None = None
    sink: FrameSink = ignore
    follower: Follower = lambda running: None
    clock: HostClock = HOST_CLOCK


Display = Callable[[BenchFile], AbstractContextManager[OpenDisplay]]


class BenchOrder:
    """The order in which cases are shown, those of one renderer together; check cases have the
    numbers from `cases` on.
    """

    def __init__(self, plan: Plan, cases: int, maker: CaseMaker, design: Design) -> None:
        self.plan = plan
        self.maker = maker
        self.cases = cases
        self._design = design
        self._every = plan.check_every
        keys = [parameter.key for parameter in maker.parameters]
        self._keys = [key for key in keys if key.split(".")[0] in RENDERER_TABLES]
        if SCENARIO in keys:
            self._keys.append(SCENARIO)
        order = np.random.default_rng((plan.seed, ORDER_STREAM)).permutation(cases)
        if self._keys:
            group: dict[str, int] = {}
            rank = np.array(
                [group.setdefault(self.renderer(int(number)), len(group)) for number in order]
            )
            order = order[np.argsort(rank, kind="stable")]
        self.order = order
        self._at_rest = self.case(0).first

    @property
    def checks(self) -> int:
        """How many check cases there are."""
        if self._every:
            return -(-self.cases // self._every) + 1
        return 0

    def case(self, number: int) -> Case:
        """The case of a number; a check case is the attitude of case 0, at rest."""
        if number < self.cases:
            return self.maker.case(number, self._design.points(number, number + 1)[0])
        at_rest = CaseMotion(self._at_rest.q_icrs_to_cam, np.zeros(3))
        return Case(number, {}, 0, at_rest.exposure(0.0, 0.0, self._at_rest.t_ns or 0), at_rest)

    def renderer(self, number: int) -> str:
        """What a case's renderer depends on, as a text that is the same for all cases of one
        renderer.
        """
        values = self.case(number).values
        if self._keys:
            return msgspec.json.encode([values.get(key) for key in self._keys]).decode()
        return ""

    def turns(self) -> Iterator[tuple[str, int, int]]:
        """Renderer, number and place in the order of each case, check cases among them with the
        renderer of the next one.
        """
        renderer = ""
        for place, number in enumerate(self.order.tolist()):
            renderer = self.renderer(number)
            if self._every and place % self._every == 0:
                yield renderer, self.cases + place // self._every, place
            yield renderer, number, place
        if self._every:
            yield renderer, self.cases + self.checks - 1, self.cases


@dataclass(slots=True)
class Tally:
    """A case on the display, and its answers so far. Times are the host's, ns; `begun_ns` is None
    while nothing is lit.
    """

    case: Case
    place: int
    begun_ns: int | None = None
    begun_utc: str = ""
    first_frame: int = 0
    received: int = 0
    late: int = 0
    wrong: int = 0
    worst_deg: float | None = None
    first_attitude_s: float | None = None
    recovery_s: float | None = None
    fault_end_s: float | None = None
    answered: Judged | None = None
    errors: list[FloatArray] = field(default_factory=list)
    stars: list[int] = field(default_factory=list)
    signals: list[float] = field(default_factory=list)
    frames_told: FrameLists = field(default_factory=FrameLists)
    star_lists: StarLists = field(default_factory=StarLists)

    def take(self, judged: Judged, right: bool, rate_rad_s: FloatArray) -> None:
        """Take an answer into the case's figures; `rate_rad_s` (3,), cam, was commanded."""
        self.received += 1
        if judged.residual is None:
            return
        if right:
            self.errors.append(judged.residual)
            self.frames_told.add(rate_rad_s, judged.residual, judged.answer.rate_cam_rad_s)
        else:
            self.wrong += 1
            self.worst_deg = max(
                self.worst_deg or 0.0, float(np.linalg.norm(judged.residual)) / 3600
            )
        self.answered = self.answered or judged
        if judged.answer.star_count is not None:
            self.stars.append(judged.answer.star_count)
        light = sorted(
            star.dn for star in judged.answer.centroids if star.dn is not None and star.dn > 0
        )[-BRIGHTEST:]
        if light:
            self.signals.append(-2.5 * math.log10(sum(light)))


class BenchRun:
    """Shows the missing cases of a campaign, and keeps the row of each. Raises InputError and
    MachineError.
    """

    def __init__(
        self,
        order: BenchOrder,
        columns: dict[str, Any],
        directory: Directory,
        *,
        source: AnswerSource,
        rules: AnswerRules,
        notices: Notices,
        on_done: Callable[[int], None],
    ) -> None:
        self.journal: Journal = directory.journal(order.cases + order.checks)
        self._order = order
        self._plan = order.plan
        self._maker = order.maker
        self._columns = columns
        self._source = source
        self._rules = rules
        self._notices = notices
        self._on_done = on_done
        self._done = self.journal.done
        self._now_path = directory.path / NOW
        runs = directory.path / RUNS
        if runs.exists():
            begun = runs.read_text().splitlines()[1:]
        else:
            begun = []
        self._run = len(begun) + 1
        starts: list[list[Any]] = [
            *(line.split(",") for line in begun),
            [self._run, f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"],
        ]
        write_csv(runs, ("run", "begun_utc"), starts)
        self._base = self._next = 0  # frame numbers go on from one renderer to the next
        self._frames: LitFrames | None = None
        self._judge: AnswerJudge | None = None
        self._shown_stars: ShownStars | None = None
        self._heard_ns: int | None = None
        self._refused = 0
        self._waiting = False
        self._before_q: FloatArray | None = None
        self._shown_q: FloatArray | None = None
        self._turns: list[tuple[int, int]] = []
        self._now: Tally | None = None
        self._dark_until_ns = 0
        self._file_sha256 = ""
        # from a swap to the light of the middle row, and from there to the last one
        self._light_ns = self._last_row_ns = 0

    def run(self, display: Display) -> bool:
        """Show the missing cases, each renderer's on a display of its own; False where a signal
        ended the run first.
        """
        self._on_done(self._done)
        missing = {
            number for block in range(self.journal.blocks) for number in self.journal.missing(block)
        }
        for _, group in groupby(
            (turn for turn in self._order.turns() if turn[1] in missing), lambda turn: turn[0]
        ):
            turns = [(number, place) for _, number, place in group]
            first = next((number for number, _ in turns if number < self._order.cases), 0)
            with display(self._maker.bench(self._order.case(first))) as opened:
                if not self.show(turns, opened):
                    return False
        self._now_path.unlink(missing_ok=True)
        return True

    def _keep(self, row: Row) -> None:
        self._done += self.journal.append([row])
        self._on_done(self._done)

    def show(self, turns: list[tuple[int, int]], opened: OpenDisplay) -> bool:
        """Show cases (number, place) that have one renderer; whether all of them are over, and
        no signal ended the run.
        """
        bench = opened.bench
        screen = opened.screen
        period_ns = NS_PER_S / bench.config.monitor.refresh_hz
        if self._frames is None:
            self._frames = LitFrames(period_ns, bench.scan.hold_s, centred=screen is None)
            self._judge = AnswerJudge(self._rules, self._frames)
        self._shown_stars = ShownStars(bench)
        self._base = self._next
        self._light_ns = 0 if screen is None else screen.swap_to_light_ns
        self._file_sha256 = bench.file.sha256
        self._last_row_ns = 0 if screen is None else round(bench.scan.scanout_s / 2 * NS_PER_S)
        if screen is None:
            pacer = Pacer(period_ns, opened.clock)
        else:
            pacer = DisplayPacer(screen, self._notices)
        faults = self._faults(bench, turns)

        def sink(shown: Shown) -> None:
            self._lit(shown)
            opened.sink(shown)

        loop = FrameLoop(bench, sink, pacer, None, self._notices, faults)
        opened.follower(Running(loop, PacketCounts()))
        self._turns = list(reversed(turns))
        over = False

        def draw_slot(moment: Moment) -> Shown | None:
            nonlocal over
            now_ns = loop.pacer.clock.now_ns()
            self._listen(now_ns)
            if self._now is None and now_ns >= self._dark_until_ns:
                if not self._turns:
                    over = True
                    loop.stop.set()
                else:
                    self._begin(*self._turns.pop())
            light_ns = moment.light_if_begun_at(now_ns)
            view = self._view(light_ns)
            if view is None:
                return loop.draw(moment.slot, 0, None, moment.lit_at(light_ns))
            attitude = Attitude(
                view.q_icrs_to_cam, 0, False, rate_cam_rad_s=view.turn.rate_cam_rad_s
            )
            return loop.draw(moment.slot, view.t_ns or 0, attitude, moment.lit_at(light_ns))

        with stop_on_signal(loop.stop), loop.watch:
            bench.warm_up()
            loop.paced(Limit(), draw_slot)
        if screen is not None and screen.window.gone is not None:
            raise MachineError(f"the run ended early: {screen.window.gone}")
        return over

    def _faults(self, bench: Bench, turns: list[tuple[int, int]]) -> FaultyFrames | None:
        """The faults of the scenario that all of these cases have."""
        scenario = next(
            (
                s
                for number, _ in turns
                if (s := self._maker.scenario(self._order.case(number))) is not None
            ),
            None,
        )
        if scenario is None:
            return None
        view = display_view(bench, scenario)
        timetable = Timetable(scenario, view.prepare, bench.config.tracker.exposure_s)

        def on(t_ns: int) -> tuple[FaultNow, ...]:
            is_case = self._now is not None and self._now.case.number < self._order.cases
            if is_case:
                return timetable.on(t_ns - self._maker.begin_ns)
            return ()

        return FaultyFrames(on, view)

    def _begin(self, number: int, place: int) -> None:
        case = self._order.case(number)
        if number < self._order.cases:
            end_s = self._maker.fault_end_s(case, self._plan.limit_s)
        else:
            end_s = None
        self._now = Tally(case, place, fault_end_s=end_s)
        self._waiting = False

    def _view(self, light_ns: int) -> View | None:
        """What a frame shows whose light leaves at a host time; None for a dark one."""
        now = self._now
        if now is None:
            return None
        if now.begun_ns is None:
            elapsed_ns = 0
        else:
            elapsed_ns = max(light_ns - now.begun_ns, 0)
        if now.case.number >= self._order.cases:
            return now.case.first
        return self._maker.after(now.case, elapsed_ns, self._rules.exposure_s)

    def _lit(self, shown: Shown) -> None:
        """Take a frame that was shown."""
        assert self._frames is not None
        attitude, on_screen, now = shown.attitude, shown.on_screen, self._now
        is_lit = attitude is not None and not on_screen.operator and not on_screen.hidden
        host_ns = (
            shown.moment_ns if shown.predicted_swap_ns is None else shown.swap_ns + self._light_ns
        )
        q = attitude.q_icrs_to_cam if attitude is not None and is_lit else None
        number = self._base + shown.number
        self._next = number + 1
        rate_rad_s = shown.drawn.rate_cam_rad_s
        self._frames.add(LitFrame(number, host_ns, host_ns, q, rate_rad_s, shown.fades))
        self._shown_q = q if q is not None else self._shown_q
        if (
            now is not None
            and now.begun_ns is None
            and not on_screen.operator
            and not on_screen.hidden
        ):
            now.begun_ns, now.first_frame = host_ns, number
            now.begun_utc = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "Z"
            first = now.case.first
            now_table = {
                "case": now.case.number,
                "order": now.place,
                "q_icrs_to_cam": first.q_icrs_to_cam.tolist(),
            }
            rate = first.turn.rate_cam_rad_s if attitude is None else attitude.rate_cam_rad_s
            now_table |= {"rate_cam_rad_s": None if rate is None else rate.tolist()}
            acceleration_rad_s2 = now.case.motion.acceleration_at(0.0)
            now_table |= {"acceleration_cam_rad_s2": acceleration_rad_s2.tolist()}
            write_whole(
                self._now_path,
                msgspec.json.encode(now_table | {"light_ns": host_ns, "begun_utc": now.begun_utc}),
            )

    def _listen(self, now_ns: int) -> None:
        """Take the answers that have come, and end the case that has enough of them or whose
        time is over.
        """
        assert self._judge is not None
        self._heard_ns = now_ns if self._heard_ns is None else self._heard_ns
        refused = sum(self._source.refusals().values())
        answers = self._source.take()
        if answers or refused != self._refused:
            self._heard_ns = now_ns
            self._refused = refused
            # the tracker is back: its case begins again
            if self._waiting and self._now is not None:
                self._notices.tell(
                    "tracker-back",
                    f"the tracker answers again; case {self._now.case.number} begins again",
                )
                self._begin(self._now.case.number, self._now.place)
        for answer in answers:
            self._count(self._judge.judge(answer), answer)
        now = self._now
        plan = self._plan
        if now is None or now.begun_ns is None:
            return
        if now.received < plan.asked:
            if now_ns - now.begun_ns < plan.limit_s * NS_PER_S:
                return
            silent_s = (now_ns - self._heard_ns) / NS_PER_S
            if min(MAX_SILENCE_S, plan.limit_s / 2) < silent_s < plan.silent_s:
                if not self._waiting:
                    self._notices.tell(
                        "tracker-silent",
                        f"the tracker is silent: waited for, up to {plan.silent_s:g} s",
                    )
                self._waiting = True
                return
        self._keep(self._row(now))
        self._before_q = self._shown_q
        self._now = None
        self._waiting = False
        self._dark_until_ns = now_ns + round(plan.blank_s * NS_PER_S)

    def _count(self, judged: Judged, answer: Answer) -> None:
        """Count an answer for the case on the display, if it is of that case."""
        now = self._now
        plan = self._plan
        if now is None or now.begun_ns is None or not self._is_of(now, judged, answer):
            return
        if judged.residual is None:
            off = None
        else:
            off = float(np.linalg.norm(judged.residual))
        right = off is not None and off <= plan.wrong_above_arcsec
        after_s = (answer.host_ns - now.begun_ns) / NS_PER_S
        if right:
            now.first_attitude_s = after_s if now.first_attitude_s is None else now.first_attitude_s
            fault_end_s = now.fault_end_s
            seen_s = (judged.middle_ns - now.begun_ns) / NS_PER_S
            if fault_end_s is not None and now.recovery_s is None and seen_s >= fault_end_s:
                now.recovery_s = after_s - fault_end_s
        if plan.settle_s is None:
            settled = now.received > 0 or off is not None
        else:
            settled = after_s >= plan.settle_s
        if settled and now.received < plan.asked:
            # what was commanded: the lit frames tell it only as well as their times are known
            view = self._view(judged.middle_ns) or now.case.first
            now.take(judged, right, view.turn.rate_cam_rad_s)
            if right and "stars" in plan.columns and judged.lit is not None:
                assert self._shown_stars is not None
                residuals = self._shown_stars.judged(answer.centroids, judged.lit.q)
                now.star_lists.judged.append(residuals)

    def _is_of(self, now: Tally, judged: Judged, answer: Answer) -> bool:
        """Whether an answer is of the case on the display; one of the case before that comes
        late is counted.
        """
        half_ns = round(self._rules.exposure_s * NS_PER_S / 2)
        if judged.middle_ns - half_ns < (now.begun_ns or 0) + self._last_row_ns:
            return False
        if judged.lit is None or judged.residual is None or answer.q_icrs_to_cam is None:
            return judged.verdict == "invalid"
        if judged.lit.first < now.first_frame:
            return False
        if now.first_attitude_s is None and self._before_q is not None:
            before = float(np.linalg.norm(residual_arcsec(answer.q_icrs_to_cam, self._before_q)))
            if before <= self._plan.wrong_above_arcsec and before < float(
                np.linalg.norm(judged.residual)
            ):
                now.late += 1
                return False
        return True

    def _row(self, now: Tally) -> Row:
        row = first_row(now.case, self._columns) | {
            "order": now.place,
            "run": self._run,
            "begun_utc": now.begun_utc,
        }
        row |= {
            "bench_sha256": self._file_sha256,
            "frames": self._plan.asked,
            "received": now.received,
            "late": now.late,
        }
        row |= {
            "solved": len(now.errors) + now.wrong,
            "wrong": now.wrong,
            "wrong_deg": now.worst_deg,
        }
        row |= {"first_attitude_s": now.first_attitude_s}
        if "recovery_s" in row:
            row |= {"fault_end_s": now.fault_end_s, "recovery_s": now.recovery_s}
        if (
            now.answered is not None
            and now.answered.lit is not None
            and now.answered.answer.q_icrs_to_cam is not None
        ):
            row |= dict(
                zip(
                    (f"solved_{name}" for name in Q),
                    now.answered.answer.q_icrs_to_cam.tolist(),
                    strict=True,
                )
            )
            row |= dict(
                zip((f"lit_{name}" for name in Q), now.answered.lit.q.tolist(), strict=True)
            )
        if now.stars:
            row["stars"] = float(np.mean(now.stars))
        if now.signals:
            row["signal_mag"] = float(np.mean(now.signals))
        if not row["solved"]:
            silent = (self._heard_ns or 0) < (now.begun_ns or 0)
            row |= {
                "status": NO_ANSWER,
                "why": "the tracker was silent" if silent else "the tracker had no attitude",
            }
        row |= now.frames_told.into(self._plan.columns)
        if "stars" in self._plan.columns:
            row |= now.star_lists.into()
        return row | spread_row(now.errors)


def write_checks(path: Path, rows: list[Row], cases: int) -> None:
    """Write the check cases' rows as checks.csv."""
    check_rows = []
    for row in rows:
        about = (row["case"] - cases, row["begun_utc"], row["run"], row["received"])
        check_rows.append((*about, *(row[name] for name in CHECK_COLUMNS[4:])))
    write_csv(path, CHECK_COLUMNS, check_rows)


def drift_of(path: Path) -> dict[str, Any] | None:
    """The bench's drift over a campaign, by straight lines through the check cases of checks.csv;
    None for fewer than two.

    `arcsec` (about x, y, z, cam) and `mag` are last minus first along that line, with their
    standard errors (None: two checks).
    """
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    at_s = np.array([datetime.fromisoformat(row["begun_utc"]).timestamp() for row in rows])
    lines = {}
    for name in CHECK_COLUMNS[4:]:
        lines[name] = _line(at_s, [float(row[name]) if row[name] else None for row in rows])
    axis_lines = [line for axis in AXES if (line := lines[f"error_{axis}_arcsec"]) is not None]
    if len(axis_lines) < len(AXES):
        return None
    mag = lines["signal_mag"] or (None, None)
    arcsec = {
        "arcsec": [change for change, _ in axis_lines],
        "sigma_arcsec": [sigma for _, sigma in axis_lines],
    }
    return {"checks": len(rows), **arcsec, "mag": mag[0], "sigma_mag": mag[1]}


def _line(at_s: FloatArray, values: list[float | None]) -> tuple[float, float | None] | None:
    """The change of values along a straight line from the first to the last time, and its
    standard error.
    """
    known = np.array([value is not None for value in values])
    if known.sum() < 2:
        return None
    t = at_s[known] - at_s[known].mean()
    y = np.array([value for value in values if value is not None])
    span = float(np.ptp(at_s))
    power = float(t @ t)
    if not power:
        return None
    slope = float(t @ y) / power
    residual = y - y.mean() - slope * t
    if len(y) > 2:
        sigma = math.sqrt(float(residual @ residual) / (len(y) - 2) / power) * span
    else:
        sigma = None
    return slope * span, sigma
