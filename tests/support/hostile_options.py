"""Values that no option or argument should be given, for every one that the command tree has."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.docs.commands_page import commands

_NO_DATABASE = "postgresql://127.0.0.1:1/none"
_NO_ADDRESS = "203.0.113.1"
VALUES = (
    *("", " ", "-", "-1", "0", "1e400", "nan", "9" * 5_000, "a" * 5_000, "é" * 200),
    *("fifo", "file", "none/none", "=", ":", "..", "a=b", "1,,2", "1x0", "*/**", "a\n\x1b[2J"),
    b"\xff".decode(errors="surrogateescape"),
)
"""``fifo`` and ``file`` are made by `prepared`."""
_ENDS_SOON = {
    "--db": _NO_DATABASE,
    "--zenoh-config": "none.json5",
    "--host": _NO_ADDRESS,
    "--http": f"{_NO_ADDRESS}:1",
}
"""Options for every command that has them: with these it ends, once it has checked all others."""
_NEEDED = {
    "LOG": "log",
    "DIR|LIST": "fleet",
    "QUERY": "question.json",
    "MODEL.onnx": "file",
    "EXPR": "place_count > 1",
    "W1": "2",
    "A..B": "1..2",
    "OFFSET": "1",
    "SHELL": "bash",
}
"""Values of required arguments and options by their names in ``--help``; of others ``run-a:1``."""
_OPTIONS = {
    "evaluate": ["--self"],
    "simulate": ["--out=drive.jsonl"],
    "draw": ["--out=a.png"],
    "tail": ["--once"],
    "detect": ["--images=fleet", "--detector=file", "--out=d.jsonl"],
}


@contextlib.contextmanager
def prepared(folder: Path) -> Iterator[None]:
    """Make what the values name in ``folder``, where there is a log ``log`` already. The FIFO has a
    reader, since one that is written to waits for that rightly; and no writer."""
    os.mkfifo(folder / "fifo")
    (folder / "file").write_text("{}")
    (folder / "fleet").mkdir()
    (folder / "question.json").write_text('{"crops": [{"class": "cup"}]}')
    reader = os.open(folder / "fifo", os.O_RDONLY | os.O_NONBLOCK)
    try:
        yield
    finally:
        os.close(reader)


def hostile_lines() -> Iterator[list[str]]:
    """Arguments of ``mapfold``, with one of `VALUES` in the place of each option and argument."""
    for name, command in commands():
        valued = [p for p in command.params if not getattr(p, "is_flag", False)]
        for one in [p for p in valued if p.name != "help"]:
            for value in VALUES:
                yield _line(name, command, one, value)


def _line(name: str, command: Any, hostile: Any, value: str) -> list[str]:
    words = ["edit", "log", name.split()[3]] if "LOG" in name else name.split()[1:]
    options, arguments = list(_OPTIONS.get(" ".join(words), ())), []
    for each in command.params:
        is_option = each.param_type_name == "option"
        if each is hostile:
            given = value
        elif each.required:
            given = _NEEDED.get(each.metavar, "run-a:1")
        elif is_option and each.opts[0] in _ENDS_SOON:
            given = _ENDS_SOON[each.opts[0]]
        else:
            continue
        if is_option:
            options.append(f"{each.opts[0]}={given}")
        else:
            arguments.append(given)
    return [*words, *options, "--", *arguments]
