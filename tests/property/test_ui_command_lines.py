"""The command lines that the web debugger gives to be copied, read back by bash."""

import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.surfaces.ui.requests import shell_line

HOSTILE = (
    "'; rm -rf ~ #", "$(reboot)", "`reboot`", "a\x03\nreboot\n", "\x1b[201~\nreboot\n", "-rf", "!!",
    "\u202egnp.exe", "\\'", "\\", "~", "*", "", "a b", "\u2028", "k\u00fcche \U0001f373", "/\udcff",
)  # fmt: skip
WORD = st.one_of(
    st.sampled_from(HOSTILE),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12),
)


def read_back(line: str) -> list[str]:
    """The words that bash makes of it."""
    script = b"printf '%s\\0' " + line.encode("utf-8")
    out = subprocess.run(["bash", "-c", script], capture_output=True, check=True).stdout
    return [word.decode("utf-8", "surrogateescape") for word in out.split(b"\0")[:-1]]


@given(st.lists(WORD, min_size=1, max_size=4))
def test_bash_reads_the_same_words(words: list[str]) -> None:
    assert read_back(shell_line(*words)) == words


@pytest.mark.parametrize("word", HOSTILE)
def test_no_terminal_obeys_it_and_it_shows_what_it_is(word: str) -> None:
    line = shell_line("mapfold", "why", word)
    assert line.isprintable()
    assert read_back(line) == ["mapfold", "why", word]
