"""What every Zenoh session of ours is configured to do. It does not import zenoh.

The rules are those at the head of `eventsrc._zenoh`. A configuration file says the rest; the
command line's endpoints go before the file's.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from .endpoints import DEFAULT_ENDPOINT, check_endpoints

Mode = Literal["client", "peer", "router"]

_OPEN_TIMEOUT_MS: Final = 5_000
_LISTEN: Final = "listen/endpoints"
_LARGEST_MESSAGE: Final = "transport/link/rx/max_message_size"


@dataclass(frozen=True, slots=True)
class ZenohOptions:
    """Where to connect, where to listen, and a Zenoh configuration file (JSON5) for the rest.

    ``connect`` and ``listen`` go before what the file says. TLS, access control and scouting are
    the file's business. ``largest_message_bytes`` is for a session that receives from strangers:
    Zenoh drops a message that is larger, unless the file says how large one may be; its own bound
    is 1 GiB, of each of several that may be under way.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config_file: Path | None = None
    largest_message_bytes: int | None = None

    @property
    def mode(self) -> Literal["client", "peer"]:
        """What a recorder or a publisher is with these options: a peer if others may call it."""
        return "peer" if self.listen else "client"


class Config(Protocol):
    """The two methods of zenoh.Config that are needed; keys are paths, values JSON5."""

    def get_json(self, key: str) -> Any: ...
    def insert_json5(self, key: str, value: Any) -> None: ...


def configure(config: Config, zenoh: Config, options: ZenohOptions, mode: Mode) -> None:
    """Apply ``options`` and the rules to ``config``, which is the file's or else like ``zenoh``,
    what Zenoh itself says where nobody does. Raises MisuseError for a bad endpoint."""
    connect, listen = check_endpoints(options.connect), check_endpoints(options.listen)
    if not connect and mode == "client" and _is_unset(config, "connect/endpoints"):
        connect = (DEFAULT_ENDPOINT,)
    _set(config, "mode", mode)
    _set(config, "transport/shared_memory/enabled", False)
    if connect:
        _set(config, "connect/endpoints", connect)
    if listen or not _says_where_to_listen(config, zenoh, mode):
        # Zenoh's own routers would listen on every address of the machine, to anybody.
        nowhere_else = (DEFAULT_ENDPOINT,) if mode == "router" else ()
        _set(config, _LISTEN, listen or nowhere_else)
    largest = options.largest_message_bytes
    if largest and config.get_json(_LARGEST_MESSAGE) == zenoh.get_json(_LARGEST_MESSAGE):
        _set(config, _LARGEST_MESSAGE, largest)
    _configure_scouting(config)
    if mode == "peer":  # a router starts before the routers it is linked to; a peer's error counts
        _set(config, "connect/exit_on_failure", True)
        _set(config, "connect/timeout_ms", _OPEN_TIMEOUT_MS)
    if mode == "router":
        _set(config, "adminspace/enabled", True)  # where a router's real locators come from


def _configure_scouting(config: Config) -> None:
    """Off unless the file turns it on; and then no half second's wait for answers nobody gives."""
    if _is_unset(config, "scouting/multicast/enabled"):
        _set(config, "scouting/multicast/enabled", False)
    scouts = json.loads(config.get_json("scouting/multicast/enabled"))
    if not scouts and _is_unset(config, "scouting/delay"):
        _set(config, "scouting/delay", 0)


def _says_where_to_listen(config: Config, zenoh: Config, mode: Mode) -> bool:
    """Whether the file does, for this mode. One that says what Zenoh says anyway, as a copy of its
    example does, counts as one that says nothing."""
    if config.get_json(_LISTEN) == zenoh.get_json(_LISTEN):
        return False
    endpoints = json.loads(config.get_json(_LISTEN))
    return not isinstance(endpoints, dict) or mode in endpoints


def _set(config: Config, key: str, value: object) -> None:
    config.insert_json5(key, json.dumps(value))


def _is_unset(config: Config, key: str) -> bool:
    return json.loads(config.get_json(key)) in (None, [])
