"""Rebuild: fold the whole log into shadows, and swap them in for the map that readers see."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.errors import FoldError
from projections.model.fold import gc_paused
from projections.settings import Settings

from .connection import Targets
from .foreign_embedding import ForeignEmbedding, first_foreign_embedding
from .inputs import LogInputs, MapInputs, SettingsOf
from .live_fold import LiveFold, batches
from .loader import LoaderName
from .origin import command_for
from .shadows import FoldedLog, ShadowWriter, drop_replaced, stream, swap_in_new_map
from .stores import Only, open_stores
from .vector_table import HnswReport

TICK_EVENTS: Final = 256
"""Events between two reports of progress and checks of whether enough rows wait to be written."""


@dataclass(frozen=True, slots=True)
class RebuildProgress:
    """``done`` of ``total`` events are folded; ``stage`` is what the rebuild does now."""

    stage: str
    done: int
    total: int


OnProgress: TypeAlias = Callable[[RebuildProgress], None]


@dataclass(frozen=True, slots=True)
class RebuildReport:
    """What a rebuild did. ``rows`` is by graph label and table; times are seconds.

    ``foreign`` is the first embedding that was left out because it is outside the map's space.
    """

    events: int
    digest: str
    counts: dict[str, int]
    rows: dict[str, int]
    fold_s: float
    total_s: float
    hnsw: HnswReport | None
    foreign: ForeignEmbedding | None = None


def rebuild(
    log: Path,
    targets: Targets,
    settings: Settings | SettingsOf,
    *,
    until: Offset | None = None,
    known_at: Offset | None = None,
    only: Only = None,
    loader: LoaderName = "copy",
    hnsw: bool = True,
    progress: OnProgress | None = None,
) -> RebuildReport:
    """Fold the first ``until`` events (all for None) and replace the map in the databases.

    The corrections are those of the commands before ``known_at``, by default before ``until``.
    Raises FoldError at an event that cannot be folded, ProjectionBusy beside a tail or another
    rebuild, and DatabaseError; the old map stays then.
    """
    started = time.monotonic()
    notify = progress or (lambda _: None)
    with gc_paused(), LogReader(log) as reader:
        total = reader.next_offset if until is None else min(until, reader.next_offset)
        inputs = LogInputs.read(reader, settings).at(total if known_at is None else known_at)
        fold = LiveFold(inputs.settings, corrections=inputs.corrections, reader=reader)
        folded_at = started

        def fold_into(writers: Sequence[ShadowWriter]) -> FoldedLog:
            nonlocal folded_at
            events, advice = reader.read(FIRST_OFFSET, total), partial(_advice, log, inputs)
            last = _fold_into(fold, events, writers, total, notify, advice)
            folded_at = time.monotonic()
            return FoldedLog(fold, last, inputs)

        def tell(stage: str) -> None:
            notify(RebuildProgress(stage, total, total))

        opened = open_stores(
            targets, inputs.settings, only=only, application="mapfold replay", loader=loader
        )
        with opened as stores:
            swap = swap_in_new_map(stores, reader.log_id, fold_into, tell)
            index = drop_replaced(stores, tell, hnsw=hnsw)
            ended = time.monotonic()
            return RebuildReport(
                total,
                swap.digest,
                fold.view.counts(),
                swap.rows,
                folded_at - started,
                ended - started,
                index,
                first_foreign_embedding(fold, reader),
            )


def _fold_into(
    fold: LiveFold,
    events: Iterable[Event],
    writers: Sequence[ShadowWriter],
    total: int,
    notify: OnProgress,
    advice: Callable[[int], str],
) -> Event | None:
    last: Event | None = None
    for batch in batches(events, TICK_EVENTS):
        for failed in fold.feed(batch):
            if failed is not None:
                raise FoldError(failed.offset, f"{failed.reason}; {advice(failed.offset)}")
        last = batch[-1]
        notify(RebuildProgress("folding", last.offset + 1, total))
        stream(fold, writers)
    return last


def _advice(log: Path, inputs: MapInputs, offset: Offset) -> str:
    """What to do about an event that cannot be folded."""
    before = command_for("replay", log, inputs, "--until", str(offset))
    return (
        "the databases stay as they were; to leave it out run:"
        f" {before} && {command_for('tail', log, inputs)}"
    )
