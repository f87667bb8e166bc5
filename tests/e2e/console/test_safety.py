"""The page against who should not get in: other names, other sites, wrong tokens, huge and slow
requests, crowds.
"""

from __future__ import annotations

import contextlib
import json
import resource
import socket
import time
from pathlib import Path

import pytest

from hilstar.server.console.server.connections import MAX_CONNECTIONS
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.pages import PageAddress, children, live, page_of, raw
from tests.support.senders import free_port
from tests.support.servers import bound
from tests.support.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.e2e
JSON = {"Content-Type": "application/json"}
HOSTILE = (
    b"",
    b"GET /live HTTP/1.1\r\nHost: x\r\n",
    b"\xff" * 3000,
    b"POST /control/x HTTP/1.1\r\n",
)
TOKEN = "a-token-of-the-bench-in-room-7"


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """A run whose page is on loopback, without a token, and shows only."""
    with bound(tmp_path_factory.mktemp("local"), "--console", "127.0.0.1:0") as served:
        yield served, page_of(served)


@pytest.fixture(scope="module")
def open_run(tmp_path_factory):
    """A run whose page can be reached from elsewhere, and acts."""
    with bound(
        tmp_path_factory.mktemp("open"),
        "--console",
        "0.0.0.0:0",
        "--control",
        "--console-name",
        "Stars.lab",
    ) as served:
        yield served, page_of(served)


def status_of(page: PageAddress, path: str = "/state", **headers: str) -> int:
    return page.ask(
        path, headers={name.replace("_", "-"): value for name, value in headers.items()}
    )[0]


def test_every_answer_has_a_strict_policy_and_is_kept_nowhere(local):
    _, page = local
    for path in (
        "/",
        "/static/main.js",
        "/static/page.css",
        "/health",
        "/metrics",
        "/state",
        "/sky",
        "/none",
        "/static/../x",
    ):
        _, headers, _ = page.ask(path)
        assert (
            headers["cache-control"] == "no-store"
            and headers["x-content-type-options"] == "nosniff"
        )
        policy = headers["content-security-policy"]
        assert (
            policy.startswith("default-src 'none'; script-src 'self'; ") and "unsafe" not in policy
        )
        assert "frame-ancestors 'none'" in policy and "server" not in headers


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:{port}",
        "127.0.0.1.evil.example:{port}",
        "192.168.7.7:{port}",
        "",
    ],
)
def test_another_name_is_not_this_page(local, host):
    _, page = local
    for path in ("/", "/health", "/state"):
        assert status_of(page, path, Host=host.format(port=page.port)) == 421
    with (
        pytest.raises(ConnectionRefusedError, match="421"),
        live(page, {"Host": host.format(port=page.port) or "x"}),
    ):
        pass


def test_a_tunnel_s_port_and_localhost_are_this_machine(local):
    _, page = local
    for host in ("localhost", f"localhost:{page.port}", "localhost:9000", f"[::1]:{page.port}"):
        assert status_of(page, Host=host) == 200


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "http://127.0.0.1:1", "http://localhost:{port}", "file://"],
)
def test_another_site_s_page_may_not_ask(local, origin):
    _, page = local
    origin = origin.format(port=page.port)
    assert status_of(page, Origin=origin) == 403
    assert page.ask("/control/blank", "POST", "{}", JSON | {"Origin": origin})[0] == 403
    with pytest.raises(ConnectionRefusedError, match="403"), live(page, {"Origin": origin}):
        pass
    assert status_of(page, Origin=f"http://127.0.0.1:{page.port}") == 200
    assert status_of(page, Sec_Fetch_Site="cross-site") == 403


def test_without_control_it_only_shows(local):
    _, page = local
    assert page.json("/state")["hello"]["control"] is False
    for name in ("blank", "pause", "patch", "crosshair", "grid", "ledger", "mark", "fault"):
        status, _, data = page.ask(f"/control/{name}", "POST", '{"on": true, "text": "x"}', JSON)
        assert status == 403 and "--control" in json.loads(data)["error"]
    assert not any(page.json("/state")["state"]["operator"].values())


