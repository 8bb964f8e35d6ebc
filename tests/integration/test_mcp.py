"""`mapfold mcp`, asked with the official client over stdio and HTTP."""

import json
import re
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.commands import UseSettings
from eventsrc.log import LogReader
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.serve import Pools
from tests.support.commands import Commands
from tests.support.http_attacks import ask, request, status
from tests.support.logs import append_command, command, write_log
from tests.unit.test_moved_things import ROOM, run
from tests.unit.test_what_changed import LATER, SETTINGS

pytest.importorskip("mcp", reason="the extra [mcp] is not installed")

READS = {
    *("find", "room", "changes", "nearest", "path", "goal", "why", "where_am_i", "state"),
}
TOKEN = "0123456789abcdef-not-a-secret"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write_log(tmp_path / "log", run("a", ROOM))
    append_command(tmp_path / "log", command(UseSettings, settings={"fusion": "evidence"}))
    return tmp_path / "log"


@pytest.fixture
def server(log: Path) -> Iterator[Any]:
    """A server in this process that may only read."""
    from projections.surfaces.mcp.agent_server import create_server
    from projections.surfaces.mcp.cited_maps import LogMaps

    with LogMaps(log, _settings) as maps:
        yield create_server(maps)


def _settings(known: Any) -> Any:
    return known.settings


@pytest.mark.seconds
def test_over_stdio(log: Path) -> None:
    from tests.support.agents import asked, over_stdio

    async def ask_all(client: Any) -> tuple[Any, ...]:
        tools = (await client.list_tools()).tools
        resources = (await client.list_resources()).resources
        read = [(await client.read_resource(str(each.uri))).contents[0] for each in resources]
        return tools, read, await client.call_tool("find", {"what": "chairs"})

    tools, (summary, picture), found = asked(over_stdio(log), ask_all)
    assert {each.name for each in tools} == READS
    assert all(each.annotations.read_only_hint and each.description for each in tools)
    by_command = Commands.in_folder(log.parent)("find", log, "chairs", "--json").json
    document = found.structured_content
    assert document["answer"] == by_command
    assert document["offsets"] == by_command["answers"][0]["offsets"]
    state = Commands.in_folder(log.parent)("state", log, "--json").json
    assert document["map"]["digest"] == state["digest"]
    assert document["map"]["offset"] == state["offset"]
    assert json.loads(found.content[0].text) == document
    assert f"digest   {state['digest']}" in summary.text
    assert picture.mime_type == "image/png"


@pytest.mark.seconds
@pytest.mark.slow
def test_over_http_only_those_ask_who_may(log: Path) -> None:
    from tests.support.agents import tool, with_token
    from tests.support.http_attacks import Served

    args = ("mcp", str(log), "--http", "127.0.0.1:0")
    service = Served(*args, MAPFOLD_TOKEN=TOKEN)
    try:
        url = f"http://127.0.0.1:{service.port}/mcp"
        by_command = Commands.in_folder(log.parent)("room", log, "p0", "--json").json
        assert tool(with_token(url, TOKEN), "room", name="p0")["answer"] == by_command
        body, sent = b"{}", {"Authorization": f"Bearer {TOKEN}"}
        for headers, refused in (
            ({}, 401),
            ({"Authorization": "Bearer wrong"}, 401),
            ({**sent, "Host": "evil.example"}, 421),
            ({**sent, "Origin": "http://evil.example"}, 403),
        ):
            got = ask(service.port, request("POST", "/mcp", body, headers))
            assert status(got) == refused, got
    finally:
        service.program.send_signal(signal.SIGINT)
        assert service.end() == 0, service.text
    assert "Traceback" not in service.text


HOSTILE: list[tuple[str, dict[str, Any], str]] = [
    ("find", {"what": "xyzzy"}, "no class like"),
    ("find", {"waht": "chair"}, "no argument 'waht'"),
    ("find", {"what": 7}, "what"),
    ("find", {"what": "x" * 100_000}, "at most 256"),
    ("find", {"top": 10**9}, "less than or equal"),
    ("find", {"near": "nan,inf"}, "no place or object"),
    ("find", {"at": "-1"}, "-1"),
    ("find", {"at": "9999999999999999999999"}, "99999"),
    ("find", {"seen_since": "'; DROP TABLE x; --"}, "is no time"),
    ("room", {}, "name"),
    ("room", {"name": "../../etc/passwd"}, "no place"),
    ("room", {"name": "\x00\x1b[31m\ud7ff"}, "no place"),
    ("path", {"start": "0,0", "end": "tv", "clearance": -1}, "clearance"),
    ("path", {"start": "0,0", "end": "tv", "clearance": "NaN"}, "clearance"),
    ("goal", {"thing": "nothing"}, "no class like"),
    ("why", {"thing": "p99"}, "p99"),
    ("why", {"thing": "a:1", "other": "a:99999"}, "99999"),
    ("changes", {"since": "b"}, "no run"),
    ("where_am_i", {"crops": []}, "crops"),
    ("where_am_i", {"crops": [{"class": "chair", "bbox": "boo"}]}, "bbox"),
    ("where_am_i", {"crops": [{"embedding": "AAAA"}]}, "embedding"),
    ("where_am_i", {"crops": [{"class": "chair"}], "camera": {"hfov_deg": 900}}, "camera"),
    ("state", {"parts": ["secrets"]}, "parts"),
    ("state", {"first": -1}, "first"),
    ("name_a_place", {"place": "p0", "name": "x", "reason": "y"}, "name_a_place"),
    ("no_such_tool", {}, "no_such_tool"),
]


