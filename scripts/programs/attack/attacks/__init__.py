"""One attack a file; each plays one round in an `Arena`."""

from scripts.programs.attack.arena import Attack

from . import (
    bombs,
    connections,
    damage,
    exports,
    exposure,
    files,
    inputs,
    interrupts,
    junk,
    kills,
    options,
    projections,
    publishers,
    questions,
    requests,
    swaps,
    workers,
)

ATTACKS: dict[str, Attack] = {
    "kills": kills.attack,
    "files": files.attack,
    "interrupts": interrupts.attack,
    "publishers": publishers.attack,
    "junk": junk.attack,
    "damage": damage.attack,
    "bombs": bombs.attack,
    "inputs": inputs.attack,
    "options": options.attack,
    "questions": questions.attack,
    "connections": connections.attack,
    "requests": requests.attack,
    "swaps": swaps.attack,
    "projections": projections.attack,
    "exposure": exposure.attack,
    "workers": workers.attack,
    "exports": exports.attack,
}
"""In the order in which they are played."""