def test_a_control_is_a_post_of_a_little_json(open_run):
    _, page = open_run
    ask = page.ask
    assert ask("/control/blank")[0] == 405
    assert ask("/control/none", "POST", "{}", JSON)[0] == 404
    assert ask("/health", "POST", "{}", JSON)[0] == 405
    assert (
        ask(
            "/control/blank", "POST", "on=1", {"Content-Type": "application/x-www-form-urlencoded"}
        )[0]
        == 415
    )
    assert ask("/control/blank", "POST", "on=1", {"Content-Type": "text/plain"})[0] == 415
    for body in (
        "{",
        "[]",
        '{"on": "yes"}',
        "\xff".encode("latin-1"),
        b'{"text": "\xff"}',
        b'{"\xff": 1}',
        '{"on": 1e999}',
        '{"onn": false}',
    ):
        assert ask("/control/blank", "POST", body, JSON)[0] == 400, body
    assert ask("/control/mark", "POST", '{"text": "  "}', JSON)[0] == 400
    # never the nearest in silence
    assert ask("/control/patch", "POST", '{"level": 0.33}', JSON)[0] == 400
    assert ask("/control/fault", "POST", '{"name": "x"}', JSON)[0] == 409
    assert not any(page.json("/state")["state"]["operator"].values())


def test_a_huge_body_is_refused_and_the_page_goes_on(open_run):
    _, page = open_run
    for size in (4_001, 5_000_000):
        assert (
            page.ask("/control/mark", "POST", b'{"text": "' + b"x" * size + b'"}', JSON)[0] == 413
        )
    head = (
        f"POST /control/mark HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\nAuthorization: Bearer"
        f" {page.token}\r\n"
    )
    head += "Content-Type: application/json\r\n"
    asked = raw(
        page.port, (head + "Content-Length: 99999999999\r\nExpect: 100-continue\r\n\r\n").encode()
    )
    assert asked.startswith(b"HTTP/1.1 413 ")
    chunk = b"%x\r\n%s\r\n" % (1 << 16, b"y" * (1 << 16))
    assert raw(
        page.port,
        (head + "Transfer-Encoding: chunked\r\n\r\n").encode() + 40 * chunk + b"0\r\n\r\n",
        3.0,
    ).startswith(b"HTTP/1.1 413 ")
    assert page.ask("/health")[0] == 503


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"\x00" * 5000,
        b"GET /" + b"a" * 100_000,
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x16\x03\x01",
    ],
)
def test_what_is_no_request_is_refused_or_closed(local, request_bytes):
    _, page = local
    answer = raw(page.port, request_bytes)
    assert answer == b"" or answer.split()[1] in {b"400", b"421"}
    assert page.ask("/state")[0] == 200


def test_a_request_that_comes_slowly_is_dropped(local):
    _, page = local
    begun_s = time.monotonic()
    with (
        socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S) as slow,
        contextlib.suppress(OSError),
    ):
        while time.monotonic() - begun_s < PATIENCE_S:
            slow.sendall(b"G" if time.monotonic() - begun_s < 0.5 else b"E")
            slow.settimeout(0.5)
            with contextlib.suppress(TimeoutError):
                if not slow.recv(1):
                    break
    assert time.monotonic() - begun_s < PATIENCE_S  # the head has 5 s


def test_beyond_loopback_a_token_is_made_and_needed(open_run):
    served, page = open_run
    assert len(page.token) >= 40
    # the address to open, and nowhere else
    assert sum(page.token in line for line in served.lines) == 1
    for given in (
        "",
        "Bearer",
        "Bearer wrong",
        f"Bearer {page.token}x",
        f"Basic {page.token}",
        f"Bearer {page.token[:-1]}",
    ):
        for path in ("/state", "/health", "/metrics", "/sky"):
            assert page.ask(path, headers={"Authorization": given})[0] == 401
        assert (
            page.ask("/control/blank", "POST", '{"on": true}', JSON | {"Authorization": given})[0]
            == 401
        )
    for token in ("wrong", "0" * len(page.token)):
        with pytest.raises(ConnectionRefusedError, match="401"), live(page, token=token):
            pass
    assert page.ask("/state?token=" + page.token, headers={"Authorization": ""})[0] == 401
    assert page.ask("/", headers={"Authorization": ""})[0] == 200  # the page itself has no secret
    assert page.ask("/state")[0] == 200
    with live(page) as link:
        assert "hello" in link.await_message(lambda said: True)


