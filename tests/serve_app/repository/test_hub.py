"""`publish` to and `serve` from a hub that speaks Hugging Face's HTTP API.

The hub here is written from that API's documentation (https://huggingface.co/.well-known/openapi.json and Git LFS's
batch API): repositories, commits in NDJSON, `resolve` with X-Repo-Commit and ETag, LFS files behind a redirect.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rlservo.policy.policy import Policy
from servers import ask, free_ports, running, wait_until_served

pytest.importorskip("huggingface_hub")
TOKEN = "hf_secret"
LFS = (".onnx", ".npz", ".ts")


class Hub(ThreadingHTTPServer):
    """Repositories as lists of commits; a commit is a mapping from paths to contents."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.commits: dict[str, list[tuple[str, dict[str, bytes]]]] = {}
        self.private: set[str] = set()
        self.objects: dict[str, bytes] = {}

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    @property
    def storage(self) -> str:
        """Another host, as the hub's storage of large files is."""
        return f"http://localhost:{self.server_address[1]}"

    def commit(self, repo: str, files: dict[str, bytes]) -> str:
        history = self.commits.setdefault(repo, [])
        whole = {**(history[-1][1] if history else {}), **files}
        sha = hashlib.sha1(repr((len(history), sorted(whole))).encode()).hexdigest()
        history.append((sha, whole))
        return sha


class Handler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None: ...

    def reply(self, status: int, body: Any = b"", **headers: str) -> None:
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def refuse(self, status: int, code: str) -> None:
        self.reply(status, {"error": code}, X_Error_Code=code, X_Error_Message=code)

    def body(self) -> bytes:
        if "chunked" in self.headers.get("Transfer-Encoding", ""):
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    @property
    def is_known(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def found(self, repo: str, revision: str) -> tuple[str, dict[str, bytes]] | None:
        """The commit of a revision; refuses the request if there is none that this caller may see."""
        history = self.server.commits.get(repo)
        if history is None or (repo in self.server.private and not self.is_known):
            self.refuse(404 if self.is_known else 401, "RepoNotFound")
            return None
        matching = [one for one in history if revision in ("main", one[0])]
        if not matching:
            self.refuse(404, "RevisionNotFound")
            return None
        return matching[-1]

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if match := re.fullmatch(r"/lfs/(\w+)", path):
            self.reply(200, self.server.objects[match[1]])
        elif match := re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/revision/([^/]+))?", path):
            if commit := self.found(match[1], match[2] or "main"):
                siblings = [{"rfilename": name} for name in commit[1]]
                self.reply(200, {"id": match[1], "sha": commit[0], "siblings": siblings, "private": True, "tags": [],
                                 "downloads": 0, "likes": 0, "modelId": match[1]})  # fmt: skip
        elif match := re.fullmatch(r"/api/models/([^/]+/[^/]+)/tree/([^/]+)", path):
            if commit := self.found(match[1], match[2]):
                files = [{"type": "file", "path": name, "size": len(data), "oid": hashlib.sha1(data).hexdigest()}
                         for name, data in commit[1].items()]  # fmt: skip
                self.reply(200, files)
        elif match := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            if commit := self.found(match[1], match[2]):
                self.resolve(*commit, match[3])
        else:
            self.refuse(404, "NotFound")

    def resolve(self, sha: str, files: dict[str, bytes], name: str) -> None:
        if name not in files:
            self.reply(404, b"", X_Error_Code="EntryNotFound", X_Repo_Commit=sha)
        elif name.endswith(LFS):
            oid = hashlib.sha256(files[name]).hexdigest()
            self.reply(302, b"", X_Repo_Commit=sha, X_Linked_Etag=f'"{oid}"', X_Linked_Size=str(len(files[name])),
                       ETag='"pointer"', Location=f"{self.server.storage}/lfs/{oid}")  # fmt: skip
        else:
            self.reply(200, files[name], X_Repo_Commit=sha, ETag=f'"{hashlib.sha1(files[name]).hexdigest()}"')

    def do_PUT(self) -> None:
        content = self.body()
        oid = self.path.rpartition("/")[2]
        if hashlib.sha256(content).hexdigest() != oid:
            self.refuse(400, "BadRequest")
            return
        self.server.objects[oid] = content
        self.reply(200)

    def do_POST(self) -> None:
        content, path = self.body(), self.path.partition("?")[0]
        if not self.is_known:
            self.refuse(401, "Unauthorized")
        elif path == "/api/validate-yaml":
            card = json.loads(content)
            front = yaml.safe_load(card["content"].split("---")[1]) if card["content"].startswith("---") else {}
            known = isinstance(front, dict) and front.get("license", "mit") in ("mit", "apache-2.0", "other")
            errors = [] if known else [{"message": '"license" must be one of the hub\'s'}]
            self.reply(400 if errors else 200, {"errors": errors, "warnings": []})
        elif path == "/api/repos/create":
            wanted = json.loads(content)
            repo = f"{wanted.get('organization') or 'owner'}/{wanted['name']}"
            exists = repo in self.server.commits
            if not exists:
                self.server.commit(repo, {".gitattributes": b"*.onnx filter=lfs\n"})
                if wanted.get("private") or wanted.get("visibility") == "private":
                    self.server.private.add(repo)
            self.reply(409 if exists else 200, {"url": f"{self.server.url}/{repo}", "id": repo, "name": repo})
        elif re.fullmatch(r"/api/models/([^/]+/[^/]+)/preupload/main", path):
            self.reply(200, {"files": [
                {"path": one["path"], "uploadMode": "lfs" if one["path"].endswith(LFS) else "regular",
                 "shouldIgnore": False} for one in json.loads(content)["files"]
            ]})  # fmt: skip
        elif path.endswith(".git/info/lfs/objects/batch"):
            objects = [
                {**one, "actions": {"upload": {"href": f"{self.server.url}/lfs/{one['oid']}", "header": {}}}}
                for one in json.loads(content)["objects"]
            ]
            self.reply(200, {"transfer": "basic", "objects": objects}, Content_Type="application/vnd.git-lfs+json")
        elif match := re.fullmatch(r"/api/models/([^/]+/[^/]+)/commit/main", path):
            self.commit(match[1], [json.loads(line) for line in content.splitlines()])
        else:
            self.refuse(404, "NotFound")

    def commit(self, repo: str, lines: list[dict[str, Any]]) -> None:
        header, files = lines[0]["value"], {}
        if header.get("parentCommit", self.server.commits[repo][-1][0]) != self.server.commits[repo][-1][0]:
            self.refuse(412, "PreconditionFailed")
            return
        for line in lines[1:]:
            value = line["value"]
            lfs = line["key"] == "lfsFile"
            files[value["path"]] = self.server.objects[value["oid"]] if lfs else base64.b64decode(value["content"])
        sha = self.server.commit(repo, files)
        url = f"{self.server.url}/{repo}/commit/{sha}"
        self.reply(200, {"success": True, "commitUrl": url, "commitOid": sha})


