"""A calibration: fold the log by evidence, read the constants, fold with them, read again.

The first fold uses the priors, and both readings are drawn towards them, never towards constants
read before: each observation counts once, and a calibrated map gives the same constants again. Then
the map as its settings make it, with the constants read, is asked its own questions (`localiser`).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraSettings, LocalizerConstants, Settings
from projections.fold.sights import camera_of
from projections.map.fold import fold_parsed, new_map, read_ahead
from projections.map.parsing import parsed_stretches
from projections.map.view import MapView

from .field_of_view import FieldOfView, field_of_view, without_estimate
from .likenesses import different, in_pictures, of_things, same, scale
from .localiser import NOT_ASKED, OwnScores, read_localiser
from .qualified_things import Row, Sightings, qualified, sightings_of
from .readings import Reading, camera_faults, errors, ranges, sizes, unread

ROUNDS = 2


@dataclass(frozen=True, slots=True)
class Round:
    """The result of one round: the constants with their evidence, and the numbers of qualified
    things and observations. ``camera`` are significant faults of the camera."""

    constants: EvidenceConstants
    readings: tuple[Reading, ...]
    sizes: tuple[Reading, ...]
    things: int
    observations: int
    camera: tuple[Reading, ...]


def read(seen: Sightings, used: EvidenceConstants, prior: EvidenceConstants) -> Round:
    """Estimate the constants from a map that was folded with ``used``, drawn towards ``prior``."""
    with np.errstate(all="ignore"):  # a value that is not finite is replaced by the prior
        return _read(seen, used, prior)


def _read(seen: Sightings, used: EvidenceConstants, prior: EvidenceConstants) -> Round:
    things = qualified(seen, used.bearing_rad, used.bearing_cut_rad, used.pose_m)
    found: list[Reading] = [*ranges(things, prior), *errors(things, seen, prior)]
    by_class, about = sizes(things, seen, prior)
    found.append(about)
    cosines, same_class = in_pictures(seen)
    scaled_by = scale(cosines, same_class)
    found.append(scaled_by)
    zero = scaled_by.value if isinstance(scaled_by.value, float) else prior.different
    if zero is None:
        names = (
            "different_spread", "same_class", "same_class_spread", "same_back", "same_side",
            "same_kappa", "same_spread", "side_by", "session_shift",
        )  # fmt: skip
        found += [unread(name, getattr(prior, name)) for name in names]
    else:
        found += different((cosines - zero) / (1.0 - zero), same_class, prior)
        found += same(of_things(seen, things, zero), prior).values()
    found = [_bounded(reading) for reading in found]
    by_class = {name: _bounded(reading, "sizes_m") for name, reading in by_class.items()}
    values: dict[str, Any] = {reading.name: reading.value for reading in found}
    values["sizes_m"] = {name: reading.value for name, reading in by_class.items()}
    return Round(
        EvidenceConstants(**values),
        tuple(found),
        tuple(by_class.values()),
        len(things),
        sum(len(thing.rows) for thing in things),
        tuple(camera_faults(things, seen)),
    )


def _bounded(reading: Reading, group: str | None = None) -> Reading:
    """The reading with its value limited to what the settings allow."""
    if not isinstance(reading.value, float):
        return reading
    least, most = _bounds(group or reading.name)
    return replace(reading, value=min(max(reading.value, least), most))


_FIELDS: dict[str, Any] = EvidenceConstants.model_json_schema()["properties"]


def _bounds(name: str) -> tuple[float, float]:
    """The least and the greatest value of a constant; of each entry's value where it is a table."""
    (rule,) = _FIELDS[name].get("patternProperties", {name: _FIELDS[name]}).values()
    return rule.get("minimum", -math.inf), rule.get("maximum", math.inf)


