"""Repositories behind URIs: published whole or not at all, fetched by hash, served while unreachable."""

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
import socket
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
from rlservo.bundle.bundle import load_bundle
from rlservo.errors import (
    BundleError,
    ConflictError,
    RefusedError,
    RlservoError,
    UnavailableError,
    UnknownPolicyError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.engines.server_process import repeat
from rlservo.serve_app.repository.index import INDEX, Index
from rlservo.serve_app.repository.object_storage import ObjectStorage
from rlservo.serve_app.repository.places import place_of
from rlservo.serve_app.repository.publication import next_version, publish
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.blocking_calls import BlockingCalls
from rlservo.serve_app.versions.deployment_plan import Plan, ServedConfig
from rlservo.serve_app.versions.plan_commands import Load, SetAlias, Unload
from rlservo.serve_app.versions.plan_files import PlanFiles
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.version_loader import VersionLoader
from storages import ENDLESS, MOST_SENT, SECRET, Cut, Drip, Lie, Storage, late, only
from waiting import until

AWAY = "(cannot be reached or read|gave no answer)"
FILES = ("SHA256SUMS", "contract.json", "golden.npz", "policy.onnx", "policy.ts")


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


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the plans of http repositories are kept, and how often those in storages are looked for."""
    monkeypatch.setattr("rlservo.serve_app.versions.plan_files.STORAGE_POLL_S", 0.1)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def put(made: Path, uri: str, *versions: str) -> None:
    for version in versions:
        publish(load_bundle(made / "ur5" / version), uri)


def repository(storage: Storage, cache: Path, **more: Any) -> Repository:
    return Repository([storage.uri], cache=cache, **{"timeout_s": 20, **more})


def replica(*places: str, cache: Path, timeout_s: float = 20) -> PlanFollower:
    loader = VersionLoader(Repository(places, cache=cache, timeout_s=timeout_s))
    return PlanFollower(loader, PlanFiles(places, cache=cache, timeout_s=timeout_s))


def aliased(version: str, alias: str = "production") -> SetAlias:
    return SetAlias(alias=alias, version=version)


def fetch(repository: Repository, version: str = "1") -> Path:
    found, digest = repository.look().find("ur5", version)
    with repository.fetch("ur5", found, digest) as folder:
        return folder


def digest_of(made: Path, version: str) -> str:
    return load_bundle(made / "ur5" / version).digest


def test_a_published_version_is_found_fetched_once_and_proven(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2")
    held = repository(storage, cache)
    assert held.look().available(needs_all=True) == {"ur5": {v: digest_of(made, v) for v in ("1", "2")}}
    before = storage.gets("ur5/2/policy.onnx")
    folder = fetch(held, "2")
    with contextlib.closing(Policy.load(folder)) as policy:
        assert (policy.contract.name, policy.contract.version) == ("ur5", "2")
    with contextlib.closing(load_served([storage.uri], ServedConfig(), ServerSettings(cache=str(cache)))) as store:
        assert store.default("ur5") == "2"
    assert storage.gets("ur5/2/policy.onnx") == before + 1


def test_versions_are_immutable_and_the_next_number_is_found(made: Path, storage: Storage) -> None:
    put(made, storage.uri, "1")
    with pytest.raises(ConflictError, match=r"ur5/1 already exists \(this very bundle\)"):
        put(made, storage.uri, "1")
    other = load_bundle(made / "other" / "ur5" / "1")
    with pytest.raises(ConflictError, match=r"ur5/1 already exists \(another bundle\): versions are never over"):
        publish(other, storage.uri)
    assert next_version(storage.uri, "ur5") == "2" and next_version(storage.uri, "mir") == "1"
    storage.change("DELETE", INDEX)  # as if left half-way: no server sees it, and its number is not free
    assert next_version(storage.uri, "ur5") == "2"
    with pytest.raises(
        ConflictError, match=r"ur5/1/SHA256SUMS holds a different file from .* published by another command"
    ):
        publish(other, storage.uri)
    put(made, storage.uri, "1")  # the same bundle continues where it stopped


def test_a_list_of_objects_of_several_pages_is_read_to_its_end(storage: Storage) -> None:
    for number in range(1, 8):
        storage.change("PUT", f"ur5/{number}/SHA256SUMS", b"x")

    def three(path: str, status: int, headers: dict[str, str], body: bytes) -> Any:
        if "list-type" in path and body.count(b"<Key>") > 3:
            first = b"</Contents>".join(body.split(b"</Contents>")[:3]) + b"</Contents>"
            body = first + b"<IsTruncated>true</IsTruncated></ListBucketResult>"
        return status, headers, body

    storage.tell(three)
    assert next_version(storage.uri, "ur5") == "8"


def test_an_object_is_read_again_after_its_connection_broke(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")
    replies = iter([True])
    storage.tell(only("1/policy.onnx", lambda _, status, heads, b: (status, heads, Cut(b) if next(replies, 0) else b)))
    assert load_bundle(fetch(repository(storage, cache))).digest == digest_of(made, "1")
    assert next(replies, None) is None


def test_an_object_is_written_although_the_reply_was_lost(made: Path, storage: Storage) -> None:
    replies = iter([None])
    storage.tell(
        only(INDEX, lambda *reply: next(replies, reply[1:]) if "PUT" in storage.proxy.requests[-1] else reply[1:])
    )
    put(made, storage.uri, "1")
    assert next(replies, 0) == 0


def test_an_empty_file_of_a_bundle_is_published_with_it(made: Path, storage: Storage, cache: Path) -> None:
    folder = Path(shutil.copytree(made / "ur5" / "1", cache.parent / "ur5" / "1"))
    (folder / "notes.txt").touch()
    with (folder / "SHA256SUMS").open("a") as sums:
        sums.write(f"{hashlib.sha256().hexdigest()}  notes.txt\n")
    publish(load_bundle(folder), storage.uri)
    fetched = fetch(repository(storage, cache))
    assert (fetched / "notes.txt").read_bytes() == b"" and load_bundle(fetched).digest == load_bundle(folder).digest


def at_once(calls: list[Callable[[], Any]]) -> list[Any]:
    """Return what each call returned or raised."""
    outcomes: list[Any] = [None] * len(calls)

    def run(number: int) -> None:
        try:
            outcomes[number] = calls[number]()
        except RlservoError as error:
            outcomes[number] = error

    threads = [threading.Thread(target=run, args=(number,)) for number in range(len(calls))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return outcomes


def test_of_two_publishers_of_a_version_one_wins_and_what_is_there_is_whole(
    made: Path, storage: Storage, cache: Path
) -> None:
    storage.tell(late(0.02))
    folders = [made / "ur5" / "1", made / "other" / "ur5" / "1"]
    outcomes = at_once([functools.partial(publish, load_bundle(folder), storage.uri) for folder in folders])
    (won,) = [folder for folder, outcome in zip(folders, outcomes, strict=True) if isinstance(outcome, str)]
    assert sum(isinstance(outcome, ConflictError) for outcome in outcomes) == 1
    assert load_bundle(fetch(repository(storage, cache))).digest == load_bundle(won).digest


@pytest.mark.parametrize("kind", ["s3", "folder"])
def test_of_publishers_of_different_versions_all_are_in_the_index(
    kind: str, made: Path, storage: Storage, cache: Path
) -> None:
    storage.tell(late(0.02))
    place = storage.uri if kind == "s3" else str(cache.parent / "folder")
    if kind == "folder":
        Path(place).mkdir()
    bundles = [load_bundle(made / "ur5" / str(version)) for version in range(1, 5)]
    outcomes = at_once([functools.partial(publish, bundle, place) for bundle in bundles])
    assert all(isinstance(outcome, str) for outcome in outcomes), outcomes
    content = Path(place, INDEX).read_bytes() if kind == "folder" else ObjectStorage(place).read(INDEX, 1 << 20)[0]
    assert Index.parse(content, place).policies == {"ur5": {b.contract.version: b.digest for b in bundles}}


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
    "changed byte": (only("2/policy.onnx", changed_byte), r"/policies/ur5/2: policy\.onnx is not the file that was"),
    "truncated": (only("2/policy.onnx", truncated), r"/policies/ur5/2: policy\.onnx is not the file that was"),
    "cut": (
        only("2/policy.onnx", lambda p, s, h, b: (s, h, Cut(b))),
        r"/policies/ur5/2/policy\.onnx cannot be reached or read: the connection broke after [\d,]+ bytes",
    ),
    "503": (only("2/policy.onnx", busy), r"/policies/ur5/2/policy\.onnx cannot be reached or read: .*later"),
    "late": (only("2/policy.onnx", late(6)), r"/policies/ur5/2/policy\.onnx gave no answer within \d"),
    "drop by drop": (
        only("2/SHA256SUMS", lambda p, s, h, b: (s, h, Drip(b))),
        r"/policies/ur5/2/SHA256SUMS gave no answer within \d s",
    ),
    "403": (only("2/policy.onnx", echo), r"/policies/ur5/2/policy\.onnx is refused with the credentials .*no: token"),
    "redirect": (
        only("2/policy.onnx", lambda *_: (307, {"location": "http://169.254.169.254/token?secret"}, b"")),
        r"/policies/ur5/2/policy\.onnx is redirected to http://169\.254\.169\.254/token, which is not followed",
    ),
    "another region": (
        only("2/policy.onnx", lambda *_: (301, {"x-amz-bucket-region": "eu-west-1"}, b"")),
        r"is redirected to eu-west-1, which is not followed",
    ),
    "deleted": (
        only("2/policy.onnx", lambda *_: (404, {}, b"<Error><Code>NoSuchKey</Code><Message>gone</Message></Error>")),
        r"/policies/ur5/2/policy\.onnx is missing: the version was deleted",
    ),
    "endless object": (
        only("2/SHA256SUMS", endless),
        r"/policies/ur5/2/SHA256SUMS: the storage sent more than the 65,536 bytes allowed$",
    ),
    "endless refusal": (
        only("2/policy.onnx", lambda *reply: (403, *endless(*reply)[1:])),
        r"/policies/ur5/2/policy\.onnx is refused with the credentials of .*\(status 403\)",
    ),
    "garbled index": (
        only(INDEX, lambda p, s, h, b: (s, h, b[:60])),
        r"/policies/index\.json is not an index of versions",
    ),
    "endless index": (only(INDEX, endless), r"/policies/index\.json: the storage sent more than the 16,777,216 b"),
    "index is 503": (only(INDEX, busy), r"/policies/index\.json cannot be reached or read"),
}


@pytest.mark.parametrize("kind", list(LIES))
def test_a_storage_that_lies_is_told_in_a_sentence_and_what_runs_goes_on(
    kind: str, made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "1")
    lie, sentence = LIES[kind]

    async def run() -> None:
        control = replica(storage.uri, cache=cache, timeout_s=4 if kind in ("late", "drop by drop") else 20)
        await control.configure({})
        await asyncio.to_thread(put, made, storage.uri, "2")
        storage.tell(lie)
        with pytest.raises((RefusedError, UnavailableError), match=sentence) as caught:
            await control.give(Load(version="2"), "ur5")
        assert "xxxx" not in caught.value.message and "AKIA" not in caught.value.message
        assert SECRET not in caught.value.message and "Signature" not in caught.value.message
        assert storage.proxy.sent < MOST_SENT  # who asked has hung up
        assert control.store is not None and control.store.versions("ur5") == ("1",)
        assert control.plan is not None and control.plan.generation == 1
        storage.tell(None)
        await control.give(Load(version="2"), "ur5")
        assert control.store.versions("ur5") == ("1", "2") and control.store.default("ur5") == "1"

    asyncio.run(run())


def test_a_bundle_is_bounded_by_the_servers_limits(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")
    settings = ServerSettings(cache=str(cache), max_policy_bytes=1024)
    with pytest.raises(BundleError, match=r"ur5/1/policy.onnx: the storage sent more than the 1,024 bytes"):
        load_served([storage.uri], ServedConfig(), settings)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("../x.json", "SHA256SUMS, line 5: expected"),
        ("..", "SHA256SUMS, line 5: expected"),
        (".bashrc", "SHA256SUMS, line 5: expected"),
        ("/etc/x.json", "SHA256SUMS, line 5: expected"),
        ("run.pkl", "lists run.pkl: a published bundle holds"),
        ("run.so", "lists run.so: a published bundle holds"),
        (None, "lists 24 files: at most 16"),
    ],
)
def test_hostile_names_of_files_are_refused(
    line: str | None, sentence: str, made: Path, storage: Storage, cache: Path
) -> None:
    hashed = f"{'0' * 64}  "
    names = [f"f{n}.txt" for n in range(20)] if line is None else [line]
    own = (made / "ur5" / "1" / "SHA256SUMS").read_text().splitlines()
    sums = "\n".join([*own, *(hashed + name for name in names)]).encode()
    for name in FILES:
        storage.change("PUT", f"ur5/1/{name}", (made / "ur5" / "1" / name).read_bytes())
    storage.change("PUT", "ur5/1/SHA256SUMS", sums)
    index = Index(policies={"ur5": {"1": hashlib.sha256(sums).hexdigest()}})
    storage.change("PUT", INDEX, index.model_dump_json().encode())
    with pytest.raises(BundleError, match=sentence):
        fetch(repository(storage, cache))
    assert not list(cache.iterdir())


UNFINISHED: dict[str, tuple[str, bytes | None, type[RlservoError], str]] = {
    "swallowed": ("/1/SHA256SUMS", None, UnavailableError, r"/ur5/1/SHA256SUMS is not there after it was written$"),
    "changed": ("/1/policy.onnx", b"another", ConflictError, r"/ur5/1/policy\.onnx holds a different file from "),
    "index swallowed": ("/index.json", None, UnavailableError, r"/index\.json is not there after it was written$"),
    "index changed": ("/index.json", b"{", BundleError, r"/index\.json is not an index of versions"),
}


@pytest.mark.parametrize("kind", list(UNFINISHED))
def test_a_storage_that_keeps_something_else_than_it_was_given_publishes_nothing(
    kind: str, made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "2")
    end, kept, error, sentence = UNFINISHED[kind]

    def lie(path: str, *reply: Any) -> Any:
        if path.partition("?")[0].endswith(end) and storage.proxy.requests[-1].startswith("PUT "):
            storage.change(
                "DELETE" if kept is None else "PUT", end.lstrip("/") if "index" in kind else f"ur5{end}", kept or b""
            )
        return reply

    storage.tell(lie)
    with pytest.raises(error, match=sentence):
        put(made, storage.uri, "1")
    if "index" not in kind:
        assert list(repository(storage, cache).look().digests["ur5"]) == ["2"]
    storage.tell(None)
    if kept is None:
        put(made, storage.uri, "1")  # the kept part is of the same bundle: it continues from there


@pytest.mark.parametrize(
    "page", [b"", b"<html><body>log in, please</body></html>"], ids=["nothing", "a page to log in"]
)
def test_an_index_that_is_none_withdraws_nothing(page: bytes, made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")

    async def run() -> None:
        control = replica(storage.uri, cache=cache)
        await control.configure({})
        storage.tell(only(INDEX, lambda *_: (200, {}, page)))
        listing = repository(storage, cache).look()
        digests, errors = listing.digests, list(listing.errors.values())
        assert digests == {} and "is not an index of versions" in str(errors[0])
        again = replica(storage.uri, cache=cache)
        await again.configure({})
        assert again.store is not None and again.store.default("ur5") == "1"

    asyncio.run(run())


def test_an_exchanged_version_is_refused_by_name_and_the_accepted_one_runs_on(
    made: Path, storage: Storage, cache: Path
) -> None:
    put(made, storage.uri, "1")
    accepted = digest_of(made, "1")
    other = load_bundle(made / "other" / "ur5" / "1")
    fetch(repository(storage, cache))
    for name in FILES:
        storage.change("PUT", f"ur5/1/{name}", (other.path / name).read_bytes())
    index = Index(policies={"ur5": {"1": other.digest}})
    storage.change("PUT", INDEX, index.model_dump_json().encode())
    assert repository(storage, cache).look().find("ur5", "1") == ("1", other.digest)
    with repository(storage, cache).fetch("ur5", "1", accepted) as folder:  # the cache still has what was accepted
        assert load_bundle(folder).digest == accepted
    with (
        pytest.raises(BundleError, match=r"policies/ur5/1 is not the bundle that was accepted as version 1 of 'ur5'"),
        repository(storage, cache.parent / "another").fetch("ur5", "1", accepted),
    ):
        pass


def test_a_plan_in_object_storage_is_followed_raced_for_and_outlives_all(
    made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "1", "2", "3")

    async def run() -> None:
        controls = [replica(storage.uri, cache=cache) for _ in range(3)]
        for control in controls:
            await control.configure({})
        polls = [
            asyncio.create_task(repeat(control.files.poll_s, control.follow, "the plan cannot be followed"))
            for control in controls
        ]
        await controls[0].give(aliased("1"), "ur5")
        await until(lambda: all(c.store is not None and c.store.default("ur5") == "1" for c in controls))
        storage.tell(late(0.1))
        outcomes = await asyncio.gather(
            controls[0].give(aliased("2"), "ur5"),
            controls[1].give(aliased("3"), "ur5"),
            return_exceptions=True,
        )
        assert sum(isinstance(outcome, ConflictError) for outcome in outcomes) == 1, outcomes
        assert sum(isinstance(outcome, Plan) for outcome in outcomes) == 1
        await until(lambda: {c.plan.generation for c in controls if c.plan} == {3})
        storage.go_away()
        with pytest.raises(UnavailableError, match=AWAY):
            await controls[2].give(aliased("1", "candidate"), "ur5")
        storage.tell(None)  # it was away for a moment: that is no refusal
        await controls[2].give(aliased("1", "candidate"), "ur5")
        for poll in polls:
            poll.cancel()
        new = replica(storage.uri, cache=cache.parent / "another")  # a whole new cluster
        await new.configure({"policies": {"ur5": {"versions": ["1"]}}})
        assert new.plan is not None and new.plan.generation == 4
        assert new.plan.policies["ur5"].aliases["candidate"] == "1"

    asyncio.run(run())


def test_a_server_starts_again_with_its_storage_away(
    made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "1", "2", "3")

    async def run(away: bool) -> None:
        control = replica(storage.uri, cache=cache)
        await control.configure({"policies": {"ur5": {"versions": ["1", "2"]}}} if not away else {})
        if not away:
            await control.give(aliased("1"), "ur5")
        assert control.store is not None and control.store.default("ur5") == "1"
        if away:
            for version in ("2", "3", None):
                with pytest.raises(UnavailableError, match=f"policies/.* {AWAY}"):
                    await control.give(Load(version=version), "ur5")
            assert control.store.versions("ur5") == ("1", "2")
            with pytest.raises(UnavailableError, match=rf"policies/\.plan {AWAY}"):
                await replica(storage.uri, cache=cache.parent / "empty").configure({})

    asyncio.run(run(away=False))
    storage.go_away()
    with caplog.at_level(logging.WARNING):
        asyncio.run(run(away=True))
    assert "serving plan 2, the last one that was seen here" in caplog.text


def test_wrong_and_missing_credentials_are_said(
    made: Path, storage: Storage, cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    put(made, storage.uri, "1")
    storage.tell(echo)
    with pytest.raises(UnavailableError, match=r"s3://.* is refused with the credentials of this process's env"):
        repository(storage, cache).look().find("ur5", None)
    storage.tell(None)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(UnavailableError, match="Unable to locate credentials"):
        repository(storage, cache).look().find("ur5", None)


@pytest.mark.parametrize(
    "uri",
    [
        "s3://key:hunter2@bucket/policies",
        "https://host/p?X-Amz-Signature=hunter2",
        "simplecache::s3://bucket/p",
        "file://host/p",
        "gs://bucket/p",
        "s3:///p",
        "hf://hunter2@owner/name",
        "hf://owner/name?token=hunter2",
    ],
)
def test_uris_with_secrets_or_of_other_protocols_are_refused_without_showing_them(uri: str) -> None:
    with pytest.raises(UsageError, match="expected s3://bucket/policies, hf://owner/name") as caught:
        Repository([uri])
    assert "hunter2" not in caught.value.message
    with pytest.raises(UsageError, match="credentials come from the environment"):
        place_of(uri)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    monkeypatch.setitem(sys.modules, "botocore.session", None)
    with pytest.raises(UsageError, match=r"s3://b/p cannot be opened here: pip install '\.\[remote\]'"):
        Repository(["s3://b/p"], cache=cache).look().find("ur5", None)


def test_local_folders_import_nothing_of_it(made: Path) -> None:
    code = (
        "import sys; from rlservo.serve_app.repository.repository import Repository; "
        f"print(Repository([{str(made)!r}]).look().find('ur5', None)[0]); "
        "print([m for m in ('fsspec', 'botocore', 'urllib3', 'aiohttp', 'pyarrow') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["4", "[]"]


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        ({"format": 2, "policies": {}}, "format: "),
        ({"policies": {"../ur5": {}}}, r"policies\.\.\./ur5"),
        ({"policies": {"ur5": {"../1": "0" * 64}}}, r"policies\.ur5\.\.\./1"),
        ({"policies": {"ur5": {"1": "0" * 63}}}, r"policies\.ur5\.1"),
        ({"policies": {"ur5": {"1": 7}}}, r"policies\.ur5\.1"),
        ({"policies": {"ur5": ["1"]}}, r"policies\.ur5"),
        ({"policies": {}, "more": 1}, "more"),
        ([], "is not an index of versions"),
        ("[" * 200_000, "is not an index of versions"),
        ("\x00", "is not an index of versions"),
    ],
)
def test_a_hostile_index_is_refused_with_a_sentence_that_names_it(document: Any, sentence: str) -> None:
    content = document if isinstance(document, str) else json.dumps(document)
    with pytest.raises(BundleError, match=sentence) as caught:
        Index.parse(content.encode(), "s3://b/index.json")
    assert caught.value.message.startswith("s3://b/index.json is not an index") and len(caught.value.message) < 400


def size_of(made: Path) -> int:
    return sum((made / "ur5" / "1" / name).stat().st_size for name in FILES)


def test_the_cache_is_bounded_and_gives_up_what_was_used_longest_ago(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2", "3")
    held = repository(storage, cache, cache_bytes=int(2.5 * size_of(made)))
    digests = {version: held.look().find("ur5", version)[1] for version in ("1", "2", "3")}
    fetch(held, "1")
    fetch(held, "2")
    for number, version in enumerate(("1", "2")):
        os.utime(cache / digests[version], (number + 1, number + 1))
    held.touch([digests["1"]])  # it is served
    fetch(held, "3")
    assert [v for v in digests if (cache / digests[v]).is_dir()] == ["1", "3"]
    small = repository(storage, cache, cache_bytes=1000)
    with small.fetch("ur5", "2", digests["2"]) as folder:  # it is being loaded
        assert [each.name for each in cache.iterdir() if each.is_dir()] == [folder.name]


def test_another_processs_bundle_stays_until_that_ends(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1", "2")
    held = repository(storage, cache, cache_bytes=int(1.5 * size_of(made)))
    fetch(held, "1")
    digest = held.look().find("ur5", "1")[1]
    code = (
        "import sys, pathlib; from rlservo.serve_app.repository.bundle_cache import BundleCache\n"
        f"with BundleCache(pathlib.Path({str(cache)!r}), 1 << 20).bundle({digest!r}, None):\n"
        "    print('holds it', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"holds it\n"
        fetch(held, "2")
        assert (cache / digest / "policy.onnx").exists()
        process.kill()
    shutil.rmtree(cache / held.look().find("ur5", "2")[1])
    fetch(held, "2")
    assert not (cache / digest).exists()


def test_processes_fetch_a_version_once_and_mend_a_damaged_one(made: Path, storage: Storage, cache: Path) -> None:
    put(made, storage.uri, "1")
    before = storage.gets("ur5/1/policy.onnx")
    storage.tell(only("policy.onnx", late(0.3)))
    folders = at_once([lambda: fetch(repository(storage, cache)) for _ in range(4)])
    assert len(set(folders)) == 1 and storage.gets("ur5/1/policy.onnx") == before + 1
    (folders[0] / "policy.onnx").write_bytes(b"damaged")
    assert load_bundle(fetch(repository(storage, cache))).path == folders[0]
    storage.go_away()
    (folders[0] / "policy.onnx").unlink()
    with (
        pytest.raises(UnavailableError, match=rf"ur5/1/SHA256SUMS {AWAY}"),
        repository(storage, cache).fetch("ur5", "1", digest_of(made, "1")),
    ):
        pass


@contextlib.contextmanager
def shown(folder: Path, answer: Callable[[http.server.SimpleHTTPRequestHandler], bool] | None = None) -> Iterator[str]:
    """A plain HTTP server of a folder; `answer` may answer in its place."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            if answer is None or not answer(self):
                super().do_GET()

        def log_message(self, *_: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def test_a_folder_is_published_to_at_once_and_served_by_path_file_uri_and_http(made: Path, cache: Path) -> None:
    folder = cache.parent / "published"
    folder.mkdir()
    put(made, f"file://{folder}", "1")
    put(made, str(folder), "2")
    with pytest.raises(ConflictError, match=r"ur5/1 already exists \(another bundle\)"):
        publish(load_bundle(made / "other" / "ur5" / "1"), str(folder))
    (folder / INDEX).unlink()
    with pytest.raises(ConflictError, match="ur5/1 already exists and holds another bundle"):
        publish(load_bundle(made / "other" / "ur5" / "1"), str(folder))
    put(made, str(folder), "1", "2")  # only their lines were missing
    assert next_version(str(folder), "ur5") == "3"
    expected = {version: digest_of(made, version) for version in ("1", "2")}
    assert sorted(path.name for path in (folder / "ur5").iterdir()) == ["1", "2"]
    for place in (str(folder), f"file://{folder}"):
        assert Repository([place]).look().available(needs_all=True) == {"ur5": expected}
    with shown(folder) as url:
        held = Repository([url], cache=cache)
        assert held.look().available(needs_all=True) == {"ur5": expected}
        assert load_bundle(fetch(held, "2")).digest == expected["2"]
        with pytest.raises(UsageError, match="can only be read"):
            put(made, url, "3")

        async def run() -> None:
            for number, version in ((1, "2"), (2, "1")):  # the plan is in the user's state folder
                control = replica(url, cache=cache)
                await control.configure({})
                plan = await control.give(aliased("1"), "ur5")
                assert (plan.generation, control.store and control.store.default("ur5")) == (2, "1"), (number, version)

        asyncio.run(run())


HTTP_LIES: dict[str, tuple[str, Callable[[http.server.SimpleHTTPRequestHandler], object], str]] = {
    "endless": ("/index.json", lambda h: stream(h, {}), "index.json: the storage sent more than the 16,777,216 bytes"),
    "packed": (
        "/index.json",
        lambda h: stream(h, {"content-encoding": "deflate"}, zlib.compress(bytes(20 << 20), 1)),
        "index.json is not an index of versions",
    ),
    "folders' links": (
        "/index.json",
        lambda h: stream(h, {"content-type": "text/html"}, b"<a" + b" " * 1500),
        "index.json is not an index of versions",
    ),
    "elsewhere": (
        "/index.json",
        lambda h: (h.send_response(302), h.send_header("location", "http://10.0.0.1/x"), h.end_headers()),
        "index.json is redirected to http://10.0.0.1/x, which is not followed",
    ),
    "header by header": ("/index.json", lambda h: drip(h), "index.json gave no answer within 1 s"),
    "no index": ("/index.json", lambda h: h.send_error(404), "has no index.json: nothing was published there"),
}


def stream(handler: http.server.SimpleHTTPRequestHandler, headers: dict[str, str], page: bytes = b"") -> None:
    handler.send_response(200)
    for name, value in headers.items():
        handler.send_header(name, value)
    handler.end_headers()
    with contextlib.suppress(ConnectionError):
        for _ in range(1 if page else MOST_SENT // len(ENDLESS)):
            handler.wfile.write(page or ENDLESS)


def drip(handler: http.server.SimpleHTTPRequestHandler) -> None:
    handler.wfile.write(b"HTTP/1.0 200 OK\r\nx: ")
    with contextlib.suppress(ConnectionError):
        for _ in range(100):
            handler.wfile.write(b"x")
            time.sleep(0.1)


@pytest.mark.parametrize("kind", list(HTTP_LIES))
def test_a_web_server_that_lies_is_told_in_a_sentence(kind: str, made: Path, cache: Path) -> None:
    folder = cache.parent / "published"
    folder.mkdir()
    put(made, str(folder), "1")
    path, lie, sentence = HTTP_LIES[kind]

    def answer(handler: http.server.SimpleHTTPRequestHandler) -> bool:
        if handler.path == path:
            lie(handler)
        return handler.path == path

    with shown(folder, answer) as url:
        began = time.monotonic()
        listing = Repository([url], cache=cache, timeout_s=2).look()
        digests, errors = listing.digests, list(listing.errors.values())
        assert time.monotonic() - began < 20 and digests == {} and sentence in str(errors[0]), errors


def test_an_environments_proxy_is_asked_but_not_for_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str | None]] = []

    def answer(handler: http.server.SimpleHTTPRequestHandler) -> bool:
        asked.append((handler.path, handler.headers.get("proxy-authorization")))
        stream(handler, {}, b"{}")
        return True

    with shown(Path("/"), answer) as url:
        monkeypatch.setenv("http_proxy", url.replace("://", "://robot:pass%20word@"))
        for target in ("http://policies.example", url):
            assert ObjectStorage(target).read("own.json", 10)[0] == b"{}"
        with socket.create_server(("127.0.0.1", 0)) as nothing:
            port = nothing.getsockname()[1]
        with pytest.raises(UnavailableError, match="cannot be reached or read"):
            ObjectStorage(f"http://127.0.0.1:{port}").read("own.json", 10)
    assert asked == [("http://policies.example/own.json", "Basic cm9ib3Q6cGFzcyB3b3Jk"), ("/own.json", None)]


def test_polling_loads_what_is_newer_and_says_once_that_the_storage_is_away(
    made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "2")

    async def run() -> None:
        control = replica(storage.uri, cache=cache)
        await control.configure({})
        poll = asyncio.create_task(repeat(0.05, control.load_newer, "looking for new versions failed"))
        await asyncio.to_thread(put, made, storage.uri, "1", "3")
        await until(lambda: control.store is not None and control.store.versions("ur5") == ("2", "3"))  # 1 is not newer
        assert control.store is not None and control.store.default("ur5") == "2"
        await control.give(Unload(version="3"), "ur5")
        looks = storage.gets(INDEX)
        await until(lambda: storage.gets(INDEX) > looks + 4)
        assert control.store.versions("ur5") == ("2",)  # what an operator unloaded stays unloaded
        storage.go_away()
        await until(lambda: "looking for new versions failed, serving continues unchanged: s3://" in caplog.text)
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
    [
        (only("2/policy.onnx", late(4)), "policy.onnx gave no answer within 1 s"),
        (only("2/policy.onnx", busy), "policy.onnx cannot be reached or"),
        (only(INDEX, echo), "index.json is refused"),
        (only("000000002.json", busy), "000000002.json cannot be reached or"),
    ],
    ids=["version late", "version away", "index away", "plan away"],
)
def test_polling_tries_again_what_could_not_be_read_for_a_while(
    lie: Lie, sentence: str, made: Path, storage: Storage, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(made, storage.uri, "1")

    async def run() -> None:
        control = replica(storage.uri, cache=cache, timeout_s=2)
        await control.configure({})
        await asyncio.to_thread(put, made, storage.uri, "2")
        storage.tell(lie)
        poll = asyncio.create_task(repeat(0.05, control.load_newer, "looking for new versions failed"))
        await until(lambda: sentence in caplog.text)
        assert control.store is not None and control.store.versions("ur5") == ("1",)
        storage.tell(None)
        await until(lambda: control.store is not None and control.store.versions("ur5") == ("1", "2"))
        poll.cancel()

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())


