"""The commands of a log: who gave which, why, what it changed, and what is undone."""

from typing import Any

from starlette.datastructures import QueryParams

from eventsrc.text import visible
from projections.edit.current import CurrentMap
from projections.edit.effect import effects_of
from projections.edit.listing import edits_document, edits_text

from .edits import edit_kinds
from .log_map import LogMap
from .moment import command_line


def corrections_answer(shown: LogMap, _: QueryParams) -> dict[str, Any]:
    """The list; effects only where they are known already."""
    current = CurrentMap(shown.reader, shown.opened.settings)
    found = effects_of(current, known_only=True)
    times = {event.offset: event.logged_ns for event in current.command_events()}
    return {
        "corrections": [
            {**each, "text": visible(f"{each['kind']} {each['what']}")}
            for each in edits_document(found, times)
        ],
        "kinds": edit_kinds(),
        "lines": edits_text(found, times).splitlines(),
        "command": command_line(shown.opened, "edits", *shown.opened.words()),
    }
