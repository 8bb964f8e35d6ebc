"""A small fleet loses nothing, whatever is killed; and what is lost is counted as lost."""

import json
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from eventsrc.record.robot.acks import payload_sha256
from scripts.programs.fleet.comparison import compare, read_published
from scripts.programs.fleet.simulate import Plan, lines_of, simulate
from tests.support.envelopes import envelope, payload

KEY = "site-0/detections"


@pytest.mark.slow
@pytest.mark.parametrize(
    "plan",
    [
        Plan(sites=4, robots=12, seconds=12.0, kill=True),
        Plan(sites=1, robots=30, per_second=4.0, seconds=4.0, burst=True),
    ],
    ids=["killed", "all at once"],
)
def test_nothing_is_lost(plan: Plan, tmp_path: Path) -> None:
    outcome = simulate(plan, tmp_path, print)
    document = outcome.document()
    assert outcome.good, document
    assert document["published"] <= document["stored"]
    assert document["published"] >= (0.7 if plan.kill else 1.0) * (
        plan.robots * plan.per_second * plan.seconds
    )
    assert document["lag_ms"]["p50"] > 0
    assert min(document["cpu_us_per_keyframe"].values()) > 0
    assert len(document["done"]) == (4 if plan.kill else 0)
    assert lines_of(outcome)[-1] == "nothing is lost"


def test_what_is_lost_altered_and_sent_again_is_counted(tmp_path: Path) -> None:
    sent = [payload(envelope(number)) for number in range(5)]
    with LogWriter(tmp_path / "log") as writer:
        for raw in (sent[0], sent[1], sent[1], payload(envelope(2, note="other"))):
            writer.append(KEY, raw)
        writer.append(KEY, payload(envelope(9)))
        writer.append("elsewhere", sent[3])
    lines = [json.dumps(["run-a", n, payload_sha256(raw)]) for n, raw in enumerate(sent)]
    (tmp_path / "published.jsonl").write_text("\n".join(lines) + '\n["run-a", 5, "ab')
    published = read_published([tmp_path / "published.jsonl"])
    assert len(published) == 5
    found = compare(published, [(tmp_path / "log", KEY)])
    assert found.lost == [("run-a", 3), ("run-a", 4)]
    assert found.altered == [("run-a", 2)]
    assert found.unknown == [("run-a", 9)]
    assert (found.published, found.stored, found.duplicates) == (5, 4, 1)
    assert not found.damage


def test_damage_of_a_log_is_found(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log") as writer:
        writer.append(KEY, payload(envelope(0)))
    (segment,) = (tmp_path / "log").glob("*.mcap")
    raw = bytearray(segment.read_bytes())
    raw[len(raw) // 2] ^= 1
    segment.write_bytes(raw)
    found = compare({}, [(tmp_path / "log", KEY)])
    assert any("crc" in line for line in found.damage)
