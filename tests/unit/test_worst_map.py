"""The worst of several maps: by three crops, else by the fewest with which a map was asked."""

from pathlib import Path
from typing import Any

from projections.surfaces.cli.evaluate import worst_of, worst_text


def scored(name: str, *, group: str = "relocalization", **errors: Any) -> tuple[Path, Any]:
    """Errors (ours, plain) by number of crops, as ``c3=(0.5, 2.0)``."""
    columns = {
        crops[1:]: {"pose_error_m": {"p50": ours}, "plain": {"pose_error_m": {"p50": plain}}}
        for crops, (ours, plain) in errors.items()
    }
    return Path(name), {group: columns}


NOTHING = (None, None)


def test_by_three_crops_where_there_are_such_questions() -> None:
    one = scored("one", c1=(9.0, 1.0), c2=(9.0, 1.0), c3=(0.5, 2.0))
    other = scored("other", c1=(0.1, 1.0), c2=(0.1, 1.0), c3=(0.6, 2.0))
    assert worst_text([one, other]) == (
        "worst map: other, 3 crops: pose error p50 0.60 m, the plain baseline's 2.00 m\n"
    )


def test_a_map_without_such_questions_is_judged_by_the_fewest_crops_it_has() -> None:
    good = scored("good", c1=(1.0, 2.0), c3=(0.5, 2.0))
    poor = scored("poor", c1=NOTHING, c2=(4.0, 2.0), c3=NOTHING, c5=(0.1, 2.0))
    for maps in ([good, poor], [poor, good]):
        found = worst_of(maps)
        assert found is not None
        assert (found.log, found.crops, found.ratio) == (Path("poor"), "2", 2.0)
    text = worst_text([good, scored("alone", c1=(3.0, 2.0), c3=NOTHING)])
    assert text.startswith("worst map: alone, 1 crop: pose error p50 3.00 m")


def test_own_questions_count_where_no_others_have_errors() -> None:
    path, scores = scored("map", c1=NOTHING, c3=NOTHING)
    own = scored("map", group="self", c1=(1.0, 2.0), c3=NOTHING)[1]
    found = worst_of([(path, scores | own)])
    assert found is not None
    assert found.crops == "1"
    assert worst_text([(path, scores)]) == "no map was asked about things that it has\n"
