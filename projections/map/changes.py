"""The rows of a `MapView` that a batch of events added or changed.

`ChangeTracker` applies events to a view and collects the ordinals that they touch; a sink reads the
values from the view afterwards. So a thousand changes of one Object in a batch are one ordinal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

from eventsrc.envelope.model import Offset
from projections.fold import deltas as d

from .place_regions import Region, place_regions
from .view import MapView

Embedded: TypeAlias = tuple[d.ObservationAdded, int]
"""An observation with an embedding of the map's space, and the log time of its event, in ns. There
are none if the view keeps no embeddings."""


@dataclass(frozen=True, slots=True)
class BatchChanges:
    """The changes of a batch, as ordinals in ascending order; `MapView` has the values.

    ``keyframes`` and ``observations`` are new. They never change later, except for the place of a
    keyframe and the object of an observation: ``placed`` are the keyframes that joined a place or
    whose place was absorbed, ``reassigned`` the observations whose object was absorbed. ``runs``,
    ``objects`` and ``places`` are new or changed, places also by what is in them; one that is not
    in `MapView.objects` or `MapView.places` any more was absorbed. ``located`` are objects that
    moved to another place or out of one, absorbed ones among them. ``links`` are pairs of places
    whose shared transitions changed; one that is not in `MapView.adjacency` any more is gone.
    ``embedded`` is in the order of the observations. ``formed`` are the places that are new,
    ``floors`` the numbers of new floors. ``maps`` is whether `MapView.maps_in_force` changed.
    ``regions`` gives the regions that changed; None stands for all of the view.
    """

    keyframes: range
    observations: range
    embedded: list[Embedded]
    runs: list[d.RunOrdinal]
    objects: list[d.ObjectOrdinal]
    places: list[d.PlaceOrdinal]
    located: list[d.ObjectOrdinal]
    placed: list[d.KeyframeOrdinal]
    links: list[tuple[d.PlaceOrdinal, d.PlaceOrdinal]]
    reassigned: list[d.ObservationOrdinal]
    formed: list[d.PlaceOrdinal]
    floors: range
    maps: bool = False
    regions: "FollowedRegions | None" = None


class FollowedRegions:
    """The regions of places, followed through batches. They are computed only when `changed` is
    called, and only if a place or a map has changed since it was called last."""

    def __init__(self) -> None:
        self.regions: dict[d.PlaceOrdinal, Region] = {}
        """As of the last call of `changed`."""
        self._are_due = self._is_first = True
        self._changed: set[d.PlaceOrdinal] = set()

    def end_batch(self, *, may_differ: bool) -> None:
        """Begin a new batch after one by whose changes regions may differ."""
        self._are_due |= may_differ
        self._changed = set()

    def changed(self, view: MapView) -> set[d.PlaceOrdinal]:
        """The places whose region is another than after the last batch for which this was called;
        at first all on a map: what was written of them before may have other regions, or some."""
        if self._are_due:
            before, self.regions, self._are_due = self.regions, place_regions(view), False
            if self._is_first and view.settings.places == "rooms" and view.maps_in_force():
                self._changed.update(view.places)
            self._is_first = False
            for place in before.keys() | self.regions.keys():
                if before.get(place) != self.regions.get(place) and place in view.places:
                    self._changed.add(place)
        return self._changed


class ChangeTracker:
    """Applies events to ``view`` and collects what they change."""

    def __init__(self, view: MapView) -> None:
        self.view = view
        self._regions = FollowedRegions()
        self._start()

    def apply_event(self, offset: Offset, deltas: Sequence[d.Delta], logged_ns: int) -> None:
        """Apply the deltas of the event at ``offset``, which was logged at ``logged_ns``."""
        collectors = self._COLLECTORS
        for delta in deltas:
            if type(delta) is d.ObservationAdded:
                if delta.embedding is not None:
                    self._embedded.append((delta, logged_ns))
            elif (collect := collectors.get(type(delta))) is not None:
                collect(self, delta)
        self.view.apply_event(offset, deltas)

    def apply_names(self, deltas: Sequence[d.PlaceNamed]) -> None:
        """Apply the deltas of `SemanticMap.use_names`, which are of no event's fold."""
        for delta in deltas:
            self._places.add(delta.place)
            self.view.apply(delta)

    @property
    def added(self) -> int:
        """The number of new keyframes and observations since the last `drain`."""
        view = self.view
        return len(view.keyframes) - self._keyframes + len(view.observations) - self._observations

    def drain(self) -> BatchChanges:
        """All changes since the last drain."""
        self._places.update(filter(self.view.places.__contains__, self.view.contents.touched))
        maps = self._maps != self.view.maps_in_force()
        self._regions.end_batch(may_differ=maps or bool(self._places))
        changes = BatchChanges(
            range(self._keyframes, len(self.view.keyframes)),
            range(self._observations, len(self.view.observations)),
            self._embedded,
            sorted(self._runs),
            sorted(self._objects),
            sorted(self._places),
            sorted(self._located),
            sorted(self._placed),
            sorted(self._links),
            sorted(self._reassigned),
            sorted(self._formed),
            range(self._floors, len(self.view.floors)),
            maps,
            self._regions,
        )
        self._start()
        return changes

    def _start(self) -> None:
        self._keyframes = len(self.view.keyframes)
        self._observations = len(self.view.observations)
        self._embedded: list[Embedded] = []
        self._runs: set[d.RunOrdinal] = set()
        self._objects: set[d.ObjectOrdinal] = set()
        self._places: set[d.PlaceOrdinal] = set()
        self._located: set[d.ObjectOrdinal] = set()
        self._placed: set[d.KeyframeOrdinal] = set()
        self._links: set[tuple[d.PlaceOrdinal, d.PlaceOrdinal]] = set()
        self._reassigned: set[d.ObservationOrdinal] = set()
        self._formed: set[d.PlaceOrdinal] = set()
        self._floors = len(self.view.floors)
        self._maps = self.view.maps_in_force()
        self.view.contents.touched.clear()

    def _place_formed(self, delta: d.PlaceFormed) -> None:
        self._places.add(delta.place)
        self._formed.add(delta.place)

    def _places_merged(self, delta: d.PlacesMerged) -> None:
        self._places.add(delta.survivor)
        self._places.update(delta.absorbed)
        for place in delta.absorbed:
            # Read before the view applies the delta: afterwards they are members of the survivor. A
            # place that this event has formed is not there yet; a command may join it at once.
            if place < len(self.view.all_places):
                self._placed.update(self.view.all_places[place].unordered_members)

    def _objects_merged(self, delta: d.ObjectsMerged) -> None:
        self._objects.update((delta.survivor, delta.absorbed))
        self._located.add(delta.absorbed)
        # Before the view applies it, as above. An Object that this event has found is not there
        # yet: all its observations are new.
        if delta.absorbed < len(self.view.all_objects):
            self._reassigned.update(self.view.all_objects[delta.absorbed].observations)

    # Of the class, not bound to the tracker; `MapView` says why.
    _COLLECTORS: ClassVar[dict[type, Callable[["ChangeTracker", Any], None]]] = {
        d.RunSeen: lambda self, of: self._runs.add(of.run),
        d.ObjectFound: lambda self, of: self._objects.add(of.object),
        d.ObjectSeen: lambda self, of: self._objects.add(of.object),
        d.ObjectsMerged: _objects_merged,
        d.ObjectEstimated: lambda self, of: self._objects.add(of.object),
        d.ObjectClassified: lambda self, of: self._objects.add(of.object),
        d.ObjectMissing: lambda self, of: self._objects.add(of.object),
        d.ObjectRelocated: lambda self, of: self._objects.add(of.object),
        d.ObjectMoved: lambda self, of: self._located.add(of.object),
        d.PlaceFormed: _place_formed,
        d.PlaceChanged: lambda self, of: self._places.add(of.place),
        d.PlaceNamed: lambda self, of: self._places.add(of.place),
        d.KeyframePlaced: lambda self, of: self._placed.add(of.keyframe),
        d.PlacesMerged: _places_merged,
        d.PlacesLinked: lambda self, of: self._links.add((of.a, of.b)),
    }
