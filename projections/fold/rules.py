"""Choose the reducers by a map's settings and commands."""

from eventsrc.envelope.model import DetId

from .constrained_places import ConstrainedPlaces
from .core_index import CoreIndex
from .corrections import Keyframe
from .evidence_fusion import EvidenceFusion
from .exact import metres_to_um
from .objects import ConstrainedObjects, Objects
from .pair_groups import PairGroups
from .places import Places
from .rooms import Rooms
from .settings import Settings


def places_by(settings: Settings, groups: PairGroups[Keyframe]) -> Places | Rooms:
    """The reducer of places; ``groups`` are the keyframes that commands name."""
    if settings.places == "rooms":
        rooms = settings.rooms
        return Rooms(metres_to_um(rooms.cell_m), metres_to_um(rooms.drive_m), groups)
    core_index = CoreIndex(metres_to_um(settings.eps_m), settings.min_samples)
    return ConstrainedPlaces(core_index, groups) if groups.group_of else Places(core_index)


def objects_by(settings: Settings, named: PairGroups[DetId]) -> Objects | EvidenceFusion:
    """The reducer of Objects; ``named`` are the detections that commands name."""
    groups = named if named.group_of else None
    if settings.fusion == "evidence":
        return EvidenceFusion(settings.evidence, groups)
    limits = settings.fusion_radius_m, settings.fusion_similarity
    return Objects(*limits) if groups is None else ConstrainedObjects(*limits, groups)
