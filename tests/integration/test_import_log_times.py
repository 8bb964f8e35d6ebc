"""The log times of imported messages that do not say when they were received."""

import json
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.system_events import REJECTED_KEY
from eventsrc.log import verify_log
from eventsrc.record.importers.sources import CLOCK_SET_NS, TOGETHER_NS, LogTimes
from eventsrc.record.log_info import log_info
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import read_log

S = 1_000_000_000
DRIVE_S = 480


def naive_times(messages: list[tuple[str, int]]) -> list[int]:
    """The rule as it is said: no earlier than any message since the run began."""
    times: list[int] = []
    began: dict[str, int] = {}
    for run, stamp in messages:
        if run not in began:
            began[run] = len(times)
            together = bool(times) and 0 <= times[-1] - stamp <= TOGETHER_NS
            times.append(times[-1] if together else stamp)
            continue
        latest = max(times[began[run] :])
        if latest - stamp > CLOCK_SET_NS:
            began[run] = len(times)
            times.append(stamp)
        else:
            times.append(max(stamp, latest))
    return times


@given(
    st.lists(
        st.tuples(
            st.sampled_from("abc"),
            st.one_of(
                st.integers(0, 40 * S),
                st.sampled_from([5, 2 * CLOCK_SET_NS, 2 * CLOCK_SET_NS + 1, 4 * CLOCK_SET_NS]),
            ),
        ),
        max_size=40,
    )
)
def test_they_are_those_of_the_plain_rule(messages: list[tuple[str, int]]) -> None:
    times = LogTimes()
    assert [times.add_stamped(*message) for message in messages] == naive_times(messages)  # type: ignore[arg-type]


def drive(folder: Path, name: str, run: str, start: float, count: int = DRIVE_S // 2) -> None:
    lines = [
        payload({**envelope(k, 0.1 * k, run_id=run), "timestamp": start + 2.0 * k})
        for k in range(count + 1)
    ]
    (folder / name).write_bytes(b"\n".join(lines))


def test_a_drive_plays_as_long_as_it_took(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    drive(tmp_path, "a.jsonl", "a", 1_000.0)
    before = json.loads(run("import", "L", "a.jsonl", "--json").out)
    assert before["accepted"] == DRIVE_S // 2 + 1
    events = read_log(tmp_path / "L")
    assert [event.logged_ns for event in events] == [event.stamp_ns for event in events]
    info = log_info(tmp_path / "L")
    assert info.last_logged_ns is not None
    assert info.first_logged_ns is not None
    assert info.last_logged_ns - info.first_logged_ns == DRIVE_S * S


def test_the_time_of_the_import_is_in_the_head_of_the_segment(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    drive(tmp_path, "a.jsonl", "a", 1_000.0, 3)
    earliest_ns = (tmp_path / "a.jsonl").stat().st_mtime_ns
    run("import", "L", "a.jsonl")
    latest_ns = next((tmp_path / "L").glob("*.mcap")).stat().st_mtime_ns
    (segment,) = log_info(tmp_path / "L").segments
    assert segment.imported
    assert segment.begun_ns is not None
    assert earliest_ns - S <= segment.begun_ns <= latest_ns + S  # files have coarser times
    shown = run("log", "info", "L").out
    assert "logged    1970-01-01T00:16:40.000000Z to 1970-01-01T00:16:46.000000Z\n" in shown
    assert "\nwritten   20" in shown
    assert shown.endswith(", sealed, imported\n")
    assert run("log", "info", "L", "--json").json["segments"][0]["begun_ns"] == segment.begun_ns


def test_older_drives_may_be_imported_later_and_times_still_find_their_events(
    tmp_path: Path,
) -> None:
    run = Commands.in_folder(tmp_path)
    drive(tmp_path, "late.jsonl", "late", 90_000.0, 4)
    drive(tmp_path, "early.jsonl", "early", 1_000.0, 4)
    run("import", "L", "late.jsonl")
    run("import", "L", "early.jsonl")
    run("import", "M", "late.jsonl", "early.jsonl")
    # where an import goes on with an older file a segment begins
    assert not [each for name in "LM" for each in verify_log(tmp_path / name).findings]
    assert read_log(tmp_path / "L") == read_log(tmp_path / "M")
    times = [event.logged_ns // S for event in read_log(tmp_path / "L")]
    assert times[:10] == [90_000 + 2 * k for k in range(5)] + [1_000 + 2 * k for k in range(5)]
    shown = run("log", "cat", "L", "--from", "1970-01-02T01:00:04Z", "--to", "4", "--json").lines
    assert [line["offset"] for line in shown] == [2, 3]


def test_two_imports_are_no_clock_that_ran_backwards_but_a_recording_is(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    drive(tmp_path, "late.jsonl", "late", 90_000.0, 4)
    drive(tmp_path, "early.jsonl", "early", 1_000.0, 4)
    run("import", "L", "late.jsonl")
    run("import", "L", "early.jsonl")
    assert not verify_log(tmp_path / "L").findings


def test_late_and_interleaved_keyframes_do_not_turn_the_log_times_back(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    stamps = [("a", 1, 100.0), ("a", 3, 104.0), ("b", 1, 103.9), ("a", 2, 102.0), ("b", 2, 104.5)]
    lines = [payload({**envelope(k, run_id=name), "timestamp": stamp}) for name, k, stamp in stamps]
    (tmp_path / "a.jsonl").write_bytes(b"\n".join(lines))
    run("import", "L", "a.jsonl")
    events = read_log(tmp_path / "L")
    assert [event.logged_ns / S for event in events] == [100.0, 104.0, 104.0, 104.0, 104.5]
    assert [event.stamp_ns / S for event in events] == [stamp for *_, stamp in stamps]
    assert not verify_log(tmp_path / "L").findings


def test_what_has_no_time_is_logged_with_the_message_before_it(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    lines = [payload(envelope(1)), b'{"no": "envelope"}', payload(envelope(2)), b"["]
    (tmp_path / "a.jsonl").write_bytes(b"\n".join(lines))
    run("import", "L", "a.jsonl", code=3)
    first, rejected, second, last = read_log(tmp_path / "L")
    assert (rejected.key, last.key) == (REJECTED_KEY, REJECTED_KEY)
    assert (rejected.logged_ns, last.logged_ns) == (first.logged_ns, second.logged_ns)


def test_many_runs_cost_no_more_than_few() -> None:
    """A hundred thousand runs in a file, each of one message, and then again."""
    times = LogTimes()
    stamps = [(f"r{n}", (n % 7) * 20 * S) for n in range(100_000)]
    for run, stamp in [*stamps, *stamps]:
        times.add_stamped(run, stamp)  # type: ignore[arg-type]
    assert times.last_ns == 120 * S


def test_rejected_lines_before_the_first_time_of_a_file_do_not_turn_the_log_times_back(
    tmp_path: Path,
) -> None:
    run = Commands.in_folder(tmp_path)
    drive(tmp_path, "late.jsonl", "late", 90_000.0, 4)
    drive(tmp_path, "early.jsonl", "early", 1_000.0, 4)
    for name in ("late.jsonl", "early.jsonl"):  # the first line of a CSV file, say
        (tmp_path / name).write_bytes(b"time,x,y\n[\n" + (tmp_path / name).read_bytes())
    run("import", "L", "late.jsonl", "early.jsonl", code=3)
    assert len(read_log(tmp_path / "L")) == 14
    assert not verify_log(tmp_path / "L").findings
