"""Answers that compare: two moments, and what changed between them in the building; the map under
other settings or without a command and the log's own; and the event that made a condition true.
"""

from collections.abc import Callable
from time import perf_counter
from typing import Any, Final

from starlette.datastructures import QueryParams

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import Offset
from eventsrc.log.seek import resolve
from projections.fold.corrections import compile_corrections
from projections.history import Expression, ExpressionError
from projections.history.condition_functions import FUNCTIONS
from projections.history.diff_rendering import difference_text, whatif_text
from projections.history.merge_reasons import merge_document
from projections.history.rendering import search_text
from projections.history.rule_folds import Rules
from projections.history.whatif import alternatives, command_trials, setting_trials, what_if
from projections.map.parsing import read_commands

from .log_map import LogMap, Opened, PrefixReader
from .requests import AskedPoint, assignments_of, command_line, lines_of, text_of

MOST_LINES: Final = 200
_FLAGS: Final = ("1", "true", "yes")
_WORDS: Final = ("and", "or", "not", "none")


def diff_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The difference between the maps at ``from`` and ``to``, each map under the commands before
    it, or both under those before ``known_at``."""
    start, end = (shown.point(text_of(query, name)) for name in ("from", "to"))
    known_at = shown.point(query["known_at"]) if query.get("known_at") else None
    found = shown.timeline.diff(start, end, known_at=known_at)
    words = [str(start), str(end)]
    if known_at is not None:
        words += ["--known-at", str(known_at)]
    settings = shown.opened.words(*assignments_of(query))
    return {
        **found.document(),
        "known_at": known_at,
        "lines": lines_of(difference_text(found, most=MOST_LINES), found.short_ids),
        "command": command_line(shown.opened, "diff", *words, *settings),
    }


def changes_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """What ``mapfold changes --json`` answers: what changed for sure ``since`` (a W, a day or a run
    from its start; default: the start of the last run) ``until`` W, a day or the end of a run."""
    timeline = shown.timeline
    end = timeline.moment(text_of(query, "until", "end"), is_end=True)
    since = query.get("since")
    start = None if since is None else timeline.moment(since, is_end=False)
    known_at = shown.point(text_of(query, "known_at", str(end)))
    found = timeline.changes(start, end, known_at=known_at)
    words = ["--since", str(found.since), "--until", str(end)]
    if known_at != end:
        words += ["--known-at", str(known_at)]
    return {
        **found.document(),
        "known_at": known_at,
        "command": command_line(shown.opened, "changes", *words, *shown.opened.words()),
    }


def bisect_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """When ``condition`` became true between ``from`` (default: the start) and ``to`` (default: the
    end); with ``scan=1`` every turn."""
    expression = Expression(text_of(query, "condition"))
    asked = AskedPoint.of(shown, query, "to")
    start = shown.point(text_of(query, "from", "0"))
    scan = query.get("scan", "") in _FLAGS
    found = asked.known.bisect(expression, start, asked.end, scan=scan)
    words = [expression.source, *(["--from", str(start)] if start else [])]
    words += ["--to", str(asked.end), *(["--scan"] if scan else [])]
    return {
        **found.document(),
        "known_at": asked.known_at,
        "lines": lines_of(search_text(found, most=MOST_LINES), asked.short_ids),
        "command": asked.command("bisect", *words, asked_at=False),
    }


def conditions_answer(_: LogMap, query: QueryParams) -> dict[str, Any]:
    """The functions of conditions, for completion, and the error in ``text`` with its column."""
    return {
        "functions": [
            {
                "name": function.name,
                "signature": function.signature,
                "parameters": [parameter.value for parameter in function.parameters],
                "optional": function.optional,
                "result": function.result.value,
                "says": function.says,
            }
            for function in FUNCTIONS.values()
        ],
        "words": list(_WORDS),
        "error": _error(query["text"]) if query.get("text") else None,
    }


def _error(text: str) -> dict[str, Any] | None:
    try:
        Expression(text)
    except ExpressionError as error:
        return {"column": error.column, "message": error.reason}
    return None


def merges_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """Every merge of places up to W."""
    asked = AskedPoint.of(shown, query)
    known = asked.known
    return {
        **asked.document(),
        "merges": [merge_document(known.history, merge) for merge in known.merges(asked.end)],
        "command": asked.command("merges"),
    }


WHATIF_OPTIONS: Final = ("try", "grid", "without")


def whatif_answer(
    opened: Opened, through: Offset, query: QueryParams, go_on: Callable[[], None]
) -> dict[str, Any]:
    """``set`` together make one alternative; each ``try``, ``grid`` and ``without`` as the options
    of ``mapfold whatif``. ``seconds`` is the time of all folds; each alternative has its own."""
    started = perf_counter()
    sets = assignments_of(query)
    tries, grids, without = (query.getlist(name) for name in WHATIF_OPTIONS)
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
    words = [
        w for name in WHATIF_OPTIONS for text in query.getlist(name) for w in (f"--{name}", text)
    ]
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
        "lines": lines_of(whatif_text(found, most=MOST_LINES), found.short_ids()),
        "seconds": round(perf_counter() - started, 3),
        "command": command_line(opened, "whatif", *words),
    }
