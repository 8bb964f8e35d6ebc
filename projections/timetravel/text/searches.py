"""`mapfold bisect` for people."""

from projections.timetravel.search import Search, Turn

from .table import shortened


def search_text(search: Search, *, most: int | None) -> str:
    """When it turned true and what made it, with the values on both sides; then other turns."""
    lines = [_verdict(search)]
    if search.found is not None:
        lines += _values(search.found)
    else:
        lines += [f"  {name}: {_value(value)} at the end" for name, value in search.at_end]
    others = [turn for turn in search.turns if turn is not search.found]
    lines += shortened([_turn(turn) for turn in others], most, "--json lists all")
    return "".join(f"{line}\n" for line in lines)


def _verdict(search: Search) -> str:
    if search.found is not None:
        cause = search.found.cause
        return (
            f"became true at offset {cause.offset:,} ({cause.title}), "
            f"shows from --at {cause.offset + 1}"
        )
    span = f"from --at {search.start} to {search.end}"
    if search.holds[0] and search.holds[1] and not search.turns:
        return f"true all along {span}"
    if search.holds[0]:
        return f"true at --at {search.start}, then false; it does not become true again {span}"
    return f"never true {span}"


def _values(turn: Turn) -> list[str]:
    after = dict(turn.after)
    return [
        f"  {name}: {_value(value)} → {_value(after[name])}"
        if value != after[name]
        else f"  {name}: {_value(value)}, before and after"
        for name, value in turn.before
    ]


def _turn(turn: Turn) -> str:
    word = "true" if turn.becomes else "false"
    cause = turn.cause
    return f"  turned {word} at offset {cause.offset:,} ({cause.title})"


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "none" if value is None else str(value)
