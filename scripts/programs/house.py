"""Numbers of the source tree, each beside its bound, and of the code that small jobs run through.

A job is a command over a copy of logs/sample, traced in a process of its own: the files and
functions of ours that it calls and its deepest stack, without what imports execute.
"""

import argparse
import ast
import atexit
import json
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from shutil import copytree
from types import FrameType
from typing import Final, NamedTuple

import grimp

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = ("eventsrc", "projections")
TAIL: Final = "projections.postgres.live_tail"
RUN: Final = "from projections.surfaces.cli import main; main()"

SETTINGS: Final = ("--set", "eps_m=0.75", "--set", "min_samples=8")
JOBS: Final = {
    "import of one envelope": ("import", "new", "one.jsonl"),
    "replay of one envelope": ("replay", "one"),
    "relocalize --log": ("relocalize", "one.jsonl", "--log", "log", *SETTINGS),
    "merges": ("merges", "log", *SETTINGS),
    "edit name-place": ("edit", "log", "name-place", "sim-7-a_p0", "bath", "--reason", "so"),
}
MOST_FILES: Final = {
    "replay of one envelope": 60,
    "relocalize --log": 50,
    "merges": 40,
    "edit name-place": 50,
}


class Number(NamedTuple):
    """A measured number; ``most`` is its bound, None without one."""

    what: str
    value: float
    most: float | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--no-jobs", action="store_true", help="leave out the traced jobs")
    parser.add_argument("--trace", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.trace is not None:
        trace(chosen.trace)
        return
    for number in shape():
        bound = "" if number.most is None else f"  of {number.most:g}"
        over = "  over" if number.most is not None and number.value > number.most else ""
        print(f"{number.what:48}{number.value:>10,g}{bound:>11}{over}")
    if not chosen.no_jobs:
        print(f"\n{'job':28}{'files':>8}{'functions':>11}{'stack':>7}{'loaded':>8}")
        for job, files, functions, stack, loaded in jobs():
            bound = f"  of {MOST_FILES[job]} files" if job in MOST_FILES else ""
            print(f"{job:28}{files:>8}{functions:>11}{stack:>7}{loaded:>8}{bound}")


def shape() -> Iterator[Number]:
    files = [path for each in PACKAGES for path in sorted((ROOT / each).rglob("*.py"))]
    texts = {path: path.read_text("utf-8") for path in files}
    lines = {path: len(text.splitlines()) for path, text in texts.items()}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    importing = sum(
        (node.end_lineno or node.lineno) - node.lineno + 1
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
    )
    stems = Counter(path.stem for path in files if not path.stem.startswith("__"))
    classes = Counter(
        node.name
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    importers = {name: graph.find_modules_that_directly_import(name) for name in graph.modules}
    yield Number("modules", len(files), 360)
    yield Number("lines", sum(lines.values()), 69_000)
    yield Number("longest module, lines", max(lines.values()), 400)
    yield Number("modules with one importer", sum(len(of) == 1 for of in importers.values()), 60)
    yield Number("import lines, %", round(100 * importing / sum(lines.values()), 1), 6.5)
    yield Number("longest chain of imports from tail", longest_chain(graph), 16)
    yield Number("file names that repeat", sum(count > 1 for count in stems.values()), 0)
    yield Number("public class names that repeat", sum(count > 1 for count in classes.values()), 0)
    yield Number("lines of tests", _lines("tests", "*.py"))
    yield Number("lines of scripts", _lines("scripts", "*.py"))
    yield Number("words of docs written by hand", _words(), 40_000)


def longest_chain(graph: grimp.ImportGraph) -> int:
    """Modules on the longest chain of imports that begins at `TAIL`. The imports go in no circle
    (a contract of import-linter), but a package and its modules may: an `__init__` is left out."""

    @cache
    def length(name: str) -> int:
        below = (
            each
            for each in graph.find_modules_directly_imported_by(name)
            if not graph.find_children(each)
        )
        return 1 + max(map(length, below), default=0)

    return length(TAIL)


def jobs() -> Iterator[tuple[str, int, int, int, int]]:
    """For each of `JOBS`: its files, functions, deepest stack, and modules of ours loaded."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        copytree(ROOT / "logs" / "sample", work / "log")
        payload = subprocess.run(
            [sys.executable, "-c", RUN, "log", "cat", "log", "--json", "--key", "tb/detections"],
            cwd=work, capture_output=True, check=True, text=True,
        ).stdout.partition("\n")[0]  # fmt: skip
        (work / "one.jsonl").write_text(json.dumps(json.loads(payload)["payload"]) + "\n", "utf-8")
        subprocess.run(
            [sys.executable, "-c", RUN, "import", "one", "one.jsonl"],
            cwd=work, capture_output=True, check=True,
        )  # fmt: skip
        for job, arguments in JOBS.items():
            command = [sys.executable, __file__, "--trace", str(work / "counts"), *arguments]
            subprocess.run(command, cwd=work, capture_output=True, check=True)
            files, functions, stack, loaded = json.loads((work / "counts").read_text("utf-8"))
            yield job, files, functions, stack, loaded


def trace(arguments: list[str]) -> None:
    """Run mapfold with ``arguments[1:]`` and write its counts to the file ``arguments[0]``."""
    roots = tuple(str(ROOT / each) for each in PACKAGES)
    seen: set[tuple[str, str]] = set()
    depths: Counter[int] = Counter()
    deepest = 0

    def profile(frame: FrameType, event: str, _argument: object) -> None:
        nonlocal deepest
        code = frame.f_code
        if not code.co_filename.startswith(roots) or not code.co_flags & 1:  # a body is no function
            return
        thread = threading.get_ident()
        if event == "call":
            seen.add((code.co_filename, code.co_qualname))
            depths[thread] += 1
            deepest = max(deepest, depths[thread])
        elif event == "return":
            depths[thread] -= 1

    def report() -> None:
        sys.setprofile(None)
        loaded = sum(name.partition(".")[0] in PACKAGES for name in sys.modules)
        counts = (len({file for file, _ in seen}), len(seen), deepest, loaded)
        Path(arguments[0]).write_text(json.dumps(counts), "utf-8")

    atexit.register(report)
    sys.argv = ["mapfold", *arguments[1:]]
    threading.setprofile(profile)
    sys.setprofile(profile)
    exec(RUN)


def _lines(folder: str, pattern: str) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in (ROOT / folder).rglob(pattern))


def _words() -> int:
    made = {"commands.md", "licences.md"}
    pages = [path for path in (ROOT / "docs").rglob("*.md") if path.name not in made]
    return sum(len(path.read_text("utf-8").split()) for path in [*pages, ROOT / "README.md"])


if __name__ == "__main__":
    main()
