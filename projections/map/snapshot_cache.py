"""The cache of snapshots beside a log: ``<log>.snapshots/<fingerprint>-<offset>.map``.

Files are written under another name and renamed, and never changed. A failure of the cache is
reported as a note and makes the fold slower, but never fails it. A snapshot of events that the log
has lost since, by recovery or deletion, is not used. For each set of settings and corrections a few
snapshots are kept: the newest, and others spread out below it.
"""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from eventsrc.base.progress import working
from eventsrc.envelope.model import Offset
from eventsrc.log import (
    cache_folder,
    delete_left_over_files,
    make_cache_folder,
    segment_signatures,
    write_cache_file,
)
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings

from .snapshot import SnapshotRefused, restore, snapshot, snapshot_fingerprint
from .view import MapView

Note = Callable[[str], None]
_NAME = re.compile(r"([0-9a-f]{16})-(\d{20})\.map")
_MAX_KEPT = 6


class SnapshotCache:
    """Snapshots of one log under one set of settings and corrections; ``note`` is called with a
    message for each that is not usable. Other names of places need no other snapshots."""

    def __init__(
        self,
        log: Path,
        log_id: str,
        settings: Settings,
        note: Note,
        *,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> None:
        self._log = log
        self.folder = cache_folder(log, "snapshots")
        self._signatures = partial(segment_signatures, log)
        self._log_id = log_id
        self._settings = settings
        self._corrections = corrections
        self._fingerprint = snapshot_fingerprint(settings, corrections)
        self._note = note
        self._unusable: set[Path] = set()

    def offsets(self) -> list[Offset]:
        """The offsets there are snapshots for, ascending."""
        try:
            names = [entry.name for entry in self.folder.iterdir()]
        except OSError:  # none yet, or not ours to read
            return []
        found = [m for name in names if (m := _NAME.fullmatch(name))]
        return sorted(Offset(int(m[2])) for m in found if m[1] == self._fingerprint)

    def latest(self, until: Offset) -> tuple[SemanticMap, MapView] | None:
        """The fold and view of the usable snapshot with the highest offset ≤ ``until``."""
        for offset in reversed([offset for offset in self.offsets() if offset <= until]):
            path = self._path(offset)
            try:
                with working("reading a snapshot of the map"):
                    found = restore(
                        path.read_bytes(),
                        self._settings,
                        self._log_id,
                        self._signatures,
                        corrections=self._corrections,
                    )
            except (OSError, SnapshotRefused) as error:
                self._note(f"{path}: this snapshot is not used: {error}; it is safe to delete")
                self._unusable.add(path)
                continue
            if found[0].next_offset == offset:
                return found
            self._note(f"{path}: this snapshot is of another offset; it is safe to delete")
            self._unusable.add(path)
        return None

    def keep(self, semantic_map: SemanticMap, view: MapView) -> None:
        """Write a snapshot for the map's offset, unless there is one that may be usable."""
        path = self._path(semantic_map.next_offset)
        try:
            make_cache_folder(self._log, "snapshots")
            if not path.exists() or path in self._unusable:
                segments = self._signatures(semantic_map.next_offset)
                with working("keeping a snapshot of the map"):
                    data = snapshot(semantic_map, view, self._log_id, segments)
                    write_cache_file(path, lambda file: file.write(data))
                self._thin_out()
        except OSError as error:
            self._note(f"{path}: no snapshot was kept: {error.strerror}")

    def _path(self, offset: Offset) -> Path:
        return self.folder / f"{self._fingerprint}-{offset:020d}.map"

    def _thin_out(self) -> None:
        """While there are too many, delete the one whose neighbours are closest together; delete
        what killed processes left."""
        delete_left_over_files(self.folder)
        offsets = self.offsets()
        while len(offsets) > _MAX_KEPT:
            gaps = [(offsets[i + 1] - offsets[i - 1], i) for i in range(1, len(offsets) - 1)]
            self._path(offsets.pop(min(gaps)[1])).unlink(missing_ok=True)
