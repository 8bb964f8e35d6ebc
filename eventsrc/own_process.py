"""Command lines of Python processes of our own, with the modules of this one."""

import json
import sys


def python_command(code: str, *arguments: str) -> list[str]:
    """The command line that runs ``code`` with ``sys.argv[1:]`` as ``arguments``.

    It imports modules from where this process does, and not from the current folder. Unlike
    `multiprocessing` it does not import the caller's main module again.
    """
    entries: list[object] = [*sys.path]
    path = [entry for entry in entries if isinstance(entry, str)]  # as the import system does
    begin = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
    return [sys.executable, "-P", "-c", begin + code, json.dumps(path), *arguments]
