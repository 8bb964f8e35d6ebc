"""``edit LOG relabel``: numbers of a detector become names, in every map that knows of it."""

import json
from pathlib import Path
from typing import Any

import pytest

from projections.fold.settings import Settings
from projections.localize.evaluate.questions import read_keyframes
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.queries.candidate_search import prepare_graph
from projections.postgres.queries.live_view import read_view
from tests.integration.test_types_of_places import DOCUMENTS, KITCHEN
from tests.support.commands import Commands
from tests.support.logs import write_log
from tests.support.thorough import mostly_slow

NUMBERS = {"refrigerator": "72", "sink": "71", "toilet": "61", "box": "4"}
NAMES = {number: name for name, number in NUMBERS.items()}
WHY = ("--reason", "the model card")


def numbered(document: dict[str, Any]) -> dict[str, Any]:
    seen = [{**each, "class": NUMBERS[each["class"]]} for each in document["detections"]]
    return {**document, "detections": seen}


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    (tmp_path / "labels.json").write_text(json.dumps(NAMES))
    return Commands.in_folder(tmp_path)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log whose classes are numbers."""
    return write_log(tmp_path / "log", map(numbered, DOCUMENTS))


RULES: list[Any] = [[], ["--preset", "rooms", "--set", "fusion=evidence"]]


def classes(mapfold: Commands, log: Path, *options: str) -> list[str]:
    state = mapfold("state", log, "--json", *options).json
    return sorted(each["class_name"] for each in state["objects"])


@pytest.mark.parametrize("rules", mostly_slow(RULES))
def test_the_map_is_that_of_a_log_with_the_names(
    mapfold: Commands, log: Path, rules: list[str]
) -> None:
    def parts(of: Path, *options: str) -> list[Any]:
        state = mapfold("state", of, "--json", *rules, *options).json
        return [state[name] for name in ("keyframes", "places", "objects", "adjacency")]

    named = write_log(log.with_name("named"), DOCUMENTS)
    before, end = parts(log), ("--at", str(len(DOCUMENTS)))
    digest = mapfold("state", log, *rules, *end, "--digest").out
    assert before != parts(named)
    said = mapfold("edit", log, "relabel", "--labels", "labels.json", *WHY, *rules, "--json").json
    assert said["effect"]["objects"] == 5
    assert parts(log) == parts(log, *end, "--known-at", "end") == parts(named)
    assert parts(log, *end) == before, "not known then"
    mapfold("edit", log, "undo", said["command_id"], *WHY, *rules)
    assert mapfold("state", log, *rules, *end, "--known-at", "end", "--digest").out == digest


def test_the_later_name_of_a_label_counts(mapfold: Commands, log: Path) -> None:
    mapfold("edit", log, "relabel", "72=fridge", "71=basin", *WHY)
    assert classes(mapfold, log) == ["4", "61", "basin", "basin", "fridge"]
    said = mapfold("edit", log, "relabel", "71=sink", *WHY, "--command-id", "c2", "--json").json
    assert said["effect"] == {"places": 0, "objects": 2, "keyframes": 0}
    assert classes(mapfold, log) == ["4", "61", "fridge", "sink", "sink"]
    rows = mapfold("edits", log, "--json").json
    assert [each["what"] for each in rows] == ["72 is fridge and 1 more", "71 is sink"]
    assert "relabel 71 is sink" in mapfold("edits", log).out
    why = mapfold("why", log, "fridge").out
    assert "label 72 called fridge by relabel " in why
    mapfold("edit", log, "undo", "c2", *WHY)
    assert classes(mapfold, log) == ["4", "61", "basin", "basin", "fridge"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "give LABEL=NAME or --labels FILE"),
        (("72",), "'72' gives no name to a label; write it as 17=chair"),
        (("72=a", "72=b"), "label '72' is given two names"),
        (("72=72",), "these labels have these names already"),
        (("17=chair",), "no label '17' in this log; near it: 4, 61, 71, 72"),
        (("72=\x1b",), "control character"),
        (("72=fridge", "17=chair"), "no label '17' in this log; near it: 4, 61, 71, 72"),
        (("--labels", "none.json"), "--labels none.json: No such file"),
        (("--labels", "others.txt"), "no label '0' in this log; near it: 4, 61, 71, 72"),
    ],
)
def test_what_names_nothing_is_refused(
    mapfold: Commands, log: Path, words: tuple[str, ...], says: str
) -> None:
    (mapfold.folder / "others.txt").write_text("person\nbicycle\n")
    assert says in mapfold("edit", log, "relabel", *words, *WHY, code=2).err


def test_the_name_of_a_label_is_no_label(mapfold: Commands, log: Path) -> None:
    mapfold("edit", log, "relabel", "72=fridge", "71=61")
    said = mapfold("edit", log, "relabel", "fridge=refrigerator", code=2).err
    assert "'fridge' is no label, but the name of '72'; `72=refrigerator` gives that anot" in said
    mapfold("edit", log, "relabel", "72=71", "61=toilet", "71=sink"), "labels, and names, too"
    assert classes(mapfold, log) == ["4", "71", "sink", "sink", "toilet"]


def test_a_file_of_all_that_a_detector_knows_says_what_of_it_is_there(
    mapfold: Commands, log: Path
) -> None:
    every = {str(n): f"thing-{n}" for n in range(70, 80)}
    (mapfold.folder / "all.json").write_text(json.dumps(every))
    said = mapfold("edit", log, "relabel", "--labels", "all.json").err
    assert "the log has 2 of 10 labels, 71, 72; the others name what comes later" in said
    assert classes(mapfold, log) == ["4", "61", "thing-71", "thing-71", "thing-72"]


def test_places_that_become_another_type_of_room_are_told(mapfold: Commands, log: Path) -> None:
    words = ("edit", log, "relabel", "--labels", "labels.json")
    for said in (mapfold(*words, "--dry-run").err, mapfold(*words).err):
        assert "p0 was of no certain type, is kitchen now, by the names" in said
    assert "kitchen" in mapfold("state", log).out
    said = mapfold("edit", log, "relabel", "72=toilet", "71=toilet").err
    assert "p0 was kitchen, is bathroom now" in said


def test_questions_go_by_the_names_and_by_the_labels(mapfold: Commands, log: Path) -> None:
    mapfold("edit", log, "relabel", "--labels", "labels.json", *WHY)

    def places(*names: str) -> Any:
        asked = [word for name in names for word in ("--class", name)]
        return mapfold("relocalize", *asked, "--log", log, "--json").json["places"]

    assert places("refrigerator", "sink")[0]["place_id"] == KITCHEN
    assert places("72", "71") == places("refrigerator", "sink")
    assert {d.class_name for k in read_keyframes([log]) for d in k.envelope.detections} == {
        *NUMBERS
    }


def test_a_tail_folds_again_when_a_label_is_named(
    mapfold: Commands, log: Path, one_database: Targets
) -> None:
    tail(log, one_database, Settings(), once=True)
    mapfold("edit", log, "relabel", "--labels", "labels.json", *WHY)
    tail(log, one_database, Settings(), once=True)
    assert all(report.sound for report in check(log, one_database, Settings()))
    rebuild(log, one_database, Settings())
    assert all(report.sound for report in check(log, one_database, Settings()))
    with connect_for_cypher(one_database.graph_url) as connection:
        prepare_graph(connection)
        found = read_view(connection).objects.values()
    assert {each.class_name for each in found} == {*NUMBERS}


def test_a_copy_of_a_log_keeps_its_names(mapfold: Commands, log: Path) -> None:
    mapfold("edit", log, "relabel", "--labels", "labels.json", "--command-id", "c1")
    mapfold("edit", log, "relabel", "4=crate", "--command-id", "c2")
    named = classes(mapfold, log)
    said = mapfold("import", "copy", log).err
    assert "2 events of mapfold's own taken over, 0 rejected" in said
    copy = mapfold.folder / "copy"
    assert classes(mapfold, copy) == named
    assert [each["command_id"] for each in mapfold("edits", "copy", "--json").json] == ["c1", "c2"]
    mapfold("edit", log, "undo", "c2", "--command-id", "u", *WHY)
    mapfold("edit", log, "name-place", KITCHEN, "Kitchen")
    said = mapfold("import", "copy", log, code=3).err
    assert "passed over: mapfold/command: 2 messages, in the log already" in said
    assert (
        "rejected: name-place is about things of its own log; `mapfold edit copy name-place`"
        " gives it here" in said
    )
    assert classes(mapfold, copy) == classes(mapfold, log) != named, "the undo came along"
    write_log(mapfold.folder / "other", map(numbered, DOCUMENTS))
    mapfold("edit", "other", "relabel", "72=fridge")
    said = mapfold("import", "other", log, code=3).err
    assert "it calls label '72' 'refrigerator', which is 'fridge' in this log; " in said
    assert "`mapfold edit other relabel 72=refrigerator` changes that" in said
    assert "rejected: undo is" not in said
