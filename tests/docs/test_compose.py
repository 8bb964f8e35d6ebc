"""docker/compose.yaml and Dockerfile, as far as they can be checked without an engine."""

import re
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from projections.surfaces.cli import command_line

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = ROOT / "docker" / "compose.yaml"
SERVICES = {
    "demo-world", "zenoh-router", "zenoh-bridge", "detector", "recorder", "embedding-ingest",
    "graph-builder", "vector", "age", "tools",
}  # fmt: skip


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    found = yaml.safe_load(COMPOSE.read_text("utf-8"))
    assert isinstance(found, dict)
    return found


def test_the_services_people_know(compose: dict[str, Any]) -> None:
    assert set(compose["services"]) == SERVICES
    assert compose["services"]["age"]["ports"] == ["127.0.0.1:5435:5432"]
    assert compose["services"]["vector"]["ports"] == ["127.0.0.1:5436:5432"]


def test_images_are_pinned(compose: dict[str, Any]) -> None:
    for name, service in compose["services"].items():
        image = re.sub(r"\$\{\w+:-(.*)\}", r"\1", service["image"])
        tag = image.partition(":")[2]
        assert re.search(r"\d+\.\d+", tag), name
    base = re.search(r"^FROM (\S+)$", (ROOT / "docker/Dockerfile").read_text(), re.MULTILINE)
    assert base is not None
    assert re.search(r":\d+\.\d+\.\d+", base[1])


def test_services_waited_for_exist_and_have_health_checks(compose: dict[str, Any]) -> None:
    services = compose["services"]
    waited = [(n, d, c) for n, s in services.items() for d, c in s.get("depends_on", {}).items()]
    assert waited
    for name, dependency, how in waited:
        assert how == {"condition": "service_healthy"}, name
        assert "healthcheck" in services[dependency], f"{name} waits for {dependency}"


def test_whatever_runs_for_long_says_whether_it_is_well(compose: dict[str, Any]) -> None:
    """But for what runs once, and the image that is not ours to ask."""
    without = {n for n, s in compose["services"].items() if "healthcheck" not in s}
    assert without == {"demo-world", "tools", "zenoh-bridge"}


def test_a_tail_is_asked_where_it_serves(compose: dict[str, Any]) -> None:
    for name in ("embedding-ingest", "graph-builder", "detector"):
        service = compose["services"][name]
        port = service["command"][-1].rpartition(":")[2]
        assert f"http://127.0.0.1:{port}/metrics" in service["healthcheck"]["test"][-1]


def test_volumes_are_declared(compose: dict[str, Any]) -> None:
    mounts = [v for s in compose["services"].values() for v in s.get("volumes", ())]
    folders = [mount for mount in mounts if mount.startswith("${MODELS:-./models}:")]
    assert len(folders) == 1
    used = {mount.partition(":")[0] for mount in mounts if mount not in folders}
    assert used == set(compose["volumes"]) == {"logs", "age", "vector"}


def test_every_mapfold_command_exists_with_its_options(compose: dict[str, Any]) -> None:
    root = typer.main.get_command(command_line())
    checked = 0
    for name, service in compose["services"].items():
        if not service["image"].startswith("mapfold"):
            continue
        words = [re.sub(r"\$\{\w+:-(.*)\}", r"\1", word) for word in service["command"]]
        command = root.commands[words[0]]  # type: ignore[attr-defined]
        context = command.make_context(words[0], list(words[1:]), resilient_parsing=False)
        assert context.params, name
        checked += 1
    assert checked == 7


def test_the_image_holds_what_the_package_needs() -> None:
    text = (ROOT / "docker/Dockerfile").read_text()
    for name in ("pyproject.toml", "README.md", "LICENSE", "eventsrc", "projections"):
        assert name in text
        assert (ROOT / name).exists()
    ignored = (ROOT / "docker/Dockerfile.dockerignore").read_text().split()
    for name in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE):
        assert {f"!{each}" for each in name.split()} <= set(ignored)
    assert 'ENTRYPOINT ["mapfold"]' in text
    assert "USER 10001" in text
