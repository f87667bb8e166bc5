"""What a run of heads that was killed left behind is cleared by the next one."""

from __future__ import annotations

import socket
import tempfile

from hilstar.run.heads.supervisor import FOLDER, SOCKET, clear_left


def test_only_a_folder_whose_socket_nobody_serves_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left, served, begun, other = (tmp_path / name for name in (f"{FOLDER}1", f"{FOLDER}2", f"{FOLDER}3", "mine"))
    for folder in (left, served, begun, other):
        folder.mkdir()
    with socket.socket(socket.AF_UNIX) as killed, socket.socket(socket.AF_UNIX) as alive:
        killed.bind(str(left / SOCKET))
        killed.close()  # its file stays
        alive.bind(str(served / SOCKET))
        alive.listen()
        clear_left()
    assert not left.exists()
    assert (served / SOCKET).exists() and begun.exists() and other.exists()
