"""Types of places: kitchen, office, bathroom …, from the classes of their Objects.

Naive Bayes over `TABLE`: all types have the same prior, and each class in the place
contributes the ratio of its frequencies in rooms of each type. For n Objects of a class the ratio
is taken to the power √n, since six chairs are hardly more evidence than three; an Object that was
observed once is often a phantom or a wrong label and counts a quarter. Absent classes are no
evidence, since the robot may not have looked there. The sum is tempered by `_TEMPER`, and more
where there is more than `_MOST_WEIGHT` of it, because classes are not independent: this calibrates
the probabilities.

Below `UNSURE` the answer is unsure. A name given to the place by a command that has a type's name
in it ("kitchen", "2nd floor office") decides, whatever is in the place.

Everything is bit-exact: one order, +, −, ×, √ and `exact`'s functions; probabilities are rounded to
three digits.

Source of the table. In which rooms of a home a class belongs follows the placement annotations of
ProcTHOR (Deitke et al., "ProcTHOR: Large-Scale Embodied AI Using Procedural Generation", NeurIPS
2022; github.com/allenai/procthor, Apache License 2.0), which rate about a hundred classes for
kitchens, living rooms, bedrooms and bathrooms as never, sometimes or often. Those ratings say where
a thing may stand, not in what share of rooms it does: the shares, the other types and the classes
that ProcTHOR does not have are estimates of our own.
docs/decisions/place-types.md has its accuracy.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Final

from .exact import exp, log

SHARES: Final = (0.007, 0.05, 0.2, 0.5, 0.9)
"""The grades; the first one is that of classes not named for a type."""

_ROOMS: Final = """
kitchen: kitchenette, pantry
90 % refrigerator, oven, stove, range hood, microwave, kitchen cabinet, sink
50 % dishwasher, toaster, kettle, coffee machine, faucet, pan, pot, plate, knife, fork, spoon,
  bowl, cup, bottle, apple, banana, orange, bread, trash can, cabinet
20 % wine glass, dining table, chair, stool, clock, soap, washing machine
5 % tv, curtain, lamp, picture, vase, potted plant, towel, fire extinguisher, book, shelf, table,
  bucket

dining room: dining, canteen
90 % dining table, chair
50 % plate, cup, wine glass
20 % knife, fork, spoon, bowl, bottle, curtain, lamp, picture, vase, potted plant, cabinet, table
5 % refrigerator, kettle, coffee machine, kitchen cabinet, apple, banana, orange, bread, stool,
  fireplace, clock, laptop, vending machine, bench, bookshelf

living room: sitting room, lounge
90 % couch, coffee table, tv
50 % armchair, side table, tv stand, remote, lamp, picture, potted plant
20 % chair, ottoman, fireplace, pillow, curtain, clock, vase, laptop, book, bookshelf, shelf,
  cabinet, table
5 % plate, bowl, cup, bottle, wine glass, dining table, stool, dresser, teddy bear, mirror, desk,
  stairs, trash can, backpack, box

bedroom: guest room, suite
90 % bed
50 % nightstand, wardrobe, dresser, pillow, curtain, lamp, picture
20 % chair, tv, teddy bear, alarm clock, suitcase, clock, potted plant, mirror, desk, laptop,
  book, laundry basket, backpack
5 % bowl, cup, bottle, stool, couch, armchair, ottoman, side table, tv stand, remote, vase, hair
  drier, office chair, monitor, keyboard, mouse, drawer unit, coat rack, shoe rack, trash can,
  bookshelf, shelf, cabinet, ironing board, box, vacuum cleaner

bathroom: restroom, washroom, toilet, wc
90 % sink, toilet, towel, toilet paper, mirror
50 % faucet, bathtub, shower, shower curtain, soap, toothbrush, trash can
20 % bottle, hair drier, cabinet, washing machine, laundry basket
5 % dresser, curtain, lamp, picture, potted plant, shelf, clothes dryer, bucket

office: study
90 % desk, office chair, monitor
50 % chair, potted plant, keyboard, mouse, laptop, printer, drawer unit, trash can
20 % coffee machine, cup, lamp, picture, clock, telephone, whiteboard, book, bookshelf, shelf,
  cabinet
