"""Reader of recordings: one pass over the messages of MCAP files, to the last whole chunk of each.

A file without an end (its writer was killed, or is still writing) is read as far as possible. Memory is bounded to one
chunk.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import orjson
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from pydantic import ValidationError

from rlservo.bundle.contract import Contract
from rlservo.errors import RlservoError, first_line
from rlservo.recording.log_file import DROPPED_TOPIC
from rlservo.recording.policy_format import PolicyFormat
from rlservo.recording.recorder import SUFFIX, is_being_written

MAGIC = b"\x89MCAP0\r\n"  # the first bytes of a file
LARGEST_RECORD = 512 * 1024 * 1024  # a larger length means damage
CLOCK_JUMP_NS = 1_000_000_000
BAG_PROFILE = "ros2"  # profile of files that `ros2 bag record` writes


class RecordingError(RlservoError):
    """The path holds no rlservo recording."""

    code = "recording-invalid"


@dataclass(slots=True)
class Entry:
    """One message: a decision of a policy, or its outcome."""

    policy: PolicyFormat
    kind: str  # decision or outcome
    log_time_ns: int
    wall_ns: int
    fields: dict[str, Any]


@dataclass
class FileFacts:
    """Facts about one file that was read."""

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
    whole: bool = False
    """Whether the file has its end; otherwise it was read to its last whole chunk."""
    being_written: bool = False
    deleted: bool = False
    """Whether a recorder has deleted it, the oldest of its folder, before it was read."""
    damage: str | None = None
    """Damage beyond a missing end."""
    position: int = 0
    """[bytes] Position up to which it was read: a reader continues here when the file has grown."""
    messages: int = 0
    dropped: int = 0
    clock_jumps: int = 0
    """Number of jumps of the wall clock by more than a second, relative to the monotonic clock."""
    profile: str = ""
    """'rlservo', or 'ros2' for a bag."""
    bag_topics: dict[str, int] = field(default_factory=dict)
    """Messages of a bag by topic."""
    bag_first_s: float | None = None
    bag_last_s: float | None = None


class Recording:
    """The recordings in some files and folders, read one after the other."""

    def __init__(self, paths: Sequence[str | Path] | str | Path, *, with_bags: bool = False) -> None:
        """Raise RecordingError if there is no file. `with_bags`: ROS 2 bags may be among them, without decisions."""
        self.with_bags = with_bags
        given = [paths] if isinstance(paths, str | Path) else list(paths)
        self.paths: list[Path] = []
        self._named: set[Path] = set()  # not found in a folder, where a recorder may delete the oldest
        for path in map(Path, given):
            inside = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
            if not inside:
                raise RecordingError(f"{path} holds no recording (*{SUFFIX})")
            if inside == [path]:
                if not path.is_file():
                    raise RecordingError(f"{path} does not exist, or is not a file")
                self._named.add(path)
            self.paths += inside
        self.files: list[FileFacts] = []
        """Facts of the files that were read so far."""
        self.policies: list[PolicyFormat] = []
        """Policies found so far; the same object for the same policy in several files."""

    def entries(self) -> Iterator[Entry]:
        """Yield every decision and outcome, in the order they were written.

        A file of a folder that is empty, or was deleted meanwhile, is left out. Raises RecordingError if a file is not
        an MCAP file, or was written by another program.
        """
        self.files = []
        for path in self.paths:
            facts = FileFacts(path, being_written=is_being_written(path))
            self.files.append(facts)
            try:
                if path not in self._named and path.stat().st_size < len(MAGIC):
                    continue  # its recorder was killed before it wrote
                yield from FileReader(self, facts).entries()
            except FileNotFoundError:
                if path in self._named:
                    raise RecordingError(f"{path} was deleted before it was read") from None
                facts.deleted = True

    def known(self, policy: PolicyFormat) -> PolicyFormat:
        """Return the known object for this policy."""
        for known in self.policies:
            if known.key == policy.key:
                return known
        self.policies.append(policy)
        return policy


def read_records(facts: FileFacts) -> Iterator[McapRecord]:
    """Yield the records of the file `facts.path` from `facts.position` to its last whole chunk, with chunks unpacked.

    Sets `whole` and `damage` at the end. Raises RecordingError if it is not an MCAP file.
    """
    path = facts.path

    def damaged(error: Exception) -> None:
        """A last chunk that is cut off is a missing end; anything before it is damage."""
        if stream.tell() < os.fstat(stream.fileno()).st_size:
            facts.damage = f"damaged before byte {stream.tell()} and read up to there: {first_line(error)}"

    with path.open("rb") as stream:
        try:
            stream.seek(facts.position)
            reader = StreamReader(
                stream, skip_magic=facts.position > 0, emit_chunks=True, record_size_limit=LARGEST_RECORD
            )
            for record in reader.records:
                if isinstance(record, Chunk):
                    yield from breakup_chunk(record, validate_crc=True)
                else:
                    yield record
                facts.position = stream.tell()
            facts.whole = True  # footer and closing magic were present
        except InvalidMagic:
            if stream.tell() <= len(MAGIC):
                raise RecordingError(f"{path} is not an MCAP file") from None
        except (EndOfFile, struct.error) as error:  # in the middle of a record
            if stream.tell() < len(MAGIC):
                raise RecordingError(f"{path} is not an MCAP file, or empty") from error
        except (McapError, CRCValidationError, ValueError, MemoryError, OverflowError) as error:
            damaged(error)
        except Exception as error:  # zstandard's and lz4's own errors share no base
            if not type(error).__module__.startswith(("zstandard", "lz4", "builtins", "zstd")):
                raise
            damaged(error)


class FileReader:
    """One pass over one file, with one call of `entries` for each addition by its writer."""

    def __init__(self, recording: Recording, facts: FileFacts) -> None:
        self._recording = recording
        self._facts = facts
        self._contracts: dict[str, Contract] = {}
        self._channels: dict[int, tuple[PolicyFormat | None, str]] = {}
        self._foreign: dict[int, str] = {}
        self._offset_ns: int | None = None

    def entries(self) -> Iterator[Entry]:
        """Yield the file's content after the last yield. Raises RecordingError."""
        for record in read_records(self._facts):
            try:
                entry = self._take(record)
            except RecordingError:
                raise
            except Exception as error:  # a message not written by rlservo
                self._facts.damage = f"read up to a message that cannot be decoded: {first_line(error)}"
                break
            if entry is not None:
                yield entry
        is_bag = self._recording.with_bags and self._facts.profile == BAG_PROFILE
        if self._foreign and not self._channels and not is_bag:
            raise RecordingError(
                f"{self._facts.path} holds no rlservo decisions: its topics are "
                f"{', '.join(sorted(self._foreign.values())[:5])}"
            )

    def _take(self, record: McapRecord) -> Entry | None:
        if isinstance(record, Message):
            return self._entry(record)
        if isinstance(record, Channel):
            self._add_channel(record)
        elif isinstance(record, Attachment):
            self._add_contract(record)
        elif isinstance(record, Header):
            self._facts.profile = record.profile
        elif isinstance(record, Metadata) and record.name == "rlservo":
            self._facts.metadata = dict(record.metadata)
        return None

    def _entry(self, message: Message) -> Entry | None:
        policy, kind = self._channels.get(message.channel_id, (None, ""))
        if kind == "":
            self._count_in_bag(message)
            return None
        fields = orjson.loads(message.data)
        self._facts.messages += 1
        if policy is None:
            self._facts.dropped += int(fields["count"])
            return None
        offset = message.publish_time - message.log_time
        if self._offset_ns is not None and abs(offset - self._offset_ns) > CLOCK_JUMP_NS:
            self._facts.clock_jumps += 1
        self._offset_ns = offset
        return Entry(policy, kind, message.log_time, message.publish_time, fields)

    def _count_in_bag(self, message: Message) -> None:
        facts, topic = self._facts, self._foreign.get(message.channel_id)
        if topic is not None and facts.profile == BAG_PROFILE:
            facts.messages += 1
            facts.bag_topics[topic] = facts.bag_topics.get(topic, 0) + 1
            time_s = message.log_time / 1e9
            facts.bag_first_s = time_s if facts.bag_first_s is None else min(facts.bag_first_s, time_s)
            facts.bag_last_s = time_s if facts.bag_last_s is None else max(facts.bag_last_s, time_s)

    def _add_contract(self, attachment: Attachment) -> None:
        if not attachment.name.startswith("contracts/"):
            return
        try:
            contract = Contract.model_validate_json(attachment.data)
        except ValidationError as error:
            raise RecordingError(
                f"{self._facts.path}: the contract {attachment.name} in it cannot be read: "
                f"{error.errors(include_url=False)[0]['msg']}"
            ) from error
        self._contracts[attachment.name.removeprefix("contracts/").removesuffix(".json")] = contract

    def _add_channel(self, channel: Channel) -> None:
        if channel.id in self._channels:
            return
        if channel.topic == DROPPED_TOPIC:
            self._channels[channel.id] = (None, "dropped")
            return
        contract = self._contracts.get(channel.metadata.get("contract_sha256", ""))
        kind = channel.topic.rpartition("/")[2]
        if contract is None or kind not in ("decision", "outcome"):
            self._foreign[channel.id] = channel.topic
            return
        graph_hash = channel.metadata.get("graph_sha256", "")
        options = orjson.loads(channel.metadata.get("options", "{}"))
        policy = self._recording.known(PolicyFormat(contract, graph_hash=graph_hash, options=options))
        self._channels[channel.id] = (policy, kind)
