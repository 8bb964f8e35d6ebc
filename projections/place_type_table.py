"""The table of room types: how often a room of each type has an object of each class.

Source. In which rooms of a home a class belongs follows the placement annotations of ProcTHOR
(Deitke et al., "ProcTHOR: Large-Scale Embodied AI Using Procedural Generation", NeurIPS 2022;
github.com/allenai/procthor, Apache License 2.0), which rate about a hundred classes for kitchens,
living rooms, bedrooms and bathrooms as never, sometimes or often. Those ratings say where a thing
may stand, not in what share of rooms it does: the shares, the other types and the classes that
ProcTHOR does not have are estimates of our own. So this is a small table made by hand, guided by a
published one. docs/decisions/place-types.md tells how well it does.

A digit is the share of rooms that have at least one: 0 is 0.7 %, 1 is 5 %, 2 is 20 %, 3 is 50 %,
4 is 90 %.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

SHARES: Final = (0.007, 0.05, 0.2, 0.5, 0.9)

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
"""The columns of the table, in its order."""

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

_NAME_WIDTH: Final = 19
# kitchen, dining, living, bedroom, bath, office, meeting, hall, reception, laundry, storage,
# patient, library
_ROWS: Final = """
refrigerator       4 1 0 0 0 1 0 0 0 1 1 0 0
oven               4 0 0 0 0 0 0 0 0 0 0 0 0
stove              4 0 0 0 0 0 0 0 0 0 0 0 0
range hood         4 0 0 0 0 0 0 0 0 0 0 0 0
microwave          4 0 0 0 0 1 0 0 0 0 0 0 0
dishwasher         3 0 0 0 0 0 0 0 0 1 0 0 0
toaster            3 0 0 0 0 0 0 0 0 0 0 0 0
kettle             3 1 0 0 0 1 0 0 0 0 0 0 0
coffee machine     3 1 0 0 0 2 1 0 1 0 0 0 0
kitchen cabinet    4 1 0 0 0 0 0 0 0 1 0 0 0
sink               4 0 0 0 4 0 0 0 0 3 0 1 0
faucet             3 0 0 0 3 0 0 0 0 2 0 1 0
pan                3 0 0 0 0 0 0 0 0 0 0 0 0
pot                3 0 0 0 0 0 0 0 0 0 0 0 0
plate              3 3 1 0 0 0 0 0 0 0 0 0 0
knife              3 2 0 0 0 0 0 0 0 0 0 0 0
fork               3 2 0 0 0 0 0 0 0 0 0 0 0
spoon              3 2 0 0 0 0 0 0 0 0 0 0 0
bowl               3 2 1 1 0 0 0 0 0 0 0 0 0
cup                3 3 1 1 0 2 1 0 0 0 0 1 0
bottle             3 2 1 1 2 1 1 0 0 1 0 1 0
wine glass         2 3 1 0 0 0 0 0 0 0 0 0 0
apple              3 1 0 0 0 0 0 0 0 0 0 0 0
banana             3 1 0 0 0 0 0 0 0 0 0 0 0
orange             3 1 0 0 0 0 0 0 0 0 0 0 0
bread              3 1 0 0 0 0 0 0 0 0 0 0 0
dining table       2 4 1 0 0 0 0 0 0 0 0 0 0
chair              2 4 2 2 0 3 4 1 2 0 0 3 3
stool              2 1 1 1 0 0 0 0 1 0 0 1 1
couch              0 0 4 1 0 1 1 0 3 0 0 0 2
armchair           0 0 3 1 0 1 0 1 3 0 0 2 2
ottoman            0 0 2 1 0 0 0 0 1 0 0 0 0
coffee table       0 0 4 0 0 0 0 0 2 0 0 0 1
side table         0 0 3 1 0 0 0 1 3 0 0 1 0
tv                 1 0 4 2 0 1 3 0 2 0 0 2 0
tv stand           0 0 3 1 0 0 0 0 0 0 0 0 0
remote             0 0 3 1 0 0 0 0 0 0 0 1 0
fireplace          0 1 2 0 0 0 0 0 0 0 0 0 0
bed                0 0 0 4 0 0 0 0 0 0 0 4 0
nightstand         0 0 0 3 0 0 0 0 0 0 0 2 0
wardrobe           0 0 0 3 0 0 0 1 0 0 0 1 0
dresser            0 0 1 3 1 0 0 1 0 0 0 0 0
pillow             0 0 2 3 0 0 0 0 0 0 0 3 0
teddy bear         0 0 1 2 0 0 0 0 0 0 0 0 0
alarm clock        0 0 0 2 0 0 0 0 0 0 0 0 0
suitcase           0 0 0 2 0 0 0 1 0 0 1 0 0
curtain            1 2 2 3 1 1 1 0 0 0 0 3 0
lamp               1 2 3 3 1 2 1 2 2 0 0 1 2
picture            1 2 3 3 1 2 2 3 2 0 0 1 1
clock              2 1 2 2 0 2 2 1 2 0 0 2 1
vase               1 2 2 1 0 0 0 1 1 0 0 0 0
potted plant       1 2 3 2 1 3 2 2 3 0 0 0 1
toilet             0 0 0 0 4 0 0 0 0 0 0 0 0
bathtub            0 0 0 0 3 0 0 0 0 0 0 0 0
shower             0 0 0 0 3 0 0 0 0 0 0 0 0
shower curtain     0 0 0 0 3 0 0 0 0 0 0 0 0
towel              1 0 0 0 4 0 0 0 0 2 0 1 0
toilet paper       0 0 0 0 4 0 0 0 0 0 1 0 0
soap               2 0 0 0 3 0 0 0 0 1 0 1 0
mirror             0 0 1 2 4 0 0 2 1 0 0 1 0
toothbrush         0 0 0 0 3 0 0 0 0 0 0 0 0
hair drier         0 0 0 1 2 0 0 0 0 0 0 0 0
desk               0 0 1 2 0 4 0 0 2 0 0 0 2
office chair       0 0 0 1 0 4 2 0 1 0 0 0 0
monitor            0 0 0 1 0 4 1 0 1 0 0 2 1
keyboard           0 0 0 1 0 3 0 0 1 0 0 0 1
mouse              0 0 0 1 0 3 0 0 1 0 0 0 1
laptop             0 1 2 2 0 3 2 0 0 0 0 0 1
printer            0 0 0 0 0 3 0 0 1 0 0 0 1
telephone          0 0 0 0 0 2 1 0 2 0 0 1 0
drawer unit        0 0 0 1 0 3 0 0 0 0 1 0 0
whiteboard         0 0 0 0 0 2 3 0 0 0 0 0 0
conference table   0 0 0 0 0 0 4 0 0 0 0 0 0
projector          0 0 0 0 0 0 3 0 0 0 0 0 0
projector screen   0 0 0 0 0 0 3 0 0 0 0 0 0
reception desk     0 0 0 0 0 0 0 0 4 0 0 0 0
sign               0 0 0 0 0 0 0 2 3 0 1 0 0
vending machine    0 1 0 0 0 0 0 1 2 0 0 0 0
bench              0 1 0 0 0 0 0 3 2 0 0 0 1
umbrella stand     0 0 0 0 0 0 0 2 1 0 0 0 0
coat rack          0 0 0 1 0 1 0 3 1 0 0 0 0
shoe rack          0 0 0 1 0 0 0 3 0 0 0 0 0
stairs             0 0 1 0 0 0 0 3 1 0 0 0 0
fire extinguisher  1 0 0 0 0 0 0 3 1 0 2 0 0
trash can          3 0 1 1 3 3 2 1 2 1 1 3 1
book               1 0 2 2 0 2 0 0 1 0 0 0 4
bookshelf          0 1 2 1 0 2 0 0 0 0 0 0 4
shelf              1 0 2 1 1 2 0 0 0 1 4 0 2
cabinet            3 2 2 1 2 2 1 0 0 2 2 2 0
table              1 2 2 0 0 1 2 0 1 0 0 1 2
washing machine    2 0 0 0 2 0 0 0 0 4 0 0 0
clothes dryer      0 0 0 0 1 0 0 0 0 4 0 0 0
laundry basket     0 0 0 2 2 0 0 0 0 3 0 0 0
ironing board      0 0 0 1 0 0 0 0 0 3 1 0 0
backpack           0 0 1 2 0 1 0 1 0 0 0 0 1
box                0 0 1 1 0 1 0 0 0 1 4 0 0
pallet             0 0 0 0 0 0 0 0 0 0 4 0 0
pallet jack        0 0 0 0 0 0 0 0 0 0 3 0 0
forklift           0 0 0 0 0 0 0 0 0 0 3 0 0
ladder             0 0 0 0 0 0 0 0 0 1 3 0 0
bucket             1 0 0 0 1 0 0 0 0 2 3 0 0
cart               0 0 0 0 0 0 0 1 0 1 3 2 0
vacuum cleaner     0 0 0 1 0 0 0 1 0 2 3 0 0
hospital bed       0 0 0 0 0 0 0 0 0 0 0 4 0
wheelchair         0 0 0 0 0 0 0 2 1 0 0 2 0
overbed table      0 0 0 0 0 0 0 0 0 0 0 3 0
iv stand           0 0 0 0 0 0 0 0 0 0 0 3 0
medical trolley    0 0 0 0 0 0 0 1 0 0 0 3 0
"""


def _shares() -> dict[str, tuple[float, ...]]:
    rows = {}
    for line in _ROWS.strip().splitlines():
        name, grades = line[:_NAME_WIDTH].strip(), line[_NAME_WIDTH:].split()
        rows[name] = tuple(SHARES[int(grade)] for grade in grades)
    return rows


TABLE: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(_shares())
"""By class, for each of `TYPES`, the share of rooms of the type that have one."""
