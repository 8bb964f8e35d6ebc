"""A robot's bounded spool: envelopes that are not yet acknowledged, in one SQLite file.

* An envelope is in the file before anything is sent, so it outlives the robot's process. The file
  uses write-ahead logging without a sync per envelope: a power cut may take the last moments, and
  nothing older. One process owns the file. The order is the order of publishing.
* An envelope is named by the SHA-256 of its bytes, and only an ack of those bytes removes it. The
  same bytes published twice are two entries; one ack removes both.
* What a recorder has refused is moved to a quarantine in the same file, with the reason, and not
  sent again. It counts towards the bound, but that recorder's log has the bytes, so when there is
  no room for a new envelope, the oldest quarantined bytes are dropped; run, keyframe and reason
  stay. An ack removes a quarantined envelope too: another recorder has it.
"""

import contextlib
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.errors import SpoolError, SpoolFull
from eventsrc.envelope.model import KeyframeId, RunId

from .acks import Ack, Refusals, payload_sha256

DEFAULT_SPOOL_BYTES: Final = 1024 * 1024 * 1024
"""Of payload: sixteen hours without a link, at two envelopes of 9 kB a second."""

_SCHEMA: Final = """
create table if not exists spooled (
    seq integer primary key autoincrement,
    run_id text not null,
    keyframe_id integer not null,
    payload blob not null,
    sha256 text
);
create index if not exists spooled_sha256 on spooled (sha256);
create table if not exists refused (
    seq integer primary key,
    run_id text not null,
    keyframe_id integer not null,
    payload blob,
    log_id text not null,
    reason text not null,
    sha256 text
);
create index if not exists refused_payload on refused (seq) where payload is not null;
create index if not exists refused_sha256 on refused (sha256);
"""


class Spooled(NamedTuple):
    """An envelope that waits for an ack; ``seq`` is never used twice in a file."""

    seq: int
    run_id: RunId
    keyframe_id: KeyframeId
    payload: bytes


class Refused(NamedTuple):
    """A quarantined envelope; the log ``log_id`` has its bytes and ``reason``."""

    run_id: RunId
    keyframe_id: KeyframeId
    log_id: str
    reason: str


