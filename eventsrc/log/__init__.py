"""The log: an append-only directory of MCAP segments, the only truth (docs/log-format.md)."""

from ._file_fault import FileFault
from ._lineage import lineage, still_holds
from .event import Event, NewEvent
from .findings import Finding
from .fsync import ALWAYS, GROUP_COMMIT, NEVER, FsyncPolicy, parse_fsync
from .reader import LogReader
from .recover import RecoveryReport, SegmentRecovery, recover_log
from .segment import Unreadable
from .tail import follow
from .verify import Verification, verify_log
from .writer import LogWriter, Sealing

__all__ = [
    "ALWAYS",
    "GROUP_COMMIT",
    "NEVER",
    "Event",
    "FileFault",
    "Finding",
    "FsyncPolicy",
    "LogReader",
    "LogWriter",
    "NewEvent",
    "RecoveryReport",
    "Sealing",
    "SegmentRecovery",
    "Unreadable",
    "Verification",
    "follow",
    "lineage",
    "parse_fsync",
    "recover_log",
    "still_holds",
    "verify_log",
]