5 % refrigerator, microwave, kettle, bottle, couch, armchair, tv, curtain, coat rack, table,
  backpack, box

meeting room: conference room, boardroom
90 % chair, conference table
50 % tv, whiteboard, projector, projector screen
20 % picture, clock, potted plant, office chair, laptop, trash can, table
5 % coffee machine, cup, bottle, couch, curtain, lamp, monitor, telephone, cabinet

hall: hallway, corridor, entrance, staircase
50 % picture, bench, coat rack, shoe rack, stairs, fire extinguisher
20 % lamp, potted plant, mirror, sign, umbrella stand, wheelchair
5 % chair, armchair, side table, wardrobe, dresser, suitcase, clock, vase, vending machine, trash
  can, backpack, cart, vacuum cleaner, medical trolley

reception: lobby, foyer, waiting room
90 % reception desk
50 % couch, armchair, side table, potted plant, sign
20 % chair, coffee table, tv, lamp, picture, clock, desk, telephone, vending machine, bench, trash
  can
5 % coffee machine, stool, ottoman, vase, mirror, office chair, monitor, keyboard, mouse, printer,
  umbrella stand, coat rack, stairs, fire extinguisher, book, table, wheelchair

laundry room: laundry
90 % washing machine, clothes dryer
50 % sink, laundry basket, ironing board
20 % faucet, towel, cabinet, bucket, vacuum cleaner
5 % refrigerator, dishwasher, kitchen cabinet, bottle, soap, trash can, shelf, box, ladder, cart

storage room: storage, store room, storeroom, warehouse
90 % shelf, box, pallet
50 % pallet jack, forklift, ladder, bucket, cart, vacuum cleaner
20 % fire extinguisher, cabinet
5 % refrigerator, suitcase, toilet paper, drawer unit, sign, trash can, ironing board

patient room: ward
90 % bed, hospital bed
50 % chair, pillow, curtain, trash can, overbed table, iv stand, medical trolley
20 % armchair, tv, nightstand, clock, monitor, cabinet, cart, wheelchair
5 % sink, faucet, cup, bottle, stool, side table, remote, wardrobe, lamp, picture, towel, soap,
  mirror, telephone, table

library: reading room
90 % book, bookshelf
50 % chair
20 % couch, armchair, lamp, desk, shelf, table
5 % stool, coffee table, picture, clock, potted plant, monitor, keyboard, mouse, laptop, printer,
  bench, trash can, backpack
"""
"""A paragraph for each type: other names that people give such rooms, and by share of them in
percent the classes that they have at least one of."""

_OTHER_NAMES: Final = """
couch: sofa; tv: television, tv monitor; refrigerator: fridge; stove: cooker, cooktop; range hood:
extractor hood; bookshelf: bookcase; potted plant: houseplant, plant; picture: painting; trash
can: garbage can, waste bin, bin; nightstand: night stand, bedside table; wardrobe: closet;
dresser: chest of drawers; bathtub: bath; faucet: water tap; remote: remote control; monitor:
computer, computer monitor; keyboard: computer keyboard; mouse: computer mouse; drawer unit:
filing cabinet; conference table: meeting table; dining table: kitchen table; box: cardboard box;
clothes dryer: tumble dryer; laundry basket: hamper; coffee machine: coffee maker; cup: mug;
medical trolley: medical cart; cabinet: metal cabinet; shelf: storage rack, rack
"""
"""Classes, and other names of them."""


def _read_rooms() -> tuple[dict[str, str], dict[str, tuple[float, ...]]]:
    """Types by their names, and by class the share of the rooms of each type that have one."""
    types: dict[str, str] = {}
    share_of: dict[str, dict[str, float]] = {}
    rooms = [re.split(r"\n(\d+) % ", paragraph) for paragraph in _ROOMS.strip().split("\n\n")]
    for head, *graded in rooms:
        room, _, others = head.partition(": ")
        types |= dict.fromkeys([room, *filter(None, others.split(", "))], room)
        for percent, classes in zip(graded[::2], graded[1::2], strict=True):
            for name in " ".join(classes.split()).split(", "):
                share_of.setdefault(name, {})[room] = int(percent) / 100
    kinds = dict.fromkeys(types.values())
    return types, {
        name: tuple(shares.get(room, SHARES[0]) for room in kinds)
        for name, shares in share_of.items()
    }


_names, _table = _read_rooms()
NAMES: Final[Mapping[str, str]] = MappingProxyType(_names)
"""Types by what people call such rooms."""
TYPES: Final = tuple(dict.fromkeys(NAMES.values()))
"""The types; every row of `TABLE` has their order."""
TABLE: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(_table)
"""By class, for each of `TYPES`, the share of rooms of the type that have one."""
SYNONYMS: Final[Mapping[str, str]] = MappingProxyType(
    {
        other: name
        for name, _, others in (
            each.partition(": ") for each in " ".join(_OTHER_NAMES.split()).split("; ")
        )
        for other in others.split(", ")
    }
)
"""Classes by other names of them."""


UNSURE: Final = 0.5
ONCE: Final = 0.25
"""The weight of an Object with one observation."""
_TEMPER: Final = 0.6
_MOST_WEIGHT: Final = 4.0
"""The greatest total weight of all classes: a place with everything is no room."""
_MOST_SHOWN: Final = 3
_LEAST_SHOWN: Final = 0.05


@dataclass(frozen=True, slots=True)
class PlaceType:
    """``type`` is None where it is unsure; ``probability`` is that of the likeliest one.
    ``candidates`` are the likeliest, at most three, with their probabilities. ``named`` is whether
    the place's name decided."""

    type: str | None
    probability: float
    candidates: tuple[tuple[str, float], ...]
    named: bool = False


