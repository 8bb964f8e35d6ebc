"""Rebuild: fold the whole log into shadows, and swap them in for the map that readers see.

Other processes read and parse a large log (`projections.map.parsed_log`), this one folds it and
makes the rows, and a thread for each database sends them.
"""

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

import psycopg

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.forms import read_envelope
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.map.fold import read_ahead
from projections.map.parsed_log import ParsedLog, default_workers
from projections.map.parsing import ParsedEvent
from projections.map.records import seen_once

from .connection import Targets, connect
from .inputs import LogInputs, MapInputs, SettingsOf
from .live_fold import LiveFold
from .origin import command_for
from .shadows import FoldedLog, ShadowWriter, drop_replaced, stream, swap_in_new_map
from .stores import Only, open_stores
from .vector_sink import HnswReport


@dataclass(frozen=True, slots=True)
class ForeignEmbedding:
    """An embedding that is outside the map's space. A model is None when it has no name.

    ``map_dim`` is None when the map has no embedding: none had the space that the settings ask for.
    """

    offset: Offset
    det_id: str
    model: str | None
    dim: int
    map_model: str | None
    map_dim: int | None


def first_foreign_embedding(fold: LiveFold, reader: LogReader) -> ForeignEmbedding | None:
    """None when there is none. Read again from the log, as the fold does not keep it."""
    first = next((o for o in fold.view.observations if o.foreign_space), None)
    if first is None:
        return None
    offset, space = fold.view.keyframes[first.keyframe].offset, fold.map.space
    (event,) = reader.read(offset, Offset(offset + 1))
    parsed = read_envelope(event, max_bytes=sys.maxsize)
    assert isinstance(parsed, Accepted)  # noqa: S101 - it was folded
    vector = parsed.vectors[parsed.det_ids.index(first.det_id)]
    assert vector is not None  # noqa: S101 - it was found to be of another space
    dim = space.dim if space.is_decided else None
    return ForeignEmbedding(
        offset, first.det_id, first.embedding_model, len(vector), space.model, dim
    )


def give_up_replaced(targets: Targets) -> list[str]:
    """Have the servers write all files, so that those of replaced rows are gone; lines on what they
    keep. Only some roles may."""
    lines = []
    for url in targets.urls:
        with connect(url, application="mapfold redact", autocommit=True) as connection:
            try:
                connection.execute("VACUUM (FULL) pg_catalog.pg_statistic")
                connection.execute("CHECKPOINT")
            except psycopg.errors.InsufficientPrivilege:
                lines.append("this role may not CHECKPOINT: files of old rows go at the next one")
    return [*lines, "not reached: the server's pg_wal, until it is written over, and its backups"]


TICK_EVENTS: Final = 256
"""Events between two reports of progress; also between two checks of the number of waiting rows."""


@dataclass(frozen=True, slots=True)
class RebuildProgress:
    """``done`` of ``total`` events are folded; ``stage`` is what the rebuild does now."""

    stage: str
    done: int
    total: int


OnProgress: TypeAlias = Callable[[RebuildProgress], None]


@dataclass(frozen=True, slots=True)
class RebuildReport:
    """The outcome of a rebuild. ``rows`` is by graph label and table; times are seconds.

    ``foreign`` is the first embedding that was left out because it is outside the map's space.
    ``workers`` is how many processes were started to parse the log, ``lost_workers`` how many of
    them died: their part was parsed here. ``seen_once`` is the number of Objects seen once.
    """

    events: int
    digest: str
    counts: dict[str, int]
    rows: dict[str, int]
    fold_s: float
    total_s: float
    hnsw: HnswReport | None
    foreign: ForeignEmbedding | None = None
    workers: int = 0
    lost_workers: int = 0
    seen_once: int = 0


def rebuild(
    log: Path,
    targets: Targets,
    settings: Settings | SettingsOf,
    *,
    until: Offset | None = None,
    known_at: Offset | None = None,
    only: Only = None,
    hnsw: bool = True,
    workers: int | None = None,
    progress: OnProgress | None = None,
) -> RebuildReport:
    """Fold the first ``until`` events (all for None) and replace the map in the databases.

    The corrections are those of the commands before ``known_at``, by default before ``until``.
    ``workers`` is how many processes may parse a large log beside this one, 0 for none, by default
    `default_workers`; the map does not depend on it.
    Raises FoldError at an event that cannot be folded, ProjectionBusy beside a tail or another
    rebuild, and DatabaseError; the old map stays then.
    """
    started = time.monotonic()
    notify = progress or (lambda _: None)
    if workers is None:
        workers = default_workers()
    with gc_paused(), LogReader(log) as reader:
        total = reader.end_for(until)
        inputs = LogInputs.read(reader, settings, total if known_at is None else known_at).latest
        fold = LiveFold(inputs.settings, corrections=inputs.corrections, reader=reader)
        folded_at = started

        def fold_into(writers: Sequence[ShadowWriter]) -> FoldedLog:
            nonlocal folded_at
            _fold_into(
                fold,
                read_ahead(parsed.stretches(), fold.map),
                writers,
                total,
                notify,
                partial(_advice, log, inputs),
            )
            folded_at = time.monotonic()
            last = next(reader.read(Offset(total - 1), total), None)
            return FoldedLog(fold, last, inputs)

        def notify_stage(stage: str) -> None:
            notify(RebuildProgress(stage, total, total))

        opened = open_stores(
            targets, inputs.settings, only=only, application="mapfold replay", remake=True
        )
        with opened as stores, ParsedLog(reader, total, workers) as parsed:
            swap = swap_in_new_map(stores, reader.log_id, fold_into, notify_stage)
            index = drop_replaced(stores, notify_stage, hnsw=hnsw)
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
                parsed.started,
                parsed.lost,
                seen_once(fold.view.objects.values()),
            )


def _fold_into(
    fold: LiveFold,
    stretches: Iterable[Sequence[ParsedEvent]],
    writers: Sequence[ShadowWriter],
    total: int,
    notify: OnProgress,
    advice: Callable[[int], str],
) -> None:
    notified = FIRST_OFFSET
    for stretch in stretches:
        try:
            fold.fold_parsed(stretch)
        except FoldError as failed:
            reason = f"{failed.reason}; {advice(failed.offset)}"
            raise FoldError(failed.offset, reason) from failed
        done = fold.map.next_offset
        if done - notified >= TICK_EVENTS or done == total:
            notified = done
            notify(RebuildProgress("folding", done, total))
            stream(fold, writers)


def _advice(log: Path, inputs: MapInputs, offset: Offset) -> str:
    """Advice for an event that cannot be folded."""
    before = command_for("replay", log, inputs, "--until", str(offset))
    return (
        "the databases stay as they were; to leave it out run:"
        f" {before} && {command_for('tail', log, inputs)}"
    )
