"""Whose segments are these? Each says at its head which log it belongs to.

Somebody copies, restores, mixes up: a segment of another log has the right name, and every checksum
in it holds. Nobody but a person knows which file is the wrong one, so nothing is guessed: a reader
stops at it, a writer does not start, recovery touches nothing.
"""

from collections.abc import Iterable
from pathlib import Path

from eventsrc.errors import LogDamaged, NotALog

from ._head import head_of
from ._naming import SegmentPath


def log_id_of(segments: Iterable[SegmentPath]) -> str | None:
    """The log that ``segments`` belong to, as far as their heads can be read. Raises LogDamaged
    when they name two."""
    found: tuple[Path, str] | None = None
    for segment in segments:
        try:
            log_id = head_of(segment.path, segment.base)["log_id"]
        except (LogDamaged, NotALog):
            continue
        if found is not None and log_id != found[1]:
            raise LogDamaged(mixed_up(segment.path, log_id, *found))
        found = found or (segment.path, log_id)
    return None if found is None else found[1]


def mixed_up(one: Path, log_id: str, other: Path, other_id: str) -> str:
    """What to say of two segments that are of two logs."""
    return (
        f"{one} belongs to log {log_id}, but {other.name} to log {other_id}; put the right file in "
        f"place of the wrong one, or move that away and run `mapfold log recover {one.parent}`"
    )
