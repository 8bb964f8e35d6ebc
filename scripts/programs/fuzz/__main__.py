"""Fuzzes targets one after the other, each in a process of its own: see `scripts.programs.fuzz`."""

import argparse
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from scripts.programs.fuzz.targets import TARGETS

ROOT = Path(__file__).parents[3]
MEMORY_LIMIT_MB = 600
SECONDS_AN_INPUT = 10
MAX_BYTES = 16_384


def main(arguments: Sequence[str] | None = None) -> int:
    """0 when no input did harm."""
    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=__doc__)
    parser.add_argument("--seconds", type=int, default=600, help="for each target")
    parser.add_argument("--folder", type=Path, default=ROOT / ".fuzz", help="inputs are kept there")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=", ".join(TARGETS))
    args = parser.parse_args(arguments)
    if unknown := set(args.targets) - TARGETS.keys():
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    harmed = [_fuzz(name, args.seconds, args.folder) for name in args.targets or TARGETS]
    return 1 if any(harmed) else 0


def _fuzz(name: str, seconds: int, folder: Path) -> bool:
    """Whether an input did harm: an error, too much time or memory. It stops at the first."""
    corpus = folder / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(TARGETS[name].seeds()):
        (corpus / f"seed-{number}").write_bytes(seed)
    command = [
        *(sys.executable, "-m", "scripts.programs.fuzz.guided", name, str(corpus)),
        *(f"-max_total_time={seconds}", f"-timeout={SECONDS_AN_INPUT}", f"-max_len={MAX_BYTES}"),
        *(f"-rss_limit_mb={MEMORY_LIMIT_MB}", f"-artifact_prefix={folder / name}/"),
    ]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        said = process.stdout.read()  # errors of Python go there, the rest to stderr
    (folder / name / "last.log").write_text(said)
    inputs = max(map(int, re.findall(r"^#(\d+)\t", said, re.MULTILINE)), default=0)
    harmed = process.returncode != 0
    shown = f"HARM, see {folder / name / 'last.log'}" if harmed else "no harm"
    print(f"{name:<10} {inputs:>12,} inputs  {shown}", flush=True)
    return harmed


if __name__ == "__main__":
    sys.exit(main())
