"""TLS from the client to nginx, in front of `rlservo serve`: the configuration that compose uses, with other paths."""

from __future__ import annotations

import json
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest

from grpc_calls import infer_request
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.errors import UnavailableError
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from servers import ROOT, LiveServer, free_ports

pytestmark = [pytest.mark.serve, pytest.mark.slow]

CONFIGURATION = ROOT / "deploy" / "compose" / "nginx.conf"
PREFIXED = ROOT / "deploy" / "nginx_prefix.conf"
OBS = np.random.default_rng(3).standard_normal(27).astype(np.float32)


@dataclass(frozen=True)
class Behind:
    """nginx with TLS in front of the live server."""

    port: int
    authority: Path  # the certificate that clients are to trust
    key: str
    log: Path

    @property
    def url(self) -> str:
        return f"https://localhost:{self.port}"


def openssl(*words: object) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True, timeout=60)


def make_certificates(folder: Path) -> tuple[Path, Path, Path]:
    """Make an authority and, signed by it, a certificate for `localhost`; return its, that and the key's file."""
    authority, authority_key = folder / "ca.pem", folder / "ca.key"
    certificate, key, request = folder / "server.pem", folder / "server.key", folder / "server.csr"
    extensions = folder / "extensions"
    extensions.write_text("subjectAltName=DNS:localhost\n")
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl("req", "-x509", *curve, "-keyout", authority_key, "-out", authority, "-days", 2, "-subj", "/CN=test CA")
    openssl("req", *curve, "-keyout", key, "-out", request, "-subj", "/CN=localhost")
    openssl("x509", "-req", "-in", request, "-CA", authority, "-CAkey", authority_key, "-CAcreateserial", "-days", 2,
            "-extfile", extensions, "-out", certificate)  # fmt: skip
    return authority, certificate, key


