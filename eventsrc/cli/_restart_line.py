"""What a writer found when it opened a log: one line for people, numbers for programs."""

from pathlib import Path

from eventsrc.log import LogWriter
from eventsrc.words import counted

from ._shell import say


def say_restart(log: Path, writer: LogWriter) -> None:
    """Say what was recovered and what was cut off; nothing, if the log was left in order."""
    found = writer.restart
    if not (found.recovered_segments or found.torn_bytes or found.torn_events):
        return
    say(
        f"{log}: the last writer did not finish; recovered "
        f"{counted(found.recovered_segments, 'segment')} with "
        f"{counted(found.recovered_events, 'event')}, cut off "
        f"{counted(found.torn_bytes, 'torn byte')} with "
        f"{counted(found.torn_events, 'event')} that never counted as recorded"
    )


def restart_as_json(writer: LogWriter) -> dict[str, int]:
    """The same for programs."""
    found = writer.restart
    return {
        "recovered_segments": found.recovered_segments,
        "recovered_events": found.recovered_events,
        "torn_bytes": found.torn_bytes,
        "torn_events": found.torn_events,
    }
