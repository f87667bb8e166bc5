"""What serve and replay have open while they show a bench: ledger, faults, the tracker's answers,
the feed of frames and the pulse, and the outlet of their frames.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace as replaced

from hilstar.basics.files import MCAP, check_ending
from hilstar.basics.notices import Notices
from hilstar.cli import running
from hilstar.cli.options import check_files, parse_split
from hilstar.cli.running import DisplayOptions, RunOptions
from hilstar.server.console.run_status import RunSource, RunStatus, on_terminal

if TYPE_CHECKING:
    from hilstar.attitude.wire.links import Pictures
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.bench.frame import Bench
    from hilstar.server.bench.scenario import Scenario
    from hilstar.server.console.listener import PageListener
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.faults import AnyFaults, Recording
    from hilstar.server.frame_feed import FrameFeed
    from hilstar.server.frame_pulse import FramePulse
    from hilstar.server.live_answers import LiveAnswers
    from hilstar.server.pacer import FrameSink
    from hilstar.server.record.ledger import LedgerSwitch, SplitLimits
    from hilstar.server.serve import Outlet
    from hilstar.server.summary import RunSummary


@dataclass(frozen=True)
class RunFiles:
    """The files of a run, checked: its ledger with what splits it, and its scenario; None for
    none.
    """

    ledger: Path | None
    split: "SplitLimits"
    scenario: "Scenario | None"


def run_files(
    options: RunOptions,
    file: "BenchFile",
    inputs: Sequence[Path | None] = (),
    outputs: Sequence[Path | None] = (),
) -> RunFiles:
    """The files that a run's options name, beside the command's own `inputs` and `outputs`. Raises
    InputError for what cannot be read, and for a file that is written and read, or is there.
    """
    ledger = running.dated_ledger(options.ledger)
    check_ending("--ledger", ledger, MCAP)
    scenario = running.optional_scenario(options.scenario)
    check_files([*inputs, options.scenario], outputs, file, ledger, options.overwrite)
    return RunFiles(ledger, parse_split(options.ledger_split), scenario)


@dataclass(frozen=True)
class Followers:
    """Who follows a run beside its terminal: a sink of its frames, and the listening sockets of
    page and SCPI. The page may act with `control`.
    """

    record: "FrameSink | None" = None
    page: "PageListener | None" = None
    control: bool = False
    scpi: "PageListener | None" = None


@dataclass(frozen=True)
class ShownRun:
    """A run that shows a bench; None stands for each part that its options and its bench file do
    not ask for.
    """

    bench: "Bench"
    screen: Any
    options: RunOptions
    notices: Notices
    ledger: "LedgerSwitch"
    split: "SplitLimits"
    faults: "AnyFaults | None"
    answers: "LiveAnswers | None"
    frames: "FrameFeed | None"
    pulse: "FramePulse | None"

    def effort(self) -> dict[str, dict[str, Any]]:
        """What the run models, as its summary has it.

        To be asked before the run: what would do takes seconds, and a run that is stopped ends at
        once.
        """
        return running.effort_of_run(self.bench, self.options.explain, self.options.as_json)

    @contextmanager
    def outlet(
        self,
        description: "RunDescription",
        source_line: str,
        frame_count: float,
        followers: Followers,
        pictures: "Pictures | None" = None,
    ) -> "Iterator[tuple[FrameSink, Outlet]]":
        """The sink and the outlet of the run's frames, while its status is on the terminal, its
        page is served and all others follow it.
        """
        from hilstar.server.serve import Outlet

        source = RunSource(
            source_line,
            self.bench.renderer.gl_renderer,
            self.bench.config.monitor.refresh_hz,
            frame_count,
            running.forced_on(self.screen),
        )
        status = RunStatus(source, self.ledger)
        parts = running.page_parts(
            self.bench,
            self.notices,
            self.ledger,
            self.screen,
            self.faults,
            self.answers,
            split=self.split,
        )
        with (
            on_terminal(status),
            running.followed(
                followers.page,
                followers.control,
                description,
                parts,
                status,
                followers.record,
                self.frames,
                followers.scpi,
            ) as (sink, follower, requests),
        ):
            outlet = Outlet(
                self.screen,
                self.ledger,
                self.notices,
                pictures,
                follower,
                requests,
                self.faults,
                self.pulse,
                self.answers,
            )
            yield sink, outlet

    def end(self, summary: "RunSummary") -> None:
        """Print the summary, once the ledger is closed; see `running.end_of_run`."""
        options = self.options
        ledger = self.ledger
        if ledger.last is not None:
            summary = replaced(summary, ledger=ledger.last.summary())
        gone = None if self.screen is None else self.screen.window.gone
        running.end_of_run(
            summary, gone, ledger.failure, self.notices, options.as_json, options.strict
        )


@contextmanager
def shown_run(
    bench: "Bench",
    screen: Any,
    options: RunOptions,
    display: DisplayOptions,
    notices: Notices,
    files: RunFiles,
    pulse: "FramePulse | None",
    recording: "Recording | None" = None,
) -> Iterator[ShownRun]:
    """The run of an open bench, as its options and its bench file ask for it. Raises InputError for
    what cannot be opened.

    `recording` is of the run that is replayed.
    """
    split = files.split
    with (
        running.optional_ledger(files.ledger, bench, notices, options.overwrite, split) as switch,
        running.run_with_faults(bench, files.scenario, notices, switch, recording) as faults,
        running.optional_answers(bench, notices, switch, screen) as answers,
        running.optional_frames(display.feed, bench, screen) as frames,
    ):
        yield ShownRun(
            bench, screen, options, notices, switch, split, faults, answers, frames, pulse
        )