def test_polling_leaves_out_what_the_configuration_pins(made: Path, cache: Path, tmp_path: Path) -> None:
    place = tmp_path / "p"
    for version in ("1", "2"):
        write_box_policy(place, version=version)
        write_box_policy(place, name="mir", version=version)

    async def served(document: Any) -> dict[str, tuple[str, ...]]:
        files = PlanFiles([place], root=str(tmp_path / json.dumps(document).replace("/", "")))
        control = PlanFollower(VersionLoader(Repository([place])), files)
        await control.configure(document)
        write_box_policy(place, version="3")
        write_box_policy(place, name="new", version="1")
        write_box_policy(place, name="new", version="2")
        poll = asyncio.create_task(repeat(0.02, control.load_newer, "looking for new versions failed"))
        await asyncio.sleep(1.0)
        poll.cancel()
        assert control.store is not None
        found = {name: control.store.versions(name) for name in control.store.names}
        shutil.rmtree(place / "ur5" / "3")
        shutil.rmtree(place / "new")
        return found

    pinned = {"policies": {"ur5": {"versions": ["1"]}}, "unlisted": "ignore"}
    assert asyncio.run(served(pinned)) == {"ur5": ("1",)}
    everything = {"ur5": ("1",), "mir": ("1", "2"), "new": ("2",)}
    assert asyncio.run(served({**pinned, "unlisted": "load"})) == everything
    assert asyncio.run(served({})) == {**everything, "ur5": ("1", "2", "3")}


