"""The browser and the pages of these tests. Without chromium or playwright they are left out, but
not under scripts/test_ui, which sets ``MAPFOLD_TEST_UI``."""

import importlib.util
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from shutil import copytree
from typing import TYPE_CHECKING

import pytest

from tests.support import logs
from tests.support.commands import Commands
from tests.support.shared_data import ROOT
from tests.support.ui_page import UiServer, showing

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ALL = "MAPFOLD_TEST_UI" in os.environ
"""Whether nothing may be left out."""

if importlib.util.find_spec("playwright") is not None or ALL:
    from tests.ui.browser import browser, opened, program

    if program() is None and not ALL:
        collect_ignore_glob = ["test_*.py"]
else:
    collect_ignore_glob = ["test_*.py"]

WIDE = ("--set", "eps_m=1.0", "--set", "min_samples=8")
SAMPLE = logs.sample_drive()
SIZES = {"small": (1280, 720), "large": (1920, 1080), "tablet": (820, 1180), "phone": (390, 844)}
SCHEMES = {"small": "light", "large": "dark", "tablet": "dark", "phone": "light"}
"""The colours in which a test of all sizes opens the page, so that both are seen."""
Visit = Callable[..., "Page"]


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator["Browser"]:
    with browser(tmp_path_factory.mktemp("chromium")) as started:
        yield started


@pytest.fixture(scope="session")
def mapfold(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    return Commands.in_folder(tmp_path_factory.mktemp("mapfold"))


@pytest.fixture(scope="session")
def sample(mapfold: Commands) -> Iterator[UiServer]:
    """The sample log under the settings of docs/time-travel.md."""
    with showing(mapfold, SAMPLE, *WIDE) as server:
        yield server


@pytest.fixture(scope="session")
def rooms(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    """A copy of logs/sample under its own settings: walls, and rooms with types."""
    with showing(
        mapfold, copytree(logs.SAMPLE, tmp_path_factory.mktemp("rooms") / "sample")
    ) as server:
        yield server


@pytest.fixture
def visit(chromium: "Browser") -> Iterator[Visit]:
    """Opens a server's page; at the end nothing must have gone wrong in it: no error in the
    console, nothing asked of another host."""
    faults: list[str] = []
    with ExitStack() as stack:

        def visited(
            server: UiServer, moment: str = "", *, wait: bool = True, **options: object
        ) -> "Page":
            origin = f"http://127.0.0.1:{server.port}"
            options.setdefault("viewport", {"width": 1280, "height": 720})
            context = chromium.new_context(accept_downloads=True, **options)  # type: ignore[arg-type]
            stack.callback(context.close)
            page = context.new_page()
            page.on("pageerror", lambda error: faults.append(f"error: {error}"))
            page.on("console", lambda said: faults.append(said.text) if _is_fault(said) else None)
            page.on("request", lambda r: None if _is_own(r.url, origin) else faults.append(r.url))
            query = "" if server.token is None else f"?token={server.token}"
            url = f"{origin}/{query}{moment}"
            if wait:
                return opened(page, url)
            page.goto(url)
            return page

        yield visited
        assert faults == []


def _is_fault(said: object) -> bool:
    # A refused question is told to the person; the console names it too.
    text = getattr(said, "text", "")
    return (
        getattr(said, "type", "") in ("error", "warning") and "Failed to load resource" not in text
    )


def _is_own(url: str, origin: str) -> bool:
    return url.startswith((f"{origin}/", f"blob:{origin}/", "about:"))


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Where screenshots go: ``build/ui-pictures``, where a person may look at them."""
    folder = ROOT / "build" / "ui-pictures"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
