"""Recordings followed while servers write them: each episode is read once, as soon as it has ended.

Every poll reads the files' additions since the last one, to the last whole chunk. A file that cannot be read is skipped
with one message, and the others continue. A remote server's files are copied first, additions only. Clocks of different
files are never compared, as servers' clocks may differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rlservo.client.admin_client import AdminClient
from rlservo.errors import DeadlineError, UnavailableError, UsageError
from rlservo.recording.episodes import EpisodeAssembler, RecordedEpisode
from rlservo.recording.reader import MAGIC, FileFacts, FileReader, Recording, RecordingError
from rlservo.recording.recorder import FILE_NAME, SUFFIX

SILENT_NS = 60_000_000_000
"""Longest pause between decisions, by the file's clock, after which an episode without an end is over."""


@dataclass(frozen=True)
class Ended:
    """An episode that has ended, or a piece without continuation, with its key in the learner's state."""

    file: str
    """The file that holds its end."""
    key: str
    """Its id and the time of its first decision: robots may reuse an id."""
    episode: RecordedEpisode


class ServerRecordings:
    """A copy of a remote server's recordings; files deleted there are deleted here as well."""

    def __init__(self, connect: Callable[[], AdminClient], folder: Path) -> None:
        """Take `connect`, which makes a client with the current admin key, and the copy's `folder`."""
        self._connect, self.folder = connect, folder.absolute()
        self.folder.mkdir(parents=True, exist_ok=True)

    def update(self) -> None:
        """Fetch the server's new records since the last call. Raises RlservoError."""
        with self._connect() as client:
            there = client.recordings()
            for name, size in there.items():
                if not FILE_NAME.match(name):
                    raise UnavailableError(
                        f"the server lists a recording named {name[:100]!r}: is it an rlservo server?"
                    )
                with (self.folder / name).open("ab") as file:
                    while file.tell() < size and (piece := client.recording(name, file.tell())):
                        file.write(piece)
        for path in self.folder.glob(f"*{SUFFIX}"):
            if path.name not in there:
                path.unlink()


class FollowedRecordings:
    """Folders in which servers record."""

    def __init__(
        self,
        folders: Sequence[Path],
        notify: Callable[[str], object],
        servers: Sequence[ServerRecordings] = (),
        progress: Callable[[str], object] = str,
    ) -> None:
        """`notify` gets one sentence for each unreadable file, `progress` the server that is waited for.

        Raises UsageError if a folder does not exist.
        """
        for folder in folders:
            if not folder.is_dir():
                raise UsageError(f"--recordings {folder}: expected the folder in which a server records (--record)")
        self._servers, self._progress = servers, progress
        self._folders = [*(folder.absolute() for folder in folders), *(server.folder for server in servers)]
        self._notify = notify
        self._policies = Recording([])  # one object for the same policy of several files
        self._files: dict[Path, tuple[FileFacts, FileReader]] = {}
        self._writers: dict[str, EpisodeAssembler] = {}

    def names(self) -> set[str]:
        """Return the names of the existing files."""
        return {str(path) for path in self._paths()}

    def poll(self) -> Iterator[Ended]:
        """Yield the episodes that have ended since the last poll. Raises RlservoError if a server refuses."""
        for server in self._servers:
            try:
                server.update()
            except (UnavailableError, DeadlineError) as error:
                self._progress(f"waiting for recordings: {error.message}")
        for path in self._paths():
            if path not in self._files:
                facts = FileFacts(path)
                self._files[path] = facts, FileReader(self._policies, facts)
            facts, reader = self._files[path]
            if facts.whole or facts.damage is not None:
                continue
            assembler = self._writers.setdefault(_writer_of(path), EpisodeAssembler())
            try:
                if path.stat().st_size < len(MAGIC):  # its writer has made it, and written nothing yet
                    continue
                for entry in reader.entries():
                    for episode in (*assembler.add(entry), *assembler.give_up(entry.log_time_ns - SILENT_NS)):
                        yield Ended(str(path), f"{episode.id}@{episode.wall_ns[0]}", episode)
            except RecordingError as error:
                facts.damage = error.message
                self._notify(f"{error.message}: left out")
                continue
            except FileNotFoundError:  # the oldest files are deleted while servers record
                continue
            except OSError as error:
                facts.damage = error.strerror or str(error)
            if facts.damage is not None:
                self._notify(f"{path} is not read any further: {facts.damage}")

    def _paths(self) -> list[Path]:
        return [path for folder in self._folders for path in sorted(folder.glob(f"*{SUFFIX}"))]


def _writer_of(path: Path) -> str:
    """Return the common part of one process's file names: an episode may continue in its next file."""
    return str(path.with_name(path.name.rpartition("-")[0])) if FILE_NAME.match(path.name) else str(path)
