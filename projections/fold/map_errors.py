"""Errors of the fold, its settings and the databases; all are `eventsrc.base.errors.MapfoldError`.

MapfoldError
├── SettingsError               2  a setting's name or value is wrong
├── LogPointError               2  a point in the log does not exist
├── QuestionError               2  a question about the map cannot be asked as it is
├── FoldError                   1  an event cannot be folded; names its offset
│   └── ImpossibleCommand       1  a command makes it one that cannot be folded
├── FoldInterrupted             1  a fold ended in the midst of an event and is of no use
└── DatabaseError               1  a database cannot be used as asked
    ├── DatabaseUnavailable     1  no server answers, or it refused the connection
    ├── ExtensionMissing        1  the server lacks AGE or pgvector
    ├── EmbeddedServerError     1  the embedded server cannot run here or did not start
    ├── ProjectionMissing       1  nothing has been projected there yet
    ├── ProjectionMismatch      1  made from another log or with other settings
    ├── ProjectionBusy          1  a rebuild or a tail already writes this target
    └── CheckpointMoved         1  another process moved the checkpoint
"""

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.model import Offset


class SettingsError(MapfoldError):
    """A setting's name or value is wrong."""

    exit_code = 2


class LogPointError(MapfoldError):
    """A point in the log does not exist."""

    exit_code = 2


class QuestionError(MapfoldError):
    """A question about the map cannot be asked as it is."""

    exit_code = 2


class FoldError(MapfoldError):
    """An event cannot be folded."""

    def __init__(self, offset: Offset, reason: str) -> None:
        super().__init__(f"event at offset {offset} cannot be folded: {reason}")
        self.offset = offset
        self.reason = reason

    def __reduce__(self) -> tuple[type["FoldError"], tuple[int, str]]:
        """Pickle the arguments, not the message, so that it passes between processes."""
        return FoldError, (self.offset, self.reason)


class FoldInterrupted(MapfoldError):
    """A fold ended in the midst of the event before ``next_offset``: it is of no use any more."""

    def __init__(self, next_offset: Offset) -> None:
        super().__init__(
            f"this fold was interrupted at the event at offset {next_offset - 1}; fold the log"
            " again from its start or from a kept fold"
        )


class ImpossibleCommand(FoldError):
    """A command makes an event one that cannot be folded; without it the event can be."""

    def __reduce__(self) -> tuple[type["ImpossibleCommand"], tuple[int, str]]:
        return ImpossibleCommand, (self.offset, self.reason)


class DatabaseError(MapfoldError):
    """A database cannot be used as asked."""


class DatabaseUnavailable(DatabaseError):
    """No server answers, or it refused the connection."""


class ExtensionMissing(DatabaseError):
    """The server lacks AGE or pgvector."""


class EmbeddedServerError(DatabaseError):
    """The embedded server cannot run here or did not start."""


class ProjectionMissing(DatabaseError):
    """Nothing has been projected there yet."""


class ProjectionMismatch(DatabaseError):
    """The projection was made from another log or with other settings."""


class ProjectionBusy(DatabaseError):
    """A rebuild or a tail already writes this target."""


class CheckpointMoved(DatabaseError):
    """Another process moved the checkpoint."""
