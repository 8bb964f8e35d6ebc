"""The shelf of a robot's spool: envelopes a recorder has refused, each with the reason.

Their bytes are in that recorder's log, so here they are only kept to be sent again, and give way
when there is no room for new envelopes: the oldest first; run, keyframe and reason stay.
A part of `eventsrc.spool`, whose lock and transactions it relies on.
"""

import sqlite3
from typing import Final, NamedTuple

from ._spool_upgrade import add_digests

_SCHEMA: Final = """
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
_INDEX: Final = "create index if not exists refused_sha256 on refused (sha256)"


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
        db.executescript(_SCHEMA)
        add_digests(db)
        db.execute(_INDEX)
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
