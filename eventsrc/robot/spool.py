"""A robot's bounded spool on disk: what is published and not yet acknowledged.

* One SQLite file, one owner. A published envelope is in the file before anything is sent, so it
  outlives the robot's process; write-ahead logging without a sync per envelope means that a power
  cut may take the last moments, and never more. The order is the order of publishing.
* An envelope is named by the SHA-256 of its bytes: an ack of those very bytes frees it, and nothing
  else. Twice the same bytes are one envelope that was published twice; an ack frees both.
* What a recorder has refused waits no more. It is set aside in the same file, within the same
  bound, and gives way to new envelopes (`eventsrc.robot.spool`). An ack frees it too: then another
  recorder has it.

A spool file of an earlier version, which did not name payloads, is given their SHA-256 when it is
opened. What was refused and has given up its bytes stays without: it can be told and discarded, and
no ack frees it.

Quarantine: envelopes that a recorder has refused, each with the reason.

Their bytes are in that recorder's log, so here they are only kept to be sent again, and give way
when there is no room for new envelopes: the oldest first; run, keyframe and reason stay.
A part of `eventsrc.robot.spool`, whose lock and transactions it relies on.
"""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.errors import SpoolError, SpoolFull

from .acks import Ack, Refusals, fingerprint

_STEPS: Final = {
    "spooled": """
        alter table spooled add column sha256 text;
        update spooled set sha256 = sha256_of(payload);
        drop index if exists spooled_keyframe;
    """,
    "refused": """
        alter table refused add column sha256 text;
        update refused set sha256 = sha256_of(payload) where payload is not null;
        drop index if exists refused_keyframe;
    """,
}


def add_digests(db: sqlite3.Connection) -> None:
    """Add the column ``sha256`` to both tables where it is missing, all or nothing."""
    db.create_function("sha256_of", 1, fingerprint, deterministic=True)
    for table, steps in _STEPS.items():
        columns = db.execute("select name from pragma_table_info(?)", (table,)).fetchall()
        if ("sha256",) not in columns:
            db.executescript(f"begin immediate; {steps} commit;")


_QUARANTINE_SCHEMA: Final = """
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
"""
_QUARANTINE_INDEX: Final = "create index if not exists refused_sha256 on refused (sha256)"


class Refused(NamedTuple):
    """One envelope that was set aside: ``log_id`` is the log that has its bytes and ``reason``."""

    run_id: str
    keyframe_id: int
    log_id: str
    reason: str


