"""`mapfold log spaces`: which embedding spaces a log has, and how many detections are in each."""

from dataclasses import asdict

from eventsrc.base.text import counted, visible
from eventsrc.log import LogReader
from projections.map.own_events import log_spaces

from .folded_log import LogArgument
from .options import JsonOption
from .terminal import Bar, display, emit


def spaces(log: LogArgument, json_: JsonOption = False) -> None:
    """Print the embedding spaces of a log: a model, its dimension, and how many detections have a
    vector of it.

    `mapfold reembed` adds vectors of another space; --space NAME maps a log in it.
    """
    with LogReader(log) as reader, Bar() as bar:
        found = log_spaces(reader, lambda done, all_: bar.show("reading", done, all_))
    if json_:
        emit(asdict(found))
        return
    bare = f", {found.bare:,} of them recorded without a vector" if found.bare else ""
    display(f"{counted(found.detections, 'detection')}{bare}")
    for each in found.spaces:
        name = "(no name)" if each.model is None else visible(each.model)
        parts = [f"{each.recorded:,} recorded"] if each.recorded else []
        parts += [f"{each.reembedded:,} re-embedded"] if each.reembedded else []
        display(f"  {name}, dimension {each.dim:,}: {', '.join(parts) or 'none'}")
