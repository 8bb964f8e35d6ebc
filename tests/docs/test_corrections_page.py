"""docs/corrections.md names every kind of command; that its story runs is tested with the other
documents."""

import re

from eventsrc.envelope.commands import KINDS, MAX_COMMAND_BYTES, MAX_REASON
from eventsrc.envelope.trajectory import MAX_POSES
from projections.edit.correct_poses import DEFAULT_SLACK_S
from tests.docs.console import ROOT

PAGE = (ROOT / "docs" / "corrections.md").read_text("utf-8")


def test_it_names_every_kind() -> None:
    for kind in KINDS:
        assert re.search(rf"^\| `{kind} ", PAGE, re.MULTILINE), kind


def test_the_story_ends_with_the_digest_it_began_with() -> None:
    digests = re.findall(r"state logs/mine --digest\n([0-9a-f]{64})\n", PAGE)
    assert len(digests) == 2
    assert digests[0] == digests[1]


def test_its_limits_are_those_of_the_code() -> None:
    assert f"`--slack` ({DEFAULT_SLACK_S:g} s)" in PAGE
    assert f"up to {MAX_REASON:,} characters" in PAGE
    assert MAX_POSES == 1_000_000
    assert f"at most {MAX_COMMAND_BYTES // 2**20} MiB" in PAGE
