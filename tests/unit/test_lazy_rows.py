"""Records of a history that are made when asked for: which are made, and how many are kept."""

import numpy as np

from projections.store.history_records import Chunks, Items, OrdinalsByName


class Making:
    """Makes squares, and remembers the most at once."""

    def __init__(self) -> None:
        self.spans: list[int] = []

    def span(self, first: int, last: int) -> list[int]:
        self.spans.append(last - first)
        return [number * number for number in range(first, last)]

    def rows(self, rows: np.ndarray) -> list[int]:
        self.spans.append(len(rows))
        return [row * row for row in rows.tolist()]


def test_few_of_those_asked_for_one_by_one_are_kept() -> None:
    making = Making()
    squares = Chunks(100_000, making.span)
    assert [squares[i] for i in range(0, 100_000, 10)] == [i * i for i in range(0, 100_000, 10)]
    assert max(making.spans) <= 64
    assert sum(map(len, squares._kept.values())) < 20_000
    making.spans.clear()
    assert squares[-1] == 99_999**2
    assert not making.spans  # the last one was kept


def test_a_walk_over_items_makes_a_few_thousand_at_once() -> None:
    making = Making()
    rows = np.arange(5, 50_000, 3)
    items = Items(rows, making.rows, lambda of: of * 2)
    assert list(items) == [row * row for row in rows.tolist()]
    assert items[7] == 26**2
    assert items[2:4] == [11**2, 14**2]
    assert max(making.spans) <= 4_096


def test_counting_items_before_an_event_makes_none() -> None:
    making = Making()
    items = Items(np.array([1, 4, 6, 9]), making.rows, lambda of: of * 10)
    ends = [0, 10, 11, 40, 41, 60, 61, 90, 91, 2**63 - 1]
    assert [items.before(end) for end in ends] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert not making.spans


def test_a_name_is_looked_for_once() -> None:
    asked: list[str] = []

    def find(name: str) -> int | None:
        asked.append(name)
        return {"a": 0}.get(name)

    found = OrdinalsByName(1, find, lambda: iter(["a"]))
    assert [found.get("a"), found.get("a"), found.get("b"), found.get("b")] == [0, 0, None, None]
    assert asked == ["a", "b"]
