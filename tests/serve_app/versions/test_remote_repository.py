"""Repositories behind URIs: published whole or not at all, fetched by hash, served while their storage is away."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import http.server
import json
import logging
import os
import shutil
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bundles import write_box_policy
from rlservo.export.contract.bundle import load_bundle
from rlservo.export.contract.errors import (
    BundleError,
    ConflictError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions import plan_changes
from rlservo.serve_app.versions.bundle_cache import MANIFEST_FILE
from rlservo.serve_app.versions.manifest import MAX_MANIFEST_BYTES, REQUIRED, Manifest
from rlservo.serve_app.versions.object_storage import announced, place_of
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.publication import next_version, publish
from rlservo.serve_app.versions.remote_repository import AT_ONCE
from rlservo.serve_app.versions.replica_versions import ReplicaVersions
from rlservo.serve_app.versions.repository import Repository
from rlservo.serve_app.versions.version_loader import VersionLoader
from storages import ENDLESS, MOST_SENT, SECRET, Cut, Lie, Storage, late, only
from stores import MemoryLedger

ALL = ServedConfig()
AWAY = "(cannot be reached or read|gave no answer)"  # a closed connection is tried again, for as long as may be


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ur5 in versions 1 to 4, and another bundle that says it is version 1, in `other`."""
    root = tmp_path_factory.mktemp("made")
    for version in range(1, 5):
        write_box_policy(root, version=str(version), seed=version)
    write_box_policy(root / "other", version="1", seed=99)
    return root


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def put(made: Path, uri: str, *versions: str) -> None:
    for version in versions:
        publish(load_bundle(made / "ur5" / version), uri)


def repository(storage: Storage, cache: Path, **more: Any) -> Repository:
    return Repository([storage.uri], cache=cache, **{"storage_timeout_s": 10, **more})


def replica(*places: str, cache: Path, timeout_s: float = 10, load_timeout_s: float = 30) -> ReplicaVersions:
    held = Repository(places, cache=cache, storage_timeout_s=timeout_s)
    loader = VersionLoader(held, load_timeout_s=load_timeout_s)
    return ReplicaVersions(loader, MemoryLedger(), replica="only")


def fetch(repository: Repository, version: str = "1") -> Path:
    found, digest = repository.find_digest("ur5", version)
    lease = repository.fetch("ur5", found, digest)
    lease.release()
    return lease.folder


