"""Verify an archive of a log without mapfold: python verify_archive.py FOLDER

FOLDER is the archive, or a copy of it (aws s3 sync s3://BUCKET/PREFIX FOLDER). Needs only `mcap`.
"""

import hashlib
import io
import json
import sys
from pathlib import Path

from mcap.reader import make_reader


def verify(folder: Path) -> int:
    """The number of events in an archive; ends the program at the first thing that is wrong."""
    log_id = json.loads((folder / "archive.json").read_text())["log_id"]
    events, before = 0, {""}
    for path in sorted((folder / "manifest").glob("*.json")):
        entry = json.loads(path.read_text())
        data = (folder / entry["object"]).read_bytes()
        reader = make_reader(io.BytesIO(data), validate_crcs=True)
        found = list(reader.iter_metadata())
        head = next(m.metadata for m in found if m.name.startswith("mapfold.segment:"))
        for what, is_right in {
            "size": len(data) == entry["size"],
            "SHA-256": hashlib.sha256(data).hexdigest() == entry["sha256"],
            "log": head["log_id"] == entry["log_id"] == log_id,
            "offset": int(head["base"]) == entry["base"] == events,
            "chain": head["previous_sha256"] in before,
            "number of events": sum(1 for _ in reader.iter_messages(log_time_order=False))
            == entry["following"] - entry["base"],
        }.items():
            if not is_right:
                sys.exit(f"{entry['object']}: wrong {what}")
        events, before = entry["following"], {entry["sha256"], head.get("replaces_sha256")}
    return events


if __name__ == "__main__":
    print(f"{verify(Path(sys.argv[1])):,} events, all good")
