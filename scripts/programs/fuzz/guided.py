"""Run one target under atheris, guided by coverage.

python -m scripts.programs.fuzz.guided TARGET CORPUS [libFuzzer options]
"""

import random
import sys

import atheris

with atheris.instrument_imports(include=["eventsrc", "projections", "mcap"]):
    from scripts.programs.fuzz.targets import TARGETS


def main() -> None:
    """Never returns: libFuzzer ends the process."""
    target = TARGETS[sys.argv.pop(1)]

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.2:
            return bytes(atheris.Mutate(data, max_size))
        return target.mutate(data, rng)[:max_size]

    atheris.Setup(sys.argv, target.check, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
