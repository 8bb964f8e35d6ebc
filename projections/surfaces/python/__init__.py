"""The public Python interface, which a script or notebook imports from ``mapfold``.

`open_log`, `fold`, `relocalize` and `Timeline` take paths as text or `Path`. What else is in
`eventsrc` and `projections` may change between versions.
"""

from eventsrc.log import Event, LogReader
from projections.fold.settings import Settings
from projections.localize.relocalize import Answer, Question

from .known_things import KnownObject, KnownPlace
from .map import Map, fold, open_log, relocalize
from .past_maps import Timeline

__all__ = [
    "Answer",
    "Event",
    "KnownObject",
    "KnownPlace",
    "LogReader",
    "Map",
    "Question",
    "Settings",
    "Timeline",
    "fold",
    "open_log",
    "relocalize",
]
