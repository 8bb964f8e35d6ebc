"""The page in one file that needs no server: with it the history's arrays, and the answers of
`projections.surfaces.ui` to what the page asks while a person looks around.

Answers have names, `_Question.name`; of each there is a list of moments with the answer there. What
many have in common is written once: ``values`` holds every object and list of JSON, in which
``[number]`` stands for another of them. All of it is compressed and in base64, so no name in a log
can end its element.
"""

import gzip
import hashlib
import json
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

from starlette.datastructures import QueryParams

from eventsrc.base.progress import reported
from eventsrc.base.text import visible
from eventsrc.base.user_files import written_whole

from .app import static_files
from .comparisons import changes_answer, diff_answer
from .crop_pictures import pictures_answer
from .log_map import LogMap
from .map_answers import digest_answer, history_answer, overview_answer, walls_answer
from .question_threads import log_document
from .search import find_answer
from .stories import why_answer

_MOST_ROWS: Final = 5000
"""Rows of the tables of objects, of all moments together: it bounds the moments."""
_MOST_OBJECTS: Final = 2000
_MOST_STORIES: Final = 2000
_MOST_PICTURES: Final = 400
_MOST_RUNS: Final = 6
"""Runs, the last ones, between which changes are answered."""
_LEVEL: Final = 9


def write_page(shown: LogMap, path: Path) -> int:
    """Write the page of a map that is folded; how many bytes it has."""
    page = _page(shown)
    with written_whole(path) as file:
        file.write(page)
    return len(page)


