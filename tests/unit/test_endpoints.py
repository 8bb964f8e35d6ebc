"""Endpoints and addresses: malformed ones are reported as such."""

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.record.transport.config import (
    check_endpoint,
    check_endpoints,
    is_loopback,
    parse_address,
)


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tls/robot.local:7448#verify_name_on_connect=false",
        "udp/10.0.0.1:0?rel=0",
        "unixsock-stream//tmp/zenoh.sock",
    ],
)
def test_an_endpoint_passes_unchanged(endpoint: str) -> None:
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("127.0.0.1:7447", "has no protocol"),
        ("", "has no protocol"),
        ("http/127.0.0.1:80", "'http' is no Zenoh protocol"),
        ("tcp/", "has no address"),
        ("tcp/127.0.0.1", "has no port"),
        ("tcp/:7447", "has no port"),
        ("tcp/127.0.0.1:", "'' is no port"),
        ("tcp/127.0.0.1:70000", "'70000' is no port"),
        ("tcp/127.0.0.1:٧", "is no port"),
        ("tcp/127.0.0.1:-1", "'-1' is no port"),
        ("tcp/127.0.0.1:" + "9" * 5_000, "is no port"),
    ],
)
def test_a_malformed_endpoint_is_named(text: str, complaint: str) -> None:
    with pytest.raises(MisuseError) as caught:
        check_endpoint(text)
    assert complaint in str(caught.value)
    assert repr(text) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_order_of_endpoints_is_kept() -> None:
    assert check_endpoints(["tcp/b:1", "tcp/a:2"]) == ("tcp/b:1", "tcp/a:2")


@pytest.mark.parametrize(
    ("text", "address"),
    [("9464", ("127.0.0.1", 9464)), ("0.0.0.0:0", ("0.0.0.0", 0)), ("::1:80", ("::1", 80))],
)
def test_an_address_is_a_port_or_host_and_port(text: str, address: tuple[str, int]) -> None:
    assert parse_address(text, "--metrics") == address


@pytest.mark.parametrize("text", ["", "x", ":1", "host:", "70000", "host:-1", "9" * 5_000])
def test_an_invalid_address_names_the_option(text: str) -> None:
    with pytest.raises(MisuseError, match=f"--metrics {text!r}"):
        parse_address(text, "--metrics")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "[::1]", "localhost"])
def test_loopback_addresses(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "[::]", "192.0.2.1", "example", "localhost.x"])
def test_addresses_other_than_loopback(host: str) -> None:
    assert not is_loopback(host)