class SetAside:
    """The table ``refused``; ``count`` rows, ``size`` bytes of payload."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        db.executescript(_QUARANTINE_SCHEMA)
        add_digests(db)
        db.execute(_QUARANTINE_INDEX)
        row = db.execute("select count(*), coalesce(sum(length(payload)), 0) from refused")
        self.count, self.size = map(int, row.fetchone())

    def take(self, seq: int, log_id: str, reason: str, size: int) -> None:
        """Keep the spooled envelope ``seq``, of ``size`` bytes."""
        self._db.execute(
            "insert into refused select seq, run_id, keyframe_id, payload, ?, ?, sha256 "
            "from spooled where seq = ?",
            (log_id, reason, seq),
        )
        self.count += 1
        self.size += size

    def rows(self, limit: int) -> list[Refused]:
        """The oldest, in order."""
        rows = self._db.execute(
            "select run_id, keyframe_id, log_id, reason from refused order by seq limit ?", (limit,)
        )
        return [Refused(*row) for row in rows]

    def make_way(self, size: int) -> bool:
        """Let the oldest payloads go, ``size`` bytes or more; False when there are not so many."""
        end = self.size - size
        while self.size > end:
            oldest = self._db.execute(
                "select seq, length(payload) from refused where payload is not null "
                "order by seq limit 1"
            ).fetchone()
            if oldest is None:
                return False
            self._db.execute("update refused set payload = null where seq = ?", (oldest[0],))
            self.size -= int(oldest[1])
        return True

    def put_back(self) -> tuple[int, int]:
        """Spool everything whose bytes are still here anew; how many, and how many bytes."""
        put = self._db.execute(
            "insert into spooled (run_id, keyframe_id, payload, sha256) select run_id, "
            "keyframe_id, payload, sha256 from refused where payload is not null order by seq"
        ).rowcount
        self._db.execute("delete from refused where payload is not null")
        size, self.size = self.size, 0
        self.count -= put
        return put, size

    def forget(self, sha256: str) -> None:
        """Drop the payload that ``sha256`` names: some log has it."""
        if self.count:
            self._drop(
                "delete from refused where sha256 = ? returning coalesce(length(payload), 0)",
                (sha256,),
            )

    def clear(self) -> int:
        """Drop everything; how many that were."""
        return self._drop("delete from refused returning coalesce(length(payload), 0)", ())

    def _drop(self, query: str, values: tuple[str, ...]) -> int:
        sizes = [size for (size,) in self._db.execute(query, values)]
        self.count -= len(sizes)
        self.size -= sum(sizes)
        return len(sizes)


DEFAULT_SPOOL_BYTES: Final = 1024 * 1024 * 1024
"""Payload bytes. At 9 kB an envelope and two envelopes a second, sixteen hours without a link."""

_SCHEMA: Final = """
create table if not exists spooled (
    seq integer primary key autoincrement,
    run_id text not null,
    keyframe_id integer not null,
    payload blob not null,
    sha256 text
);
"""
_INDEX: Final = "create index if not exists spooled_sha256 on spooled (sha256)"


class Spooled(NamedTuple):
    """One envelope that waits; ``seq`` grows with every envelope ever spooled in this file."""

    seq: int
    run_id: str
    keyframe_id: int
    payload: bytes


class Spool:
    """Any thread may call; raises SpoolError when the file cannot be used."""

    def __init__(self, path: Path, max_bytes: int = DEFAULT_SPOOL_BYTES) -> None:
        self.path = path
        self.max_bytes = max_bytes
        self._lock = threading.Lock()
        self._count = self._bytes = 0
        with self._clear_errors():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(
                path, timeout=0, isolation_level=None, check_same_thread=False
            )
            try:
                self._prepare()
            except sqlite3.Error:
                self._db.close()
                raise

    def _prepare(self) -> None:
        self._db.execute("pragma locking_mode = exclusive")
        self._db.execute("pragma journal_mode = wal")
        self._db.execute("pragma synchronous = normal")
        self._db.executescript(_SCHEMA)
        self._aside = SetAside(self._db)  # which upgrades both tables
        self._db.execute(_INDEX)
        row = self._db.execute("select count(*), coalesce(sum(length(payload)), 0) from spooled")
        self._count, self._bytes = row.fetchone()

    def add(self, run_id: str, keyframe_id: int, payload: bytes) -> None:
        """Keep one envelope until it is acknowledged. Raises SpoolFull if there is no room."""
        with self._clear_errors(), self._lock:
            if not self._make_room(len(payload)):
                raise SpoolFull(
                    f"{self.path}: {self._count} envelopes ({self._bytes} bytes) wait for a "
                    f"recorder's acknowledgement and {self.max_bytes} bytes are the limit; "
                    "bring the link or the recorder back, or allow a larger spool"
                )
            self._db.execute(
                "insert into spooled (run_id, keyframe_id, payload, sha256) values (?, ?, ?, ?)",
                (run_id, keyframe_id, payload, fingerprint(payload)),
            )
            self._count += 1
            self._bytes += len(payload)

    def _make_room(self, size: int) -> bool:
        """Whether ``size`` bytes fit, once what was refused has given way."""
        if self._bytes + size > self.max_bytes:
            return False
        too_much = self._bytes + self._aside.size + size - self.max_bytes
        return too_much <= 0 or self._aside.make_way(too_much)

    def after(self, seq: int, limit: int) -> list[Spooled]:
        """The oldest envelopes after ``seq``, in order, at most ``limit``."""
        with self._clear_errors(), self._lock:
            rows = self._db.execute(
                "select seq, run_id, keyframe_id, payload from spooled where seq > ? "
                "order by seq limit ?",
                (seq, limit),
            )
            return [Spooled(*row) for row in rows]

    def oldest(self) -> int | None:
        """The seq of the oldest envelope that waits."""
        with self._clear_errors(), self._lock:
            ((seq,),) = self._db.execute("select min(seq) from spooled")
            return None if seq is None else int(seq)

    def waiting_up_to(self, seq: int) -> int:
        """How many envelopes up to ``seq`` still wait."""
        with self._clear_errors(), self._lock:
            rows = self._db.execute("select count(*) from spooled where seq <= ?", (seq,))
            (count,) = rows.fetchone()
            return int(count)

    def acknowledge(self, ack: Ack) -> int:
        """Let go of what ``ack`` names; how many envelopes wait no more."""
        removed = 0
        with self._clear_errors(), self._lock, self._transaction():
            for sha256 in ack.sha256:
                rows = self._db.execute(
                    "delete from spooled where sha256 = ? returning length(payload)", (sha256,)
                ).fetchall()
                removed += len(rows)
                self._bytes -= sum(size for (size,) in rows)
                self._aside.forget(sha256)
            self._count -= removed
        return removed

    def refuse(self, refusals: Refusals, up_to: int) -> int:
        """Set aside what ``refusals`` name among the envelopes up to the seq ``up_to``; how many
        envelopes wait no more."""
        moved = 0
        with self._clear_errors(), self._lock, self._transaction():
            for said in refusals.refused:
                rows = self._db.execute(
                    "select seq, length(payload) from spooled where sha256 = ? and seq <= ?",
                    (said.sha256, up_to),
                ).fetchall()
                for seq, size in rows:
                    self._set_aside(seq, size, refusals.log_id, said.reason)
                    moved += 1
        return moved

    def _set_aside(self, seq: int, size: int, log_id: str, reason: str) -> None:
        self._aside.take(seq, log_id, reason, size)
        self._db.execute("delete from spooled where seq = ?", (seq,))
        self._count -= 1
        self._bytes -= size

    @property
    def refused_count(self) -> int:
        """How many envelopes are set aside."""
        return self._aside.count

    def refused(self, limit: int) -> list[Refused]:
        """The oldest that are set aside, in order, at most ``limit``."""
        with self._clear_errors(), self._lock:
            return self._aside.rows(limit)

    def retry_refused(self) -> int:
        """Let everything set aside whose bytes are still here wait again, behind the others; how
        many envelopes that were."""
        with self._clear_errors(), self._lock, self._transaction():
            count, size = self._aside.put_back()
            self._count += count
            self._bytes += size
        return count

    def discard_refused(self) -> int:
        """Forget everything that is set aside; how many envelopes that were."""
        with self._clear_errors(), self._lock:
            return self._aside.clear()

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Let another process use the file. What waits stays in it."""
        with self._lock:
            self._db.close()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """All or nothing, in the file. After an error the numbers here may be wrong; every error
        is final for the sender, and the next process counts anew."""
        with self._db:
            self._db.execute("begin immediate")
            yield

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise SpoolError(f"spool {self.path}: {error.strerror}") from None
        except sqlite3.OperationalError as error:
            hint = "another robot process uses it; give each its own spool"
            hint = hint if "locked" in str(error) else "check the path, its rights and the disk"
            raise SpoolError(f"spool {self.path}: {error}; {hint}") from None
        except sqlite3.DatabaseError as error:
            raise SpoolError(
                f"spool {self.path}: {error}; move the file away and publish into a new one"
            ) from None
