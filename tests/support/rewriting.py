"""Segments as other MCAP programs rewrite them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer


def rewrite(
    path: Path,
    *,
    metadata: Iterable[str] = ("mapfold.segment", "mapfold.seal"),
    in_log_time: bool = True,
    keep: Callable[[str, int], bool] = lambda *_: True,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 2000,
    chunked: bool = True,
    profile: str = "mapfold",
    renumber: Callable[[int], int] = lambda sequence: sequence,
) -> None:
    """As `mcap sort` (the default), `mcap filter` and `mcap compress` of the Go tool do: a header
    with another library, metadata, then messages with the sequence numbers they had.
    """
    with path.open("rb") as file:
        reader = SeekingReader(file)
        records = [r for r in reader.iter_metadata() if r.name.split(":")[0] in metadata]
        messages = list(reader.iter_messages(log_time_order=in_log_time))
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=compression, use_chunking=chunked)
        writer.start(profile, "mcap go v1.7.2; mapfold")
        for record in records:
            writer.add_metadata(record.name, record.metadata)
        ids: dict[int, int] = {}
        for schema, channel, message in messages:
            assert schema is not None
            if not keep(channel.topic, message.sequence):
                continue
            if channel.id not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            writer.add_message(
                ids[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                renumber(message.sequence),
            )
        writer.finish()


class DuplicateMetadata(Exception):
    """`mcap merge` ends with this unless it is given ``--allow-duplicate-metadata``."""


def merge(sources: Sequence[Path], path: Path) -> None:
    """As `mcap merge` does, without options: messages of all files by log time, and their metadata,
    of which no two records may have one name."""
    messages: list[tuple[int, int, Any, Any, Any]] = []
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("mapfold", "mcap go v1.7.2; ")
        names: set[str] = set()
        for number, source in enumerate(sources):
            with source.open("rb") as stream:
                reader = SeekingReader(stream)
                for record in reader.iter_metadata():
                    if record.name in names:
                        raise DuplicateMetadata(record.name)
                    names.add(record.name)
                    writer.add_metadata(record.name, record.metadata)
                messages += [(m.log_time, number, s, c, m) for s, c, m in reader.iter_messages()]
        ids: dict[tuple[int, int], int] = {}
        for _, number, schema, channel, message in sorted(messages, key=lambda row: row[:2]):
            if (number, channel.id) not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[number, channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            id_ = ids[number, channel.id]
            writer.add_message(
                id_, message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()


def plainly_read(path: Path) -> dict[int, tuple[str, bytes]]:
    """Key and payload by sequence number, by the mcap package alone."""
    with path.open("rb") as file:
        return {m.sequence: (c.topic, m.data) for _, c, m in SeekingReader(file).iter_messages()}
