"""CURVE keys: whose they are from the first byte on, and an allow-list that follows its
directory.
"""

from __future__ import annotations

import os
import stat
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import zmq.auth

from hilstar.attitude.wire.endpoint import Endpoint
from hilstar.attitude.wire.keys import (
    AllowList,
    CurveKeys,
    check_reach,
    load_public,
    load_secret,
    make_keys,
)
from hilstar.attitude.wire.zmq_links import ZmqSender
from tests.support.refusals import refusal
from tests.support.senders import free_port


def test_a_secret_key_is_its_owner_s_alone_before_anything_else_happens_to_it(
    tmp_path, monkeypatch
):
    """Seen at the moment when the file has just been written, by a user whose umask lets all
    read.
    """
    seen = []
    create = zmq.auth.create_certificates

    def spy(folder, name):
        paths = create(folder, name)
        seen.append(stat.S_IMODE(os.stat(paths[1]).st_mode))  # noqa: PTH116
        return paths

    monkeypatch.setattr(zmq.auth, "create_certificates", spy)
    before = os.umask(0o002)
    try:
        written = make_keys(tmp_path / "keys")
    finally:
        left = os.umask(before)
    assert left == 0o002
    assert seen == [0o600, 0o600]
    for path in written:
        assert path.exists()
        assert path.parent.stat().st_mode & 0o077 == 0
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == [
        "allowed_clients",
        "client.key",
        "client.key_secret",
        "server.key",
        "server.key_secret",
    ]


def test_a_client_in_an_allow_list_is_not_overwritten(tmp_path):
    allowed = tmp_path / "allowed_clients"
    allowed.mkdir()
    (allowed / "client.key").write_text("somebody's")
    assert "may be in use" in refusal(make_keys, tmp_path)
    assert (allowed / "client.key").read_text() == "somebody's"


def test_a_secret_key_that_others_can_read_is_remarked_on(tmp_path, caplog):
    make_keys(tmp_path)
    secret = tmp_path / "server.key_secret"
    load_secret(secret)
    assert caplog.text == ""
    secret.chmod(0o644)
    load_secret(secret)
    assert "chmod 600" in caplog.text
    assert str(secret) in caplog.text


def test_an_allow_list_follows_its_directory(tmp_path, caplog):
    make_keys(tmp_path / "a")
    make_keys(tmp_path / "b")
    first, second = (load_public(tmp_path / name / "client.key") for name in ("a", "b"))
    allowed = tmp_path / "a" / "allowed_clients"
    clients = AllowList(allowed)
    assert clients.callback("*", first)
    assert not clients.callback("*", second)
    (allowed / "second.key").write_bytes((tmp_path / "b" / "client.key").read_bytes())
    assert clients.callback("*", second)
    (allowed / "client.key").unlink()
    assert not clients.callback("*", first)
    (allowed / "broken.key").write_text("no key")
    assert clients.callback("*", second)
    assert "broken.key" in caplog.text
    for path in allowed.iterdir():
        path.unlink()
    assert not clients.callback("*", second)


HERE, THERE = Endpoint("tcp://127.0.0.1:1", loopback=True), Endpoint("tcp://10.0.0.1:1", False)
SECRET, SERVER, CLIENTS = Path("mine.key_secret"), Path("theirs.key"), Path("allowed")


@pytest.mark.parametrize(
    ("endpoint", "bind", "keys"),
    [
        (HERE, True, CurveKeys()),
        (THERE, True, CurveKeys(SECRET, None, CLIENTS)),
        (THERE, False, CurveKeys(SECRET, SERVER)),
    ],
)
def test_each_side_reaches_beyond_this_machine_with_its_own_keys(endpoint, bind, keys):
    check_reach(endpoint, "as written", bind=bind, keys=keys)


def test_who_binds_is_the_server_of_its_keys_and_who_connects_knows_the_server_s(tmp_path):
    make_keys(tmp_path)
    server = CurveKeys(tmp_path / "server.key_secret", None, tmp_path / "allowed_clients")
    client = CurveKeys(tmp_path / "client.key_secret", tmp_path / "server.key")
    configured = []
    for bind, keys in ((True, server), (False, client)):
        endpoint = f"tcp://127.0.0.1:{free_port()}"
        with closing(ZmqSender(endpoint, bind=bind, keys=keys)) as sender:
            made = SimpleNamespace(setsockopt=lambda option, value: None)
            sender._configure(made)
            configured.append(vars(made))
    of_server, of_client = configured
    assert of_server["curve_server"] is True and "curve_serverkey" not in of_server
    assert of_client["curve_serverkey"] == of_server["curve_publickey"]
    assert "curve_server" not in of_client
    assert of_client["curve_publickey"] != of_server["curve_publickey"]


def test_a_public_key_is_no_secret_one_and_no_text_is_a_key(tmp_path):
    make_keys(tmp_path)
    public, secret = load_secret(tmp_path / "server.key_secret")
    assert public == load_public(tmp_path / "server.key")
    assert secret != public
    line = refusal(load_secret, tmp_path / "server.key")
    assert line.startswith(f"{tmp_path / 'server.key'}: contains no secret key; ")
    (tmp_path / "text.key").write_text("not a key")
    assert "not a key file" in refusal(load_public, tmp_path / "text.key")
    short = (tmp_path / "server.key").read_text().replace(public.decode(), public.decode()[:35])
    (tmp_path / "short.key").write_text(short)
    assert "a key is 40 characters of Z85" in refusal(load_public, tmp_path / "short.key")
    assert "no such key file" in refusal(load_public, tmp_path / "none.key")


def test_a_secret_key_that_others_may_read_is_told(tmp_path, caplog):
    make_keys(tmp_path)
    path = tmp_path / "client.key_secret"
    load_secret(path)
    assert caplog.text == ""
    for mode in (0o640, 0o604):
        caplog.clear()
        path.chmod(mode)
        load_secret(path)
        assert f"readable by other users (mode {mode:03o}); run chmod 600" in caplog.text


def test_an_allow_list_without_a_key_is_refused(tmp_path):
    (tmp_path / "allowed").mkdir()
    (tmp_path / "allowed" / "notes.txt").write_text("keys come here")
    line = refusal(AllowList, tmp_path / "allowed")
    assert line.startswith(f"{tmp_path / 'allowed'}: allowed_clients contains no *.key file")
