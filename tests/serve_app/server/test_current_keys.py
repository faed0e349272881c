"""The key file is followed while the server runs: changes that revoke a key, changes without effect, and their logs."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rlservo.errors import UsageError
from rlservo.serve_app.server import current_keys
from rlservo.serve_app.server.api_keys import Keys, new_key
from rlservo.serve_app.server.current_keys import CurrentKeys
from rlservo.serve_app.server.settings import ServerSettings
from servers import ask, served_in_thread
from streams import Stream
from waiting import wait_for

OLD, OLD_LINE = new_key("cell-7")
NEW, NEW_LINE = new_key("cell-8")
OBS = [0.1] * 27


def status(port: int, key: str) -> int:
    return ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS}, key)[0]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "keys"
    file.write_text(OLD_LINE + "\n")
    return file


@pytest.fixture
def replicas(ur5: Path, file: Path) -> Iterator[tuple[int, int]]:
    settings = {"api_keys_file": str(file)}
    with served_in_thread([ur5], settings=settings) as one, served_in_thread([ur5], settings=settings) as two:
        yield one, two


def in_place(file: Path, text: str) -> None:
    file.write_text(text)


def renamed_over(file: Path, text: str) -> None:
    beside = file.with_name("beside")
    beside.write_text(text)
    beside.replace(file)


def same_size_and_time(file: Path, text: str) -> None:
    before = file.stat()
    assert len(text) == before.st_size
    file.write_text(text)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize("write", [in_place, renamed_over, same_size_and_time])
def test_a_removed_key_stops_and_a_new_one_works_on_every_replica(
    replicas: tuple[int, int], file: Path, write: Callable[[Path, str], None]
) -> None:
    assert {status(port, OLD) for port in replicas} == {200} and {status(port, NEW) for port in replicas} == {401}
    write(file, NEW_LINE + "\n")
    # Two looks, half a second apart; the machine may be busy.
    wait_for(
        lambda: [status(port, key) for port in replicas for key in (OLD, NEW)] == [401, 200] * 2,
        timeout_s=5.0,
        poll_s=0.1,
    )


def test_a_secret_that_kubernetes_swaps_is_followed(ur5: Path, tmp_path: Path) -> None:
    def publish(name: str, text: str) -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "keys").write_text(text)
        (tmp_path / "..data_tmp").symlink_to(name)
        (tmp_path / "..data_tmp").replace(tmp_path / "..data")

    publish("..one", OLD_LINE)
    (tmp_path / "keys").symlink_to("..data/keys")
    with served_in_thread([ur5], settings={"api_keys_file": str(tmp_path / "keys")}) as port:
        assert status(port, OLD) == 200
        publish("..two", NEW_LINE)
        shutil.rmtree(tmp_path / "..one")
        wait_for(lambda: (status(port, OLD), status(port, NEW)) == (401, 200))


def break_by(file: Path, how: str) -> None:
    if how == "deleted":
        file.unlink()
    elif how == "empty":
        file.write_text("# nobody\n")
    elif how == "world-writable":
        file.write_text(NEW_LINE)
        file.chmod(0o666)
    elif how == "malformed":
        file.write_text(f"{NEW_LINE}\nsecret-in-clear\n")
    elif how == "a folder":
        file.unlink()
        file.mkdir()
    elif how == "a FIFO":
        file.unlink()
        os.mkfifo(file)
    elif how == "no text":
        file.write_bytes(b"\xff\xfe" + NEW_LINE.encode())
    elif how == "endless":
        file.write_text(NEW_LINE)
        os.truncate(file, 1 << 33)


def restore(file: Path) -> None:
    if file.is_dir():
        file.rmdir()
    elif file.exists():
        file.unlink()
    renamed_over(file, NEW_LINE)


@pytest.mark.parametrize(
    ("how", "sentence"),
    [("deleted", "cannot be read"), ("empty", "hold no key"), ("world-writable", "writable by every user"),
     ("malformed", "line 2: expected"), ("a folder", "is a folder"), ("a FIFO", "is a FIFO, not a regular file"),
     ("no text", "cannot be read"), ("endless", "is larger than")],
)  # fmt: skip
def test_a_file_that_cannot_be_used_changes_nothing_and_is_said_once(
    file: Path, how: str, sentence: str, caplog: pytest.LogCaptureFixture
) -> None:
    keys = CurrentKeys(ServerSettings(api_keys_file=str(file)))
    break_by(file, how)
    refresh(keys, times=5)
    assert keys.accepted.find(OLD.encode()) and not keys.accepted.find(NEW.encode()) and not keys.current
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert len(said) == 1 and "the API keys were not changed" in said[0] and sentence in said[0]
    assert "secret-in-clear" not in said[0]
    restore(file)
    refresh(keys, times=2)
    assert keys.accepted.find(NEW.encode()) and not keys.accepted.find(OLD.encode()) and keys.current
    assert "'cell-8' added, 'cell-7' removed" in caplog.text
    with pytest.raises(UsageError, match=sentence):  # what the start refuses, for the same reason
        break_by(file, how)
        Keys.from_settings(ServerSettings(api_keys_file=str(file)))


def refresh(keys: CurrentKeys, times: int = 1) -> None:
    for _ in range(times):
        asyncio.run(keys.refresh())


def test_half_a_file_is_not_used(file: Path) -> None:
    keys = CurrentKeys(ServerSettings(api_keys_file=str(file)))
    half, whole = f"{NEW_LINE}\n", f"{NEW_LINE}\n{OLD_LINE}\n"
    file.write_text(half)
    refresh(keys)
    file.write_text(whole)
    refresh(keys)
    assert keys.accepted.find(OLD.encode()) and not keys.accepted.find(NEW.encode())  # each was seen once
    refresh(keys)
    assert keys.accepted.find(OLD.encode()) and keys.accepted.find(NEW.encode())


def test_a_file_system_that_hangs_is_seen_in_the_metrics_and_stops_nobody(
    ur5: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def hang(_file: Path) -> bytes:
        go_on.wait(30)
        return OLD_LINE.encode()

    def are_current(value: bytes) -> bool:
        return b'rlservo_api_keys_current{replica=""} %s.0\n' % value in ask(port, "GET", "/metrics", key=OLD)[1]

    monkeypatch.setattr(current_keys, "READ_S", 0.1)
    with served_in_thread([ur5], settings={"api_keys_file": str(file)}) as port:
        assert are_current(b"1")
        monkeypatch.setattr(current_keys, "read_key_file", hang)
        try:
            wait_for(lambda: are_current(b"0"))
            assert status(port, OLD) == 200
        finally:
            go_on.set()
        wait_for(lambda: are_current(b"1"))


@pytest.mark.parametrize("query", ["", "?errors=keep"])
def test_a_stream_opened_with_a_removed_key_gets_no_further_action(
    replicas: tuple[int, int], file: Path, query: str
) -> None:
    with Stream(replicas[0], f"/v1/policies/ur5/stream{query}", x_api_key=OLD) as stream:
        assert "actions" in stream.ask(obs=OBS)
        file.write_text(f"{OLD_LINE}\n{NEW_LINE}\n")  # a change that leaves this key alone
        wait_for(lambda: status(replicas[0], NEW) == 200)
        assert "actions" in stream.ask(obs=OBS)
        file.write_text(f"{NEW_LINE}\n")
        wait_for(lambda: status(replicas[0], OLD) == 401)
        assert stream.ask(obs=OBS)["code"] == "unauthenticated"
        assert stream.close_code() is not None
