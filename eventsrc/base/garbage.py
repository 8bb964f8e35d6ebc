"""Pause the search for reference cycles while many objects are made that stay."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pause the search for reference cycles: a fold, and commands as they are read and compiled,
    make none and free next to nothing. Also a decorator.

    The search would traverse all records again and again as a map grows, a fifth of the whole time
    of a fold and most of that of reading thousands of commands. Afterwards all objects are in the
    oldest generation, so that the next search skips them.
    """
    was_on = gc.isenabled()
    try:
        gc.disable()
        yield
    finally:
        if was_on:
            gc.freeze()
            gc.unfreeze()
            gc.enable()
