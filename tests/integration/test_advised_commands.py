"""Every command line that a message advises can be pasted into a shell, and is the right one."""

import ast
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psycopg
import pytest
import typer
from psycopg.conninfo import conninfo_to_dict

from eventsrc.base.text import advised, complete_by
from eventsrc.log import LogWriter
from projections.postgres.connection import Targets, check_url, url_without_secrets
from projections.surfaces.cli import COMMANDS, command_line
from projections.surfaces.cli.composition import _command
from tests.support.commands import Commands, Said
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import flip
from tests.support.logs import bridge, walk, write_log

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {
    path: path.read_text("utf-8")
    for top in ("eventsrc", "projections")
    for path in (ROOT / top).rglob("*.py")
}
LOG = "my logs/the log"
SETTINGS = "my settings.json"
ADVICE = re.compile(rf"(`|\brun:? |\bwith: )mapfold ({'|'.join(COMMANDS)})\b")


def strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """The string constants that are no docstrings and no help texts, with their lines."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(id(node.value))
        if isinstance(node, ast.keyword) and node.arg in ("help", "metavar"):
            skipped |= {id(inner) for inner in ast.walk(node.value)}
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "option":
            skipped |= {id(inner) for given in node.args[:2] for inner in ast.walk(given)}
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and id(node) not in skipped:
            yield node.lineno, node.value


def test_no_message_has_a_command_line_of_its_own() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path, source in SOURCES.items()
        if "mapfold" in source  # parsing is dear
        for line, text in strings(ast.parse(source))
        if ADVICE.search(text)
    ]
    named = {
        "projections/surfaces/cli/record_command.py": 1,  # "taking commands of `mapfold edit`"
        "projections/surfaces/demo/story.py": 1,  # what the demo ran
    }
    others = [each for each in found if each.split(":")[0] not in named]
    assert not others, "\n".join(others)
    assert len(found) <= sum(named.values())


def calls() -> list[tuple[str, ast.Call]]:
    return [
        (f"{path.relative_to(ROOT)}:{node.lineno}", node)
        for path, source in SOURCES.items()
        if "advised(" in source
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "advised"
    ]


def test_each_advised_command_exists_and_takes_its_words() -> None:
    """With a word for each value: ``db check --repair X`` is a command, and takes an argument."""
    found = calls()
    assert found
    for place, call in found:
        check_words(place, call)


def check_words(place: str, call: ast.Call) -> None:
    words = [
        arg.value if isinstance(arg, ast.Constant) else "X"
        for arg in call.args
        if not isinstance(arg, ast.Starred)
    ]
    if words[0] == "X":  # a name that its caller gives
        return
    assert words[0] in COMMANDS, place
    _command(tuple(map(str, words)))  # what it is completed by
    command: Any = typer.main.get_command(command_line([words[0]]))
    names = list(words)
    while hasattr(command, "commands") and names and names[0] in command.commands:
        command = command.commands[names.pop(0)]
        if hasattr(command, "commands") and names and names[0] == "X":  # mapfold edit LOG KIND …
            return
    options = {option for param in command.params for option in param.opts}
    assert {name for name in names if str(name).startswith("-")} <= options, place
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    assert len([n for n in names if not str(n).startswith("-")]) <= len(arguments) + 1, place


def test_nothing_is_added_outside_the_program() -> None:
    assert advised("log", "verify", "a b's") == """mapfold log verify 'a b'"'"'s'"""
    complete_by(lambda words, without: ["--x", *words[:1], *without])
    try:
        assert advised("replay", without=["--set"]) == "mapfold replay --x replay --set"
    finally:
        complete_by(None)


def told(said: Said) -> list[list[str]]:
    """The words of the command lines in what was said, without ``mapfold``."""
    found = re.findall(r"`(mapfold [^`]*)`|(?:run|with): (mapfold .*)", said.err + said.out)
    return [shlex.split(quoted or rest)[1:] for quoted, rest in found]


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Beside a log and settings whose names have spaces."""
    (tmp_path / "my logs").mkdir()
    write_log(tmp_path / LOG, walk(40) + list(bridge()))
    (tmp_path / SETTINGS).write_text(json.dumps({"eps_m": 0.9}))
    (tmp_path / "question.json").write_text(json.dumps([{"class": "cup", "embedding": [1.0, 0.0]}]))
    return Commands.in_folder(tmp_path)


OWN = ("--settings", SETTINGS, "--set", "min_samples=4")


