"""Repair of a recording without an end, or a damaged one: a copy to its last whole chunk, with end and index."""

from __future__ import annotations

import os
from pathlib import Path

from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from rlservo.recording.conversion.common import new_path
from rlservo.recording.log_file import CHUNK_BYTES
from rlservo.recording.reader import FileFacts, read_records


def repair_recording(path: Path, out: Path) -> FileFacts:
    """Write the new file `out` and return the facts about `path`, which is not changed.

    Any MCAP file can be repaired, also one by another program. Raises UsageError and RecordingError.
    """
    facts = FileFacts(path)
    with new_path(out) as part, os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        schemas, channels = {0: 0}, dict[int, int]()
        for record in read_records(facts):
            if isinstance(record, Header):
                writer.start(record.profile, record.library)
            elif isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                schema = schemas[record.schema_id]
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
                )
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                facts.messages += 1
            elif isinstance(record, Attachment):
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
        writer.finish()
    return facts
