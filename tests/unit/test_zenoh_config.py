"""Listen endpoints and message bound of a session, with and without a configuration file."""

import json
from pathlib import Path

import pytest
import zenoh

from eventsrc.record.transport.config import DEFAULT_ENDPOINT, Mode, ZenohOptions, configure

ELSEWHERE = "tcp/127.0.0.2:0"
ZENOHS_OWN = "{listen: {endpoints: {router: ['tcp/[::]:7447'], peer: ['tcp/[::]:0']}}}"
"""Stands in the example that comes with Zenoh."""


def _configured(
    folder: Path,
    text: str | None,
    mode: Mode,
    listen: tuple[str, ...] = (),
    largest: int | None = None,
) -> zenoh.Config:
    if text is None:
        config, options = zenoh.Config(), ZenohOptions(listen=listen)
    else:
        file = folder / "zenoh.json5"
        file.write_text(text)
        config = zenoh.Config.from_file(file)
        options = ZenohOptions(listen=listen, config_file=file, max_message_bytes=largest)
    configure(config, zenoh.Config(), options, mode)
    return config


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
@pytest.mark.parametrize(
    "text",
    [
        None,
        "{}",
        "{listen: {}}",
        "{mode: 'router', scouting: {multicast: {enabled: false}}}",
        "{transport: {link: {tls: {enable_mtls: true}}}}",
        ZENOHS_OWN,
    ],
)
def test_a_session_listens_on_loopback_or_nowhere_by_default(
    tmp_path: Path, text: str | None, mode: Mode
) -> None:
    listens = json.loads(_configured(tmp_path, text, mode).get_json("listen/endpoints"))
    assert listens == ([DEFAULT_ENDPOINT] if mode == "router" else [])
    assert DEFAULT_ENDPOINT.startswith("tcp/127.0.0.1:")


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
@pytest.mark.parametrize("text", [None, "{}", f"{{listen: {{endpoints: ['{ELSEWHERE}']}}}}"])
def test_endpoints_of_the_command_line_replace_those_of_the_file(
    tmp_path: Path, text: str | None, mode: Mode
) -> None:
    config = _configured(tmp_path, text, mode, ("tcp/127.0.0.3:0",))
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.3:0"]


@pytest.mark.parametrize(
    ("endpoints", "listens"),
    [
        (f"['{ELSEWHERE}']", [ELSEWHERE]),
        ("['tcp/[::]:7447']", ["tcp/[::]:7447"]),
        (f"{{router: ['{ELSEWHERE}']}}", {"router": [ELSEWHERE]}),
        (f"{{peer: ['{ELSEWHERE}']}}", [DEFAULT_ENDPOINT]),
        ("[]", []),
    ],
)
def test_listen_endpoints_of_a_file_are_used(
    tmp_path: Path, endpoints: str, listens: list[str]
) -> None:
    config = _configured(tmp_path, f"{{listen: {{endpoints: {endpoints}}}}}", "router")
    assert json.loads(config.get_json("listen/endpoints")) == listens


@pytest.mark.parametrize(
    ("text", "largest", "size"),
    [
        ("{}", None, 2**30),
        ("{}", 2**27, 2**27),
        ("{transport: {link: {rx: {max_message_size: 77}}}}", 2**27, 77),
    ],
)
def test_a_message_bound_of_a_file_is_used(
    tmp_path: Path, text: str, largest: int | None, size: int
) -> None:
    config = _configured(tmp_path, text, "client", largest=largest)
    assert json.loads(config.get_json("transport/link/rx/max_message_size")) == size


@pytest.mark.parametrize(
    ("text", "mode", "size"),
    [
        ("{}", "client", 2**22),
        ("{}", "peer", 65_535),
        ("{}", "router", 65_535),
        ("{transport: {link: {rx: {buffer_size: 70000}}}}", "client", 70_000),
    ],
)
def test_a_client_uses_its_receive_buffers_again_unless_the_file_says_otherwise(
    text: str, mode: Mode, size: int
) -> None:
    config = zenoh.Config.from_json5(text)
    configure(config, zenoh.Config(), ZenohOptions(), mode)
    assert json.loads(config.get_json("transport/link/rx/buffer_size")) == size
