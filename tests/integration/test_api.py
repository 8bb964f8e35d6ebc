"""The Python interface that scripts and notebooks import from ``mapfold``."""

import doctest
import json
import os
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import mapfold as public
import pytest

from eventsrc.base.errors import LogNotFound, MisuseError
from projections.fold.map_errors import QuestionError, SettingsError
from projections.history import NoSuchThing
from projections.surfaces import python as api
from projections.surfaces.python import Map, Timeline, fold, open_log, relocalize
from tests.support import prefork
from tests.support.commands import TIMEOUT_S, Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import sample_drive, write_log

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = sample_drive()
ROOMS = {"eps_m": 0.75, "min_samples": 8}
OPTIONS = ("--set", "eps_m=0.75", "--set", "min_samples=8", "--json")
WHY = ("--reason", "a test")


@pytest.fixture(scope="module")
def house() -> Map:
    return fold(SAMPLE, settings=ROOMS)


@pytest.fixture(scope="module")
def known() -> Map:
    """The map by the settings of its log, which knows rooms; tests may only read it."""
    return fold(ROOT / "logs" / "sample")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


@pytest.mark.parametrize("name", ["python.map", "python.past_maps", "mapfold"])
def test_examples_of_docstrings_give_what_they_show(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    module = import_module(f"projections.surfaces.{name}")
    names = {each: getattr(api, each) for each in api.__all__}
    names["fold"] = cache(fold)  # most examples begin with the same map
    found = doctest.testmod(module, extraglobs=names)
    assert (found.failed, found.attempted > 0) == (0, True)


def test_mapfold_has_every_name_of_the_api() -> None:
    assert public.__all__ == api.__all__
    assert all(getattr(public, name) is getattr(api, name) for name in api.__all__)


def test_mapfold_lists_nothing_that_is_not_ours() -> None:
    assert dir(public) == sorted(public.__all__)


def test_what_is_found_says_what_it_is_in_one_line(known: Map) -> None:
    oven = known.find("oven").answers[0]
    with Timeline(SAMPLE, ROOMS, cache=False) as timeline, open_log(SAMPLE) as log:
        shown = [
            *(known.objects[0], known.places[1], known.objects, known.places),
            *(oven, known.find("chairs"), known.room("kitchen"), known.path("kitchen", "oven")),
            *(known.goal("oven"), known.changes(since=200), timeline, log),
        ]
    for each in shown:
        assert repr(each)[0] in "<[", each
        assert len(repr(each)) < 300, each
    assert repr(timeline) == f"<Timeline of {SAMPLE}: 445 events>"
    assert repr(log) == f"<LogReader {SAMPLE}: 445 events>"
    assert repr(oven).startswith(f"<oven {oven.object_id} at (")
    assert known.places[1].type == known.places[1]["type"] == "kitchen"
    assert known.places[1].name is None
    with pytest.raises(AttributeError, match="no 'colour' here; there are place_id"):
        _ = known.places[1].colour


def test_what_changed_since_a_moment_is_that_of_the_timeline(known: Map) -> None:
    by_map = known.changes(since=200)
    with Timeline(ROOT / "logs" / "sample", cache=False) as timeline:
        assert by_map == timeline.changes("200")
        assert timeline.at().changes(timeline.at(200)).since == 200
    with pytest.raises(MisuseError, match="give an earlier map"):
        Map(known.view).changes()


def test_tables_and_graphs_are_those_of_the_state(
    house: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = house.graph()
    kinds = [values["kind"] for _, values in graph.nodes(data=True)]
    assert (kinds.count("Place"), kinds.count("Object")) == (len(house.places), len(house.objects))
    assert graph.number_of_edges() >= len(house.adjacency)
    table = house.objects.to_pandas()
    assert list(table["object_id"]) == [each.object_id for each in house.objects]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MisuseError, match="pip install pandas"):
        house.objects.to_pandas()


def test_a_notebook_keeps_at_most_60_kb_of_a_large_map(
    known: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hundreds of places with long names, and drives that fill the picture."""
    for place in known.view.places.values():
        monkeypatch.setattr(place, "name", "<&>" * 250)
    shown = Map(known.view)._repr_html_()
    assert len(shown.encode()) <= 60_000
    assert "<img" in shown
    assert "more places" in shown


@pytest.mark.slow
def test_a_notebook_keeps_as_little_of_a_map_with_hundreds_of_places(tmp_path: Path) -> None:
    spots = [(4.0 * (n % 20), 4.0 * (n // 20)) for n in range(400)]
    drive = [
        envelope(3 * n + again, x + 0.1 * again, y, detections=[detection()])
        for n, (x, y) in enumerate(spots)
        for again in range(3)
    ]
    large = fold(write_log(tmp_path / "large", drive))
    assert len(large.places) == 400
    shown = large._repr_html_()
    assert len(shown.encode()) <= 60_000
    assert "<img" in shown
    assert "more places" in shown


def test_python_m_mapfold_is_the_program(tmp_path: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "mapfold", "log", "info", SAMPLE, "--json"],
        cwd=tmp_path,
        capture_output=True,
        check=True,
    )
    assert json.loads(said.stdout)["events"] == 445


def test_python_m_mapfold_names_itself_mapfold(tmp_path: Path) -> None:
    program = "import runpy; runpy.run_module('mapfold', run_name='__main__', alter_sys=True)"
    argv = ["-c", "state"]
    helped = prefork.run(program, argv, env=os.environ, cwd=tmp_path, timeout=TIMEOUT_S)
    assert helped.returncode == 2
    assert b"mapfold state" in helped.stderr


def test_answers_are_those_of_the_commands(house: Map, mapfold: Commands) -> None:
    assert house.state == mapfold("state", SAMPLE, *OPTIONS).json
    assert f"{house}" == mapfold("state", SAMPLE, *OPTIONS[:-1]).out
    with Timeline(str(SAMPLE), ROOMS) as timeline:
        assert timeline.end == 445
        merges = mapfold("merges", SAMPLE, "--at", "300", *OPTIONS).json
        assert timeline.merges(300) == merges
        assert timeline.at("sim-7-a:200").state == fold(SAMPLE, at=200, settings=ROOMS).state
        assert timeline.diff(240, 241) == mapfold("diff", SAMPLE, "240", "241", *OPTIONS).json
        assert timeline.why("sim-7-a_p6") == mapfold("why", SAMPLE, "sim-7-a_p6", *OPTIONS).json
        same = ("sim-7-a:201", "sim-7-a:240")
        found = mapfold("why", SAMPLE, "--same", *same, *OPTIONS).json
        assert timeline.why_same(*same) == found
        condition = "place_count >= 5"
        found = mapfold("bisect", SAMPLE, condition, *OPTIONS).json
        assert timeline.bisect(condition) == found
        asked = mapfold("whatif", SAMPLE, "--set", "eps_m=1.0", "--json").json
    with Timeline(SAMPLE) as timeline:
        given = timeline.whatif({"eps_m": 1.0})
    assert _without_times(given) == _without_times(asked)


def _without_times(document: object) -> object:
    if isinstance(document, dict):
        return {k: _without_times(v) for k, v in document.items() if k != "fold_seconds"}
    return [_without_times(v) for v in document] if isinstance(document, list) else document


def test_a_question_is_answered_as_by_the_command(
    house: Map, mapfold: Commands, tmp_path: Path
) -> None:
    with open_log(SAMPLE) as log:
        seen = json.loads(next(log.read(350)).payload)
    question = tmp_path / "question.json"
    question.write_text(json.dumps(seen))
    told = mapfold("relocalize", question, "--log", SAMPLE, *OPTIONS).json
    assert told["places"][0]["place_id"] == "sim-7-a_p0"
    for asked in (seen, seen["detections"], question, str(question)):
        assert relocalize(house, asked).document() == told


def test_settings_come_as_a_mapping_a_file_or_those_of_the_log(
    house: Map, mapfold: Commands, tmp_path: Path
) -> None:
    file = tmp_path / "rooms.json"
    file.write_text(json.dumps(ROOMS))
    assert fold(SAMPLE, settings=file).digest == house.digest
    assert fold(SAMPLE, settings=house.view.settings).digest == house.digest
    log = write_log(tmp_path / "log", [envelope(k, k * 0.5, 0.0) for k in range(9)])
    assert fold(log).view.settings.eps_m == 1.5
    assert mapfold("edit", log, "use-settings", "--set", "eps_m=0.4", *WHY).code == 0
    assert fold(log).view.settings.eps_m == 0.4
    assert fold(log, known_at=9).view.settings.eps_m == 1.5
    assert fold(log, at=9).view.settings.eps_m == 1.5


def test_a_map_is_shown_with_hostile_names_as_text(mapfold: Commands, tmp_path: Path) -> None:
    name = "<script>alert(1)</script>"
    seen = [detection(name)]
    drive = [envelope(k, k * 0.01, 0.0, detections=seen) for k in range(9)]
    log = write_log(tmp_path / "log", drive)
    assert mapfold("edit", log, "name-place", "run-a_p0", name, *WHY).code == 0
    shown = fold(log)._repr_html_()
    tags = _Tags()
    tags.feed(shown)
    assert tags.found == {"img", "table", "tr", "th", "td"}
    assert name in tags.text


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.found.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


def test_a_picture_is_drawn(house: Map, tmp_path: Path) -> None:
    house.draw(tmp_path / "map.svg")
    assert "map 83caf24d after 445 events" in (tmp_path / "map.svg").read_text()
    with pytest.raises(MisuseError, match=r"\.png, \.svg or \.pdf"):
        house.draw(tmp_path / "map.xyz")


def test_an_empty_log_has_an_empty_map(tmp_path: Path) -> None:
    empty = fold(write_log(tmp_path / "log", []))
    assert (empty.places, empty.objects, empty.adjacency) == ([], [], [])
    assert "0 places" in repr(empty)
    assert "<img" in empty._repr_html_()
    assert relocalize(empty, [{"embedding": [1.0, 0.0]}]).unknown


def test_what_cannot_be_answered_is_refused(house: Map, tmp_path: Path) -> None:
    with pytest.raises(LogNotFound, match="nowhere"):
        fold(tmp_path / "nowhere")
    with pytest.raises(MisuseError, match="beyond the end"):
        fold(SAMPLE, at=446)
    with pytest.raises(SettingsError, match="eps"):
        fold(SAMPLE, settings={"epsm": 1.0})
    with pytest.raises(MisuseError, match=r"none\.json"):
        fold(SAMPLE, settings=tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(SettingsError, match="not JSON"):
        fold(SAMPLE, settings=tmp_path / "bad.json")
    with pytest.raises(MisuseError, match="embeddings=False"):
        relocalize(fold(SAMPLE, at=9, embeddings=False), [{"class": "cup"}])
    with pytest.raises(QuestionError):
        relocalize(house, {"views": 3})
    with pytest.raises(MisuseError, match=r"gone\.json"):
        relocalize(house, tmp_path / "gone.json")
    with Timeline(SAMPLE) as timeline, pytest.raises(NoSuchThing):
        timeline.why("p999")
