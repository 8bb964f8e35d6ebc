"""The log: an append-only directory of MCAP segments, the only truth (docs/log-format.md).

Most programs only read a log: what writes, verifies and repairs one is imported when one of its
names is.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from .durable_files import ALWAYS, GROUP_COMMIT, NEVER, FsyncPolicy, parse_fsync
from .event import Event, MessageFormat, NewEvent, VerbatimEvent, event_hash
from .log_identity import (
    cache_folder,
    cache_sizes,
    delete_left_over_files,
    make_cache_folder,
    same_but_sealed,
    segment_signatures,
    write_cache_file,
)
from .reader import LogReader, follow
from .segment import Unreadable

if TYPE_CHECKING:
    from .active_segment import SegmentFault
    from .recover import RecoveryReport, SegmentRecovery, recover_log
    from .verify import Verification, verify_log
    from .verify_events import Finding
    from .writer import LogWriter, Sealing

__all__ = [
    "ALWAYS",
    "GROUP_COMMIT",
    "NEVER",
    "Event",
    "Finding",
    "FsyncPolicy",
    "LogReader",
    "LogWriter",
    "MessageFormat",
    "NewEvent",
    "RecoveryReport",
    "Sealing",
    "SegmentFault",
    "SegmentRecovery",
    "Unreadable",
    "VerbatimEvent",
    "Verification",
    "cache_folder",
    "cache_sizes",
    "delete_left_over_files",
    "event_hash",
    "follow",
    "make_cache_folder",
    "parse_fsync",
    "recover_log",
    "same_but_sealed",
    "segment_signatures",
    "verify_log",
    "write_cache_file",
]

_MODULES = {
    "Finding": "verify_events",
    "LogWriter": "writer",
    "RecoveryReport": "recover",
    "Sealing": "writer",
    "SegmentFault": "active_segment",
    "SegmentRecovery": "recover",
    "Verification": "verify",
    "recover_log": "recover",
    "verify_log": "verify",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f".{_MODULES[name]}", __name__), name)
