"""The backlog: every missing case is handed out, a dead worker's once more and one by one, and
the one that kills is named.
"""

from __future__ import annotations

from pathlib import Path

from hilstar.instruments.campaign.backlog import MAX_DEATHS, Backlog
from hilstar.instruments.campaign.plan import Design
from hilstar.instruments.campaign.store import Journal


def backlog(folder: Path, cases: int, done: list[int]) -> Backlog:
    journal = Journal(folder / "journal", cases)
    journal.append([{"case": case} for case in done])
    return Backlog(Design("sobol", 1, cases, 3, []), journal, 1.0)


def test_all_missing_cases_are_handed_out_once_in_tasks_as_long_as_wanted(tmp_path: Path) -> None:
    this, seen, sizes = backlog(tmp_path, 500, [3, 4, 100]), [], []
    while (task := this.take(2)) is not None:
        seen += range(task.begin, task.begin + len(task))
        sizes.append(len(task))
        this.done(task, 0.1 * len(task))
    assert sorted(seen) == sorted(set(range(500)) - {3, 4, 100})
    assert max(sizes) == 10 and sizes[-1] == 1  # 1 s of 0.1 s, and shorter at the end
    assert this.to_run == 0


def test_a_thousand_workers_get_tasks_that_one_scheduler_keeps_up_with(tmp_path: Path) -> None:
    this = backlog(tmp_path, 16_000, [])
    this.done(this.take(1000), 0.001)  # type: ignore[arg-type]
    task = this.take(1000)
    # 16 000 / (4 x 1000): not the whole of 20 s, so that all end together
    assert task is not None and len(task) == 4


def test_the_case_that_kills_its_workers_is_named_and_the_others_are_run(tmp_path: Path) -> None:
    this, died, ran = backlog(tmp_path, 12, []), [], set()
    this.done(this.take(1), 0.3)  # type: ignore[arg-type]
    while (task := this.take(1)) is not None:
        if 7 in range(task.begin, task.begin + len(task)):
            died.append(this.died(task))
        else:
            ran |= set(range(task.begin, task.begin + len(task)))
            this.done(task, 0.3 * len(task))
    assert (
        died[-1] == 7
        and died[:-1] == [None] * (len(died) - 1)
        and MAX_DEATHS <= len(died) <= MAX_DEATHS + 1
    )
    assert ran == set(range(1, 12)) - {7} and this.to_run == 0


def test_a_task_is_as_long_as_cases_took_so_far_the_last_of_them_by_three_tenths(
    tmp_path: Path,
) -> None:
    """Cases of 1 s and of 0.5 s: 0.85 s, of which 17 s are 20; and 0.02 s for each of 1000 workers
    are longer than the second that is wanted.
    """
    this = Backlog(Design("sobol", 1, 4000, 3, []), Journal(tmp_path / "journal", 4000), 17.0)
    for case_s in (1.0, 0.5):
        task = this.take(1)
        assert task is not None
        this.done(task, case_s * len(task))
    task = this.take(1)
    assert task is not None and len(task) == 20
    this.give_back(task)
    assert this.take(1) is task  # nobody has begun it
    many = backlog(tmp_path / "many", 400_000, [])
    many.done(many.take(1000), 0.5)  # type: ignore[arg-type]
    task = many.take(1000)
    assert task is not None and len(task) == 40


def test_the_cases_of_a_dead_worker_come_again_at_their_own_points(tmp_path: Path) -> None:
    this = backlog(tmp_path, 40, [0, 1, 2, 9])
    this.done(this.take(1), 0.1)  # type: ignore[arg-type]
    task = this.take(1)
    assert task is not None and (task.begin, len(task)) == (4, 5)
    assert this.died(task) is None
    points = Design("sobol", 1, 40, 3, []).points(0, 40)
    for case in range(4, 9):
        again = this.take(1)
        assert again is not None and (again.begin, len(again)) == (case, 1)
        assert again.points[0].tolist() == points[case].tolist()
    after = this.take(1)
    assert after is not None and after.begin == 10
