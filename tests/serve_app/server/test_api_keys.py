"""API keys: valid files, refused starts, and access over every protocol."""

from __future__ import annotations

import hashlib
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus

from bundles import controlled
from rlservo.client.formats.addresses import is_loopback
from rlservo.errors import ForbiddenError, RequestError, UsageError
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.access_checks import OriginChecks, fold_headers
from rlservo.serve_app.server.api_keys import Keys, Role, check_exposure, new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import exchange, over_uvicorn
from stores import control_of, load_store
from streams import Stream

CELL, CELL_LINE = new_key("cell-7")
OTHER, OTHER_LINE = new_key("cell-8")
EXPLORER, EXPLORER_LINE = new_key("trainee", explore=True)
ADMIN, ADMIN_LINE = new_key("operator", admin=True)
OBS = [0.1] * 27
ACT = ("POST", "/v1/policies/ur5/act", {"obs": OBS})
INFER = (
    "POST",
    "/v2/models/ur5/infer",
    {"inputs": [{"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": OBS}]},
)

LIST = ("GET", "/v1/policies", None)
LOAD = ("POST", "/v2/repository/models/ur5/load", {})


def call(port: int, method: str, path: str, body: Any, **headers: str) -> tuple[int, dict[str, str], Any]:
    reply = exchange(port, method, path, body, **headers)
    return reply.status, reply.headers, reply.document


def stream(port: int, **headers: str) -> dict[str, Any]:
    """Connect and return the metadata."""
    with Stream(port, **headers) as connected:
        metadata: dict[str, Any] = connected.metadata
        return metadata


@pytest.fixture(scope="module")
def store(ur5: Path) -> PolicyStore:
    return load_store(ur5)


