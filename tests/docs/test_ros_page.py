"""docs/ros.md says what the importer takes."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

from eventsrc.ros.messages import embeddings_of_floats, embeddings_of_text
from tests.support import ros_messages as ros

PAGE = (Path(__file__).parents[2] / "docs" / "ros.md").read_text()
COMMANDS = (Path(__file__).parents[2] / "docs" / "commands.md").read_text()
STAMP = 1774357234_500_000_000


def test_the_example_of_embeddings_is_read() -> None:
    (example,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    read = embeddings_of_text(SimpleNamespace(data=example))
    assert (read.stamp_ns, read.model) == (STAMP, "ViT-B-32/laion2b_s34b_b79k")
    assert read.by_index == ["AACAPwAAAAA=", None]
    (by_id,) = re.findall(r"`(\{\"7\".*?\})`", PAGE)
    named = json.dumps({**json.loads(example), "embeddings": json.loads(by_id)})
    assert embeddings_of_text(SimpleNamespace(data=named)).by_id == {"7": "AACAPwAAAAA="}


def test_the_label_of_a_stamp_is_as_described() -> None:
    (label,) = re.findall(r"`label` \(`([\d.]+)`", PAGE)
    rows = ros.float_rows(STAMP, [[1.0, 0.0]])
    assert rows.layout.dim[0].label == label
    assert embeddings_of_floats(rows).stamp_ns == STAMP


def test_every_option_of_the_page_is_one_of_import() -> None:
    section = COMMANDS.partition("## mapfold import")[2].partition("\n## ")[0]
    named = {*re.findall(r"`(--[a-z-]+)", PAGE.partition("\n## 3")[2].partition("\n## 4")[0])}
    assert len(named) > 10
    assert [option for option in sorted(named) if option not in section] == []
