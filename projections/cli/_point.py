"""A point of a log on the command line: W means the same, and warns the same, in every command."""

from eventsrc.cli._shell import say
from eventsrc.log import LogReader
from eventsrc.log.whence import resolve

W = "number of events, ISO time, RUN:KEYFRAME (inclusive) or end"
"""What W may be, for help texts."""


def point(reader: LogReader, text: str) -> int:
    """The number of events that W means in this log; people are told when stamps run backwards."""
    return resolve(reader, text, note=say)
