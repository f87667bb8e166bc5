"""Where a page listens, as it is written, and which token lets somebody in."""

from __future__ import annotations

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
