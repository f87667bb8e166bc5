"""Temporary folders that a killed process left are deleted by the next one of the same user, and
nothing else is.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import threading

import pytest

from hilstar.basics.files import OWNER, clear_left, temporary_folder

KILLED = """
import os, signal
from hilstar.basics.files import temporary_folder
with temporary_folder("test") as folder:
    (folder / "deep").mkdir()
    (folder / "deep" / "file").write_text("x")
    print(folder, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """The machine's folder for temporary files."""
    path = tmp_path / "tmp"
    path.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(path))
    return path


def test_a_folder_goes_with_its_process_and_after_a_kill_with_the_next_one(place):
    environment = {**os.environ, "TMPDIR": str(place)}
    killed = subprocess.run(
        [sys.executable, "-c", KILLED],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    assert [str(path) for path in place.iterdir()] == [killed.stdout.strip()]
    with temporary_folder("test") as folder:
        assert [path.name for path in place.iterdir()] == [folder.name]
        assert folder.stat().st_mode & 0o777 == 0o700
        with temporary_folder("other"):  # the first one's owner lives
            assert folder.is_dir()
    assert not any(place.iterdir())


def test_no_link_is_followed_and_nothing_of_others_is_deleted(place, tmp_path):
    victim, mine = tmp_path / "victim", place / "hilstar-heads-pictures"
    for folder in (victim, mine):
        folder.mkdir()
        (folder / "file").write_text("kept")
    (victim / OWNER).touch()
    (place / "hilstar-heads-link").symlink_to(victim)
    linked_owner = place / "hilstar-heads-owner"
    linked_owner.mkdir()
    (linked_owner / OWNER).symlink_to(victim / "file")
    (place / "hilstar-heads-file").write_text("kept")
    inner = place / "hilstar-heads-dead"
    inner.mkdir()
    (inner / OWNER).touch()
    (inner / "away").symlink_to(victim)
    clear_left()
    assert not inner.exists()
    assert (victim / "file").read_text() == (mine / "file").read_text() == "kept"
    assert (
        linked_owner.is_dir()
        and (place / "hilstar-heads-file").exists()
        and (place / "hilstar-heads-link").is_symlink()
    )


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make another user's folder")
def test_another_user_s_folder_stays(place):
    theirs = place / "hilstar-heads-theirs"
    theirs.mkdir()
    (theirs / OWNER).touch()
    os.chown(theirs, 65534, 65534)
    clear_left()
    assert theirs.is_dir()


def test_a_folder_cleared_before_it_is_held_is_made_anew(place, monkeypatch):
    lock, cleared = fcntl.flock, []

    def late(descriptor: int, how: int) -> None:
        if how == fcntl.LOCK_EX and not cleared:
            cleared.extend(place.iterdir())
            clear_left()
        lock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with temporary_folder("test") as folder:
        assert cleared and not cleared[0].exists()
        assert folder.is_dir() and folder != cleared[0]


def test_many_at_once_clear_nobody_s_folder():
    wrong: list[object] = []

    def use() -> None:
        for _ in range(20):
            with temporary_folder("test") as folder:
                (folder / "file").write_text("x")
                clear_left()
                if not (folder / "file").exists():
                    wrong.append(folder)

    threads = [threading.Thread(target=use) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