def test_a_published_version_is_found_fetched_and_proven(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2")
    held = repository(storage, cache)
    assert held.available(ALL) == {"ur5": {v: load_bundle(made / "ur5" / v).digest for v in ("1", "2")}}
    before = storage.gets("ur5/2/policy.onnx")
    folder = fetch(held, "2")
    with contextlib.closing(Policy.load(folder)) as policy:
        assert (policy.contract.name, policy.contract.version) == ("ur5", "2")
    with contextlib.closing(load_served([storage.uri], ALL, ServerSettings(cache=str(cache)))) as store:
        assert store.default("ur5") == "2"
    assert storage.gets("ur5/2/policy.onnx") == before + 1


def test_versions_are_immutable_and_the_next_number_is_found(made: Path, storage: Storage) -> None:
    put(made, storage.uri, "1")
    with pytest.raises(ConflictError, match=r"ur5/1\.json is there already \(this very bundle\)"):
        put(made, storage.uri, "1")
    with pytest.raises(
        ConflictError, match=r"ur5/1\.json is there already \(another bundle\): versions are never over"
    ):
        publish(load_bundle(made / "other" / "ur5" / "1"), storage.uri)
    assert next_version(storage.uri, "ur5") == "2" and next_version(storage.uri, "mir") == "1"
    storage.change("DELETE", "ur5/1.json")  # as if left half-way: nobody sees it, and its number is not free
    assert next_version(storage.uri, "ur5") == "2"
    with pytest.raises(ConflictError, match=r"ur5/1/SHA256SUMS holds another file than .* published by somebody else"):
        publish(load_bundle(made / "other" / "ur5" / "1"), storage.uri)
    put(made, storage.uri, "1")  # the same bundle goes on where it was left


def test_an_object_is_read_again_after_its_connection_broke(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")
    replies = iter([True, True])
    storage.tell(only("1/policy.onnx", lambda _, status, heads, b: (status, heads, Cut(b) if next(replies, 0) else b)))
    assert load_bundle(fetch(repository(storage, cache))).digest == load_bundle(made / "ur5" / "1").digest
    assert next(replies, None) is None


def test_an_empty_file_of_a_bundle_is_published_with_it(made: Path, storage: Storage, cache: Path) -> None:
    folder = Path(shutil.copytree(made / "ur5" / "1", cache.parent / "ur5" / "1"))
    (folder / "notes.txt").touch()
    with (folder / "SHA256SUMS").open("a") as sums:
        sums.write(f"{hashlib.sha256().hexdigest()}  notes.txt\n")
    publish(load_bundle(folder), storage.uri)
    fetched = fetch(repository(storage, cache))
    assert (fetched / "notes.txt").read_bytes() == b"" and load_bundle(fetched).digest == load_bundle(folder).digest


def test_of_two_publishers_at_once_one_wins_and_what_is_there_is_whole(
    made: Path, storage: Storage, cache: Path
) -> None:
    outcomes: dict[str, object] = {}
    storage.tell(late(0.02))

    def run(name: str, folder: Path) -> None:
        try:
            outcomes[name] = publish(load_bundle(folder), storage.uri)
        except RlservoError as error:
            outcomes[name] = error

    folders = {"a": made / "ur5" / "1", "b": made / "other" / "ur5" / "1"}
    threads = [threading.Thread(target=run, args=item) for item in folders.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (won,) = [name for name, outcome in outcomes.items() if isinstance(outcome, str)]
    assert sum(isinstance(outcome, ConflictError) for outcome in outcomes.values()) == 1
    assert load_bundle(fetch(repository(storage, cache))).digest == load_bundle(folders[won]).digest


def test_without_a_manifest_there_is_no_version(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2")
    storage.change("DELETE", "ur5/2.json")
    held = repository(storage, cache)
    assert list(held.available(ALL)["ur5"]) == ["1"]
    storage.change("DELETE", "ur5/1.json")
    with pytest.raises(BundleError, match=r"policies holds no published version: expected <name>/<version>\.json"):
        held.available(ALL)


def changed_byte(_path: str, status: int, headers: dict[str, str], body: bytes) -> Any:
    return status, headers, body[:-1] + bytes([body[-1] ^ 1])


def truncated(_path: str, status: int, headers: dict[str, str], body: bytes) -> Any:
    return status, headers, body[: len(body) // 2]


def endless(*_: Any) -> Any:
    return 200, {}, ENDLESS


def busy(*_: Any) -> Any:
    return (
        503,
        {"content-type": "application/xml"},
        b"<Error><Code>ServiceUnavailable</Code><Message>later</Message></Error>",
    )


def echo(_path: str, *_: Any) -> Any:
    text = f"<Error><Code>AccessDenied</Code><Message>no: token {'x' * 50} AKIAIOSFODNN7EXAMPLE</Message></Error>"
    return 403, {"content-type": "application/xml"}, text.encode()


LIES: dict[str, tuple[Lie, str]] = {
    "changed byte": (
        only("2/policy.onnx", changed_byte),
        r"/policies/ur5/2: policy\.onnx is not the file that was published: its sha256 is",
    ),
    "truncated": (only("2/policy.onnx", truncated), r"/policies/ur5/2/policy\.onnx ends after [\d,]+ of [\d,]+ bytes"),
    "503": (only("2/policy.onnx", busy), r"/policies/ur5/2/policy\.onnx cannot be reached or read: .*later"),
    "late": (only("2/policy.onnx", late(6)), r"/policies/ur5/2/policy\.onnx gave no answer within \d s"),
    "403": (only("2/policy.onnx", echo), r"/policies/ur5/2/policy\.onnx is refused with the credentials .*no: token"),
    "deleted": (
        only("2/policy.onnx", lambda *_: (404, {}, b"<Error><Code>NoSuchKey</Code><Message>gone</Message></Error>")),
        r"/policies/ur5/2 lacks a file that its manifest lists",
    ),
    "garbled manifest": (only("2.json", lambda p, s, h, b: (s, h, b[:100])), r"/policies/ur5/2\.json is no manifest"),
    "endless object": (
        only("2/policy.onnx", endless),
        r"/policies/ur5/2/policy\.onnx: the storage sends more than the [\d,]+ bytes that it may$",
    ),
    "endless manifest": (only("2.json", endless), r"/policies/ur5/2\.json: the storage sends more than the 65,537 b"),
    "endless refusal": (
        only("2/policy.onnx", lambda *reply: (403, *endless(*reply)[1:])),
        r"/policies/ur5/2/policy\.onnx: the storage sends more than",
    ),
    "endless list": (
        lambda path, *reply: endless(path, *reply) if "list-type" in path else reply,
        r"/policies: the storage sends more than the 33,554,432 bytes that it may$",
    ),
    "list is 503": (lambda path, *r: busy() if "list-type" in path else r, r"/policies cannot be reached or read"),
}


@pytest.mark.parametrize("kind", list(LIES))
def test_a_storage_that_lies_is_told_in_a_sentence_and_what_runs_goes_on(
    kind: str, made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "1")
    lie, sentence = LIES[kind]

    async def run() -> None:
        control = replica(storage.uri, cache=cache, timeout_s=2 if kind == "late" else 10)
        await control.configure({})
        await asyncio.to_thread(put, made, storage.uri, "2")
        storage.tell(lie)
        with pytest.raises((RefusedError, UnavailableError), match=sentence) as caught:
            await control.load("ur5", "2", what="load")
        assert "xxxx" not in caught.value.message and "AKIA" not in caught.value.message
        assert SECRET not in caught.value.message
        assert storage.proxy.sent < MOST_SENT  # who asked has hung up
        assert control.store is not None and control.store.versions("ur5") == ("1",)
        storage.tell(None)
        await control.load("ur5", "2", what="load")
        assert control.store.versions("ur5") == ("1", "2") and control.store.default("ur5") == "1"

    asyncio.run(run())
    assert not list(cache.glob(".fetching-*"))


UNFINISHED: dict[str, tuple[str, bytes | None, type[RlservoError], str]] = {
    "swallowed": ("/1/SHA256SUMS", None, UnavailableError, r"/ur5/1/SHA256SUMS is not there after it was written$"),
    "changed": (
        "/1/policy.onnx",
        b"another",
        ConflictError,
        r"/ur5/1/policy\.onnx holds another file than .*manifest:",
    ),
    "manifest swallowed": ("/1.json", None, UnavailableError, r"/ur5/1\.json is not there after it was written$"),
    "manifest changed": ("/1.json", b"{}", BundleError, r"/ur5/1\.json is of format None"),
}


@pytest.mark.parametrize("kind", list(UNFINISHED))
def test_a_storage_that_keeps_something_else_than_it_was_given_publishes_nothing(
    kind: str, made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "2")
    end, kept, error, sentence = UNFINISHED[kind]

    def lie(path: str, *reply: Any) -> Any:
        if path.partition("?")[0].endswith(end) and storage.proxy.requests[-1].startswith("PUT "):
            storage.change("DELETE" if kept is None else "PUT", f"ur5{end}", kept or b"")
        return reply

    storage.tell(lie)
    with pytest.raises(error, match=sentence):
        put(made, storage.uri, "1")
    digests, wrong = repository(storage, cache).look()
    assert list(digests) == [("ur5", "2")] and len(wrong) == (kind == "manifest changed")
    storage.tell(None)
    if kept is None:
        put(made, storage.uri, "1")  # what was kept is the same bundle's: it goes on from there


@pytest.mark.parametrize(
    "page", [b"", b"<html><body>log in, please</body></html>"], ids=["nothing", "a page to log in"]
)
def test_a_list_that_is_none_withdraws_nothing(page: bytes, made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")
    held = repository(storage, cache)
    fetch(held)
    storage.tell(lambda path, *reply: (200, {}, page) if "list-type" in path else reply)
    assert held.look()[0] == {} and "holds no published version" in str(held.look()[1][0])
    storage.tell(echo)  # and what the cache knew before is still known
    assert list(repository(storage, cache).available(ALL)["ur5"]) == ["1"]


def test_any_uri_that_fsspec_reads_is_a_repository(made: Path, cache: Path) -> None:
    uri = "memory://bucket/policies"
    put(made, uri, "1", "2")
    with pytest.raises(
        ConflictError, match=r"memory://bucket/policies/ur5/1\.json is there already \(another bundle\)"
    ):
        publish(load_bundle(made / "other" / "ur5" / "1"), uri)
    with contextlib.closing(load_served([uri], ALL, ServerSettings(cache=str(cache)))) as store:
        assert store.default("ur5") == "2" and store.get("ur5", "2").digest == load_bundle(made / "ur5" / "2").digest


def test_wrong_etags_and_wrong_sizes_in_the_list_change_nothing(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")

    def lie(path: str, status: int, headers: dict[str, str], body: bytes) -> Any:
        if "list-type" in path:
            body = body.replace(b"<ETag>", b"<ETag>0").replace(b"<Size>", b"<Size>9")
        return status, {k: v for k, v in headers.items() if k.lower() != "etag"} | {"ETag": '"lie"'}, body

    storage.tell(lie)
    assert load_bundle(fetch(repository(storage, cache))).digest == load_bundle(made / "ur5" / "1").digest


def test_an_exchanged_version_is_refused_by_name_and_the_accepted_one_runs_on(
    made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "1")
    accepted = load_bundle(made / "ur5" / "1").digest
    other = load_bundle(made / "other" / "ur5" / "1")
    fetch(repository(storage, cache))
    files = {name: (other.path / name).read_bytes() for name in REQUIRED}
    sums = {name: {"size": len(c), "sha256": hashlib.sha256(c).hexdigest()} for name, c in files.items()}
    for name, content in files.items():
        storage.change("PUT", f"ur5/1/{name}", content)
    manifest = {"format": 1, "name": "ur5", "version": "1", "published_at": "", "files": sums}
    storage.change("PUT", "ur5/1.json", json.dumps(manifest).encode())
    assert repository(storage, cache).find_digest("ur5", "1") == ("1", other.digest)
    lease = repository(storage, cache).fetch("ur5", "1", accepted)  # the cache still has what was accepted
    lease.release()
    with pytest.raises(BundleError, match=r"ur5/1\.json is not the manifest that was accepted as version 1 of 'ur5'"):
        repository(storage, cache.parent / "another").fetch("ur5", "1", accepted)


def test_a_server_starts_again_with_its_storage_away(
    made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "1", "2")

    async def run(away: bool) -> None:
        control = replica(storage.uri, cache=cache)
        await control.configure({"policies": {"ur5": {"versions": ["1"]}}} if not away else {})
        assert control.store is not None and control.store.default("ur5") == "1"
        if away:
            with pytest.raises(UnavailableError, match=f"policies {AWAY}"):
                await control.load("ur5", "2", what="load")
            with pytest.raises(UnavailableError, match=f"policies {AWAY}"):
                await control.load("ur5", None, what="load")
            assert control.store.versions("ur5") == ("1",)
            with pytest.raises(UnavailableError, match=f"policies {AWAY}"):
                await replica(storage.uri, cache=cache).configure({"policies": {"ur5": {"versions": ["2"]}}})

    asyncio.run(run(away=False))
    storage.go_away()
    with caplog.at_level(logging.WARNING):
        asyncio.run(run(away=True))
    assert "the cache serves what was published on 20" in caplog.text
    assert "not in the cache, and left out: ur5 2" in caplog.text
    with pytest.raises(UnavailableError, match=f"policies {AWAY}"):
        repository(storage, cache.parent / "empty").available(ALL)


@pytest.fixture
def two(made: Path, storage: Storage, tmp_path: Path) -> dict[str, str]:
    """The hashes of ur5 and mir, both in version 1; mir's manifest is refused."""
    mir = load_bundle(write_box_policy(tmp_path, name="mir"))
    put(made, storage.uri, "1")
    publish(mir, storage.uri)
    storage.tell(only("mir/1.json", echo))
    return {"ur5": load_bundle(made / "ur5" / "1").digest, "mir": mir.digest}


MIR_UNREAD = r"policies/mir/1\.json is refused with the credentials"


def test_a_manifest_that_cannot_be_read_takes_its_own_version_away_and_no_other(
    two: dict[str, str], storage: Storage, cache: Path
) -> None:
    def pinned(name: str) -> ServedConfig:
        return ServedConfig.parse({"policies": {name: {"versions": ["1"]}}, "unlisted": "ignore"})

    held = repository(storage, cache)
    assert held.available(pinned("ur5")) == {"ur5": {"1": two["ur5"]}}
    assert held.find_digest("ur5", None) == ("1", two["ur5"])
    for config in (pinned("mir"), ALL):
        with pytest.raises(UnavailableError, match=MIR_UNREAD):
            held.available(config)
    for version in (None, "1"):
        with pytest.raises(UnavailableError, match=MIR_UNREAD):
            held.find_digest("mir", version)
    storage.tell(only("ur5/2.json", echo))
    storage.change("PUT", "ur5/2.json")
    assert held.find_digest("ur5", "1") == ("1", two["ur5"])
    with pytest.raises(UnavailableError, match=r"ur5/2\.json is refused"):  # nobody knows whether it is the newest
        held.find_digest("ur5", None)
    storage.tell(lambda path, *reply: reply if "list-type" in path else echo(path))
    with pytest.raises(UnavailableError, match=MIR_UNREAD):  # none can be read: the storage is away
        repository(storage, cache.parent / "empty").available(pinned("ur5"))


def test_what_the_cache_has_is_served_and_remembered_while_its_manifest_cannot_be_read(
    two: dict[str, str], storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    storage.tell(None)
    held = repository(storage, cache)
    for name, digest in two.items():
        held.find_digest(name, None)
        held.fetch(name, "1", digest).release()
    storage.tell(only("mir/1.json", echo))
    everything = {name: {"1": digest} for name, digest in two.items()}
    with caplog.at_level(logging.WARNING):
        assert repository(storage, cache).available(ALL) == everything
    assert "mir/1.json is refused" in caplog.text and "the copy in the cache or a folder is served" in caplog.text
    storage.go_away()
    assert repository(storage, cache).available(ALL) == everything


def test_polling_reads_a_manifest_again_that_could_not_be_read(
    made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "1")

    async def run() -> None:
        control = replica(storage.uri, cache=cache)
        await control.configure({})
        await asyncio.to_thread(put, made, storage.uri, "2")
        storage.tell(only("ur5/2.json", echo))
        poll = asyncio.create_task(control.poll_repository(0.05))
        await until(lambda: "ur5/2.json is refused" in caplog.text)
        storage.tell(None)
        await until(lambda: control.store is not None and control.store.versions("ur5") == ("1", "2"))
        poll.cancel()

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())


def test_a_storage_that_stopped_to_answer_is_not_asked_for_every_manifest(storage: Storage, cache: Path) -> None:
    for version in range(1, 81):
        storage.change("PUT", f"ur5/{version}.json")
    storage.tell(lambda path, *reply: reply if "list-type" in path else late(3)(path, *reply))
    with pytest.raises(UnavailableError, match=r"\.json gave no answer within 1 s"):
        repository(storage, cache, storage_timeout_s=1).available(ALL)
    assert len({line for line in storage.proxy.requests if line.endswith(".json")}) <= 3 * AT_ONCE


def test_wrong_and_missing_credentials_are_said(
    made: Path, storage: Storage, cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    put(made, storage.uri, "1")
    storage.tell(echo)
    with pytest.raises(
        UnavailableError, match=r"s3://.*/policies is refused with the credentials of this process's env"
    ):
        repository(storage, cache).find_digest("ur5", None)
    storage.tell(None)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(UnavailableError, match="Unable to locate credentials"):
        repository(storage, cache).find_digest("ur5", None)


@pytest.mark.parametrize(
    ("uri", "sentence"),
    [
        (
            "s3://key:hunter2@bucket/policies",
            r"s3://\.\.\.@bucket/policies holds a password: credentials come from the",
        ),
        ("https://host/p?X-Amz-Signature=hunter2", "https://host/p: a query or fragment may hold a secret"),
        ("simplecache::s3://bucket/p", "expected one protocol"),
        ("file://host/p", "expected file:///absolute/path"),
    ],
)
def test_uris_with_secrets_or_tricks_are_refused_without_showing_them(uri: str, sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence) as caught:
        Repository([uri])
    assert "hunter2" not in caught.value.message
    with pytest.raises(UsageError, match=sentence):
        place_of(uri)


@pytest.mark.parametrize("uri", ["s3://b/p", "gs://b/p", "az://b/p", "abfs://b/p", "nowhere://b"])
def test_a_missing_extra_is_named(uri: str, monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    if uri.startswith("s3"):
        monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(UsageError, match=rf"{uri} cannot be opened here: pip install 'rlservo\[remote\]'"):
        Repository([uri], cache=cache).find_digest("ur5", None)


def test_local_folders_import_nothing_of_it(made: Path) -> None:
    code = (
        "import sys; from rlservo.serve_app.versions.repository import Repository; "
        f"print(Repository([{str(made)!r}]).find_digest('ur5', None)[0]); "
        "print([m for m in ('fsspec', 's3fs', 'botocore', 'aiohttp', 'pyarrow') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["4", "[]"]


GOOD = {
    "format": 1,
    "name": "ur5",
    "version": "3",
    "published_at": "2026-11-22T22:00:00.000+00:00",
    "files": {name: {"size": 10, "sha256": "0" * 64} for name in REQUIRED},
}


def with_file(name: str, size: Any = 1, sha256: str = "0" * 64) -> dict[str, Any]:
    return {**GOOD, "files": {**GOOD["files"], name: {"size": size, "sha256": sha256}}}  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        (with_file("../x.json"), "files"),
        (with_file("/etc/x.json"), "files"),
        (with_file("a/b.json"), "files"),
        (with_file("..json"), "files"),
        (with_file(".manifest.json"), "files"),
        (with_file("a\\b.json"), "files"),
        (with_file("a\n.json"), "files"),
        (with_file("run.pkl"), "lists run.pkl: a published bundle holds"),
        (with_file("run.so"), "lists run.so: a published bundle holds"),
        (with_file("x.json", size=-1), "size"),
        (with_file("x.json", size=1.5), "size"),
        (with_file("x.json", size=True), "size"),
        (with_file("contract.json", size=1 << 30), "contract.json has 1,073,741,824 bytes: at most 16,777,216"),
        (with_file("x.json", sha256="0" * 63), "sha256"),
        ({**GOOD, "files": {"SHA256SUMS": {"size": 1, "sha256": "0" * 64}}}, "does not list policy.onnx"),
        (functools.reduce(lambda d, n: {**d, "files": {**d["files"], f"f{n}.txt": {"size": 1, "sha256": "0" * 64}}},
                          range(20), GOOD), "lists 25 files: at most 17"),
        ({**GOOD, "format": 2}, "is of format 2: this rlservo reads manifests of format 1"),
        ({**GOOD, "format": True}, "is of format True"),
        ({**GOOD, "version": "4"}, r"is the manifest of policy 'ur5' version 4: expected at ur5/4\.json"),
        ({**GOOD, "name": "../ur5"}, "name"),
        ({**GOOD, "more": 1}, "more"),
        ([GOOD], "is of format None"),
        (json.dumps(GOOD).replace('"policy.ts"', '"policy.onnx"'), "it has 'policy.onnx' twice"),
        ("[" * 20_000, "is no manifest|is of format"),
        (json.dumps(GOOD) + " " * MAX_MANIFEST_BYTES, "is larger than 65,536 bytes"),
        ("\x00", "is no manifest"),
    ],
)  # fmt: skip
def test_a_hostile_manifest_is_refused_with_a_sentence_that_names_it(document: Any, sentence: str) -> None:
    content = document if isinstance(document, str) else json.dumps(document)
    assert Manifest.parse(json.dumps(GOOD).encode(), "s3://b/ur5/3.json").digest == "0" * 64
    with pytest.raises(BundleError, match=sentence) as caught:
        Manifest.parse(content.encode(), "s3://b/ur5/3.json")
    assert caught.value.message.startswith("s3://b/ur5/3.json") and len(caught.value.message) < 400


def size_of(made: Path) -> int:
    return sum((made / "ur5" / "1" / name).stat().st_size for name in REQUIRED)


def test_the_cache_is_bounded_and_never_evicts_what_is_in_use(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2", "3")
    held = repository(storage, cache, cache_bytes=int(2.5 * size_of(made)))
    digests = {version: held.find_digest("ur5", version)[1] for version in ("1", "2", "3")}
    used = held.fetch("ur5", "1", digests["1"])
    os.utime(used.folder, (1, 1))  # used longest ago, and in use
    fetch(held, "2")
    fetch(held, "3")
    assert [v for v in digests if (cache / digests[v]).is_dir()] == ["1", "3"]
    other = repository(storage, cache, cache_bytes=int(1.5 * size_of(made)))
    with pytest.raises(
        UnavailableError, match=r"ur5/2 needs .* of the cache's .* are in use: raise RLSERVO_CACHE_BYTES"
    ):
        fetch(other, "2")
    used.release()
    fetch(other, "2")
    assert [v for v in digests if (cache / digests[v]).is_dir()] == ["2"]
    with pytest.raises(UnavailableError, match=r"the cache may hold 1,000 \(RLSERVO_CACHE_BYTES\)"):
        fetch(repository(storage, cache, cache_bytes=1000), "1")


def test_another_processs_lease_keeps_its_bundle_and_ends_with_it(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2")
    held = repository(storage, cache, cache_bytes=int(1.5 * size_of(made)))
    fetch(held, "1")
    digest = held.find_digest("ur5", "1")[1]
    code = (
        "import sys, pathlib; from rlservo.serve_app.versions.bundle_cache import BundleCache; "
        f"lease = BundleCache(pathlib.Path({str(cache)!r}), 1 << 20).lease({digest!r}); "
        "print(lease is not None, flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"True\n"
        with pytest.raises(UnavailableError, match="are in use"):
            fetch(held, "2")
        process.kill()
    fetch(held, "2")
    assert not (cache / digest).exists()


def test_replicas_fetch_a_version_once_and_mend_a_damaged_one(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")
    before = storage.gets("ur5/1/policy.onnx")
    storage.tell(only("policy.onnx", late(0.3)))
    folders: list[Path] = []
    threads = [threading.Thread(target=lambda: folders.append(fetch(repository(storage, cache)))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(folders)) == 1 and len(folders) == 4 and storage.gets("ur5/1/policy.onnx") == before + 1
    (folders[0] / "policy.onnx").write_bytes(b"damaged")
    assert load_bundle(fetch(repository(storage, cache))).path == folders[0]
    storage.go_away()
    (folders[0] / "policy.onnx").unlink()
    digest = load_bundle(made / "ur5" / "1").digest
    with pytest.raises(UnavailableError, match=rf"ur5/1\.json {AWAY}"):
        repository(storage, cache).fetch("ur5", "1", digest)


@pytest.mark.parametrize("name", ["SHA256SUMS", "policy.onnx"])
def test_an_entry_whose_manifest_lacks_a_file_is_fetched_again(
    name: str, made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "1")
    folder = fetch(repository(storage, cache))
    document = json.loads((folder / MANIFEST_FILE).read_text())
    del document["files"][name]
    (folder / MANIFEST_FILE).write_text(json.dumps(document))
    (folder / name).unlink()
    assert load_bundle(fetch(repository(storage, cache))).digest == load_bundle(made / "ur5" / "1").digest


def test_a_served_version_stays_in_the_cache_until_it_is_let_go(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2")
    held = repository(storage, cache, cache_bytes=int(1.5 * size_of(made)))

    async def run() -> None:
        control = ReplicaVersions(VersionLoader(held), MemoryLedger(), replica="only")
        await control.configure({"policies": {"ur5": {"versions": ["1"]}}})
        with pytest.raises(UnavailableError, match="are in use"):
            await control.load("ur5", "2", what="load")
        await control.change(lambda plan: plan_changes.unload(plan, "ur5", None), what="unload")
        await control.load("ur5", "2", what="load")

    asyncio.run(run())


def test_a_folder_is_published_to_at_once_and_served_by_path_file_uri_and_http(made: Path, cache: Path) -> None:
    folder = cache.parent / "published"
    put(made, f"file://{folder}", "1")
    put(made, str(folder), "2")
    with pytest.raises(ConflictError, match=r"1\.json is there already \(another bundle\)"):
        publish(load_bundle(made / "other" / "ur5" / "1"), str(folder))
    (folder / "ur5" / "1.json").unlink()
    with pytest.raises(ConflictError, match="ur5/1 is there already and holds another bundle"):
        publish(load_bundle(made / "other" / "ur5" / "1"), str(folder))
    put(made, str(folder), "1")  # only its manifest was missing
    assert next_version(str(folder), "ur5") == "3"
    expected = {version: load_bundle(made / "ur5" / version).digest for version in ("1", "2")}
    assert sorted(path.name for path in (folder / "ur5").iterdir()) == ["1", "1.json", "2", "2.json"]
    for place in (str(folder), f"file://{folder}"):
        assert Repository([place]).available(ALL) == {"ur5": expected}
    with shown(folder) as url:
        held = Repository([url], cache=cache)
        assert held.available(ALL) == {"ur5": expected}
        assert load_bundle(held.fetch("ur5", "2", expected["2"]).folder).digest == expected["2"]
        with pytest.raises(UsageError, match="can only be read"):
            put(made, url, "3")


@contextlib.contextmanager
def shown(folder: Path) -> Iterator[str]:
    """A plain HTTP server of a folder, which knows no ranges."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(
    ("place", "is_packed"), [("/ur5/", True), ("/ur5/1.json", False), ("/ur5/1/policy.onnx", False)]
)
def test_a_web_server_that_sends_more_than_it_may_is_left(
    place: str, is_packed: bool, made: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = cache.parent / "published"
    put(made, str(folder), "1")
    digest = load_bundle(made / "ur5" / "1").digest
    page = zlib.compress(bytes(MOST_SENT), 1)

    def do_get(self: http.server.SimpleHTTPRequestHandler) -> None:
        if self.path != place:
            honest(self)
            return
        self.send_response(200)
        self.send_header("content-type", "text/html")
        if is_packed:
            self.send_header("content-encoding", "deflate")
        self.end_headers()
        with contextlib.suppress(ConnectionError):
            for _ in range(1 if is_packed else MOST_SENT // len(ENDLESS)):
                self.wfile.write(page if is_packed else ENDLESS)
            ended.append(self.path)

    honest, ended = http.server.SimpleHTTPRequestHandler.do_GET, list[str]()
    monkeypatch.setattr(http.server.SimpleHTTPRequestHandler, "do_GET", do_get)
    with shown(folder) as url:
        held = Repository([url], cache=cache, storage_timeout_s=10)
        what = f"{place.rstrip('/')}: the storage sends more than"
        if place.endswith("onnx"):
            with pytest.raises(BundleError, match=what):
                held.fetch("ur5", "1", digest)
        else:
            digests, errors = held.look()
            assert digests == {} and what in str(errors[0])
    assert is_packed or not ended


async def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)


def test_polling_loads_what_is_newer_and_says_once_that_the_storage_is_away(
    made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "2")

    async def run() -> None:
        control = replica(storage.uri, cache=cache)
        await control.configure({})
        poll = asyncio.create_task(control.poll_repository(0.05))
        await asyncio.to_thread(put, made, storage.uri, "1", "3")
        await until(lambda: control.store is not None and control.store.versions("ur5") == ("2", "3"))  # 1 is not newer
        assert control.store is not None and control.store.default("ur5") == "2"
        reads = storage.gets("ur5/3.json")
        await control.change(lambda plan: plan_changes.unload(plan, "ur5", "3"), what="unload")
        looked = storage.gets("/policies") + len(storage.proxy.requests)
        await until(lambda: len(storage.proxy.requests) > looked + 4)
        assert control.store.versions("ur5") == ("2",)  # what an operator unloaded stays unloaded
        assert storage.gets("ur5/3.json") == reads  # manifests that the list tells apart are read once
        storage.go_away()
        await until(lambda: "looking for new versions, what is served goes on: s3://" in caplog.text)
        storage.tell(None)
        await asyncio.to_thread(put, made, storage.uri, "4")
        await until(lambda: control.store is not None and control.store.versions("ur5") == ("2", "4"))
        poll.cancel()

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())
    told = [line for line in caplog.messages if line.startswith("looking for new versions")]
    assert len(told) == len(set(told))


@pytest.mark.parametrize(
    ("lie", "sentence"),
    [(late(9), "took longer than 6 s and was given up"), (None, "policy.onnx cannot be reached or")],
)
def test_polling_tries_again_what_could_not_be_read_for_a_while(
    lie: Lie | None, sentence: str, made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "1")

    async def run() -> None:
        control = replica(storage.uri, cache=cache, timeout_s=30, load_timeout_s=6 if lie is not None else 30)
        await control.configure({})
        await asyncio.to_thread(put, made, storage.uri, "2")
        storage.tell(only("2/policy.onnx", lie or busy))
        poll = asyncio.create_task(control.poll_repository(0.05))
        await until(lambda: sentence in caplog.text)
        assert control.store is not None and control.store.versions("ur5") == ("1",)
        assert control.plan is not None and control.plan.refused is None
        storage.tell(None)
        await until(lambda: control.store is not None and control.store.versions("ur5") == ("1", "2"))
        poll.cancel()

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())


def test_polling_leaves_out_what_the_configuration_pins(made: Path, cache: Path, tmp_path: Path) -> None:
    put(made, str(tmp_path / "p"), "1", "2")
    write_box_policy(tmp_path / "p", name="mir", version="1")
    write_box_policy(tmp_path / "p", name="mir", version="2")
    repository = Repository([tmp_path / "p"])
    control = ReplicaVersions(VersionLoader(repository), MemoryLedger(), replica="only")
    document = {"policies": {"ur5": {"versions": ["1"]}}, "unlisted": "ignore"}
    asyncio.run(control.configure(document))
    assert control._newer(repository.look()[0]) == []
    asyncio.run(control.configure({**document, "unlisted": "load"}))
    assert control._newer({**repository.look()[0], ("new", "1"): "", ("new", "2"): ""}) == [("new", "2")]


def test_a_wait_is_said(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), announced(lambda: "s3://b/ur5/3/policy.onnx", period_s=0.02):
        deadline = time.monotonic() + 30
        while "waiting for s3://b/ur5/3/policy.onnx" not in caplog.text and time.monotonic() < deadline:
            time.sleep(0.01)
    assert "waiting for s3://b/ur5/3/policy.onnx" in caplog.text


def test_a_folder_and_a_uri_are_one_repository(made: Path, storage: Storage, cache: Path, tmp_path: Path) -> None:
    put(made, storage.uri, "1", "2")
    local = tmp_path / "local"
    shutil.copytree(made / "ur5" / "1", local / "ur5" / "1")  # a copy is the same
    shutil.copytree(made / "ur5" / "4", local / "ur5" / "4")
    both = Repository([local, storage.uri], cache=cache)
    assert list(both.available(ALL)["ur5"]) == ["1", "2", "4"]
    shutil.rmtree(local / "ur5" / "1")
    shutil.copytree(made / "other" / "ur5" / "1", local / "ur5" / "1")
    with pytest.raises(UsageError, match=r"version 1 is in both .*/local/ur5/1 and s3://.*/policies/ur5/1"):
        both.available(ALL)
    with pytest.raises(UnknownPolicyError, match="has no policy 'mir': it has ur5"):
        both.find_digest("mir", None)
