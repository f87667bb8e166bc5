"""`hilstar study`: in a process of its own, and what it refuses."""

from __future__ import annotations

from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here
from tests.support.pictures import assert_drawn, table


def test_the_thesis_s_outputs_are_drawn(tmp_path):
    result = run_hilstar("study", "outputs", "-o", tmp_path)
    assert result.returncode == 0, result.stderr
    for name, least in (("orion", 500), ("lyra", 100), ("rosetta", 50)):
        assert_drawn(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.fits").is_file()
        assert len(table(tmp_path / f"{name}.csv")) > least


def test_an_unwritable_directory_and_an_unknown_study_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert_refused(run_hilstar_here("study", "models", "-o", tmp_path / "file" / "x"), 2, "cannot be written")
    assert_refused(run_hilstar_here("study", "weather", "-o", tmp_path), 2, "weather")
    assert_refused(run_hilstar_here("study", "models"), 2, "-o")
