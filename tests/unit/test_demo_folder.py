"""The demo's folder: locked while a demo runs, refused if no demo made it."""

from pathlib import Path

import pytest

from eventsrc.base.errors import MisuseError
from projections.surfaces.demo.recorded_run import fresh_folder


def test_a_second_demo_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    with fresh_folder(tmp_path / "demo") as folder:
        (folder / "log").mkdir()
        with pytest.raises(MisuseError, match="another demo is at work there; wait"):
            fresh_folder(tmp_path / "demo").__enter__()
        assert (folder / "log").is_dir()
    with fresh_folder(tmp_path / "demo") as again:
        assert not (again / "log").exists()


def test_a_folder_that_no_demo_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    with pytest.raises(MisuseError, match="not made by the demo"), fresh_folder(tmp_path):
        raise AssertionError
    assert [path.name for path in tmp_path.iterdir()] == ["log"]