def test_a_wait_is_said(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rlservo.serve_app.versions.blocking_calls.SILENCE_S", 0.05)
    go_on = threading.Event()

    async def run() -> None:
        waiting = asyncio.create_task(BlockingCalls(60).run("loading policy 'ur5'", go_on.wait))
        await until(lambda: "loading policy 'ur5' has taken" in caplog.text)
        go_on.set()
        assert await waiting

    with caplog.at_level(logging.WARNING):
        asyncio.run(run())


def test_a_folder_and_a_uri_are_one_repository(made: Path, storage: Storage, cache: Path, tmp_path: Path) -> None:
    put(made, storage.uri, "1", "2")
    local = tmp_path / "local"
    shutil.copytree(made / "ur5" / "1", local / "ur5" / "1")  # a copy is the same
    shutil.copytree(made / "ur5" / "4", local / "ur5" / "4")
    both = Repository([local, storage.uri], cache=cache)
    assert list(both.look().available(needs_all=True)["ur5"]) == ["1", "2", "4"]
    shutil.rmtree(local / "ur5" / "1")
    shutil.copytree(made / "other" / "ur5" / "1", local / "ur5" / "1")
    with pytest.raises(UsageError, match=r"version 1 is in both .*/local/ur5/1 and s3://.*/policies/ur5/1"):
        both.look().available(needs_all=True)
    with pytest.raises(UnknownPolicyError, match="has no policy 'mir': it has ur5"):
        both.look().find("mir", None)
