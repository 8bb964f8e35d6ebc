"""The table of room types: how often a room of each type has an object of each class.

Source. In which rooms of a home a class belongs follows the placement annotations of ProcTHOR
(Deitke et al., "ProcTHOR: Large-Scale Embodied AI Using Procedural Generation", NeurIPS 2022;
github.com/allenai/procthor, Apache License 2.0), which rate about a hundred classes for kitchens,
living rooms, bedrooms and bathrooms as never, sometimes or often. Those ratings say where a thing
may stand, not in what share of rooms it does: the shares, the other types and the classes that
ProcTHOR does not have are estimates of our own. So this is a small table made by hand, guided by a
published one. docs/decisions/place-types.md has its accuracy.

There are five grades of the share of rooms that have at least one: 90, 50, 20, 5 and 0.7 %.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

SHARES: Final = (0.007, 0.05, 0.2, 0.5, 0.9)
"""The grades; the first one is that of classes not named for a type."""

TYPES: Final = (
    "kitchen",
    "dining room",
    "living room",
    "bedroom",
    "bathroom",
    "office",
    "meeting room",
    "hall",
    "reception",
    "laundry room",
    "storage room",
    "patient room",
    "library",
)
"""The types; every row of `TABLE` has their order."""

NAMES: Final[Mapping[str, str]] = MappingProxyType(
    {
        **{name: name for name in TYPES},
        "kitchenette": "kitchen",
        "pantry": "kitchen",
        "dining": "dining room",
        "canteen": "dining room",
        "sitting room": "living room",
        "lounge": "living room",
        "guest room": "bedroom",
        "suite": "bedroom",
        "restroom": "bathroom",
        "washroom": "bathroom",
        "toilet": "bathroom",
        "wc": "bathroom",
        "study": "office",
        "conference room": "meeting room",
        "boardroom": "meeting room",
        "hallway": "hall",
        "corridor": "hall",
        "entrance": "hall",
        "staircase": "hall",
        "lobby": "reception",
        "foyer": "reception",
        "waiting room": "reception",
        "laundry": "laundry room",
        "storage": "storage room",
        "store room": "storage room",
        "storeroom": "storage room",
        "warehouse": "storage room",
        "ward": "patient room",
        "reading room": "library",
    }
)
"""Types by what people call such rooms."""

SYNONYMS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "sofa": "couch",
        "television": "tv",
        "tv monitor": "tv",
        "fridge": "refrigerator",
        "cooker": "stove",
        "cooktop": "stove",
        "extractor hood": "range hood",
        "bookcase": "bookshelf",
        "houseplant": "potted plant",
        "plant": "potted plant",
        "painting": "picture",
        "garbage can": "trash can",
        "waste bin": "trash can",
        "bin": "trash can",
        "night stand": "nightstand",
        "bedside table": "nightstand",
        "closet": "wardrobe",
        "chest of drawers": "dresser",
        "bath": "bathtub",
        "water tap": "faucet",
        "remote control": "remote",
        "computer": "monitor",
        "computer monitor": "monitor",
        "computer keyboard": "keyboard",
        "computer mouse": "mouse",
        "filing cabinet": "drawer unit",
        "meeting table": "conference table",
        "kitchen table": "dining table",
        "cardboard box": "box",
        "tumble dryer": "clothes dryer",
        "hamper": "laundry basket",
        "coffee maker": "coffee machine",
        "mug": "cup",
        "medical cart": "medical trolley",
        "metal cabinet": "cabinet",
        "storage rack": "shelf",
        "rack": "shelf",
    }
)
"""Other names of classes."""

_USUAL: Final[Mapping[str, Mapping[float, str]]] = MappingProxyType(
    {
        "kitchen": {
            0.9: "refrigerator, oven, stove, range hood, microwave, kitchen cabinet, sink",
            0.5: (
                "dishwasher, toaster, kettle, coffee machine, faucet, pan, pot, plate, "
                "knife, fork, spoon, bowl, cup, bottle, apple, banana, orange, bread, "
                "trash can, cabinet"
            ),
            0.2: "wine glass, dining table, chair, stool, clock, soap, washing machine",
            0.05: (
                "tv, curtain, lamp, picture, vase, potted plant, towel, fire "
                "extinguisher, book, shelf, table, bucket"
            ),
        },
        "dining room": {
            0.9: "dining table, chair",
            0.5: "plate, cup, wine glass",
            0.2: (
                "knife, fork, spoon, bowl, bottle, curtain, lamp, picture, vase, potted "
                "plant, cabinet, table"
            ),
            0.05: (
                "refrigerator, kettle, coffee machine, kitchen cabinet, apple, banana, "
                "orange, bread, stool, fireplace, clock, laptop, vending machine, bench, "
                "bookshelf"
            ),
        },
        "living room": {
            0.9: "couch, coffee table, tv",
            0.5: "armchair, side table, tv stand, remote, lamp, picture, potted plant",
            0.2: (
                "chair, ottoman, fireplace, pillow, curtain, clock, vase, laptop, book, "
                "bookshelf, shelf, cabinet, table"
            ),
            0.05: (
                "plate, bowl, cup, bottle, wine glass, dining table, stool, dresser, "
                "teddy bear, mirror, desk, stairs, trash can, backpack, box"
            ),
        },
        "bedroom": {
            0.9: "bed",
            0.5: "nightstand, wardrobe, dresser, pillow, curtain, lamp, picture",
            0.2: (
                "chair, tv, teddy bear, alarm clock, suitcase, clock, potted plant, "
                "mirror, desk, laptop, book, laundry basket, backpack"
            ),
            0.05: (
                "bowl, cup, bottle, stool, couch, armchair, ottoman, side table, tv "
                "stand, remote, vase, hair drier, office chair, monitor, keyboard, "
                "mouse, drawer unit, coat rack, shoe rack, trash can, bookshelf, shelf, "
                "cabinet, ironing board, box, vacuum cleaner"
            ),
        },
        "bathroom": {
            0.9: "sink, toilet, towel, toilet paper, mirror",
            0.5: "faucet, bathtub, shower, shower curtain, soap, toothbrush, trash can",
            0.2: "bottle, hair drier, cabinet, washing machine, laundry basket",
            0.05: ("dresser, curtain, lamp, picture, potted plant, shelf, clothes dryer, bucket"),
        },
        "office": {
            0.9: "desk, office chair, monitor",
            0.5: ("chair, potted plant, keyboard, mouse, laptop, printer, drawer unit, trash can"),
            0.2: (
                "coffee machine, cup, lamp, picture, clock, telephone, whiteboard, book, "
                "bookshelf, shelf, cabinet"
            ),
            0.05: (
                "refrigerator, microwave, kettle, bottle, couch, armchair, tv, curtain, "
                "coat rack, table, backpack, box"
            ),
        },
        "meeting room": {
            0.9: "chair, conference table",
            0.5: "tv, whiteboard, projector, projector screen",
            0.2: "picture, clock, potted plant, office chair, laptop, trash can, table",
            0.05: (
                "coffee machine, cup, bottle, couch, curtain, lamp, monitor, telephone, cabinet"
            ),
        },
        "hall": {
            0.5: "picture, bench, coat rack, shoe rack, stairs, fire extinguisher",
            0.2: "lamp, potted plant, mirror, sign, umbrella stand, wheelchair",
            0.05: (
                "chair, armchair, side table, wardrobe, dresser, suitcase, clock, vase, "
                "vending machine, trash can, backpack, cart, vacuum cleaner, medical "
                "trolley"
            ),
        },
        "reception": {
            0.9: "reception desk",
            0.5: "couch, armchair, side table, potted plant, sign",
            0.2: (
                "chair, coffee table, tv, lamp, picture, clock, desk, telephone, vending "
                "machine, bench, trash can"
            ),
            0.05: (
                "coffee machine, stool, ottoman, vase, mirror, office chair, monitor, "
                "keyboard, mouse, printer, umbrella stand, coat rack, stairs, fire "
                "extinguisher, book, table, wheelchair"
            ),
        },
        "laundry room": {
            0.9: "washing machine, clothes dryer",
            0.5: "sink, laundry basket, ironing board",
            0.2: "faucet, towel, cabinet, bucket, vacuum cleaner",
            0.05: (
                "refrigerator, dishwasher, kitchen cabinet, bottle, soap, trash can, "
                "shelf, box, ladder, cart"
            ),
        },
        "storage room": {
            0.9: "shelf, box, pallet",
            0.5: "pallet jack, forklift, ladder, bucket, cart, vacuum cleaner",
            0.2: "fire extinguisher, cabinet",
            0.05: (
                "refrigerator, suitcase, toilet paper, drawer unit, sign, trash can, ironing board"
            ),
        },
        "patient room": {
            0.9: "bed, hospital bed",
            0.5: ("chair, pillow, curtain, trash can, overbed table, iv stand, medical trolley"),
            0.2: "armchair, tv, nightstand, clock, monitor, cabinet, cart, wheelchair",
            0.05: (
                "sink, faucet, cup, bottle, stool, side table, remote, wardrobe, lamp, "
                "picture, towel, soap, mirror, telephone, table"
            ),
        },
        "library": {
            0.9: "book, bookshelf",
            0.5: "chair",
            0.2: "couch, armchair, lamp, desk, shelf, table",
            0.05: (
                "stool, coffee table, picture, clock, potted plant, monitor, keyboard, "
                "mouse, laptop, printer, bench, trash can, backpack"
            ),
        },
    }
)
"""By type, the classes that a share of its rooms have at least one of."""


def _shares() -> dict[str, tuple[float, ...]]:
    share_of: dict[str, dict[str, float]] = {}
    for room, usual in _USUAL.items():
        for share, classes in usual.items():
            for name in classes.split(", "):
                share_of.setdefault(name, {})[room] = share
    return {
        name: tuple(share_by_room.get(room, SHARES[0]) for room in TYPES)
        for name, share_by_room in share_of.items()
    }


TABLE: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(_shares())
"""By class, for each of `TYPES`, the share of rooms of the type that have one."""
