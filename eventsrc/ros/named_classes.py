"""Names of classes by id, as the nodes of a robot tell them.

They are in a vision_msgs/LabelInfo, or in a parameter that its node announces on /parameter_events:
a list of names, the first that of class 0; a text of JSON, which is such a list or an object of
names by id; or a parameter for each id (``labels.17``). Which parameter it is may be said by the
``database_location`` of a vision_msgs/VisionInfo; without one, it is a parameter of a name that is
usual for it (`USUAL`), of the node whose name is nearest to the detections'. Filters, such as
``classes``, are no names by id. The latest message counts, and a LabelInfo before parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from pydantic_core import from_json

from .messages import LABELS, PARAMETERS, VISION_INFO, BadMessage, read

USUAL: Final = (
    "class_names",
    "class_labels",
    "label_names",
    "labels",
    "names",
    "id2label",
    "label_map",
    "class_map",
)
"""Names of parameters, the surer first."""
CLASS_TYPES: Final = (LABELS, VISION_INFO, PARAMETERS)
_TEXT, _TEXTS = 4, 9
"""Types of a ParameterValue: text, list of texts."""
_MOST_KEPT: Final = 10_000
"""Bound of the parameters kept: a VisionInfo that comes later may name any of them."""


class Named(NamedTuple):
    """Names by class id, and what gave them: ``labels of /detector``, empty for a LabelInfo.
    ``doubt`` says why there are none; empty without a reason."""

    labels: Mapping[str, str]
    by: str = ""
    doubt: str = ""


class ClassNames:
    """What the messages so far say about the names of classes."""

    def __init__(self) -> None:
        self._label_info: dict[str, str] = {}
        self._location = ""
        self._parameters: dict[tuple[str, str], dict[str, str]] = {}

    def add(self, type_name: str, message: Any) -> bool:
        """Add a LabelInfo, VisionInfo or ParameterEvent; return whether it says anything new.
        Raises BadMessage."""
        before = self._label_info, self._location
        if type_name == LABELS:
            self._label_info = read(_labels_of, message)
        elif type_name == VISION_INFO:
            self._location = read(_location_of, message)
        elif type_name == PARAMETERS:
            news = [self._add_parameter(*each) for each in read(_parameters_of, message)]
            return any(news)
        else:
            raise BadMessage(f"it is {type_name:.80}, not {' or '.join(CLASS_TYPES)}")
        return before != (self._label_info, self._location)

    def _add_parameter(self, node: str, name: str, labels: dict[str, str]) -> bool:
        stem, _, last = name.rpartition(".")
        known = self._parameters.get((node, stem)) if last.isdecimal() else None
        if last.isdecimal() and stem:
            name, labels = stem, {**(known or {}), **labels}
        if self._parameters.get((node, name)) == labels:
            return False
        if (node, name) not in self._parameters and len(self._parameters) >= _MOST_KEPT:
            raise BadMessage(f"more than {_MOST_KEPT:,} parameters hold texts")
        self._parameters[node, name] = labels
        return True

    def of(self, detections: str) -> Named:
        """The names for a topic of detections."""
        if self._label_info:
            return Named(self._label_info)
        if self._location:
            for (node, name), labels in self._parameters.items():
                if _is_at(self._location, node, name):
                    return Named(labels, f"{name} of {node}")
        named = self._usual(detections)
        if named.labels or not self._location:
            return named
        return Named({}, doubt=f"no parameter {self._location!r:.200}, which a VisionInfo names")

    def _usual(self, detections: str) -> Named:
        """The names in a parameter of a usual name."""
        ranked: dict[str, list[tuple[int, str]]] = {}
        for node, name in self._parameters:
            last = name.rpartition(".")[2].lower()
            if last in USUAL:
                ranked.setdefault(node, []).append((USUAL.index(last), name))
        near = nearest(detections, [*ranked])
        found = [(node, min(ranked[node])[1]) for node in near]
        if not found:
            return Named({})
        if any(self._parameters[each] != self._parameters[found[0]] for each in found):
            several = " and ".join(f"{name} of {node}" for node, name in found[:3])
            return Named({}, doubt=f"several nodes name classes, {several:.200}")
        node, name = found[0]
        return Named(self._parameters[found[0]], f"{name} of {node}")


def nearest(topic: str, names: Sequence[str]) -> list[str]:
    """The names that share the most leading parts with ``topic``, of several those with the fewest
    parts; names and topic are such as ``/robot1/camera/detections``."""
    parts = topic.strip("/").split("/")

    def distance(name: str) -> tuple[int, int]:
        others = name.strip("/").split("/")
        shared = 0
        while shared < min(len(parts), len(others)) and parts[shared] == others[shared]:
            shared += 1
        return -shared, len(others)

    best = min(map(distance, names), default=None)
    return [name for name in names if distance(name) == best]


def _labels_of(message: Any) -> dict[str, str]:
    """The names of a LabelInfo by class id, as detections write it."""
    named = ((str(int(each.class_id)), str(each.class_name)) for each in message.class_map)
    return {class_id: name for class_id, name in named if name}


def _location_of(message: Any) -> str:
    """Where a VisionInfo says that names are."""
    return str(message.database_location)


def _parameters_of(event: Any) -> list[tuple[str, str, dict[str, str]]]:
    """Node, parameter and names of the parameters of a ParameterEvent that may name classes."""
    node = str(event.node)
    return [
        (node, str(each.name), labels)
        for each in (*event.new_parameters, *event.changed_parameters)
        if (labels := _names_in(str(each.name), each.value))
    ]


def _names_in(parameter: str, value: Any) -> dict[str, str]:
    """The names by id that a parameter's value holds; none if it holds something else."""
    if value.type == _TEXTS:
        return _named(enumerate(value.string_array_value))
    if value.type != _TEXT:
        return {}
    text = str(value.string_value)
    last = parameter.rpartition(".")[2]
    if last.isdecimal():
        return _named([(last, text)])
    if not text.lstrip().startswith(("{", "[")):
        return {}
    try:
        document = from_json(text)
    except ValueError:
        return {}  # a text that begins so and is something else
    return _named(document.items() if isinstance(document, dict) else enumerate(document))


def _named(pairs: Iterable[tuple[object, object]]) -> dict[str, str]:
    """The pairs of an id and a name; none if a name is no text."""
    listed = [(str(class_id), name) for class_id, name in pairs]
    if not all(isinstance(name, str) for _, name in listed):
        return {}
    return {class_id: str(name) for class_id, name in listed if name}


def _is_at(location: str, node: str, parameter: str) -> bool:
    """Whether a location, such as ``/detectnet/class_labels_12``, is that of a parameter."""
    path, inside = (text.replace(".", "/").replace(":", "/") for text in (location, parameter))
    there = f"{node}/{inside}".strip("/")
    path = path.strip("/")
    return path in (there, inside) or there.endswith(f"/{path}")