def test_hostile_arguments_get_errors_and_nothing_is_written(server: Any, log: Path) -> None:
    from mcp.shared.exceptions import MCPError

    from tests.support.agents import asked, text_of

    async def ask_all(client: Any) -> list[str]:
        said = []
        for name, arguments, _ in HOSTILE:
            try:
                found = await client.call_tool(name, arguments)
                assert found.is_error, name
                said.append(text_of(found))
            except MCPError as error:
                said.append(str(error))
        return said

    before = {file: file.read_bytes() for file in log.iterdir()}
    for (name, arguments, part), said in zip(HOSTILE, asked(server, ask_all), strict=True):
        assert part in said, (name, arguments, said)
        assert "Traceback" not in said
        assert said != f"Error executing tool {name}", "an unexpected exception"
        assert len(said) < 2_000
    assert {file: file.read_bytes() for file in log.iterdir()} == before


def test_a_growing_log_is_followed(server: Any, log: Path) -> None:
    from tests.support.agents import tool

    before = tool(server, "find", what="chair")
    write_log(log, run("b", LATER))
    after = tool(server, "find", what="chair")
    assert after["map"]["offset"] > before["map"]["offset"]
    assert after["map"]["digest"] != before["map"]["digest"]
    assert after["answer"]["answers"][0]["last_seen"]["run_id"] == "b"
    past = tool(server, "find", what="chair", at=str(before["map"]["offset"]))
    assert past == before
    why = tool(server, "why", thing="p0")
    assert why["answer"]["entries"]
    assert why["offsets"]


def test_a_robot_that_sees_things_is_found(server: Any) -> None:
    from tests.support.agents import tool

    found = tool(server, "where_am_i", crops=[{"class": "chair"}, {"class": "table"}])
    assert found["answer"]["places"][0]["place_id"] == "a_p0"
    assert found["offsets"]
    camera = {"hfov_deg": 60.0, "width_px": 640.0, "height_px": 480.0}
    boxed = [{"class": "chair", "bbox": [10.0, 200.0, 90.0, 300.0]}]
    poses = [tool(server, "where_am_i", crops=boxed, camera=c)["answer"] for c in (None, camera)]
    assert poses[1]["pose"] != poses[0]["pose"]
    nearest = tool(server, "nearest", near="6.0,1.5", top=1)["answer"]["answers"]
    assert [each["class_name"] for each in nearest] == ["tv"]
    state = tool(server, "state", parts=["objects"], limit=1, first=1)["answer"]
    assert len(state["objects"]) == 1
    assert "places" not in state


def test_edits_are_allowed_only_with_a_reason(log: Path) -> None:
    from projections.surfaces.mcp.agent_server import create_server
    from projections.surfaces.mcp.cited_maps import LogMaps
    from tests.support.agents import called, text_of, tool

    def no_session() -> Any:
        raise AssertionError("the log is free")

    with LogMaps(log, _settings, issued_by="agent@test", open_session=no_session) as maps:
        writer = create_server(maps, allow_edits=True)
        place = {"place": "p0", "name": "parlour"}
        for wrong in (place, {**place, "reason": ""}, {**place, "reason": "  "}):
            refused = called(writer, "name_a_place", wrong)
            assert refused.is_error
            assert "reason" in text_of(refused)
        done = tool(writer, "name_a_place", **place, reason="a person said so")
        assert tool(writer, "room", name="parlour")["answer"]["name"] == "parlour"
        undone = done["answer"]["command_id"]
        tool(writer, "undo_a_command", command_id=undone, reason="it was a mistake")
        assert called(writer, "room", {"name": "parlour"}).is_error
    with closing(LogReader(log)) as reader:
        last = [json.loads(each.payload) for each in reader.read(done["answer"]["offset"])]
    assert [each["reason"] for each in last] == ["a person said so", "it was a mistake"]
    assert {each["issued_by"] for each in last} == {"agent@test"}


def test_the_databases_have_one_map(log: Path, one_database: Targets) -> None:
    from projections.surfaces.mcp.agent_server import create_server
    from projections.surfaces.mcp.cited_maps import LiveMaps
    from tests.support.agents import called, text_of, tool

    rebuild(log, one_database, SETTINGS)
    with Pools(one_database, 2) as pools:
        live = create_server(LiveMaps(pools))
        by_command = Commands.in_folder(log.parent)("find", log, "chairs", "--json").json
        found = tool(live, "find", what="chairs")
        assert found["answer"] == by_command
        assert found["map"]["digest"] is None
        with closing(LogReader(log)) as reader:
            assert found["map"]["log_id"] == reader.log_id
        assert tool(live, "state", parts=["objects"])["answer"]["counts"]["objects"] > 0
        assert tool(live, "where_am_i", crops=[{"class": "chair"}])["answer"]["places"]
        for name, arguments in (
            ("changes", {}),
            ("why", {"thing": "p0"}),
            ("find", {"at": "3"}),
        ):
            refused = called(live, name, arguments)
            assert refused.is_error
            assert re.search("only by the log; give LOG", text_of(refused))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give a LOG, or --db URL"),
        (("log", "--db", ""), "give a LOG, or --db URL"),
        (("--db", "", "--allow-edits"), "--allow-edits records commands in a log"),
        (("log", "--token-file", "x"), "--token-file is for HTTP"),
        (("log", "--http", "nowhere"), "write it as HOST:PORT"),
        (("nothing-there",), "nothing-there"),
    ],
)
def test_options_that_do_not_fit_are_misuse(log: Path, words: tuple[str, ...], said: str) -> None:
    refused = Commands.in_folder(log.parent)("mcp", *words, code=None)
    assert refused.code in (1, 2)
    assert said in refused.err