class Spool:
    """The envelopes in one spool file. Thread-safe; every method raises SpoolError when the file
    cannot be used."""

    def __init__(self, path: Path, max_bytes: int = DEFAULT_SPOOL_BYTES) -> None:
        self.path = path
        self.max_bytes = max_bytes
        self._lock = threading.Lock()
        self._count = self._bytes = self._refused_bytes = 0
        self.refused_count = 0
        """How many envelopes are in quarantine."""
        with _spool_errors(self.path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(
                path, timeout=0, isolation_level=None, check_same_thread=False
            )
            try:
                self._open_tables()
            except sqlite3.Error:
                self._db.close()
                raise

    @staticmethod
    def is_spool(path: Path) -> bool:
        """Whether a file is a spool, or empty as one before its first use: `Spool` would add its
        tables to any SQLite file. Raises SpoolError for a file that cannot be read."""
        with (
            _spool_errors(path),
            contextlib.closing(
                sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=0)
            ) as db,
        ):
            tables = {name for (name,) in db.execute("select name from sqlite_master")}
        return not tables or "spooled" in tables

    def _open_tables(self) -> None:
        self._db.execute("pragma locking_mode = exclusive")
        self._db.execute("pragma journal_mode = wal")
        self._db.execute("pragma synchronous = normal")
        self._db.executescript(_SCHEMA)
        counted = "select count(*), coalesce(sum(length(payload)), 0) from "
        self._count, self._bytes = self._db.execute(counted + "spooled").fetchone()
        self.refused_count, self._refused_bytes = self._db.execute(counted + "refused").fetchone()

    def add(self, run_id: RunId, keyframe_id: KeyframeId, payload: bytes) -> None:
        """Keep one envelope until it is acknowledged. Raises SpoolFull if there is no room."""
        with _spool_errors(self.path), self._lock:
            if not self._make_room(len(payload)):
                raise SpoolFull(
                    f"{self.path}: {self._count} envelopes ({self._bytes} bytes) wait for a "
                    f"recorder's acknowledgement and {self.max_bytes} bytes are the limit; "
                    "bring the link or the recorder back, or allow a larger spool"
                )
            self._db.execute(
                "insert into spooled (run_id, keyframe_id, payload, sha256) values (?, ?, ?, ?)",
                (run_id, keyframe_id, payload, payload_sha256(payload)),
            )
            self._count += 1
            self._bytes += len(payload)

    def _make_room(self, size: int) -> bool:
        """Drop quarantined bytes as needed; False if ``size`` bytes do not fit even so."""
        if self._bytes + size > self.max_bytes:
            return False
        while self._bytes + self._refused_bytes + size > self.max_bytes:
            oldest = self._db.execute(
                "select seq, length(payload) from refused where payload is not null "
                "order by seq limit 1"
            ).fetchone()
            if oldest is None:  # after an error the count may be wrong; see `_transaction`
                return False
            self._db.execute("update refused set payload = null where seq = ?", oldest[:1])
            self._refused_bytes -= int(oldest[1])
        return True

    def after(self, seq: int, limit: int) -> list[Spooled]:
        """The oldest waiting envelopes after ``seq`` in order, at most ``limit``."""
        with _spool_errors(self.path), self._lock:
            rows = self._db.execute(
                "select seq, run_id, keyframe_id, payload from spooled where seq > ? "
                "order by seq limit ?",
                (seq, limit),
            )
            return [Spooled(*row) for row in rows]

    def oldest(self) -> int | None:
        """The seq of the oldest waiting envelope; None if there is none."""
        with _spool_errors(self.path), self._lock:
            ((seq,),) = self._db.execute("select min(seq) from spooled")
            return None if seq is None else int(seq)

    def waiting_up_to(self, seq: int) -> int:
        """How many envelopes up to ``seq`` still wait."""
        with _spool_errors(self.path), self._lock:
            rows = self._db.execute("select count(*) from spooled where seq <= ?", (seq,))
            (count,) = rows.fetchone()
            return int(count)

    def acknowledge(self, ack: Ack) -> int:
        """Remove the payloads that ``ack`` names; returns how many waiting envelopes those were."""
        removed = 0
        with _spool_errors(self.path), self._lock, self._transaction():
            for sha256 in ack.sha256:
                rows = self._db.execute(
                    "delete from spooled where sha256 = ? returning length(payload)", (sha256,)
                ).fetchall()
                removed += len(rows)
                self._bytes -= sum(size for (size,) in rows)
                if self.refused_count:
                    self._drop_refused("where sha256 = ?", (sha256,))
            self._count -= removed
        return removed

    def refuse(self, refusals: Refusals, up_to: int) -> int:
        """Quarantine what ``refusals`` name, up to the seq ``up_to``; returns how many."""
        moved = 0
        with _spool_errors(self.path), self._lock, self._transaction():
            for refusal in refusals.refused:
                rows = self._db.execute(
                    "select seq, length(payload) from spooled where sha256 = ? and seq <= ?",
                    (refusal.sha256, up_to),
                ).fetchall()
                for seq, size in rows:
                    self._move_to_quarantine(seq, size, refusals.log_id, refusal.reason)
                    moved += 1
        return moved

    def _move_to_quarantine(self, seq: int, size: int, log_id: str, reason: str) -> None:
        self._db.execute(
            "insert into refused select seq, run_id, keyframe_id, payload, ?, ?, sha256 "
            "from spooled where seq = ?",
            (log_id, reason, seq),
        )
        self._db.execute("delete from spooled where seq = ?", (seq,))
        self._count -= 1
        self._bytes -= size
        self.refused_count += 1
        self._refused_bytes += size

    def refused(self, limit: int) -> list[Refused]:
        """The oldest in quarantine, in order, at most ``limit``."""
        with _spool_errors(self.path), self._lock:
            rows = self._db.execute(
                "select run_id, keyframe_id, log_id, reason from refused order by seq limit ?",
                (limit,),
            )
            return [Refused(*row) for row in rows]

    def retry_refused(self) -> int:
        """Move everything in quarantine that still has its bytes behind the waiting envelopes;
        returns how many."""
        with _spool_errors(self.path), self._lock, self._transaction():
            count = self._db.execute(
                "insert into spooled (run_id, keyframe_id, payload, sha256) select run_id, "
                "keyframe_id, payload, sha256 from refused where payload is not null order by seq"
            ).rowcount
            self._bytes += self._refused_bytes
            self._count += count
            self._drop_refused("where payload is not null")
        return count

    def discard_refused(self) -> int:
        """Empty the quarantine; returns how many envelopes were in it."""
        with _spool_errors(self.path), self._lock:
            return self._drop_refused()

    def _drop_refused(self, where: str = "", values: tuple[str, ...] = ()) -> int:
        query = f"delete from refused {where} returning coalesce(length(payload), 0)"  # noqa: S608
        sizes = [size for (size,) in self._db.execute(query, values)]
        self.refused_count -= len(sizes)
        self._refused_bytes -= sum(sizes)
        return len(sizes)

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Release the file to other processes. Waiting envelopes stay in it."""
        with self._lock:
            self._db.close()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """A transaction in the file. After an error the counts here may be wrong; every error ends
        the sender, and the next process counts again."""
        with self._db:
            self._db.execute("begin immediate")
            yield


@contextlib.contextmanager
def _spool_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SpoolError(f"spool {path}: {error.strerror}") from None
    except sqlite3.OperationalError as error:
        hint = "another robot process uses it; give each its own spool"
        if "no such column" in str(error):
            hint = "a version that was never released made it: move it away, use a new one"
        elif "locked" not in str(error):
            hint = "check the path, its rights and the disk"
        raise SpoolError(f"spool {path}: {error}; {hint}") from None
    except sqlite3.DatabaseError as error:
        raise SpoolError(
            f"spool {path}: {error}; move the file away and publish into a new one"
        ) from None
