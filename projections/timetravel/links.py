"""Why two places became one, in words and as JSON."""

from typing import Any

from projections.deltas import Link

from .bridging import Chain, chains_of
from .history import History
from .lives import Merge
from .story import keyframe_name, listed, place_name


def reason(history: History, merge: Merge) -> str:
    """Who bridged, what that made core, and the chain of core points to each absorbed place."""
    if merge.cause.kind != "keyframe":
        return merge.cause.name
    chains = chains_of(history, merge)
    bridge = keyframe_name(history, merge.bridge)
    if not chains:
        links = "; ".join(_link_text(history, link) for link in merge.links)
        return f"{bridge} bridged them: {links}"
    made = dict.fromkeys(point for chain in chains for point in chain.made_core)
    names = ["itself" if k == merge.bridge else keyframe_name(history, k) for k in made]
    what = "a core point" if len(made) == 1 else "core points"
    joins = "; ".join(chain_text(history, chain) for chain in chains)
    return f"{bridge} made {listed(names)} {what}: {joins}"


def chain_text(history: History, chain: Chain) -> str:
    """``run:2 (run_p0) –0.900 m– run:3 –1.000 m– run:5 (run_p1)``."""
    names = [keyframe_name(history, point) for point in chain.points]
    names[0] += f" ({place_name(history, chain.joined)})"
    names[-1] += f" ({place_name(history, chain.absorbed)})"
    steps = [
        f"{name} –{d / 1e6:.3f} m–" for name, d in zip(names, chain.distances_um, strict=False)
    ]
    return " ".join([*steps, names[-1]])


def _link_text(history: History, link: Link) -> str:
    core, neighbour = keyframe_name(history, link.core), keyframe_name(history, link.neighbour)
    return f"{core} and {neighbour} are core points {link.distance_um / 1e6:.3f} m apart"


def link_document(history: History, link: Link) -> dict[str, Any]:
    """A link of the merge, as the fold states it."""
    return {
        "core": keyframe_name(history, link.core),
        "neighbour": keyframe_name(history, link.neighbour),
        "distance_m": link.distance_um / 1e6,
    }


def chain_document(history: History, chain: Chain) -> dict[str, Any]:
    """A chain of core points from a joined place to an absorbed one."""
    return {
        "from": place_name(history, chain.joined),
        "to": place_name(history, chain.absorbed),
        "points": [keyframe_name(history, point) for point in chain.points],
        "distances_m": [distance / 1e6 for distance in chain.distances_um],
        "made_core": [keyframe_name(history, point) for point in chain.made_core],
    }