def test_beyond_loopback_it_has_numbers_and_its_own_names_for_its_name(open_run):
    _, page = open_run
    for host in (
        f"10.1.2.3:{page.port}",
        f"[fe80::1]:{page.port}",
        "stars.lab",
        "STARS.LAB:443",
        f"stars.lab:{page.port}",
    ):
        assert status_of(page, Host=host) == 200, host
    for host in ("evil.example", f"stars.lab.evil.example:{page.port}", "10.1.2.3:1"):
        assert status_of(page, Host=host) == 421, host
    assert status_of(page, Host="stars.lab", Origin="https://stars.lab") == 200
    assert status_of(page, Host="stars.lab", Origin="https://evil.example") == 403


def missed_and_frames(page: PageAddress) -> tuple[int, int]:
    counts = page.json("/state")["state"]["counts"]
    return counts["missed"], counts["frames"]


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def test_two_hundred_idle_and_hostile_connections_leave_room_for_the_operator(local):
    """And frames go on; what they cost is measured by tests/benchmarks/bench_console.py."""
    _, page = local
    with contextlib.ExitStack() as stack:
        for k in range(200):
            connection = stack.enter_context(
                socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S)
            )
            with contextlib.suppress(OSError):
                connection.sendall(
                    (
                        b"",
                        b"GET /live HTTP/1.1\r\nHost: x\r\n",
                        b"\xff" * 3000,
                        b"POST /control/x HTTP/1.1\r\n",
                    )[k % 4]
                )
        _, frames = missed_and_frames(page)
        with live(page) as link:
            link.want(picture=True, hz=10)
            link.await_message(lambda said: isinstance(said, bytes))
        wait_for(lambda: missed_and_frames(page)[1] > frames + 30)


def test_connections_that_stay_after_their_answer_are_bounded(local):
    """They give way before one that waits for its own: descriptors do not run out."""
    served, page = local
    (pid,) = children(served.process.pid, "hilstar.server.console.server")
    with contextlib.ExitStack() as stack:
        for _ in range(300):
            connection = stack.enter_context(
                socket.create_connection(("127.0.0.1", page.port), timeout=10)
            )
            connection.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
            assert connection.recv(12) == b"HTTP/1.1 200"
        assert len(list(Path(f"/proc/{pid}/fd").iterdir())) < 2 * MAX_CONNECTIONS
        assert status_of(page) == 200


def test_forty_pages_that_ask_for_nothing_make_room_for_one_that_does(local):
    _, page = local
    with contextlib.ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(live(page))
        with live(page, {"Origin": f"http://127.0.0.1:{page.port}"}) as link:
            link.want(picture=True, hz=10)
            link.await_message(lambda said: isinstance(said, bytes))


def hz(text: str) -> str:
    return f'{{"want": {{"picture": true, "hz": {text}}}}}'


HZ = (
    '"fast"',
    "-1",
    "0",
    "-0.0",
    "-5e-324",
    "1e999",
    "NaN",
    "Infinity",
    "null",
    "true",
    "[8]",
    "9" * 3000,
)
NONSENSE = [
    "nonsense",
    "{}",
    "",
    "null",
    '{"want": null}',
    '{"want": []}',
    '{"want": {"picture": 1}}',
    '{"want": {"grid": ""}}',
]
DEEP = [
    "[" * 3900,
    '{"want": {"x": ' + "[" * 3900,
    '{"want": {"picture": "' + "x" * 3000 + '"}}',
    "x" * 10_000,
]


