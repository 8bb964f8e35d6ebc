"""The current map of a log under its corrections, and look-up of user input in it."""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, DetId, KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import Event, LogReader
from projections.fold.corrections import Corrections, Keyframe, RecordedCommand, compile_corrections
from projections.fold.deltas import PlaceOrdinal
from projections.fold.objects import object_id
from projections.fold.settings import Settings
from projections.history import NoSuchThing
from projections.map.own_events import read_commands
from projections.map.records import KeyframeRecord, ObjectRecord, ObservationRecord
from projections.map.view import MapView
from projections.store.history_recorder import HistoryRecorder, map_after
from projections.store.history_records import Merge
from projections.store.timeline_cache import TimelineCache

SettingsOf = Callable[[Corrections], Settings]
"""The settings of the map, given the log's corrections."""


class MapToEdit:
    """A log, the commands in it, and the map that it is folded to under ``settings_of`` these.

    With ``until`` it is the log as of its first ``until`` events. ``note`` is called with a
    message for each part of a kept history that could not be used. ``commands`` are those before
    ``until`` and ``corrections`` what they compile to, where the caller has them.
    """

    def __init__(
        self,
        reader: LogReader,
        settings_of: SettingsOf,
        *,
        until: Offset | None = None,
        commands: Sequence[RecordedCommand] | None = None,
        corrections: Corrections | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.reader = reader
        self.settings_of = settings_of
        self.end = reader.next_offset if until is None else until
        self.commands = read_commands(reader, self.end) if commands is None else commands
        if corrections is None:
            corrections = compile_corrections(self.commands)
        self.corrections = corrections
        self.settings = settings_of(self.corrections)
        self.note = note
        self._view: MapView | None = None

    @property
    def known_at(self) -> Offset:
        """The offset after the last command; 0 without commands."""
        return Offset(self.commands[-1].offset + 1) if self.commands else FIRST_OFFSET

    def command_events(self) -> Iterator[Event]:
        """The events of the commands, in order."""
        return self.reader.read(FIRST_OFFSET, self.end, keys={COMMAND_KEY})

    def find_command(self, command_id: str) -> RecordedCommand | None:
        """The command with this id, whether undone or not."""
        return next((c for c in self.commands if c.command.command_id == command_id), None)

    def fold(self, corrections: Corrections, settings: Settings) -> MapView:
        """The map under other corrections or settings."""
        return map_after(self.reader, settings, self.end, corrections=corrections, note=self.note)

    @property
    def view(self) -> MapView:
        """The map; folded at the first use."""
        if self._view is None:
            self._view = self.fold(self.corrections, self.settings)
        return self._view

    def set_view(self, view: MapView) -> None:
        """Use ``view`` as the map instead of folding it."""
        self._view = view

    @cached_property
    def merges(self) -> list[Merge]:
        """Every merge of places, in order."""
        cache = TimelineCache(self.reader, self.settings, self.corrections, self.note)
        recorder = HistoryRecorder(self.reader, self.settings, self.corrections, cache, None)
        merges = recorder.history(self.end).merges
        return [merge for merge in merges if merge.cause.offset < self.end]

    @cached_property
    def keyframes(self) -> dict[Keyframe, KeyframeRecord]:
        """The keyframes of the map."""
        return {Keyframe(k.run_id, k.keyframe_id): k for k in self.view.keyframes}

    @cached_property
    def observations(self) -> dict[DetId, ObservationRecord]:
        """The observations of the map."""
        return {o.det_id: o for o in self.view.observations}

    @cached_property
    def _objects(self) -> dict[str, ObjectRecord]:
        """The objects of the map and the absorbed ones, by id."""
        return {o.object_id: o for o in self.view.all_objects}

    def run(self, run_id: str) -> list[KeyframeRecord]:
        """The keyframes of a run. Raises NoSuchThing with the runs there are."""
        view = self.view
        number = next((r.ordinal for r in view.runs if r.run_id == run_id), None)
        if number is None:
            raise NoSuchThing("run", run_id, (r.run_id for r in view.runs))
        return [k for k in view.keyframes if k.run == number]

    def place_of(self, keyframe: Keyframe) -> PlaceOrdinal | None:
        """The place that a keyframe is in now; None for none, or if it is not in the map."""
        record = self.keyframes.get(keyframe)
        return None if record is None else record.place

    def founder(self, place: PlaceOrdinal) -> Keyframe:
        """The keyframe that founded a place."""
        record = self.view.keyframes[self.view.all_places[place].founder]
        return Keyframe(record.run_id, record.keyframe_id)

    def find_place(self, text: str) -> Keyframe:
        """The keyframe that stands for a place: of a place id, also of an absorbed one, or of a
        place's name, that which founded it; of ``run:keyframe`` this keyframe, for the place that
        it is in.

        Raises NoSuchThing, or MisuseError for a keyframe in no place.
        """
        view = self.view
        for place in view.all_places:
            if place.place_id == text:
                return self.founder(place.ordinal)
        run_id, colon, number = text.rpartition(":")
        if not colon or all(run.run_id != run_id for run in view.runs):
            if (named := self._named(text)) is not None:
                return self.founder(named)
            raise NoSuchThing("place", text, (p.place_id for p in view.all_places))
        keyframe = _keyframe(run_id, number)
        if keyframe is None or keyframe not in self.keyframes:
            names = (f"{run_id}:{k.keyframe_id}" for k in self.run(run_id))
            raise NoSuchThing("keyframe", text, names)
        if self.place_of(keyframe) is None:
            why = "has no pose" if self.keyframes[keyframe].pose is None else "is noise"
            raise MisuseError(
                f"keyframe {text} is in no place, because it {why}; name a place or a keyframe in "
                f"one (`{advised('state')}` lists the places)"
            )
        return keyframe

    def _named(self, name: str) -> PlaceOrdinal | None:
        """The place with this name; None if there is none. Raises MisuseError if there are
        several."""
        named = [place for place in self.view.places.values() if place.name == name]
        if len(named) > 1:
            ids = ", ".join(place.place_id for place in named)
            raise MisuseError(f"{len(named)} places are called {name!r}: {ids}; give an id")
        return named[0].ordinal if named else None

    def place_name(self, keyframe: Keyframe) -> str:
        """The id of the place that a keyframe is in now, or ``no place``."""
        return self.view.place_id(self.place_of(keyframe)) or "no place"

    def find_observation(self, text: str) -> ObservationRecord:
        """The founding observation of an object, given by the object's id, also of an absorbed one;
        or an observation by its det_id. Raises NoSuchThing, or MisuseError for an observation
        without an object."""
        if text in self._objects:
            founding = (o for o in self.view.observations if object_id(o.det_id) == text)
            return next(founding)
        observation = self.observations.get(DetId(text))
        if observation is None:
            raise self._no_object(text)
        if observation.object is None:
            raise MisuseError(
                f"observation {text!r} is of no object: it has no embedding or no pose; "
                "name an object, or an observation that is of one"
            )
        return observation

    def find_object(self, text: str) -> ObjectRecord:
        """The object of this id, for an absorbed one the object that it is part of now. Raises
        NoSuchThing."""
        found = self._objects.get(text)
        if found is None:
            raise self._no_object(text)
        return self.view.objects[self.view.object_survivors.find(found.ordinal)]

    def _no_object(self, text: str) -> NoSuchThing:
        if text.startswith("obj-") or not self.observations:
            return NoSuchThing("object", text, (o.object_id for o in self.view.objects.values()))
        return NoSuchThing("observation", text, self.observations)


_NUMBER = re.compile(r"-?[0-9]{1,19}")


def _keyframe(run_id: str, number: str) -> Keyframe | None:
    if _NUMBER.fullmatch(number) is None:
        return None
    return Keyframe(RunId(run_id), KeyframeId(int(number)))
