"""Snapshots: a fold put down at some offset, to be taken up there again.

``restore(snapshot(map, view))`` and then fold equals fold from the start. A snapshot is a cache:
deleting it costs time and nothing else, and one that is damaged, of another log, of other settings
or of another version is not used.
"""

from .cache import SnapshotCache
from .codec import SnapshotRefused, restore, snapshot

__all__ = ["SnapshotCache", "SnapshotRefused", "restore", "snapshot"]