def _page(shown: LogMap) -> bytes:
    files = static_files()
    code = _inline(files["/mapfold.js"].content, "script")
    style = _inline(files["/mapfold.css"].content, "style")
    licences = _inline(files["/licences.md"].content, "script")
    icon = b64encode(files["/favicon.svg"].content).decode()
    history = history_answer(shown, QueryParams({}), 0.0)
    answers = _Answers()
    answers.add("log", shown.through, log_document(shown.opened, shown))
    questions = _questions(shown)
    for each in reported(questions, "answering", len(questions), "questions"):
        parameters = QueryParams({**each.named, **each.rest})
        answers.add(each.name, each.at, each.answer(shown, parameters))
    policy = (
        f"default-src 'none'; script-src {_allowed(code)}; style-src {_allowed(style)};"
        " img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    name = escape(visible(shown.reader.path.name))
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{name} · mapfold</title>
<link rel="icon" href="data:image/svg+xml;base64,{icon}">
<style>{style}</style>
</head>
<body>
<div id="app"></div>
<noscript>This page computes the map in the browser, so it needs JavaScript.</noscript>
<script type="text/plain" id="saved-history">{_packed(history)}</script>
<script type="text/plain" id="saved-answers">{_packed(answers.document())}</script>
<script type="module">{code}</script>
<script type="text/plain">{licences}</script>
</body>
</html>
""".encode()


def _inline(content: bytes, element: str) -> str:
    """A file's text as the content of an element, which it must not end."""
    return content.decode().replace(f"</{element}", f"<\\/{element}").strip()


def _allowed(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _packed(content: bytes) -> str:
    return b64encode(gzip.compress(content, _LEVEL, mtime=0)).decode()


class _Answers:
    """Answers by name and moment, which share what is equal in them."""

    def __init__(self) -> None:
        self._values: dict[str, int] = {}
        self._answers: dict[str, list[list[int]]] = {}

    def add(self, name: str, moment: int, answer: Mapping[str, Any]) -> None:
        (number,) = self._slot(answer)
        self._answers.setdefault(name, []).append([moment, number])

    def _slot(self, value: Any) -> Any:
        """How a value is written within another."""
        if isinstance(value, Mapping):
            text = json.dumps({key: self._slot(each) for key, each in value.items()}, **_JSON)
        elif isinstance(value, list | tuple):
            text = json.dumps([self._slot(each) for each in value], **_JSON)
        else:
            return value
        return [self._values.setdefault(text, len(self._values))]

    def document(self) -> bytes:
        values = ",\n".join(self._values)
        answers = json.dumps(self._answers, **_JSON)
        return f'{{"answers":{answers},"values":[{values}]}}'.encode("utf-8", "replace")


_JSON: Final[dict[str, Any]] = {
    "ensure_ascii": False,
    "allow_nan": False,
    "separators": (",", ":"),
}


@dataclass(frozen=True, slots=True)
class _Question:
    """``path`` and ``named`` are its name; the ``rest`` of its parameters is not, with the moment
    ``at``."""

    path: str
    at: int
    answer: Callable[[LogMap, QueryParams], dict[str, Any]]
    named: Mapping[str, str]
    rest: Mapping[str, str]

    @property
    def name(self) -> str:
        """What the page calls it, too."""
        named = (f"{key}={value}" for key, value in sorted(self.named.items()))
        return "\n".join([self.path, *named])


def _questions(shown: LogMap) -> list[_Question]:
    end = shown.through
    known = {"known_at": str(end)}
    found = list[_Question]()
    for at in _moments(shown):
        moment = {"at": str(at), **known}
        found.append(_Question("overview", at, overview_answer, {}, moment))
        found.append(_Question("digest", at, digest_answer, {}, moment))
        for named in ({}, {"all": "1"}):
            rest = moment | {"top": str(_MOST_OBJECTS)}
            found.append(_Question("find", at, find_answer, named, rest))
    for start, until in _spans(shown):
        span = {"from": str(start), "to": str(until)}
        found.append(_Question("diff", end, diff_answer, span, known))
        if shown.timeline.settings.fusion == "evidence":
            span = {"since": str(start), "until": str(until)}
            found.append(_Question("changes", end, changes_answer, span, known))
    things = _things(shown)
    latest = {"at": str(end), **known}
    found += [
        _Question("why", end, why_answer, {"what": what}, latest) for what in things[:_MOST_STORIES]
    ]
    if shown.crops.are_kept:
        objects = [what for what in things if what.startswith("object:")][:_MOST_PICTURES]
        found += [
            _Question("pictures", end, pictures_answer, {"what": what}, latest | {"top": "1"})
            for what in objects
        ]
    maps = [str(number) for number in range(len(shown.timeline.history.maps))]
    found += [_Question("walls", end, walls_answer, {"number": each}, {}) for each in maps]
    return found


def _moments(shown: LogMap) -> list[int]:
    """The moments at which tables are answered: the ends of runs and as many between, evenly, as
    there is room for."""
    history = shown.timeline.history
    rows = max(1, history.tables.count("found"))
    most = max(1, min(shown.through, _MOST_ROWS // rows))
    evenly = {shown.through * step // most for step in range(most + 1)}
    return sorted(evenly | {until for _, until in _runs(shown)[-_MOST_ROWS // rows :]})


def _runs(shown: LogMap) -> list[tuple[int, int]]:
    """The first event of each run, and the moment after its last one."""
    found: dict[int, tuple[int, int]] = {}
    for each in shown.timeline.history.keyframes:
        start, _ = found.get(each.run, (int(each.offset), 0))
        found[each.run] = start, int(each.offset) + 1
    return list(found.values())


def _spans(shown: LogMap) -> list[tuple[int, int]]:
    """From the start of a run to the end of it and of each later one; of a single run none."""
    runs = _runs(shown)[-_MOST_RUNS:]
    if len(runs) == 1:
        return []
    return sorted({(start, until) for start, _ in runs for _, until in runs if start < until})


def _things(shown: LogMap) -> list[str]:
    """What a person can select, as ``what`` names it: objects, places and merges before the
    keyframes."""
    history = shown.timeline.history
    tables = history.tables
    objects = tables.texts("found", "object_id", 0, tables.count("found"))
    places = tables.texts("formed", "place_id", 0, tables.count("formed"))
    merges = dict.fromkeys(int(merge.cause.offset) for merge in history.merges)
    names = [f"{k.run_id}/{k.keyframe_id}" for k in history.keyframes]
    return [
        *(f"place:{each}" for each in places),
        *(f"object:{each}" for each in objects),
        *(f"merge:{each}" for each in merges),
        *(f"keyframe:{each}" for each in names),
    ]
