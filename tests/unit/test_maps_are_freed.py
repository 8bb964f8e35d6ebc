"""A map is freed with its last reference, not by the cyclic garbage collector.

A rebuild leaves hundreds of megabytes behind, and a process that folds again and again (a
tail that restarts, ``whatif``, ``serve``) would hold several of them.
"""

import gc
import weakref
from collections.abc import Callable, Iterator

import pytest

from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import LogReader
from projections.ask.find import Wanted, find
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.postgres.graph_sink import GraphSink
from projections.postgres.live_fold import LiveFold
from projections.postgres.vector_sink import VectorSink
from projections.store.history import History
from projections.store.tables import Tables
from tests.support.logs import sample_drive

SAMPLE = sample_drive()


@pytest.fixture
def no_search_for_cycles() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


def folded() -> object:
    with LogReader(SAMPLE) as reader:
        return fold_log(reader, Settings())[1]


def asked() -> object:
    """A map that keeps what questions made of it."""
    with LogReader(SAMPLE) as reader:
        view = fold_log(reader, Settings())[1]
    find(view, Wanted(near="p0", start="0,0", every=True))
    return view


def folding() -> object:
    with LogReader(SAMPLE) as reader:
        return fold_log(reader, Settings())[0]


def no_map(offset: Offset) -> OccupancyMap:
    raise AssertionError(offset)


@pytest.mark.usefixtures("no_search_for_cycles")
@pytest.mark.parametrize(
    "make",
    [
        folded,
        asked,
        folding,
        lambda: LiveFold(Settings()).view,
        GraphSink,
        lambda: LiveFold(Settings()).tracker,
        VectorSink,
        lambda: History(Settings(), NO_CORRECTIONS, Tables(), no_map),
    ],
    ids=[
        "view",
        "asked view",
        "map",
        "live view",
        "graph sink",
        "tracker",
        "vector sink",
        "history",
    ],
)
def test_it_is_in_no_reference_cycle(make: Callable[[], object]) -> None:
    thing = make()
    gone = weakref.ref(thing)
    del thing
    assert gone() is None
