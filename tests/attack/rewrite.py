"""Rewrite an MCAP file with the mcap package, in order of log time, as other tools do."""

from io import BytesIO
from pathlib import Path

from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer


def rewrite(source: Path, target: Path) -> int:
    """Copy the messages of ``source``, its metadata too, as `mcap sort` does; how many."""
    out, count = BytesIO(), 0
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start(profile="", library="mcap go v1.7.0")
    channels: dict[int, int] = {}
    with source.open("rb") as file:
        for schema, channel, message in NonSeekingReader(file).iter_messages():
            if channel.id not in channels:
                schema_id = (
                    writer.register_schema(schema.name, schema.encoding, schema.data)
                    if schema is not None
                    else 0
                )
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
                )
            writer.add_message(
                channels[channel.id],
                log_time=message.log_time,
                publish_time=message.publish_time,
                sequence=message.sequence,
                data=message.data,
            )
            count += 1
        file.seek(0)
        for record in NonSeekingReader(file).iter_metadata():
            writer.add_metadata(record.name, dict(record.metadata))
    writer.finish()  # type: ignore[no-untyped-call]
    target.write_bytes(out.getvalue())
    return count
