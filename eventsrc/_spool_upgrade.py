"""Give a spool file of an earlier version, which did not name payloads, their SHA-256.

A part of `eventsrc.spool`. What was refused and has given up its bytes stays without: it can be
told and discarded, and no ack frees it.
"""

import sqlite3
from typing import Final

from .refusals import fingerprint

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
