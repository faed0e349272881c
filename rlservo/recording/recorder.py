"""Recorder: a bounded buffer on the hot path, and a thread that writes it to MCAP files.

Recording never delays acting: `record` takes a microsecond and raises nothing; records that do not fit into the buffer
are dropped and counted (and the file notes where); if a file cannot be written, recording ends with one line in the
log.
"""

from __future__ import annotations

import atexit
import fcntl
import logging
import os
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlservo.bundle.contract import Contract
from rlservo.errors import UsageError, first_line
from rlservo.policy.acting_policy import Closeable
from rlservo.recording.log_file import LogFile
from rlservo.recording.policy_format import PolicyFormat
from rlservo.recording.records import DecisionRecord, OutcomeRecord

logger = logging.getLogger(__name__)

SUFFIX = ".mcap"
FILE_NAME = re.compile(r"^rlservo-[0-9]{8}T[0-9]{6}-[^/\n]+-[0-9]+-[0-9]+\.mcap\Z")
MIB = 1024 * 1024
BUFFER_RECORDS = 20_000
BUFFER_BYTES = 64 * MIB
DRAIN_S = 0.1  # between two checks of the buffer
FLUSH_S = 0.7  # together under a second, the most that a killed process loses
WAIT_S = 10.0  # time for the writer to finish at close


