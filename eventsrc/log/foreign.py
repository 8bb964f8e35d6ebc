"""Messages of MCAP files that others wrote, by the mcap package, in file order."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ._mcap import Channel, ForeignError, Message, StreamReader


class ForeignDamage(ValueError):
    """The file is torn, rotten or uses what the mcap package cannot read."""


@dataclass(frozen=True, slots=True)
class ForeignMessage:
    """One message: MCAP's topic is the key, its log and publish time are int nanoseconds."""

    key: str
    encoding: str
    logged_ns: int
    published_ns: int
    payload: bytes


def foreign_messages(file: BinaryIO) -> Iterator[ForeignMessage]:
    """Every message, with chunk CRCs checked. Raises ForeignDamage after the last good one."""
    channels: dict[int, Channel] = {}
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                yield ForeignMessage(
                    channel.topic,
                    channel.message_encoding,
                    record.log_time,
                    record.publish_time,
                    record.data,
                )
    except (*ForeignError, struct.error, ValueError, KeyError) as error:
        raise ForeignDamage(f"torn or damaged: {type(error).__name__} {error}".rstrip()) from None
