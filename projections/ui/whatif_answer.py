"""The map under other settings or without a command, compared with the log's own map."""

from collections.abc import Callable
from time import perf_counter
from typing import Any

from starlette.datastructures import QueryParams

from eventsrc.envelope import Offset
from eventsrc.errors import MisuseError
from eventsrc.log.seek import resolve
from eventsrc.text import visible_lines
from projections.corrections import compile_corrections
from projections.history.parallel import Rules
from projections.history.whatif import alternatives, command_trials, setting_trials, what_if
from projections.history.whatif_rendering import whatif_text
from projections.model.log_commands import read_commands

from .comparisons import MOST_LINES
from .log_prefix import PrefixReader
from .moment import command_line
from .opened import Opened
from .requests import assignments_of, text_of

_OPTIONS = ("try", "grid", "without")


def whatif_answer(
    opened: Opened, through: Offset, query: QueryParams, go_on: Callable[[], None]
) -> dict[str, Any]:
    """``set`` together make one alternative; each ``try``, ``grid`` and ``without`` as the options
    of ``mapfold whatif``. Says how long the folds took: ``seconds``, and each its own."""
    started = perf_counter()
    sets = assignments_of(query)
    tries, grids, without = (query.getlist(name) for name in _OPTIONS)
    with PrefixReader(opened.log, through, go_on) as reader:
        end = resolve(reader, text_of(query, "at", "end"))
        known_at = resolve(reader, text_of(query, "known_at", str(end)))
        commands = read_commands(reader, known_at)
    corrections = compile_corrections(commands)
    base = Rules(opened.settings(corrections), corrections)
    trials = setting_trials(base, alternatives(base.settings, sets, tries, grids))
    trials += command_trials(commands, without, opened.settings)
    if not trials:
        raise MisuseError("nothing to try; give set, try, grid or without")
    found = what_if(opened.log, base, trials, end, truth=opened.truth, progress=lambda *_: go_on())
    words = [w for name in _OPTIONS for text in query.getlist(name) for w in (f"--{name}", text)]
    words += [word for text in sets for word in ("--set", text)]
    words += [*opened.base_words(), "--at", str(end)]
    if known_at != end:
        words += ["--known-at", str(known_at)]
    return {
        "through": through,
        "at": end,
        "known_at": known_at,
        **found.document(),
        "names": [each.name for each in found.all],
        "lines": visible_lines(whatif_text(found, most=MOST_LINES)).splitlines(),
        "seconds": round(perf_counter() - started, 3),
        "command": command_line(opened, "whatif", *words),
    }
