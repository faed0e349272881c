"""The client's path to a server on another machine: proxies of the environment, and TLS."""

from __future__ import annotations

import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from rlservo.client.http_transport import Transport
from rlservo.errors import UnavailableError, UsageError

REPLY = b'HTTP/1.1 200 OK\r\ncontent-length: 11\r\nconnection: close\r\n\r\n{"ok":true}'


class Server:
    """Answers every connection's request in the same way, and keeps what was asked."""

    def __init__(self, context: ssl.SSLContext | None = None, reply: bytes = REPLY) -> None:
        self.reply = reply
        self.asked: list[bytes] = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self.listener.getsockname()[1]
        self._context = context
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            try:
                with connection if self._context is None else self._context.wrap_socket(connection, True) as one:
                    asked = b""
                    while b"\r\n\r\n" not in asked and (more := one.recv(65536)):
                        asked += more
                    self.asked.append(asked)
                    one.sendall(self.reply)
            except OSError:  # a client that does not trust the certificate
                connection.close()


@pytest.fixture
def proxy() -> Iterator[Server]:
    server = Server()
    with closing(server.listener):
        yield server


def test_a_proxy_of_the_environment_is_asked_with_its_password(proxy: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", f"http://robot:p%40ss@127.0.0.1:{proxy.port}")
    monkeypatch.delenv("no_proxy", raising=False)
    with closing(Transport("http://policies.example:8000/cell", timeout_s=10, retries=0, api_key="k")) as transport:
        assert transport.get("v1", "a b") == {"ok": True}
    (asked,) = proxy.asked
    head, *headers = asked.decode().lower().split("\r\n")
    assert head == "get http://policies.example:8000/cell/v1/a%20b http/1.1"
    assert "host: policies.example:8000" in headers and "authorization: api-key k" in headers
    assert "proxy-authorization: basic cm9ib3q6cebzcw==" in headers  # robot:p@ss, in lower case


def test_a_proxy_that_is_none_is_refused_without_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "gopher://robot:secret@proxy:70")
    with pytest.raises(
        UsageError, match=r"has the scheme 'gopher': expected an address such as 'http://proxy:3128'"
    ) as refusal:
        Transport("http://policies.example", timeout_s=10, retries=0)
    assert "secret" not in str(refusal.value)


def test_the_port_and_brackets_of_an_address_are_in_the_host_header(proxy: Server) -> None:
    with closing(Transport(f"http://127.0.0.1:{proxy.port}", timeout_s=10, retries=0)) as transport:
        transport.post("v1", document={})
    assert f"\r\nhost: 127.0.0.1:{proxy.port}\r\n".encode() in proxy.asked[0].lower()
    assert b"\r\ncontent-length: 2\r\n" in proxy.asked[0].lower()


@pytest.mark.parametrize("url", ["http://a..b:8000", "http://" + "x" * 64])
def test_a_name_that_no_wire_can_carry_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match="is not a server address"):
        Transport(url, timeout_s=1, retries=0)


def test_tls_is_checked_against_what_the_environment_trusts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("there is no openssl to make a certificate with")
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate,
         "-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server = Server(context)
    with closing(server.listener):
        url = f"https://127.0.0.1:{server.port}"
        monkeypatch.delenv("SSL_CERT_FILE", raising=False)
        with closing(Transport(url, timeout_s=20, retries=0)) as transport, pytest.raises(UnavailableError):
            transport.get("v1")
        assert server.asked == []
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with closing(Transport(url, timeout_s=20, retries=0)) as transport:
            assert transport.get("v1") == {"ok": True}


@pytest.mark.parametrize(
    ("reply", "sentence"),
    [
        (b"SSH-2.0-OpenSSH_9.2\r\n", "is it an rlservo server"),
        (b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\ntransfer-encoding: chunked\r\n\r\n{}", "is it an rlservo server"),
        (b"HTTP/1.1 200 OK\r\nx: " + b"a" * 300_000, "more than 131072 bytes besides its body"),
        (b"HTTP/1.1 200 OK\r\ncontent-length: 9\r\n\r\n{}", "closed it before the answer was complete"),
    ],
)
def test_an_answer_that_is_not_whole_http_is_refused_in_a_sentence(reply: bytes, sentence: str) -> None:
    server = Server(reply=reply)
    one = Transport(f"http://127.0.0.1:{server.port}", timeout_s=9, retries=0)
    with closing(server.listener), closing(one), pytest.raises(UnavailableError, match=sentence):
        one.get("v1")


@pytest.mark.parametrize(
    "reply",
    [
        b"HTTP/1.0 200 OK\r\n\r\n{}",  # until the end of the connection
        b"HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}",
        b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n1\r\n{\r\n1\r\n}\r\n0\r\nx-trailer: 1\r\n\r\n",
        b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n[]",
    ],
)
def test_every_framing_of_a_body_is_read(reply: bytes) -> None:
    server = Server(reply=reply)
    with closing(server.listener), closing(Transport(f"http://127.0.0.1:{server.port}", timeout_s=9, retries=1)) as one:
        assert one.get("v1") == one.get("v1") == {}


def test_tls_goes_through_a_tunnel_of_the_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    proxy = Server(reply=b"HTTP/1.1 407 Proxy Authentication Required\r\ncontent-length: 0\r\n\r\n")
    monkeypatch.setenv("https_proxy", f"http://robot:p@127.0.0.1:{proxy.port}")
    monkeypatch.delenv("no_proxy", raising=False)
    one = Transport("https://policies.example", timeout_s=9, retries=0)
    refused = pytest.raises(UnavailableError, match="cannot be reached: the proxy answered 407")
    with closing(proxy.listener), closing(one), refused:
        one.get("v1")
    head, *headers = proxy.asked[0].decode().lower().split("\r\n")
    assert head == "connect policies.example:443 http/1.1" and "host: policies.example:443" in headers
    assert "proxy-authorization: basic cm9ib3q6ca==" in headers  # robot:p


def test_a_key_that_would_end_its_header_is_refused_without_showing_it() -> None:
    with pytest.raises(UsageError, match="API key has characters") as refusal:
        Transport("http://127.0.0.1:9", timeout_s=1, retries=0, api_key="secret\r\nx-more: 1")
    assert "secret" not in str(refusal.value)