@dataclass(frozen=True, slots=True)
class Calibration:
    """The calibration of a log. ``settings`` are those that it was calibrated under; `calibrated`
    are the same with its constants. Counts are of the last fold: keyframes with a pose,
    observations that were fused, Objects, runs. ``embedded`` observations have an embedding,
    ``unboxed`` ones an empty box; ``beyond`` boxes reach beyond the picture. ``unstated`` keyframes
    have a camera that nothing states, ``field`` is its estimate, None where it cannot be made.
    ``own`` are the results of its own questions."""

    settings: Settings
    last: Round
    runs: int
    keyframes: int
    observations: int
    objects: int
    embedded: int
    unboxed: int
    beyond: int
    unstated: int
    field: FieldOfView | None
    own: OwnScores

    @property
    def calibrated(self) -> Settings:
        """The settings with the constants that were read."""
        text_shift = self.settings.localizer.text_shift
        localizer = self.own.constants.model_copy(update={"text_shift": text_shift})
        changed: dict[str, Any] = {"evidence": self.last.constants, "localizer": localizer}
        if self.field is not None:
            changed["camera"] = self.field.settings
        return self.settings.model_copy(update=changed)


Fold = Callable[[Settings], MapView]
"""A function that folds a log under settings; the view has the embeddings."""


def calibrate(
    reader: LogReader,
    settings: Settings,
    corrections: Corrections = NO_CORRECTIONS,
    until: Offset | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Calibration:
    """Calibrate the map of a log's first ``until`` events, all of them for None; folded by
    evidence whatever rule the settings name. ``progress`` is called with the number of events
    folded and the number to fold, both over all rounds. Raises FoldError, LogDamaged."""
    end = reader.end_for(until)
    before = 0

    def fold(used: Settings) -> MapView:
        nonlocal before
        semantic_map = new_map(reader, used, corrections)
        view = MapView(used, corrections=corrections)
        parsed = parsed_stretches(reader.read(FIRST_OFFSET, end))
        with gc_paused():
            for stretch in read_ahead(parsed, semantic_map):
                for event in stretch:
                    view.apply_event(event.offset, fold_parsed(event, semantic_map))
                progress(before + view.next_offset, (ROUNDS + 1) * end)
        before += end
        return view

    return calibrate_by(fold, settings)


def calibrate_by(fold: Fold, settings: Settings, *, ask: bool = True) -> Calibration:
    """Calibrate what ``fold`` folds, in rounds. Without ``ask`` the map is asked nothing, and
    re-localisation keeps its defaults."""
    constants = prior = EvidenceConstants()
    said = without_estimate(settings.camera)
    camera, field = said, None
    for _ in range(ROUNDS):
        changed = {"fusion": "evidence", "evidence": constants, "camera": camera}
        view = fold(settings.model_copy(update=changed))
        if not said.is_stated:
            rows = [r for r in _rows(view, said) if view.keyframes[r.picture].camera is None]
            field = field_of_view(rows, said, prior)
            camera = said if field is None else field.settings
        seen = sightings_of(_rows(view, camera))
        last = read(seen, constants, prior)
        constants = last.constants
    plain = LocalizerConstants(text_shift=settings.localizer.text_shift)
    changed = {"evidence": constants, "localizer": plain, "camera": camera}
    own = read_localiser(fold(settings.model_copy(update=changed))) if ask else NOT_ASKED
    return Calibration(
        settings,
        last,
        runs=len(view.runs),
        keyframes=sum(keyframe.pose is not None for keyframe in view.keyframes),
        observations=len(seen),
        objects=len(view.objects),
        embedded=int(seen.looked.sum()),
        unboxed=int((~seen.boxed).sum()),
        beyond=seen.beyond,
        unstated=0 if said.is_stated else view.without_camera(),
        field=field,
        own=own,
    )


def _rows(view: MapView, camera: CameraSettings) -> Iterator[Row]:
    for observation in view.observations:
        keyframe = view.keyframes[observation.keyframe]
        if observation.object is None or keyframe.pose is None:
            continue
        yield Row(
            picture=keyframe.ordinal,
            run=keyframe.run,
            pose=keyframe.pose,
            camera=camera_of(keyframe.camera, camera),
            class_name=observation.class_name,
            bbox=observation.bbox,
            look=observation.embedding,
            thing=observation.object,
        )
