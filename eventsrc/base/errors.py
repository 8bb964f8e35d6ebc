"""The errors of `eventsrc`.

Every message names the value, the place and the next step. The command line prints it as one line,
without a traceback, and exits with ``exit_code``.

    MapfoldError                    1  something failed
    ├── MisuseError                 2  the call itself is wrong
    ├── LogError                    1  a log cannot be used as asked
    │   ├── LogNotFound             2  no log there
    │   ├── NotALog                 2  not a mapfold log
    │   ├── LogBusy                 1  another writer holds it
    │   └── LogDamaged              1  recorded events cannot be read
    ├── ArchiveError                1  an archive of a log cannot be used as asked
    │   └── NoSuchObject            1  nothing is there under that name
    ├── InvalidEnvelope             1  a payload is not an envelope; the message is the reason
    └── TransportError              1  Zenoh cannot connect, listen or send
        └── SpoolError              1  a robot's spool cannot be used
            └── SpoolFull           1  it has no room for another envelope

``projections.fold.map_errors`` adds the branch for databases and folds.
"""


class MapfoldError(Exception):
    """Something failed; the message says what, where and what to do next."""

    exit_code = 1


class MisuseError(MapfoldError):
    """The call itself is wrong: an argument, a combination, a missing piece."""

    exit_code = 2


class LogError(MapfoldError):
    """A log cannot be used as asked."""


class LogNotFound(LogError):
    """There is no log at this path."""

    exit_code = 2


class NotALog(LogError):
    """The file or folder at this path is not a mapfold log."""

    exit_code = 2


class LogBusy(LogError):
    """Another writer holds the log."""


class LogDamaged(LogError):
    """Recorded events cannot be read: bytes are damaged, or a segment is missing or foreign."""


class ArchiveError(MapfoldError):
    """An archive of a log cannot be used as asked, or its store does not answer."""


class NoSuchObject(ArchiveError):
    """A store has no such object, or there is no such store."""


class InvalidEnvelope(MapfoldError):
    """A payload is not an envelope."""


class TransportError(MapfoldError):
    """Zenoh cannot connect, listen or send."""


class SpoolError(TransportError):
    """A robot's spool cannot be used."""


class SpoolFull(SpoolError):
    """A robot's spool has no room for another envelope."""
