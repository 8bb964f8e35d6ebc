"""The gap ledger against a set of everything recorded, recounted from scratch."""

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.losses import Gap, GapLedger

SETTLE_NS = 5

RUNS = ("run-a", "run-b")
steps = st.lists(st.tuples(st.sampled_from(RUNS), st.integers(-3, 30), st.integers(0, 4)))


def _missing(recorded: set[int]) -> set[int]:
    return set(range(min(recorded), max(recorded) + 1)) - recorded if recorded else set()


@given(steps)
def test_missing_is_what_lies_between_and_was_never_recorded(
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


@given(st.sets(st.integers(-3, 30), min_size=1), st.integers(-5, 35))
def test_a_stretch_is_the_longest_around_a_keyframe(recorded: set[int], probe: int) -> None:
    ledger = GapLedger(SETTLE_NS)
    for keyframe_id in sorted(recorded, key=lambda k: (k * 7) % 11):
        ledger.record("run-a", keyframe_id, 0)
    first = last = probe
    while first - 1 in recorded:
        first -= 1
    while last + 1 in recorded:
        last += 1
    assert ledger.stretch("run-a", probe) == ((first, last) if probe in recorded else None)


@given(steps, st.integers(0, 20))
def test_restored_it_goes_on_as_if_nothing_had_been(
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
def test_what_was_reported_stays_so_until_a_keyframe_closes_it(
    before: list[int], told: list[tuple[int, int]], late: list[int]
) -> None:
    """Whole holes of the ledger are reported, as an earlier recorder would have done."""
    ledger = GapLedger(SETTLE_NS)
    for keyframe_id in before:
        ledger.record("run-a", keyframe_id, 0)
    holes = list(ledger.gaps())
    reported: set[int] = set()
    for first, length in told:
        ledger.mark_reported(Gap("run-a", first, first + length))
        for hole in holes:
            if first <= hole.first and hole.last <= first + length:
                reported |= set(range(hole.first, hole.last + 1))
    for keyframe_id in late:
        ledger.record("run-a", keyframe_id, 0)
    missing = _missing(set(before + late))
    assert ledger.missing_reported() == len(reported & missing)
    flushed = {k for gap in ledger.flush() for k in range(gap.first, gap.last + 1)}
    assert flushed == missing - reported
    assert ledger.missing_reported() == ledger.missing == len(missing)