@pytest.fixture(scope="module")
def behind(live_server: LiveServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Behind]:
    for program in ("nginx", "openssl"):
        if shutil.which(program) is None:
            pytest.skip(f"there is no {program} here (Debian: apt-get install {program})")
    folder = tmp_path_factory.mktemp("nginx")
    authority, certificate, key = make_certificates(folder)
    (port,) = free_ports(1)
    text = CONFIGURATION.read_text().replace(" /tmp/", f" {folder}/")
    for ours, theirs in (
        ("    location / {\n", f"{PREFIXED.read_text()}    location / {{\n"),
        ("http://127.0.0.1:8000/;", f"http://127.0.0.1:{live_server.port}/;"),
        ("listen 8443 ssl", f"listen 127.0.0.1:{port} ssl"),
        ("server server:8000;", f"server 127.0.0.1:{live_server.port};"),
        ("server server:8001;", f"server 127.0.0.1:{live_server.grpc_port};"),
        ("/run/secrets/tls_certificate;", f"{certificate};"),
        ("/run/secrets/tls_key;", f"{key};"),
        ("worker_processes auto;", "worker_processes 1;"),
        ("access_log /dev/stdout ", f"access_log {folder}/access.log "),
    ):
        assert text.count(ours) == 1, ours
        text = text.replace(ours, theirs)
    file = folder / "nginx.conf"
    file.write_text(text)
    words = ["nginx", "-c", str(file), "-e", "stderr"]
    checked = subprocess.run([*words, "-t"], capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stderr
    process = subprocess.Popen([*words, "-g", "daemon off;"], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while True:
            assert process.poll() is None and time.monotonic() < deadline
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                time.sleep(0.05)
        yield Behind(port, authority, live_server.key, folder / "access.log")
    finally:
        process.terminate()
        process.wait(30)


@pytest.fixture
def trusted(behind: Behind, monkeypatch: pytest.MonkeyPatch) -> Behind:
    monkeypatch.setenv("SSL_CERT_FILE", str(behind.authority))
    return behind


def test_http_acts_through_tls_as_in_process(trusted: Behind, ur5: Path) -> None:
    with Policy.load(ur5) as policy, PolicyClient(trusted.url, "ur5", api_key=trusted.key, timeout_s=60) as client:
        for factor in (0.5, 1.0, 2.0):
            np.testing.assert_array_equal(client.act(OBS * factor), policy.act(OBS * factor))


def test_a_stream_acts_through_tls_as_in_process(trusted: Behind, ur5: Path) -> None:
    with Policy.load(ur5) as policy, StreamClient(trusted.url, "ur5", api_key=trusted.key, timeout_s=60) as client:
        for factor in (0.5, 1.0, 2.0):
            np.testing.assert_array_equal(client.act(OBS * factor), policy.act(OBS * factor))


def test_clients_act_below_a_prefix(trusted: Behind, ur5: Path) -> None:
    with Policy.load(ur5) as policy:
        for kind in (PolicyClient, StreamClient):
            with kind(f"{trusted.url}/robots", "ur5", api_key=trusted.key, timeout_s=60) as client:
                np.testing.assert_array_equal(client.act(OBS), policy.act(OBS))


def test_grpc_acts_through_tls_as_in_process(trusted: Behind, ur5: Path) -> None:
    credentials = grpc.ssl_channel_credentials(trusted.authority.read_bytes())
    with grpc.secure_channel(f"localhost:{trusted.port}", credentials) as channel:
        infer = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
        content = infer(
            infer_request([OBS]).SerializeToString(), metadata=(("authorization", f"Bearer {trusted.key}"),), timeout=60
        )
    reply = messages.ModelInferResponse.FromString(content)
    with Policy.load(ur5) as policy:
        assert reply.raw_output_contents[0] == policy.act(OBS).tobytes()


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
def test_a_certificate_that_nobody_vouches_for_is_refused_in_a_sentence(
    behind: Behind, monkeypatch: pytest.MonkeyPatch, kind: type[PolicyClient | StreamClient]
) -> None:
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    with (
        pytest.raises(UnavailableError, match="certificate verify failed"),
        kind(behind.url, "ur5", api_key=behind.key, timeout_s=5) as client,
    ):
        client.act(OBS)


def test_a_key_is_wanted_behind_tls_too_and_old_protocols_are_refused(trusted: Behind) -> None:
    context = ssl.create_default_context(cafile=str(trusted.authority))
    with (
        socket.create_connection(("127.0.0.1", trusted.port), timeout=20) as plain,
        context.wrap_socket(plain, server_hostname="localhost") as secured,
    ):
        secured.sendall(b"GET /v1/policies HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert secured.recv(64).startswith(b"HTTP/1.1 401 ")
        assert secured.version() == "TLSv1.3"
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    context.set_ciphers("DEFAULT:@SECLEVEL=0")
    with pytest.warns(DeprecationWarning):
        context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_1
    with socket.create_connection(("127.0.0.1", trusted.port), timeout=20) as plain, pytest.raises(ssl.SSLError):
        context.wrap_socket(plain, server_hostname="localhost")


def test_administration_is_logged_with_the_clients_address_and_nothing_else_is(trusted: Behind) -> None:
    with PolicyClient(trusted.url, "ur5", api_key=trusted.key, timeout_s=60) as client:
        client.act(OBS)
    assert trusted.log.read_text() == ""
    replies = []
    with httpx.Client(base_url=trusted.url, headers={"Authorization": f"Bearer {trusted.key}"}, timeout=60) as client:
        for path in ("/v1/admin/policies/none/load", "/v2/repository/models/none/load"):
            replies.append(client.post(path, json={}))
    deadline = time.monotonic() + 20
    while len(lines := trusted.log.read_text().splitlines()) < len(replies) and time.monotonic() < deadline:
        time.sleep(0.05)
    for line, reply in zip(lines, replies, strict=True):
        written = json.loads(line)
        assert reply.status_code >= 400
        assert written.pop("time").startswith("20")
        assert written == {
            "logger": "nginx.administration",
            "client": "127.0.0.1",
            "method": "POST",
            "path": reply.url.path,
            "status": str(reply.status_code),
            "request_id": reply.headers["x-request-id"],
        }
