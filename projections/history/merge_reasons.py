"""Why places merged: the chain of core points that joins them, in words and as JSON.

Places merge when a path of core points, each within ε of the next, leads from one to the other. The
bridging keyframe, whose event merged them, need not be on that path: it may be the last neighbour
that a point of the path needed to become a core point. So the path leads from an old core point of
one place, over points that this event made core, to an old core point of the other. The shortest
such path is the chain.

Places by rooms have no chains: they merge when their cells are a short drive apart on the mean.
The Objects that both have seen are printed beside it for the reader; the rule does not use them.

When an event joins several places, the chains form a tree: each further place is joined to one that
is joined already. A place that a ``join`` command brought has no chain: the two keyframes that the
command names are the reason.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from projections.fold import deltas
from projections.fold.corrections import RecordedCommand
from projections.fold.exact import UM_PER_M
from projections.map.phrases import command_document, command_on, command_title
from projections.store.history import History
from projections.store.history_records import EdgeChange, Merge, ObjectMerge, RefusedMerge

from .names import keyframe_name, log_name, place_name

_NATS = 1000
MOST_SEEN = 4
"""The most objects that a text names; of more, the first are named and the others counted."""


@dataclass(frozen=True, slots=True)
class Chain:
    """Core points from place ``joined`` to the absorbed place ``absorbed``, ends included.

    ``points`` are keyframe ordinals; all but the first and the last were made core by this event.
    ``distances_um`` are the steps between them.
    """

    joined: deltas.PlaceOrdinal
    absorbed: deltas.PlaceOrdinal
    points: tuple[deltas.KeyframeOrdinal, ...]
    distances_um: tuple[int, ...]

    @property
    def made_core(self) -> tuple[deltas.KeyframeOrdinal, ...]:
        """The points that this event made core."""
        return self.points[1:-1]


def chains_of(history: History, merge: Merge) -> list[Chain]:
    """A chain for each absorbed place, in the order of joining, shortest first.

    A place that a command joined has no chain, nor has any place by rooms.
    """
    if history.settings.places == "rooms":
        return []
    made = history.neighbours.made_core(merge.bridge, merge.cause.offset)
    contacts = {keyframe: _contacts(history, merge, keyframe) for keyframe in made}
    joined, remaining, chains = {merge.survivor}, set(merge.absorbed), list[Chain]()
    while remaining:
        chain = _shortest(history, merge, contacts, joined, remaining)
        if chain is None:
            commanded = next((place for place in merge.joined if place in remaining), None)
            if commanded is None:
                break
            absorbed = commanded
        else:
            chains.append(chain)
            absorbed = chain.absorbed
        joined.add(absorbed)
        remaining.remove(absorbed)
    return chains


def _contacts(
    history: History, merge: Merge, keyframe: deltas.KeyframeOrdinal
) -> dict[deltas.PlaceOrdinal, deltas.KeyframeOrdinal]:
    """By place the nearest old core point within ε of a new one."""
    offset, neighbours = merge.cause.offset, history.neighbours
    contacts: dict[deltas.PlaceOrdinal, deltas.KeyframeOrdinal] = {}
    near = (k for k in neighbours.of(keyframe, Offset(offset + 1)) if neighbours.is_core(k, offset))
    for old in sorted(near, key=lambda k: (neighbours.distance_um(keyframe, k), k)):
        place = history.place_at(old, offset)
        if place is not None:
            contacts.setdefault(place, old)
    return contacts


def _shortest(
    history: History,
    merge: Merge,
    contacts: dict[deltas.KeyframeOrdinal, dict[deltas.PlaceOrdinal, deltas.KeyframeOrdinal]],
    joined: set[deltas.PlaceOrdinal],
    remaining: set[deltas.PlaceOrdinal],
) -> Chain | None:
    """Breadth first over the new core points, from the joined places to a remaining one."""
    paths: deque[tuple[deltas.PlaceOrdinal, tuple[deltas.KeyframeOrdinal, ...]]] = deque(
        (place, (old, new))
        for new in contacts
        for place, old in contacts[new].items()
        if place in joined
    )
    visited = {path[-1] for _, path in paths}
    while paths:
        place, path = paths.popleft()
        for goal in sorted(contacts[path[-1]].keys() & remaining):
            return _chain_of(history, place, goal, (*path, contacts[path[-1]][goal]))
        for new in _new_core_neighbours(history, merge, path[-1], contacts):
            if new not in visited:
                visited.add(new)
                paths.append((place, (*path, new)))
    return None


def _new_core_neighbours(
    history: History,
    merge: Merge,
    keyframe: deltas.KeyframeOrdinal,
    contacts: dict[deltas.KeyframeOrdinal, dict[deltas.PlaceOrdinal, deltas.KeyframeOrdinal]],
) -> Iterator[deltas.KeyframeOrdinal]:
    near = history.neighbours.of(keyframe, Offset(merge.cause.offset + 1))
    return (k for k in near if k in contacts)


def _chain_of(
    history: History,
    joined: deltas.PlaceOrdinal,
    absorbed: deltas.PlaceOrdinal,
    points: tuple[deltas.KeyframeOrdinal, ...],
) -> Chain:
    distances = tuple(history.neighbours.distance_um(a, b) for a, b in pairwise(points))
    return Chain(joined, absorbed, points, distances)


def merge_reason(history: History, merge: Merge, *, most_seen: int | None = MOST_SEEN) -> str:
    """The bridging keyframe, the core points it made, and the chain to each absorbed place; of
    places by rooms how long the drive between them is, and up to ``most_seen`` of the objects that
    both saw, None for all."""
    if merge.cause.kind != "keyframe":
        return merge.cause.name
    commanded = "; ".join(_join_text(history, link) for link in join_links(merge))
    chains = chains_of(history, merge)
    bridge = keyframe_name(history, merge.bridge)
    if merge.drives:
        return f"{bridge} brought them near: {_drive_text(history, merge, most_seen)}"
    if not chains:
        return commanded
    made = dict.fromkeys(point for chain in chains for point in chain.made_core)
    names = ["itself" if k == merge.bridge else keyframe_name(history, k) for k in made]
    what = "a core point" if len(made) == 1 else "core points"
    joins = "; ".join(chain_text(history, chain) for chain in chains)
    also = f"; {commanded}" if commanded else ""
    return f"{bridge} made {_enumerated(names)} {what}: {joins}{also}"


def _drive_text(history: History, merge: Merge, most_seen: int | None) -> str:
    """``5 cells of a_p0 and 7 of a_p3 are a drive of 3.812 m apart on the mean, at most 4 m joins
    them; nearest are those of run:2 and run:8, 0.900 m; both saw couch obj-7 and tv obj-2``."""
    (drive,), (link,) = merge.drives, merge.links
    survivor, absorbed = (place_name(history, place) for place in merge.places)
    core, neighbour = keyframe_name(history, link.core), keyframe_name(history, link.neighbour)
    cells = counted(drive.cells, "cell")
    at = merge.cause.offset
    both = [history.object_at(each, at) for each in seen_from_both(history, merge)]
    seen = [f"{each.class_name} {each.object_id}" for each in both]
    if most_seen is not None and len(seen) > most_seen:
        seen = [*seen[: most_seen - 1], f"{len(seen) - most_seen + 1} more"]
    return (
        f"{cells} of {survivor} and {drive.absorbed_cells} of {absorbed} are a drive of "
        f"{drive.mean_um / 1e6:.3f} m apart on the mean, at most "
        f"{history.settings.rooms.drive_m:g} m joins them; nearest are those of {core} and "
        f"{neighbour}, {link.distance_um / 1e6:.3f} m"
        + (f"; both saw {_enumerated(seen)}" if seen else "")
    )


def seen_from_both(history: History, merge: Merge) -> Sequence[deltas.ObjectOrdinal]:
    """The objects that keyframes of all the places had seen when these merged."""
    return history.sighting_index.seen_from_all(merge.places, merge.cause.offset)


def join_links(merge: Merge) -> list[deltas.PlaceLink]:
    """The links of the places that a command joined, one for each: the keyframes that it names."""
    return [
        link
        for place, link in zip(merge.absorbed, merge.links, strict=True)
        if place in merge.joined
    ]


def _join_text(history: History, link: deltas.PlaceLink) -> str:
    core, neighbour = keyframe_name(history, link.core), keyframe_name(history, link.neighbour)
    distance = f"{link.distance_um / 1e6:.3f} m apart"
    found = _command(history, (link.core, link.neighbour), joins=True)
    return f"{core} and {neighbour}, {distance}, joined by {_title(found)}"


def _command(
    history: History, pair: tuple[deltas.KeyframeOrdinal, deltas.KeyframeOrdinal], *, joins: bool
) -> RecordedCommand | None:
    """The command that joins two keyframes, or keeps them apart."""
    first, second = (log_name(history, keyframe) for keyframe in pair)
    return command_on(history.corrections, first, second, joins=joins)


def _title(recorded: RecordedCommand | None) -> str:
    return "a command" if recorded is None else command_title(recorded.command)


def _document(recorded: RecordedCommand | None) -> dict[str, Any] | None:
    return None if recorded is None else command_document(recorded)


def refusal_reason(history: History, refusal: RefusedMerge) -> str:
    """The core points that would have joined two places, and the command that keeps them apart."""
    return f"{_link_text(history, refusal.link)}; kept apart by {refuser(history, refusal)}"


def refuser(history: History, refusal: RefusedMerge) -> str:
    """The command that refused a merge: kind, id, author and reason."""
    return _title(_command(history, refusal.apart, joins=False))


def refusal_document(history: History, refusal: RefusedMerge) -> dict[str, Any]:
    """One refused merge as JSON; ``run_id`` and ``keyframe_id`` name the bridging keyframe."""
    return {
        **refusal.cause.document(),
        "places": [place_name(history, place) for place in (refusal.a, refusal.b)],
        "link": link_document(history, refusal.link),
        "apart": [keyframe_name(history, k) for k in refusal.apart],
        "command": _document(_command(history, refusal.apart, joins=False)),
    }


def _enumerated(names: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def chain_text(history: History, chain: Chain) -> str:
    """``run:2 (run_p0) –0.900 m– run:3 –1.000 m– run:5 (run_p1)``."""
    names = [keyframe_name(history, point) for point in chain.points]
    names[0] += f" ({place_name(history, chain.joined)})"
    names[-1] += f" ({place_name(history, chain.absorbed)})"
    steps = [
        f"{name} –{d / 1e6:.3f} m–" for name, d in zip(names, chain.distances_um, strict=False)
    ]
    return " ".join([*steps, names[-1]])


def _link_text(history: History, link: deltas.PlaceLink) -> str:
    core, neighbour = keyframe_name(history, link.core), keyframe_name(history, link.neighbour)
    if history.settings.places == "rooms":
        drive = f"{link.distance_um / 1e6:.3f} m"
        return f"the cells of {core} and {neighbour} are a drive of {drive} apart"
    return f"{core} and {neighbour} are core points {link.distance_um / 1e6:.3f} m apart"


def link_document(history: History, link: deltas.PlaceLink) -> dict[str, Any]:
    """A link of the merge as JSON."""
    return {
        "core": keyframe_name(history, link.core),
        "neighbour": keyframe_name(history, link.neighbour),
        "distance_m": link.distance_um / 1e6,
    }


def chain_document(history: History, chain: Chain) -> dict[str, Any]:
    """A chain of core points as JSON."""
    return {
        "from": place_name(history, chain.joined),
        "to": place_name(history, chain.absorbed),
        "points": [keyframe_name(history, point) for point in chain.points],
        "distances_m": [distance / 1e6 for distance in chain.distances_um],
        "made_core": [keyframe_name(history, point) for point in chain.made_core],
    }


def merge_document(history: History, merge: Merge) -> dict[str, Any]:
    """One merge as JSON; ``run_id`` and ``keyframe_id`` name the bridging keyframe."""
    bridge = history.keyframes[merge.bridge]
    joined = {"joined": [_joined_document(history, link) for link in join_links(merge)]}
    return {
        **merge.cause.document(),
        "run_id": bridge.run_id,
        "keyframe_id": bridge.keyframe_id,
        "number": merge.number,
        "survivor": place_name(history, merge.survivor),
        "survivor_size": merge.survivor_size,
        "absorbed": [place_name(history, place) for place in merge.absorbed],
        "absorbed_sizes": list(merge.absorbed_sizes),
        "links": [link_document(history, link) for link in merge.links],
        "chains": [chain_document(history, chain) for chain in chains_of(history, merge)],
        "objects": [history.objects[number].object_id for number in merge.objects],
        "edges": [_edge_document(history, edge) for edge in merge.edges],
        **(joined if merge.joined else {}),
        **(_drives_document(history, merge) if merge.drives else {}),
    }


def _drives_document(history: History, merge: Merge) -> dict[str, Any]:
    """Why places by rooms merged, and what both had seen, which the rule does not use."""
    drives = [
        {
            "mean_m": drive.mean_um / 1e6,
            "limit_m": history.settings.rooms.drive_m,
            "cells": drive.cells,
            "absorbed_cells": drive.absorbed_cells,
        }
        for drive in merge.drives
    ]
    seen = [history.objects[each].object_id for each in seen_from_both(history, merge)]
    return {"drives": drives, "seen_from_both": seen}


def _joined_document(history: History, link: deltas.PlaceLink) -> dict[str, Any]:
    command = _document(_command(history, (link.core, link.neighbour), joins=True))
    return {**link_document(history, link), "command": command}


def evidence_text(evidence: deltas.MergeEvidence | None) -> str:
    """``0.34 m apart, looks +3.2, positions +1.1, in one picture 0 of 12 times``; looks and
    positions are log-likelihood ratios in nats. None stands for a merge by a command."""
    if evidence is None:
        return "a command"
    return (
        f"{evidence.distance_um / UM_PER_M:.2f} m apart, looks {evidence.look / _NATS:+.1f}, "
        f"positions {evidence.geometry / _NATS:+.1f}, "
        f"in one picture {evidence.pictures_with_both:,} of {counted(evidence.pictures, 'time')}"
    )


def evidence_document(evidence: deltas.MergeEvidence) -> dict[str, Any]:
    """The evidence of a merge of objects as JSON; log-likelihood ratios in nats."""
    return {
        "distance_m": evidence.distance_um / UM_PER_M,
        "look": evidence.look / _NATS,
        "geometry": evidence.geometry / _NATS,
        "pictures_with_both": evidence.pictures_with_both,
        "pictures": evidence.pictures,
    }


def object_merge_document(history: History, merge: ObjectMerge) -> dict[str, Any]:
    """One merge of objects as JSON."""
    survivor = history.object_at(merge.survivor, Offset(merge.offset + 1))
    evidence = merge.values.evidence
    return {
        **merge.cause.document(),
        "class_name": survivor.class_name,
        "survivor": survivor.object_id,
        "absorbed": history.objects[merge.absorbed].object_id,
        **({} if evidence is None else {"evidence": evidence_document(evidence)}),
    }


def _edge_document(history: History, edge: EdgeChange) -> dict[str, Any]:
    return {
        "a": place_name(history, edge.a),
        "b": place_name(history, edge.b),
        "before": edge.before,
        "after": edge.after,
    }