@pytest.mark.parametrize("text", [*NONSENSE, *map(hz, HZ), *DEEP], ids=lambda text: text[:45])
def test_a_page_that_says_nonsense_is_closed_and_the_page_s_process_stays(local, text):
    served, page = local
    before = children(served.process.pid, "hilstar.server.console.server")
    with live(page) as link:
        link.say(text)
        with contextlib.suppress(OSError):
            for _ in link.messages():
                pass  # until it is closed
    assert page.ask("/health")[0] in {200, 503}
    assert children(served.process.pid, "hilstar.server.console.server") == before


@pytest.mark.parametrize(
    "text", ["5e-324", "1e-300", "0.001", "1e308", "123456789012345678901234567890"]
)
def test_a_wish_beyond_bounds_is_one_within_them(local, text):
    served, page = local
    before = children(served.process.pid, "hilstar.server.console.server")
    with live(page) as link:
        link.say(hz(text))
        for _ in range(5):
            link.await_message(lambda said: "state" in said if isinstance(said, dict) else False)
    assert children(served.process.pid, "hilstar.server.console.server") == before


def test_pages_that_do_not_read_never_lock_the_operator_out(local):
    """More of them than there are places, as browsers' pages with wishes: each that comes later
    has a place all the same. tests/unit/server/console/test_page_server.py holds that they end.
    """
    served, page = local
    own = {"Origin": f"http://127.0.0.1:{page.port}"}
    before = children(served.process.pid, "hilstar.server.console.server")
    with contextlib.ExitStack() as stack:
        deaf = [stack.enter_context(live(page, own)) for _ in range(40)]
        for each in deaf[-32:]:
            each.want(picture=True, hz=10)
        with live(page, own) as link:
            link.want(picture=True, hz=10)
            link.await_message(lambda said: isinstance(said, bytes))
            for each in [stack.enter_context(live(page, own)) for _ in range(40)]:
                each.want(picture=True, hz=10)
            link.await_message(lambda said: isinstance(said, bytes))
    assert children(served.process.pid, "hilstar.server.console.server") == before


def test_a_page_that_reads_gives_way_before_the_operator_is_refused(local):
    _, page = local
    with contextlib.ExitStack() as stack:
        for _ in range(33):
            link = stack.enter_context(live(page, {"Origin": f"http://127.0.0.1:{page.port}"}))
            link.want(picture=False)
            link.await_message(lambda said: "state" in said)
        link.await_message(lambda said: "history" not in said)


def test_pings_whose_answers_are_not_read_take_little_memory(local):
    served, page = local
    (pid,) = children(served.process.pid, "hilstar.server.console.server")
    before_mb = resident_mb(pid)
    with live(page) as link, contextlib.suppress(OSError):
        link.flood(b"\x89\xfd\0\0\0\0" + b"x" * 125, 200_000)
    assert resident_mb(pid) < before_mb + 20


def test_a_given_token_is_never_printed(tmp_path, monkeypatch):
    monkeypatch.setenv("HILSTAR_TOKEN", TOKEN)
    with bound(tmp_path, "--console", "127.0.0.1:0") as served:
        found = page_of(served)
        page = PageAddress(found.host, found.port, TOKEN)
        assert page.ask("/state")[0] == 200
        assert page.ask("/state", headers={"Authorization": "Bearer no"})[0] == 401
    assert not any(TOKEN in line for line in served.lines)


def test_what_cannot_be_is_refused_in_one_line():
    port = free_port()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        for options, words in (
            (("--console", f"127.0.0.1:{port}"), ("cannot listen", str(port))),
            (("--console", "127.0.0.1:99999"), ("127.0.0.1:99999", "HOST:PORT")),
            (("--console=evil host:1",), ("HOST:PORT",)),
            (("--console", "127.0.0.1:0", "--token", "short"), ("--token", "16")),
            (("--console", "127.0.0.1:0", "--console-name", "a b"), ("--console-name",)),
            (("--control",), ("--control", "--console")),
        ):
            assert_refused(
                run_hilstar_here("serve", "configs/demo.toml", "--headless", *options), 2, *words
            )