@pytest.fixture
def hub() -> Iterator[Hub]:
    server = Hub()
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def environment(hub: Hub, home: Path, token: str = TOKEN, **more: str) -> dict[str, str]:
    return {"HF_ENDPOINT": hub.url, "HF_HOME": str(home / "hf"), "HF_TOKEN": token, "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1", "XDG_CACHE_HOME": str(home / "cache"), **more}  # fmt: skip


def rlservo(hub: Hub, home: Path, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rlservo.deploy.cli", *map(str, words)]
    variables = os.environ | environment(hub, home, **more)
    return subprocess.run(command, capture_output=True, text=True, timeout=200, env=variables)


def served_action(hub: Hub, home: Path, uri: str, **more: str) -> Any:
    (port,) = free_ports(1)
    command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", uri, "--port", str(port)]
    with running(command, port, **environment(hub, home, **more)) as run:
        wait_until_served(run)
        status, reply = ask(port, "POST", "/v1/policies/ur5/act", {"obs": [0.1] * 27})
        assert status == 200, reply
        return reply


def test_a_bundle_is_published_in_one_commit_and_served_by_revision_without_the_hub(
    hub: Hub, ur5: Path, tmp_path: Path
) -> None:
    said = rlservo(hub, tmp_path, "publish", ur5, "hf://owner/arm", "--license", "apache-2.0")
    assert said.returncode == 0, said.stderr
    (_, _), (sha, files) = hub.commits["owner/arm"]
    assert said.stdout == f"ur5 version {ur5.name} is published: hf://owner/arm@{sha}\n"
    assert {"index.json", "README.md", f"ur5/{ur5.name}/policy.onnx", f"ur5/{ur5.name}/SHA256SUMS"} <= set(files)
    assert b'license: "apache-2.0"' in files["README.md"] and b"rlservo serve hf://owner/arm" in files["README.md"]
    assert hub.private == {"owner/arm"}
    again = rlservo(hub, tmp_path, "publish", ur5, "hf://owner/arm")
    assert again.returncode != 0 and "versions are never overwritten" in again.stderr
    with Policy.load(ur5) as policy:
        wanted = policy.act(np.full(27, 0.1, np.float32))
    pinned = f"hf://owner/arm@{sha}"
    reply = served_action(hub, tmp_path, pinned)
    np.testing.assert_allclose(reply["action"], wanted, rtol=1e-5)
    hub.commits["owner/arm"].append(("f" * 40, {}))  # what a revision does not see
    offline = served_action(hub, tmp_path, pinned, HF_HUB_OFFLINE="1")
    assert offline["action"] == reply["action"]


def test_a_readme_that_a_person_wrote_stays(hub: Hub, ur5: Path, tmp_path: Path) -> None:
    hub.commit("owner/arm", {"README.md": b"# My own\n"})
    assert rlservo(hub, tmp_path, "publish", ur5, "hf://owner/arm").returncode == 0
    assert hub.commits["owner/arm"][-1][1]["README.md"] == b"# My own\n"


@pytest.mark.parametrize(
    ("uri", "token", "words"),
    [
        ("hf://owner/arm", TOKEN, "hf://owner/arm/index.json: there is no such repository, or it is not open to"),
        ("hf://owner/secret", "hf_other", "hf://owner/secret/index.json: there is no such repository, or it is not"),
        ("hf://owner/secret@v9", TOKEN, "the repository has no revision 'v9'"),
        ("hf://owner/secret", TOKEN, "hf://owner/secret has no index.json: nothing was published there"),
        ("hf://owner", TOKEN, "hf://owner: expected s3://bucket/policies, hf://owner/name (@revision)"),
    ],
)
def test_what_cannot_be_served_is_refused_in_a_sentence(
    uri: str, token: str, words: str, hub: Hub, tmp_path: Path
) -> None:
    hub.commit("owner/secret", {"README.md": b""})
    hub.private.add("owner/secret")
    (port,) = free_ports(1)
    said = rlservo(hub, tmp_path, "serve", uri, "--port", port, token=token)
    assert said.returncode != 0
    assert words in " ".join((said.stderr + said.stdout).split()) and "Traceback" not in said.stderr


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"HF_TOKEN": ""}, "hf://owner/arm cannot be read or written: the hub refuses this: set HF_TOKEN, or run"),
        ({"HF_ENDPOINT": "http://127.0.0.1:9"}, "http://127.0.0.1:9 does not answer: check the network, and HF_ENDP"),
        ({"HF_HUB_OFFLINE": "1"}, "hf://owner/arm cannot be reached: HF_HUB_OFFLINE is set: unset it to ask the hub"),
    ],
)
def test_a_publication_without_token_or_network_names_it(
    variables: dict[str, str], words: str, hub: Hub, ur5: Path, tmp_path: Path
) -> None:
    said = rlservo(hub, tmp_path, "publish", ur5, "hf://owner/arm", **variables)
    assert (said.returncode, said.stdout) == (1, "") and words in said.stderr


def test_what_is_not_cached_is_not_served_offline(hub: Hub, tmp_path: Path) -> None:
    (port,) = free_ports(1)
    said = rlservo(hub, tmp_path, "serve", "hf://owner/arm", "--port", port, HF_HUB_OFFLINE="1")
    words = "hf://owner/arm/index.json is not in the hub's cache here (HF_HOME), and HF_HUB_OFFLINE is set"
    assert said.returncode == 1 and words in said.stderr


def test_a_pinned_revision_is_not_published_to(hub: Hub, ur5: Path, tmp_path: Path) -> None:
    said = rlservo(hub, tmp_path, "publish", ur5, "hf://owner/arm@v1")
    assert said.returncode == 2 and "hf://owner/arm@v1 is one revision: publish to hf://owner/arm" in said.stderr
