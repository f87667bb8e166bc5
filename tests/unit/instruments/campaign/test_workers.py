"""What the workers of a campaign are told and bring, and what becomes of a case that ends them."""

from __future__ import annotations

import contextlib
import resource
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

import hilstar
from hilstar.basics.errors import InputError
from hilstar.instruments.campaign import job
from hilstar.instruments.campaign.backlog import MAX_DEATHS, Backlog
from hilstar.instruments.campaign.job import (
    Answered,
    Identity,
    code_sha256,
    difference,
    files_sha256,
    identity_of,
    peak_bytes,
)
from hilstar.instruments.campaign.plan import parse_plan
from hilstar.instruments.campaign.pool import processes_within
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.store import Directory
from tests.support.campaigns import read_columns, write_campaign

CAMPAIGN = Identity("1.0", "a" * 64, "2.1", "1.14", "llvmpipe")
OTHER = Identity("1.1", "b" * 64, "2.2", "1.15", "GeForce")
# the largest part of memory that a process gains between two looks at its peak
GAINED = 0.01


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("hilstar", "has hilstar 1.1, and the campaign is of 1.0;"),
        (
            "code_sha256",
            f"code {'b' * 12} under the same version, and the campaign is of {'a' * 12};",
        ),
        ("numpy", "has NumPy 2.2, and the campaign is of 2.1;"),
        ("scipy", "has SciPy 1.15, and the campaign is of 1.14;"),
        ("gl_renderer", "has the renderer GeForce, and the campaign is of llvmpipe:"),
    ],
)
def test_a_worker_of_another_kind_is_told_what_it_has_and_what_the_campaign_is_of(
    name: str, words: str
) -> None:
    worker = msgspec.structs.replace(CAMPAIGN, **{name: getattr(OTHER, name)})
    told = difference(worker, CAMPAIGN)
    assert told is not None and words in told
    assert difference(CAMPAIGN, CAMPAIGN) is None
    assert str(difference(OTHER, CAMPAIGN)).startswith("has hilstar 1.1")


def test_a_process_s_peak_is_what_the_kernel_counts_in_bytes() -> None:
    kibibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert peak_bytes() == pytest.approx(1024 * kibibytes, rel=GAINED)


def test_code_is_another_with_any_file_or_place_of_python_or_a_shader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a copy: a module that is moved, one that changes, and a shader that does."""
    package, shaders = tmp_path / "hilstar", tmp_path / "shaders"
    for folder, names in ((package, ("__init__.py", "basics/units.py")), (shaders, ("star.vert",))):
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(name)
    monkeypatch.setattr(hilstar, "__file__", str(package / "__init__.py"))
    monkeypatch.setattr(job, "resource_path", tmp_path.joinpath)
    digests = []

    def digest() -> None:
        code_sha256.cache_clear()
        digests.append(code_sha256())

    digest()
    (package / "notes.txt").write_text("no code")
    digest()
    assert digests[0] == digests[1]
    (package / "basics/units.py").write_text("NS_PER_S = 1")
    digest()
    (package / "basics/units.py").rename(package / "units.py")
    digest()
    (shaders / "star.vert").write_text("another")
    digest()
    code_sha256.cache_clear()
    assert len(set(digests)) == 4


def test_a_campaign_is_of_the_bytes_of_each_file_that_its_plan_names(tmp_path: Path) -> None:
    """A log, two scenarios and a PSF: each counts by its bytes, and not by its name."""
    path = write_campaign(
        tmp_path,
        {"key": "scenario", "values": ["", "a.toml", "b.toml"]},
        attitudes={"kind": "log", "log": "log.csv"},
    )
    path.write_text(path.read_text() + '[centroids]\ncentroider = "psf"\npsf = "p.fits"\n')
    plan = parse_plan(path, path.read_text())
    names = ("log.csv", "a.toml", "b.toml", "p.fits")
    for name in names:
        (tmp_path / name).write_text(name)
    digests = [files_sha256(plan, tmp_path)]
    for name in names:
        (tmp_path / name).write_text("another")
        digests.append(files_sha256(plan, tmp_path))
    assert len(set(digests)) == 5


@pytest.mark.parametrize(
    ("memory", "fits"), [(300, 2), (299, 1), (200, 1), (10_000, 7), (801, 7), (799, 6)]
)
def test_workers_are_as_many_as_fit_beside_this_process(memory: int, fits: int) -> None:
    assert processes_within(memory, 100, 100, 7) == fits


def test_a_budget_in_which_no_worker_fits_is_told_the_least_that_does() -> None:
    with pytest.raises(InputError) as refused:
        processes_within(599_000_000, 200_000_000, 400_000_000, 7)
    assert str(refused.value) == (
        "--memory 599 MB: this process and one worker take 600 MB; write so much or more"
    )


class DyingWorkers:
    """Workers that die over one case, and bring no more than their number of the others."""

    task_s = 0.5

    def __init__(self, campaign: Campaign, deadly: int) -> None:
        self._job, self._deadly = campaign.job, deadly

    def run(self, backlog: Backlog, done: Any, lost: Any) -> None:
        session = Session(self._job)
        with contextlib.closing(session):
            while (task := backlog.take(1)) is not None:
                if task.begin <= self._deadly < task.begin + len(task):
                    lost(task, backlog.died(task))
                    continue
                answered = session.run(task.begin, task.points)
                backlog.done(task, 1e-6)  # so that a task has many cases
                done(task, Answered(answered.rows, 1e-6, answered.peak_bytes))


def test_a_case_that_ends_its_workers_is_a_failed_row_with_its_own_values(tmp_path: Path) -> None:
    vary = {"key": "tracker.psf_sigma_px", "minimum": 0.5, "maximum": 1.0}
    path = write_campaign(tmp_path, vary, cases=12)
    path.write_text(path.read_text() + "[planted]\nbias_arcsec = [1.0, 2.0, 3.0]\n")
    campaign = Campaign(tmp_path / "plan.toml", tmp_path / "out", "centroids", 1.0, False)
    counts: list[int] = []
    with contextlib.closing(Directory(tmp_path / "out")) as directory:
        campaign.run(directory, DyingWorkers(campaign, 7), counts.append)  # type: ignore[arg-type]
    rows = read_columns(tmp_path / "out" / "cases.parquet")
    assert rows["case"] == list(range(12))
    assert [case for case, status in enumerate(rows["status"]) if status == "failed"] == [7]
    assert rows["why"][7] == f"its worker died {MAX_DEATHS} times over it"
    sigma_px = 0.5 + 0.5 * campaign.design.points(0, 12)[:, -1]
    assert rows["vary.tracker.psf_sigma_px"] == pytest.approx(sigma_px.tolist())
    assert counts[0] == 0 and counts[-1] == 12 and sorted(counts) == counts
    about = pq.read_schema(tmp_path / "out" / "cases.parquet").metadata
    assert about[b"hilstar.solver"] == b"centroids"
    assert about[b"hilstar.bench_sha256"] == campaign.file.sha256.encode()
    plan = msgspec.json.decode(about[b"hilstar.plan"])
    assert plan["planted"]["bias_arcsec"] == [1.0, 2.0, 3.0]
    assert not {"columns", "require"} & set(plan)
    identity = msgspec.json.decode(about[b"hilstar.identity"])
    assert identity["numpy"] == np.__version__
    assert identity == msgspec.to_builtins(identity_of(identity["gl_renderer"]))
