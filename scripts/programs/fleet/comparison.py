"""Compare what robots published with what is in the logs."""

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.base.errors import LogError
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY
from eventsrc.log import LogReader, verify_log
from eventsrc.record.robot.acks import payload_sha256

Keyframe = tuple[str, int]
"""Run and keyframe id."""

_HARMLESS = ("duplicate", "time", "torn")
"""Kinds of findings that lose nothing: sent again, a clock that was set, never synced."""


@dataclass
class Comparison:
    """``lost`` keyframes were published and are in no log, ``altered`` ones are there with other
    bytes, ``unknown`` ones were never published. ``duplicates`` are events beyond the first of a
    keyframe: it was sent again, and the fold counts it once."""

    published: int = 0
    stored: int = 0
    duplicates: int = 0
    rejected: int = 0
    loss_events: int = 0
    log_bytes: int = 0
    lost: list[Keyframe] = field(default_factory=list)
    altered: list[Keyframe] = field(default_factory=list)
    unknown: list[Keyframe] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)


def read_published(paths: Iterable[Path]) -> dict[Keyframe, str]:
    """Digest of the payload by run and keyframe, from the files that `fleet.robots` writes.
    A line that a killed process left without its end was not published by then."""
    published: dict[Keyframe, str] = {}
    for path in paths:
        for line in path.read_text().split("\n")[:-1]:
            run_id, keyframe_id, sha256 = json.loads(line)
            published[run_id, keyframe_id] = sha256
    return published


def compare(published: dict[Keyframe, str], logs: Iterable[tuple[Path, str]]) -> Comparison:
    """Read every log, given with the key of its robots, to its end."""
    found = Comparison(published=len(published))
    stored: Counter[Keyframe] = Counter()
    for log, key in logs:
        found.log_bytes += sum(path.stat().st_size for path in log.glob("*.mcap*"))
        found.damage += [
            f"{log.name}: {finding.kind}: {finding.message}"
            for finding in verify_log(log).findings
            if finding.kind not in _HARMLESS
        ]
        try:
            _read(log, key, published, stored, found)
        except LogError as error:
            found.damage.append(str(error))  # and what could not be read counts as lost
    found.stored = len(stored)
    found.duplicates = stored.total() - len(stored)
    found.lost = sorted(published.keys() - stored.keys())
    return found


def _read(
    log: Path,
    key: str,
    published: dict[Keyframe, str],
    stored: Counter[Keyframe],
    found: Comparison,
) -> None:
    with LogReader(log) as reader:
        for event in reader.read():
            if event.key == key:
                document = json.loads(event.payload)
                keyframe = document["run_id"], document["keyframe_id"]
                stored[keyframe] += 1
                wanted = published.get(keyframe)
                if wanted is None:
                    found.unknown.append(keyframe)
                elif payload_sha256(event.payload) != wanted:
                    found.altered.append(keyframe)
            found.rejected += event.key == REJECTED_KEY
            found.loss_events += event.key == LOSS_KEY