@pytest.mark.parametrize(
    ("args", "advice"),
    [
        (("merges", LOG, "--show", "99", *OWN), [["merges", LOG, *OWN]]),
        (
            ("merges", LOG, "--show", "99", "--preset", "rooms"),
            [["merges", LOG, "--preset", "rooms"]],
        ),
        (("room", LOG, "nowhere", *OWN), [["state", LOG, *OWN]]),
        (("edits", LOG), [["edit", LOG]]),
        (("log", "cat", LOG, "--from", "run-a:4711"), [["log", "cat", LOG]]),
        (("state", "my logs/a file", *OWN), [["import", "LOG", "my logs/a file"]]),
        (
            ("edit", LOG, "keep-apart", "run-a_p0", "run-a_p0", "--reason", "x", *OWN),
            [["merges", LOG, *OWN]],
        ),
        (("db", "url"), [["db", "start"]]),
    ],
    ids=lambda each: " ".join(each[:3]) if isinstance(each, tuple) else None,
)
def test_advice_names_the_log_and_the_options_in_force_and_runs(
    run: Commands, args: tuple[str, ...], advice: list[list[str]] | None
) -> None:
    (run.folder / "my logs/a file").write_bytes(payload(envelope(1)))
    found = told(run(*args, code=None))
    assert found
    if advice is not None:
        assert found == advice
    for words in found:
        assert run(*words, code=None).code == (2 if words[0] == "edit" else 0)  # shows its help
    run("db", "stop")


def test_advice_on_a_damaged_log_repairs_it(run: Commands) -> None:
    log = run.folder / LOG
    segment = next(log.glob("*.mcap"))
    flip(segment, segment.stat().st_size - 30)
    (words,) = told(run("state", LOG, *OWN, code=1))
    assert words == ["log", "recover", LOG]
    run(*words, code=None)
    assert "all good" in run("log", "verify", LOG).err


def test_advice_of_an_import_shows_what_was_rejected(run: Commands) -> None:
    (words,) = told(run("import", LOG, "-", stdin=b"junk", code=3))
    assert "not JSON" in run(*words).out


def test_advice_on_a_command_of_a_later_version_shows_the_map_before_it(run: Commands) -> None:
    with LogWriter(run.folder / LOG) as writer:
        unknown = {"kind": "paint", "command_id": "c", "issued_by": "me"}
        writer.append("mapfold/command", payload(unknown))
    (words,) = told(run("merges", LOG, *OWN, code=1))
    assert words[:3] == ["state", "--at", "60"]
    assert words[3:] == [LOG, *OWN]
    assert run(*words, "--digest").out


def test_advice_on_a_conflict_takes_the_other_command_back(run: Commands) -> None:
    places = ("run-a_p0", "run-a:39", "--reason", "two rooms", *OWN)
    run("edit", LOG, "keep-apart", *places, "--command-id", "c c")
    (words,) = told(run("edit", LOG, "join", *places, code=2))
    assert words == ["edit", LOG, "undo", "c c", "--reason", "WHY", *OWN]
    run(*words)
    run("edit", LOG, "join", *places)


def test_settings_without_a_log_are_advised_with_the_settings(run: Commands) -> None:
    (words,) = told(run("relocalize", "question.json", *OWN, code=2))
    assert words == ["replay", "LOG", *OWN]


def test_what_is_asked_of_databases_is_no_log(run: Commands, one_database: Targets) -> None:
    url = one_database.graph_url
    (words,) = told(run("find", "chair", "--db", url, code=1))
    assert words == ["replay", "LOG", "--db", url]


@pytest.mark.slow
@pytest.mark.seconds
def test_what_db_check_advises_repairs_under_the_same_settings_and_databases(
    run: Commands, one_database: Targets
) -> None:
    url = one_database.graph_url
    run("replay", LOG, *OWN, "--db", url)
    with psycopg.connect(url) as connection:
        connection.execute("DELETE FROM detection_embeddings WHERE det_pk = 1")
    said = run("db", "check", LOG, *OWN, "--db", url, code=3)
    (words,) = told(said)
    assert words[:3] == ["db", "check", "--repair"]
    assert words[3] == LOG
    run(*words, code=3)
    assert not told(run("db", "check", LOG, *OWN, "--db", url))
    said = run("tail", LOG, "--once", "--set", "eps_m=2", "--db", url, code=1)
    (words,) = told(said)
    assert words == ["replay", LOG, "--set", "eps_m=2.0", "--db", url]
    run(*words)
    run("tail", LOG, "--once", "--set", "eps_m=2", "--db", url)


def test_the_embedded_server_is_advised_as_it_is_given() -> None:
    assert url_without_secrets("") == ""


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        (
            "postgresql://ann:s3cret@h:5433/maps?application_name=x",
            "postgresql://ann@h:5433/maps?application_name=x",
        ),
        ("postgresql://:s3cret@/maps?host=/run/a%26b", "postgresql://@/maps?host=/run/a%26b"),
        ("postgresql://h/maps?passwor%64=s3cret&sslmode=require&sslpassword=s3cret",
         "postgresql://h/maps?sslmode=require"),
        ("postgres://[::1]:5433/maps?password=s3cret", "postgres://[::1]:5433/maps"),
        ("postgresql://ann@h/maps", "postgresql://ann@h/maps"),
        ("postgresql://ann:s3%3Fcr%2Fet@a,b:1,2/my%20maps", "postgresql://ann@a,b:1,2/my%20maps"),
    ],
)  # fmt: skip
def test_a_password_is_not_in_advised_urls_which_are_still_taken(url: str, shown: str) -> None:
    check_url(url)
    assert url_without_secrets(url) == shown
    check_url(shown)
    kept = conninfo_to_dict(url)
    kept.pop("password", None)
    kept.pop("sslpassword", None)
    assert conninfo_to_dict(shown) == kept
