"""A log to refold, a live tail beside a test, and the rows that a refold must leave."""

import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.log_commands import read_corrections
from projections.postgres import TailProgress, TailReport, rebuild, tail
from projections.postgres.connection import Targets
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows, expected_graph, parsed

SETTINGS = Settings()
WAIT_S = 60.0
LOG_LENGTH = 120


def three_rooms(folder: Path) -> Path:
    """A log of three rooms that the run b joins into one place, and a third run."""
    documents = walk(60) + list(bridge()) + walk(40, seed=3, run_id="run-c")
    return write_log(folder / "log", documents)


def fresh_rows(log: Path, targets: Targets, **options: Any) -> Any:
    """The rows of a replay, which must also be those that the view of a plain fold asks for."""
    rebuild(log, targets, SETTINGS, **options)
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        _, view = fold_log(reader, SETTINGS, corrections=corrections)
    found = all_rows(targets)
    assert parsed(found[0]) == expected_graph(view)
    return found


@contextmanager
def tailing(
    log: Path, targets: Targets, **options: Any
) -> Iterator[tuple[TailProgress, "Future[TailReport]"]]:
    """A live tail in a thread, stopped at the end."""
    progress, stop = TailProgress(), threading.Event()
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(
            tail, log, targets, options.pop("settings", SETTINGS), stop=stop, progress=progress,
            **options,
        )  # fmt: skip
        try:
            yield progress, running
        finally:
            stop.set()
            running.result(WAIT_S)
