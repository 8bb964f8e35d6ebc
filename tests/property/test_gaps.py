"""The gap ledger against a set of everything recorded, recounted from scratch."""

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.gaps import Gap, GapLedger

SETTLE_NS = 5

RUNS = ("run-a", "run-b")
steps = st.lists(st.tuples(st.sampled_from(RUNS), st.integers(-3, 30), st.integers(0, 4)))


def _missing(recorded: set[int]) -> set[int]:
    return set(range(min(recorded), max(recorded) + 1)) - recorded if recorded else set()


@given(steps)
def test_missing_are_unrecorded_ids_between_recorded_ones(
    steps: list[tuple[str, int, int]],
) -> None:
    ledger = GapLedger(SETTLE_NS)
    recorded: dict[str, set[int]] = {run_id: set() for run_id in RUNS}
    duplicates = now_ns = 0
    for run_id, keyframe_id, wait_ns in steps:
        now_ns += wait_ns
        duplicates += keyframe_id in recorded[run_id]
        recorded[run_id].add(keyframe_id)
        ledger.record(run_id, keyframe_id, now_ns)
    missing = {(gap.run_id, k) for gap in ledger.gaps() for k in range(gap.first, gap.last + 1)}
    assert missing == {(run_id, k) for run_id in RUNS for k in _missing(recorded[run_id])}
    assert ledger.missing == len(missing)
    assert ledger.duplicates == duplicates


@given(steps)
def test_every_missing_keyframe_is_reported_once_when_it_has_settled(
    steps: list[tuple[str, int, int]],
) -> None:
    """The oracle keeps, for every missing keyframe, since when it has been missing."""
    ledger = GapLedger(SETTLE_NS)
    recorded: dict[str, set[int]] = {run_id: set() for run_id in RUNS}
    since_ns: dict[tuple[str, int], int] = {}
    told: list[tuple[str, int]] = []
    now_ns = 0
    for run_id, keyframe_id, wait_ns in steps:
        now_ns += wait_ns
        recorded[run_id].add(keyframe_id)
        ledger.record(run_id, keyframe_id, now_ns)
        since_ns.pop((run_id, keyframe_id), None)
        for missing in _missing(recorded[run_id]):
            since_ns.setdefault((run_id, missing), now_ns)
        expected = {k for k, since in since_ns.items() if now_ns - since >= SETTLE_NS} - set(told)
        due = [(g.run_id, k) for g in ledger.due(now_ns) for k in range(g.first, g.last + 1)]
        assert set(due) == expected
        told += due
    told += [(g.run_id, k) for g in ledger.flush() for k in range(g.first, g.last + 1)]
    assert len(told) == len(set(told))
    assert set(since_ns) <= set(told)


@given(
    st.lists(st.one_of(st.integers(0, 20), st.tuples(st.integers(0, 30)))),
    st.integers(0, 20),
)
def test_announced_keyframes_are_missing_until_recorded(
    steps: list[int | tuple[int]], late: int
) -> None:
    """A bare number is recorded, one in a tuple is said to be the last that was sent."""
    ledger = GapLedger(0)
    recorded: set[int] = set()
    highest = -1
    for step in steps:
        if isinstance(step, tuple):
            ledger.expect("run-a", step[0], 0)
            ledger.due(0)
            highest = max(highest, step[0]) if recorded else highest
        else:
            ledger.record("run-a", step, 0)
            recorded.add(step)
            highest = max(highest, step)
    if recorded:
        ledger.record("run-a", late, 0)
        recorded.add(late)
    wanted = set(range(min(recorded), max(highest, late) + 1)) - recorded if recorded else set()
    missing = {k for gap in ledger.gaps() for k in range(gap.first, gap.last + 1)}
    assert missing == wanted
    assert ledger.missing == len(wanted)
    again = GapLedger(0)
    for k in sorted(recorded):
        again.record("run-a", k, 0)
    for gap in ledger.gaps():  # as loss events of the log tell them
        again.add_reported(gap, 0)
    assert {k for g in again.reported_gaps() for k in range(g.first, g.last + 1)} == wanted
    assert again.missing == len(wanted)


@given(steps, st.integers(0, 20))
def test_a_restored_ledger_continues_like_the_original(
    steps: list[tuple[str, int, int]], at: int
) -> None:
    whole, half = GapLedger(SETTLE_NS), GapLedger(SETTLE_NS)
    for index, (run_id, keyframe_id, _) in enumerate(steps):
        if index == at:
            assert half.flush() == whole.flush()
            restored = GapLedger(SETTLE_NS)
            restored.restore(half.state(), 0)
            half = restored
        whole.record(run_id, keyframe_id, 0)
        half.record(run_id, keyframe_id, 0)
    assert half.state() == whole.state()
    assert half.due(SETTLE_NS) == whole.due(SETTLE_NS)
    assert half.flush() == []


@given(
    st.lists(st.integers(0, 30), min_size=1),
    st.lists(st.tuples(st.integers(0, 30), st.integers(0, 10))),
    st.lists(st.integers(0, 30)),
)
def test_reported_gaps_stay_reported_until_closed(
    before: list[int], told: list[tuple[int, int]], late: list[int]
) -> None:
    ledger = GapLedger(SETTLE_NS)
    for keyframe_id in before:
        ledger.record("run-a", keyframe_id, 0)
    holes = list(ledger.gaps())
    reported: set[int] = set()
    for first, length in told:
        ledger.mark_reported(Gap("run-a", first, first + length))
        for hole in holes:
            reported |= set(range(max(first, hole.first), min(first + length, hole.last) + 1))
    for keyframe_id in late:
        ledger.record("run-a", keyframe_id, 0)
    missing = _missing(set(before + late))
    assert ledger.missing_reported() == len(reported & missing)
    flushed = {k for gap in ledger.flush() for k in range(gap.first, gap.last + 1)}
    assert flushed == missing - reported
    assert ledger.missing_reported() == ledger.missing == len(missing)
