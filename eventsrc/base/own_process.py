"""Command lines of Python processes that import the same modules as this one."""

import json
import sys


def python_command(code: str, *arguments: str) -> list[str]:
    """The command line that runs ``code`` with ``sys.argv[1:]`` as ``arguments``.

    The process has the ``sys.path`` of this one, without the current folder. Unlike
    `multiprocessing` it does not import the caller's main module again.
    """
    entries: list[object] = [*sys.path]
    path = [entry for entry in entries if isinstance(entry, str)]  # as the import system does
    begin = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
    return [sys.executable, "-P", "-c", begin + code, json.dumps(path), *arguments]
