"""A fold and its view as one container, and back."""

import zlib
from collections.abc import Callable, Sequence
from typing import Any

from eventsrc.log import still_holds
from projections.geometry import Neighbourhood
from projections.reducers._state import part, prefixed
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings
from projections.view import MapView

from .container import NotAContainer, pack, unpack
from .view_state import dump_view, load_view

FOLD_VERSION = 2
"""Raise it with every change of the reducers after which the same log gives another map."""


class SnapshotRefused(ValueError):
    """A snapshot cannot be used here; the message says why."""


def snapshot(
    semantic_map: SemanticMap, view: MapView, log_id: str, segments: Sequence[str] = ()
) -> bytes:
    """Both, as of ``semantic_map.next_offset``; the view's embeddings are left out. ``segments`` is
    the `eventsrc.log.lineage` of the events they were folded from."""
    about = {
        "fold_version": FOLD_VERSION,
        "log_id": log_id,
        "segments": list(segments),
        "fingerprint": semantic_map.settings.fingerprint(),
        "offset": semantic_map.next_offset,
    }
    return pack(
        prefixed("about", about)
        | prefixed("map", semantic_map.dump())
        | prefixed("view", dump_view(view))
    )


def restore(
    data: bytes,
    settings: Settings,
    log_id: str,
    neighbourhood: Neighbourhood | None = None,
    lineage_at: Callable[[int], Sequence[str]] = lambda _: (),
) -> tuple[SemanticMap, MapView]:
    """The fold and the view of `snapshot`, the view without embeddings. ``lineage_at`` tells what
    the log's first events are in now. Raises SnapshotRefused, and what ``lineage_at`` raises."""
    semantic_map = SemanticMap(settings, neighbourhood)
    view = MapView(settings, keep_embeddings=False)
    try:
        state = unpack(data)
        about = part("about", state)
        _check(about, settings, log_id)
        _check_lineage(about["segments"], lineage_at(about["offset"]))
        semantic_map.load(part("map", state))
        load_view(view, part("view", state))
    except (NotAContainer, zlib.error) as error:
        raise SnapshotRefused(str(error)) from None
    except SnapshotRefused:
        raise
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise SnapshotRefused(f"its content does not fit together: {error!r}") from None
    return semantic_map, view


def _check(about: dict[str, Any], settings: Settings, log_id: str) -> None:
    if about["fold_version"] != FOLD_VERSION:
        raise SnapshotRefused(f"it is of fold version {about['fold_version']}, not {FOLD_VERSION}")
    if about["log_id"] != log_id:
        raise SnapshotRefused(f"it is of the log {about['log_id']}, not of {log_id}")
    if about["fingerprint"] != settings.fingerprint():
        raise SnapshotRefused("it was made with other settings")


def _check_lineage(before: Sequence[str], now: Sequence[str]) -> None:
    if not still_holds(before, now):
        raise SnapshotRefused("the log has lost events since it was made")