@pytest.fixture(scope="module")
def port(store: PolicyStore, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    file = tmp_path_factory.mktemp("keys") / "keys"
    file.write_text(f"# robots\n{CELL_LINE}\n\n{ADMIN_LINE}\n{EXPLORER_LINE}\n")
    settings = ServerSettings(api_keys_file=str(file), api_keys=OTHER_LINE)
    with over_uvicorn(create_app(control_of(store), settings)) as port:
        yield port


def test_a_key_is_never_kept_only_its_hash() -> None:
    assert CELL not in CELL_LINE and f"cell-7 act sha256:{hashlib.sha256(CELL.encode()).hexdigest()}" == CELL_LINE
    assert len(CELL) > 40 and CELL != OTHER
    keys = Keys.from_settings(ServerSettings(api_keys=f"{CELL_LINE}, {ADMIN_LINE},"))
    assert [(key.label, key.role) for key in keys.keys] == [("cell-7", Role.act), ("operator", Role.admin)]
    assert keys.find(ADMIN.encode()) == keys.keys[1]
    assert keys.find(b"") is keys.find(CELL[:-1].encode()) is keys.find(CELL_LINE.encode()) is None
    assert CELL_LINE not in repr(ServerSettings(api_keys=CELL_LINE))


@pytest.mark.parametrize("content", ["s3cret-key-in-clear", "cell act sha256:abc", "cell root sha256:" + "0" * 64])
def test_a_line_that_is_no_hash_is_named_by_place_and_not_shown(tmp_path: Path, content: str) -> None:
    file = tmp_path / "keys"
    file.write_text(f"# a comment\n{content}\n")
    with pytest.raises(UsageError, match="line 2: expected '<label> <act") as caught:
        Keys.from_settings(ServerSettings(api_keys_file=str(file)))
    assert content not in caught.value.message
    with pytest.raises(UsageError, match="entry 1 of RLSERVO_API_KEYS"):
        Keys.from_settings(ServerSettings(api_keys=content))


def test_a_key_file_that_is_missing_empty_or_open_to_all_refuses_the_start(tmp_path: Path) -> None:
    file = tmp_path / "keys"
    settings = ServerSettings(api_keys_file=str(file))
    with pytest.raises(UsageError, match="cannot be read"):
        Keys.from_settings(settings)
    file.write_text("# nothing yet\n")
    with pytest.raises(UsageError, match="hold no key and would leave the server open"):
        Keys.from_settings(settings)
    file.write_text(CELL_LINE)
    file.chmod(0o666)
    with pytest.raises(UsageError, match="is writable by every user"):
        Keys.from_settings(settings)
    with pytest.raises(UsageError, match="label"):
        new_key("two words")


def test_beyond_this_machine_a_server_wants_keys_or_an_explicit_word() -> None:
    for host in ("127.0.0.1", "localhost", "::1", "127.3.2.1"):
        assert is_loopback(host) and check_exposure(host, ServerSettings()).keys == ()
    for host in ("0.0.0.0", "::", "192.168.0.7", "robot.local"):
        assert not is_loopback(host)
        with pytest.raises(UsageError, match=r"without API keys .* RLSERVO_ALLOW_UNAUTHENTICATED=1"):
            check_exposure(host, ServerSettings())
        assert check_exposure(host, ServerSettings(allow_unauthenticated=True)).keys == ()
        assert len(check_exposure(host, ServerSettings(api_keys=CELL_LINE)).keys) == 1


@pytest.mark.parametrize("headers", [{}, {"authorization": "Bearer wrong"}, {"authorization": f"Basic {CELL}"}])
def test_without_a_known_key_every_protocol_answers_401_in_our_form(port: int, headers: dict[str, str]) -> None:
    for request in (ACT, INFER, LIST, LOAD, ("GET", "/metrics", None), ("GET", "/nowhere", None), ("GET", "/v2", None)):
        status, received, reply = call(port, *request, **headers)
        assert (status, reply["code"], received["www-authenticate"]) == (401, "unauthenticated", "Bearer"), request
        assert "error" in reply
    with pytest.raises(InvalidStatus) as caught:
        stream(port, **headers)
    assert caught.value.response.status_code == 401
    assert json.loads(caught.value.response.body or b"")["code"] == "unauthenticated"
    counted = call(port, "GET", "/metrics", None, authorization=f"Bearer {CELL}")[2].decode()
    for protocol in ("http", "websocket"):  # rejected keys are counted
        assert f'{{code="unauthenticated",policy="",protocol="{protocol}"' in counted


@pytest.mark.parametrize("key", [CELL, OTHER, ADMIN], ids=["cell", "other", "admin"])
def test_a_known_key_gets_through_however_it_is_sent(port: int, key: str) -> None:
    for headers in ({"authorization": f"Bearer {key}"}, {"authorization": f"api-key {key}"}, {"x_api_key": key}):
        for request in (ACT, INFER, LIST, ("GET", "/metrics", None)):
            assert call(port, *request, **headers)[0] == 200
        assert stream(port, **headers)["policy"] == "ur5"


EXPLORE = ("POST", ACT[1], {**ACT[2], "explore": True})
EXPLORE_OIP = ("POST", INFER[1], {**INFER[2], "parameters": {"explore": True}})


def test_only_a_key_that_says_so_explores_in_every_protocol(port: int, store: PolicyStore) -> None:
    def explores(key: str) -> bool:
        with Stream(port, authorization=f"Bearer {key}") as connected:
            return "actions" in connected.ask(obs=OBS, explore=True)

    for key, status in ((CELL, 403), (OTHER, 403), (EXPLORER, 200), (ADMIN, 200)):
        for request in (EXPLORE, EXPLORE_OIP):
            found, _, reply = call(port, *request, authorization=f"Bearer {key}")
            assert found == status, reply
            assert status == 200 or "may not request exploring actions" in reply["error"]
        assert explores(key) is (status == 200)
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as open_port:  # without keys all may
        assert call(open_port, *EXPLORE)[0] == 200


def test_probes_need_no_key(port: int) -> None:
    for path in ("/healthz", "/v2/health/live", "/v2/health/ready"):
        assert call(port, "GET", path, None)[0] == 200, path


def test_administration_wants_an_admin_key_even_where_no_key_is_asked_for(ur5: Path) -> None:
    with controlled(ur5) as control:
        lines = f"{CELL_LINE},{ADMIN_LINE},{EXPLORER_LINE}"
        with over_uvicorn(create_app(control, ServerSettings(api_keys=lines))) as port:
            status, _, reply = call(port, *LOAD, authorization=f"Bearer {CELL}")
            assert (status, reply["code"]) == (403, "forbidden") and "'cell-7'" in reply["error"]
            assert call(port, *LOAD, authorization=f"Bearer {EXPLORER}")[0] == 403
            assert call(port, *LOAD)[0] == call(port, *LOAD, authorization="Bearer wrong")[0] == 401
            assert call(port, *LOAD, authorization=f"Bearer {ADMIN}")[0] in (200, 409)
        with over_uvicorn(create_app(control, ServerSettings())) as open_port:
            assert call(open_port, *ACT)[0] == 200
            status, _, reply = call(open_port, *LOAD)
            assert status == 403 and "this server has none" in reply["error"]


def test_a_web_page_of_another_origin_opens_no_stream(store: PolicyStore) -> None:
    with over_uvicorn(create_app(control_of(store), ServerSettings())) as port:
        assert stream(port, origin=f"http://127.0.0.1:{port}")["policy"] == "ur5"
        for origin in ("http://evil.example", "null", "http://["):
            with pytest.raises(InvalidStatus) as caught:
                stream(port, origin=origin)
            assert caught.value.response.status_code == 403


def check(headers: list[tuple[bytes, bytes]], **settings: Any) -> None:
    """Check a request with these headers against a server on loopback that wants no key."""
    checks = OriginChecks("127.0.0.1", ServerSettings(**settings), keyed=False)
    checks.check({"type": "http", "method": "POST"}, fold_headers(headers))


@pytest.mark.parametrize(
    "page",
    [
        {b"origin": [b"http://evil.example", b"http://x"]},
        {b"origin": [b"http://x", b"http://x"]},
        {b"sec-fetch-site": [b"cross-site", b"none"]},
    ],
)
def test_a_page_that_says_twice_where_it_is_from_is_refused(page: dict[bytes, list[bytes]]) -> None:
    headers = [(b"host", b"x"), *((name, value) for name, values in page.items() for value in values)]
    with pytest.raises(ForbiddenError):
        check(headers, allowed_hosts="x")


def test_a_page_has_no_origin_where_the_request_has_no_host() -> None:
    with pytest.raises(ForbiddenError):
        check([(b"origin", b"http://")])


@pytest.mark.parametrize("hosts", [(b"127.0.0.1", b"127.0.0.1"), (b"127.0.0.1", b"evil.example")])
@pytest.mark.parametrize("allowed", ["", "*"])
def test_a_request_that_names_two_hosts_is_refused(hosts: tuple[bytes, bytes], allowed: str) -> None:
    with pytest.raises(RequestError, match="two Host headers"):
        check([(b"host", host) for host in hosts], allowed_hosts=allowed)


def asked_as(host: str, listening_on: str, *, keyed: bool = False, allowed: str = "") -> bool:
    return OriginChecks(listening_on, ServerSettings(allowed_hosts=allowed), keyed=keyed).permit(host.encode())


def test_a_server_answers_to_its_own_names_and_addresses() -> None:
    for host in ("localhost", "LOCALHOST:8000", "localhost.", "127.0.0.1:8000", "127.3.2.1", "[::1]", "[::1]:8000"):
        for listening_on in ("127.0.0.1", "::1", "0.0.0.0", "192.168.0.7"):
            assert asked_as(host, listening_on), (host, listening_on)
    for host in ("evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "", ":8000", "a b", "evil:x", "é"):
        for listening_on in ("127.0.0.1", "0.0.0.0", "robot.lan"):
            assert not asked_as(host, listening_on), (host, listening_on)
    # An address cannot lead elsewhere, as a name can; beyond this machine it may be one that we do not know of.
    assert not asked_as("10.1.2.3:8000", "127.0.0.1") and not asked_as("0.0.0.0:8000", "127.0.0.1")
    assert asked_as("10.1.2.3:8000", "0.0.0.0") and asked_as("[fe80::1]:8000", "::")
    assert asked_as(socket.gethostname(), "0.0.0.0") and asked_as(f"{socket.gethostname()}.local:8000", "0.0.0.0")
    assert asked_as("robot.lan:8000", "robot.lan")


def test_further_names_are_a_setting_and_keys_do_without() -> None:
    assert asked_as("robot-7.lan:8000", "127.0.0.1", allowed=" proxy.lan, Robot-7.lan")
    assert asked_as("evil.example", "127.0.0.1", allowed="*")
    assert asked_as("policies.default.svc:8000", "0.0.0.0", keyed=True)  # a page has no key, whatever name it is of
    assert not asked_as("other.example", "0.0.0.0", keyed=True, allowed="robot-7.lan")
    assert not asked_as("evil.example", "127.0.0.1", keyed=True)
    with pytest.raises(UsageError, match=r"RLSERVO_ALLOWED_HOSTS is not usable: expected names without scheme"):
        ServerSettings.from_environment(environment={"RLSERVO_ALLOWED_HOSTS": "http://robot-7.lan"})
