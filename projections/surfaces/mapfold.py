"""mapfold: a robot's semantic map as a deterministic fold over an append-only log.

The wheel installs this file as the module ``mapfold``; ``python -m mapfold`` is the program.

>>> import mapfold
>>> house = mapfold.fold("logs/sample")
>>> len(house.places), len(house.objects)
(8, 66)
"""

import sys

if __name__ == "__main__":
    from projections.surfaces.cli import main

    sys.argv[0] = "mapfold"
    main()

from projections.surfaces import python as api
from projections.surfaces.python import *  # noqa: F403


def __dir__() -> list[str]:
    return sorted(__all__)


__all__: list[str] = []
__all__ += api.__all__