class Recorder(Closeable):
    """Writes records to one file, or to a folder of files that rotate.

    ```python
    with Recorder("recordings") as recorder:
        policy = recorder.policy(contract)
        recorder.record(DecisionRecord(policy, obs, action))
    ```

    Any thread may record. Several processes may record into one folder: each has its own files.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        max_file_bytes: int = 256 * MIB,
        max_file_s: float = 3600.0,
        max_folder_bytes: int = 10 * 1024 * MIB,
        wait: bool = False,
    ) -> None:
        """Record to the new file `path` if that ends in .mcap, else into the folder `path`.

        In a folder, a new file begins at `max_file_bytes` or after `max_file_s`; beyond `max_folder_bytes` the oldest
        recordings that are not being written are deleted. With `wait` a full buffer blocks the caller instead of
        dropping records, for a simulation that can wait. Raises UsageError if nothing can be written there.
        """
        if max_file_bytes < MIB or max_file_s <= 0 or max_folder_bytes < 2 * max_file_bytes:
            raise UsageError(
                f"max_file_bytes is {max_file_bytes}, max_file_s {max_file_s:g}, max_folder_bytes {max_folder_bytes}: "
                f"expected files of at least {MIB} bytes and more than 0 s, and room for two of them in the folder"
            )
        self.path = Path(path)
        self._wait = wait
        self._is_folder = self.path.suffix != SUFFIX
        self._max_file_bytes, self._max_file_s, self._max_folder_bytes = max_file_bytes, max_file_s, max_folder_bytes
        self._buffer: deque[DecisionRecord | OutcomeRecord] = deque()
        self._room = BUFFER_RECORDS
        self._held = 0  # in the buffer; each row of a batch counts
        self._lock = threading.Lock()
        self._policies: dict[tuple[str, ...], PolicyFormat] = {}
        self.dropped = 0
        """Records that did not fit into the buffer, or came after the end of the recording."""
        self.written = 0
        self.failure: str | None = None
        """Reason why recording has ended, if it could not continue."""
        self._marked = 0
        self._unreadable = False
        self._files = 0
        self._file: LogFile | None = None
        self._began = f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{socket.gethostname()}-{os.getpid()}"
        try:
            if self._is_folder:
                self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
                if not os.access(self.path, os.W_OK | os.X_OK):
                    raise PermissionError(13, "Permission denied", str(self.path))
            else:
                self._file = LogFile(self.path)
        except FileExistsError:
            raise UsageError(f"{self.path} exists: expected a new file, or a folder") from None
        except OSError as error:
            raise UsageError(f"nothing can be recorded at {self.path}: {error.strerror or error}") from error
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="rlservo-recorder", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def policy(
        self, contract: Contract, *, graph_hash: str = "", options: Mapping[str, Any] | None = None
    ) -> PolicyFormat:
        """Return the format of a policy's records, the same object for the same policy."""
        made = PolicyFormat(contract, graph_hash=graph_hash, options=options)
        made = self._policies.setdefault(made.key, made)
        self._room = min(self._room, max(64, BUFFER_BYTES // made.record_bytes))
        return made

    def record(self, record: DecisionRecord | OutcomeRecord) -> bool:
        """Put a record into the buffer; return whether there was room for it."""
        while self._wait and self._held >= self._room and self._thread.is_alive():
            time.sleep(0.001)
        with self._lock:
            if self._held >= self._room or self.failure is not None or self._closing.is_set():
                self.dropped += record.rows
                return False
            self._held += record.rows
            self._buffer.append(record)
        return True

    def close(self) -> None:
        """Write the buffer and end the file."""
        atexit.unregister(self.close)
        with self._lock:  # later records are dropped, so that the writer ends
            self._closing.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(WAIT_S)

    def _run(self) -> None:
        flushed = time.monotonic()
        try:
            while True:
                closing = self._closing.wait(DRAIN_S)
                self._drain()
                now = time.monotonic()
                if self._file is not None and (closing or now - flushed >= FLUSH_S):
                    self._file.flush()
                    flushed = now
                    self._rotate()
                if closing and not self._buffer:
                    break
            if self._file is not None:
                self._file.close()
        except Exception as error:  # a full disk or a removed folder: acting continues
            self._end(error)

    def _drain(self) -> None:
        """Write the buffer's present content."""
        for _ in range(len(self._buffer)):
            with self._lock:
                record = self._buffer.popleft()
                self._held -= record.rows
            file = self._file or self._next_file()
            try:
                if isinstance(record, DecisionRecord):
                    file.add_decision(record)
                else:
                    file.add_outcome(record)
                self.written += record.rows
            except OSError:
                raise
            except Exception as error:  # does not fit the policy's spaces
                self.dropped += record.rows
                if not self._unreadable:
                    self._unreadable = True
                    logger.warning("a record of policy '%s' was dropped: %s", record.policy.title, first_line(error))
        missing = self.dropped - self._marked
        if missing and self._file is not None:
            self._file.add_dropped(missing)
            self._marked += missing

    def _rotate(self) -> None:
        file = self._file
        if file is None:
            return
        if file.is_deleted:
            if not self._is_folder:
                raise FileNotFoundError(f"{file.path} was deleted")
            self._file = None
            file.close()
            logger.warning("the recording %s was deleted while it was being written", file.path)
        elif self._is_folder and (file.size >= self._max_file_bytes or file.age_s >= self._max_file_s):
            self._file = None
            file.close()

    def _next_file(self) -> LogFile:
        while True:
            self._files += 1
            try:
                self._file = LogFile(self.path / f"rlservo-{self._began}-{self._files:06d}{SUFFIX}")
            except FileExistsError:  # from another recorder in this process
                continue
            _delete_oldest(self.path, self._max_folder_bytes - self._max_file_bytes)
            return self._file

    def _end(self, error: Exception) -> None:
        self.failure = first_line(error)
        with self._lock:
            self.dropped += self._held
            self._held = 0
            self._buffer.clear()
        if self._file is not None:
            self._file.abandon()
        logger.error("recording to %s stopped, acting continues: %s", self.path, self.failure)


def _delete_oldest(folder: Path, limit: int) -> None:
    """Delete the oldest recordings in a folder until at most `limit` bytes remain, but never one being written."""
    found: list[tuple[float, int, Path]] = []
    for path in folder.iterdir():
        if FILE_NAME.match(path.name):
            try:
                facts = path.lstat()
            except FileNotFoundError:  # another writer of the folder deleted it first
                continue
            found.append((facts.st_mtime, facts.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= limit:
            return
        if not is_being_written(path):
            path.unlink(missing_ok=True)
            total -= size


def is_being_written(path: Path) -> bool:
    """Return whether a process holds the file open for recording."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
