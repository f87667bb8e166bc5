"""Where a page listens, as it is written, and which token lets somebody in."""

from __future__ import annotations

import socket

import pytest

from hilstar.cli.options import with_values
from hilstar.server.console.listener import ListenAddress, PageListener, parse_address
from tests.support.refusals import refusal


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("127.0.0.1:0", ("127.0.0.1", 0)),
        ("", ("127.0.0.1", 8765)),
        ("9000", ("127.0.0.1", 9000)),
        (":9000", ("127.0.0.1", 9000)),
        ("0.0.0.0", ("0.0.0.0", 8765)),
        ("localhost:1", ("localhost", 1)),
        ("[::1]:9000", ("::1", 9000)),
        ("[::]", ("::", 8765)),
        ("::1", ("::1", 8765)),
        ("bench-7.lab:80", ("bench-7.lab", 80)),
    ],
)
def test_an_address_is_read_as_it_is_meant(text, wanted):
    assert parse_address(text) == ListenAddress(*wanted)


@pytest.mark.parametrize(("option", "port"), [("--console", 8765), ("--scpi", 5025)])
def test_an_address_without_a_port_has_its_option_s(option, port):
    for text in ("", "127.0.0.1", "127.0.0.1:"):
        assert parse_address(text, option) == ListenAddress("127.0.0.1", port)
    assert parse_address("9000", option).port == 9000


@pytest.mark.parametrize(
    "text",
    [
        "1.2.3.4:x",
        "1.2.3.4:65536",
        "a b:1",
        "[::1",
        "[::1]9",
        "1.2.3:4",
        "-x:1",
        "h:1:2",
        "\u0661:1",
    ],
)
def test_what_is_no_address_is_refused(text):
    assert "HOST:PORT" in refusal(parse_address, text)


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.0.4", False),
        ("bench.lab", False),
    ],
)
def test_loopback_is_told_from_elsewhere(host, loopback):
    assert ListenAddress(host, 1).is_loopback is loopback


def test_a_token_is_made_beyond_loopback_only_and_in_the_address_only_where_it_was_made():
    with PageListener(ListenAddress("127.0.0.1", 0)) as own:
        assert own.token == "" and "#" not in own.url
    with (
        PageListener(ListenAddress("0.0.0.0", 0)) as first,
        PageListener(ListenAddress("0.0.0.0", 0)) as second,
    ):
        assert first.token != second.token and len(first.token) >= 40
        assert (
            first.url.endswith(f":{first.port}/#token={first.token}") and "0.0.0.0" not in first.url
        )
    given = "a-token-that-was-given"
    with PageListener(ListenAddress("0.0.0.0", 0), given) as listener:
        assert listener.token == given and given not in listener.url


def test_console_may_stand_alone_before_other_words():
    usual = "127.0.0.1:8765"
    assert with_values(["serve", "b.toml", "--console"])[-1] == usual
    assert with_values(["serve", "--console", "b.toml", "--json"]) == [
        "serve",
        "--console",
        usual,
        "b.toml",
        "--json",
    ]
    for value in (
        "0.0.0.0:80",
        "8080",
        ":8080",
        "localhost",
        "[::1]:1",
        "10.0.0.1",
        "host.lab:99999",
    ):
        assert with_values(["serve", "--console", value]) == ["serve", "--console", value]


LOOPBACK = ListenAddress("127.0.0.1", 0)


@pytest.mark.parametrize("name", ["stars.lab", "stars.lab:8443", "a", "LAB-7"])
def test_a_proxy_s_name_is_one_as_browsers_have_it(name):
    with PageListener(LOOPBACK, names=(name,)) as listener:
        assert listener.names == (name,)


@pytest.mark.parametrize(
    "name", ["", "stars.lab/page", "http://stars.lab", "stars lab", "-x", "stars.lab:", "a..b"]
)
def test_what_browsers_have_as_no_name_is_refused(name):
    assert "--console-name" in refusal(lambda: PageListener(LOOPBACK, names=(name,)))


@pytest.mark.parametrize("token", ["short", "x" * 201, "has a space, is long", "a" * 20 + "\n"])
def test_a_token_that_needs_escapes_or_is_guessed_is_refused(token):
    assert "--token" in refusal(lambda: PageListener(LOOPBACK, token))


def test_a_port_that_is_taken_is_refused_and_a_page_s_own_name_is_in_lower_case():
    with PageListener(LOOPBACK) as first:
        taken = ListenAddress("127.0.0.1", first.port)
        assert "cannot listen there" in refusal(lambda: PageListener(taken))
        assert first.hosts == sorted({"localhost", "127.0.0.1", "[::1]"})
    with PageListener(ListenAddress("0.0.0.0", 0)) as listener:
        assert socket.gethostname().lower() in listener.hosts
        assert listener.hosts == [name.lower() for name in listener.hosts]
