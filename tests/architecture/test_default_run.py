"""What scripts/test runs by default: some test of every module of tests, and of every command."""

import re
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]
COMMANDS = TESTS.parent / "docs" / "commands.md"
SLOW_AS_A_WHOLE = {
    "acceptance/test_undone_merge.py",
    "chaos/test_edit_kills.py",
    "integration/test_calibrate_kernels.py",
    "integration/test_detect_map.py",
}
"""What a quicker test in another module checks with fewer cases."""
_FUNCTION = re.compile(r"( *)(?:async )?def (\w+)")


def _functions(text: str) -> Iterator[tuple[str, bool, str]]:
    """Name, whether it is marked slow, and lines of each function; what is outside has no name."""
    name, slow, depth, lines, marked = "", False, -1, list[str](), False
    for line in text.splitlines():
        found = _FUNCTION.match(line)
        indent = len(line) - len(line.lstrip())
        ends = line.strip() and indent <= depth and not line.lstrip().startswith(")")
        if (found and indent <= max(depth, 4)) or ends:
            yield name, slow, "\n".join(lines)
            name, slow, depth, lines = "", False, -1, []
        if line.strip() == "@pytest.mark.slow":
            marked = True
        if found and not name:
            name, slow, depth, marked = found[2], marked, indent, False
        lines.append(line)
    yield name, slow, "\n".join(lines)


def _test_modules() -> dict[str, str]:
    files = sorted(TESTS.rglob("test_*.py"))
    return {str(f.relative_to(TESTS)): f.read_text() for f in files if f.parent.name != "ui"}


def test_every_test_module_has_a_test_that_is_not_slow() -> None:
    modules = _test_modules()
    assert len(modules) > 200
    slow = {
        name
        for name, text in modules.items()
        if "def test_" in text
        and all(is_slow for each, is_slow, _ in _functions(text) if each.startswith("test_"))
    }
    assert slow == SLOW_AS_A_WHOLE, "keep one test quick, or name the module above"


def test_what_is_not_even_imported_is_slow() -> None:
    modules = {n: text for n, text in _test_modules().items() if n.startswith("interop/")}
    assert len(modules) > 3
    for name in modules:
        marks = re.search(r"^pytestmark = \[?\s*pytest\.mark\.slow\b", modules[name], re.MULTILINE)
        assert marks, f"{name}: scripts/test does not import it"


def test_every_command_is_run_by_a_test_that_is_not_slow() -> None:
    quick = "\n".join(
        lines
        for text in _test_modules().values()
        for _, slow, lines in _functions(text)
        if not slow
    )
    commands = re.findall(r"^#+ mapfold (.+)$", COMMANDS.read_text(), re.MULTILINE)
    assert len(commands) > 20
    missing = [
        command
        for command in commands
        if ", ".join(f'"{word}"' for word in command.removeprefix("edit LOG ").split()) not in quick
    ]
    assert missing == [], "only slow tests run these commands"


def test_functions_are_told_apart() -> None:
    text = "import x\n@pytest.mark.slow\ndef test_a(\n    x,\n):\n    1\n\ndef test_b():\n    2\n"
    found = [(name, slow) for name, slow, _ in _functions(text) if name]
    assert found == [("test_a", True), ("test_b", False)]
