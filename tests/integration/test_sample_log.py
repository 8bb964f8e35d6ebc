"""`logs/sample`: small, whole, and what the simulator would publish again today."""

from pathlib import Path

from eventsrc.log import LogReader
from eventsrc.record.log_info import log_info
from tests.support.logs import simulated

SAMPLE = Path(__file__).resolve().parents[2] / "logs" / "sample"


def test_it_is_one_sealed_segment_of_at_most_two_megabytes() -> None:
    info = log_info(SAMPLE)
    assert len(info.segments) == 1
    assert info.segments[0].sealed
    assert info.size_bytes <= 2_000_000
    assert (info.rejected, info.lost) == (0, 0)


def test_its_payloads_are_those_of_the_simulated_run_byte_for_byte() -> None:
    with LogReader(SAMPLE) as reader:
        events = list(reader.read())
    assert [event.payload for event in events] == list(simulated(7, "a").payloads)
    assert [event.offset for event in events] == list(range(len(events)))
    assert {event.key for event in events} == {"tb/detections"}
