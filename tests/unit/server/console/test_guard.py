"""Who may ask the operator's page: its own names, its own origin and the right token, each in a
table of headers, without a server; and what its metrics say of a tracker.
"""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console.protocol import TOKEN_PROTOCOL
from hilstar.server.console.server.app import Guard, Refused, tracker_metrics


def guard(*, any_address: bool = False, port: int = 8000, token: str = "") -> Guard:
    """The guard of a page at 192.168.1.5 that is also named bench.lab and, by a proxy, sky:9000."""
    return Guard(
        SimpleNamespace(
            hosts=["192.168.1.5", "[fe80::1]"],
            names=["bench.lab", "sky:9000"],
            any_address=any_address,
            port=port,
            token=token,
        )
    )


def is_let_in(check, *args) -> bool:
    """Whether a check refuses nothing."""
    try:
        check(*args)
    except Refused:
        return False
    return True


@pytest.mark.parametrize(
    ("host", "is_own"),
    [
        ("192.168.1.5:8000", True),
        ("192.168.1.5", False),  # of port 80
        ("192.168.1.5:8001", False),
        ("[fe80::1]:8000", True),
        ("[fe80::1]x:8000", False),
        ("192.168.1.6:8000", False),
        # a tunnel has any port
        ("localhost:4242", True),
        ("LOCALHOST", True),
        ("127.0.0.1:1", True),
        ("[::1]:7", True),
        ("localhost:", False),
        ("localhost:80x", False),
        ("localhost.evil.example:8000", False),
        ("bench.lab", True),
        ("Bench.Lab:8000", True),
        ("bench.lab:443", True),
        ("bench.lab:8001", False),
        ("sky:9000", True),
        ("sky", False),
        ("sky:8000", False),
        ("evil.example:8000", False),
        ("", False),
    ],
)
def test_a_page_answers_to_its_own_names_alone(host, is_own):
    assert is_let_in(guard().check_host, host) is is_own


@pytest.mark.parametrize(
    ("host", "any_address", "is_own"),
    [
        ("10.9.8.7:8000", True, True),
        ("10.9.8.7:8000", False, False),
        ("[2001:db8::7]:8000", True, True),
        ("10.9.8.7:8001", True, False),
        # a name may be pointed at this machine by anybody
        ("evil.example:8000", True, False),
    ],
)
def test_a_page_on_every_address_answers_to_any_address_and_no_name(host, any_address, is_own):
    assert is_let_in(guard(any_address=any_address).check_host, host) is is_own


def test_port_80_may_be_left_out():
    assert is_let_in(guard(port=80).check_host, "192.168.1.5")


@pytest.mark.parametrize(
    ("headers", "may_ask"),
    [
        ({}, True),
        ({"origin": "http://bench.lab:8000"}, True),
        ({"origin": "HTTPS://bench.lab:8000"}, True),
        ({"origin": "http://bench.lab"}, False),
        ({"origin": "http://evil.example"}, False),
        ({"origin": "null"}, False),
        ({"origin": "ftp://bench.lab:8000"}, False),
        ({"sec-fetch-site": "same-origin"}, True),
        ({"sec-fetch-site": "none"}, True),
        ({"sec-fetch-site": "cross-site"}, False),
        ({"sec-fetch-site": "same-site"}, False),
        # a link on another page may lead here
        ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, True),
        ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, False),
    ],
)
def test_another_site_s_page_may_not_ask(headers, may_ask):
    asked = {"host": "Bench.Lab:8000", **headers}
    assert is_let_in(guard().check_origin, asked) is may_ask


@pytest.mark.parametrize(
    ("authorization", "protocols", "may_see"),
    [
        ("Bearer secret", (), True),
        ("bearer  secret ", (), True),
        ("Basic secret", (), False),
        ("Bearer secre", (), False),
        ("Bearer secrets", (), False),
        ("Bearer", (), False),
        ("", (), False),
        ("", ("hilstar", f"{TOKEN_PROTOCOL}secret"), True),
        ("", ("hilstar", f"{TOKEN_PROTOCOL}wrong"), False),
        ("", ("secret",), False),
        ("Bearer wrong", (f"{TOKEN_PROTOCOL}secret",), True),
    ],
)
def test_a_token_is_the_whole_one_in_a_header_or_a_subprotocol(authorization, protocols, may_see):
    headers = {"authorization": authorization} if authorization else {}
    assert is_let_in(guard(token="secret").check_token, headers, protocols) is may_see
    assert is_let_in(guard().check_token, headers, protocols)


def test_a_tracker_s_metrics_are_its_figures_by_axis_and_verdict():
    figures = TrackerFigures(
        right=7,
        refused={"crc": 2},
        residual_arcsec=[1.0, -2.0, 30.0],
        rms_arcsec=None,
        silent="no answer for 2 s",
    )
    values = {}
    for metric in tracker_metrics(figures):
        for sample in metric.samples:
            values[(sample.name, *sample.labels.values())] = sample.value
    for axis, arcsec in zip("xyz", (1.0, -2.0, 30.0), strict=True):
        assert values["hilstar_tracker_residual_arcsec", axis] == arcsec
    assert values["hilstar_tracker_answers_total", "right"] == 7
    assert values["hilstar_tracker_refused_total", "crc"] == 2
    assert values["hilstar_tracker_silent",] == 1.0
    assert values["hilstar_tracker_trouble",] == 0.0
    assert ("hilstar_tracker_residual_rms_arcsec", "x") not in values