def place_type(counts: Mapping[str, float], name: str | None = None) -> PlaceType | None:
    """The type of a place with these numbers of Objects of each class; None without evidence."""
    named = None if name is None else type_of_name(name)
    if named is not None:
        return PlaceType(named, 1.0, ((named, 1.0),), named=True)
    by_class: dict[str, float] = {}
    for class_name, count in counts.items():
        known = known_class(class_name)
        if known is not None and count > 0:
            by_class[known] = by_class.get(known, 0.0) + count
    if not by_class:
        return None
    scores, total = [0.0] * len(TYPES), 0.0
    for known in sorted(by_class):
        count = by_class[known]
        weight = count if count < 1.0 else math.sqrt(count)
        total += weight
        for number, ratio in enumerate(_LOGS[known]):
            scores[number] += weight * ratio
    temper = _TEMPER * min(1.0, _MOST_WEIGHT / total)
    return _answer([temper * score for score in scores])


def _answer(scores: list[float]) -> PlaceType:
    best = max(scores)
    odds = [exp(max(score - best, -40.0)) for score in scores]
    total = math.fsum(odds)
    ranked = sorted(
        ((round(each / total, 3), number) for number, each in enumerate(odds)),
        key=lambda pair: (-pair[0], pair[1]),
    )
    shown = tuple((TYPES[n], p) for p, n in ranked[:_MOST_SHOWN] if p >= _LEAST_SHOWN)
    probability, number = ranked[0]
    return PlaceType(TYPES[number] if probability >= UNSURE else None, probability, shown)


@lru_cache(maxsize=4096)
def known_class(class_name: str) -> str | None:
    """The table's name of a class; None for one that it does not have."""
    plain = " ".join(class_name.casefold().replace("_", " ").replace("-", " ").split())
    plain = SYNONYMS.get(plain, plain)
    return plain if plain in TABLE else None


@lru_cache(maxsize=4096)
def type_of_name(name: str) -> str | None:
    """The type in a place's name: of the types' names in it, also in the plural, the longest, of
    several of one length the first; None if there is none."""
    words = re.split(r"[^a-z]+", name.casefold())
    plain = f" {' '.join(words)} {' '.join(word.removesuffix('s') for word in words)} "
    found = [(-len(each), plain.index(f" {each} "), each) for each in NAMES if f" {each} " in plain]
    return NAMES[min(found)[2]] if found else None


_LOGS: Final[Mapping[str, tuple[float, ...]]] = {
    name: tuple(log(share) for share in shares) for name, shares in TABLE.items()
}
