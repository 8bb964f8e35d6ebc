"""Databases with a map, and what answers questions about them."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools
from tests.support.logs import walk, write_log
from tests.support.services import build

if TYPE_CHECKING:
    from tests.support.services import Service


@pytest.fixture(scope="module")
def walked_map(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> Targets:
    """The map of a walk of 60 keyframes."""
    log = write_log(tmp_path_factory.mktemp("map") / "log", walk(60, seed=3))
    rebuild(log, module_database, Settings())
    return module_database


@pytest.fixture(scope="module")
def described_map(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> Targets:
    """The map of `described_maps`."""
    build(tmp_path_factory.mktemp("described"), module_database)
    return module_database


@pytest.fixture(scope="module")
def service(described_map: Targets) -> Iterator["Service"]:
    """Answers about `described_map`."""
    from tests.support.services import serving_twice  # imports fastapi

    with serving_twice(described_map) as service:
        yield service


@pytest.fixture(scope="module")
def described(service: "Service") -> Any:
    """The description that the service gives of itself."""
    return service.document("/openapi.json")


@pytest.fixture
def pools(walked_map: Targets) -> Iterator[Pools]:
    """Connections to `walked_map`."""
    with Pools(walked_map, 4) as pools:
        yield pools


@pytest.fixture
def answerer(pools: Pools) -> Answerer:
    """Answers about `walked_map`."""
    return Answerer(pools, per_second=10_000.0)


@pytest.fixture
def queue() -> Iterator[FairQueue]:
    """Four threads."""
    with FairQueue(4, max_wait_s=30.0) as queue:
        yield queue
