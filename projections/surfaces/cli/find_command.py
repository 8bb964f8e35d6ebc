"""``mapfold find``, ``room`` and ``path``: where things are, what is in a place, the way to it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised, counted, shorten_by, table, visible
from projections.ask.best_views import write_best
from projections.ask.find import FoundObject, FoundObjects, SeenAt, Wanted, find
from projections.ask.goal_pose import CLEARANCE_M
from projections.ask.room_and_path import DrivenPath, NamedPlace, Room, goal_of, path, room
from projections.ask.words import ObjectVectors, Words
from projections.map.naming import ShortIds, things_of
from projections.map.view import MapView
from projections.store.history_recorder import map_after
from projections.surfaces.text_encoders import words_of

from .folded_log import CachedLog, FoldSettings, FoldToOption, KnownAtOption, NoCacheOption
from .goals import ClearanceOption, GoalOption, GoalSender, print_goal
from .options import Databases, JsonOption, LiveDbOption, LogOrDbArgument, option
from .terminal import display, emit, say


@dataclass(frozen=True, kw_only=True)
class AskedMap(FoldSettings):
    """The map that is asked: a log folded to a point, or with ``--db`` that of the databases."""

    log: LogOrDbArgument = None
    at: FoldToOption = "end"
    known_at: KnownAtOption = None
    no_cache: NoCacheOption = False
    db: LiveDbOption = None

    def words(self, *given: str | None) -> list[str | None]:
        """The arguments after LOG; with ``--db`` LOG is the first of them. Raises MisuseError."""
        if self.db is None:
            if self.log is None:
                raise MisuseError("give a LOG, or --db URL to ask the databases")
            return list(given)
        if given and given[-1] is not None:
            raise MisuseError(f"--db asks the databases, not the log {self.log}; give one of them")
        return [None if self.log is None else str(self.log), *given[:-1]]

    def view(self, text_encoder: Path | None = None) -> MapView:
        """The map that is asked, with another text encoder than its own where one is given; texts
        printed from here on have its short ids."""
        view = self._view(embeddings=text_encoder is not None)
        if text_encoder is not None:
            named = {"text_encoder": str(text_encoder), "text_encoder_sha256": None}
            view.settings = view.settings.model_copy(update=named)
        shorten_by(ShortIds.of(things_of(view)).text)
        return view

    def write_crops(self, view: MapView, found: FoundObjects, folder: Path) -> dict[str, str]:
        """Write the best crop of each answer that has one; the files by Object."""
        best = [each.object_id for each in found.answers]
        files = write_best(view, best, self.log or Path(), folder)
        if len(files) < len(found.answers):
            count = counted(len(found.answers) - len(files), "answer")
            say(f"{self.log} keeps no crop of {count}; an import with --keep-crops keeps them")
        return files

    def compared(self, view: MapView) -> Words | None:
        """What compares words with the embeddings of the map; None where nothing does."""
        return words_of(view) if self.db is None else words_of(view, self._vectors)

    def _view(self, *, embeddings: bool) -> MapView:
        if self.db is None:
            source = CachedLog(
                preset=self.preset,
                space=self.space,
                set_=self.set_,
                settings_file=self.settings_file,
                log=self.log or Path(),
            )
            with source.opened(self.at, self.known_at) as (reader, end, _, corrections, settings):
                return map_after(
                    *(reader, settings, end),
                    corrections=corrections,
                    note=say,
                    cache=not self.no_cache,
                    embeddings=embeddings or settings.text_encoder is not None,
                )
        self.of_past_map(None)  # refuses settings
        if self.at != "end" or self.known_at is not None:
            raise MisuseError("--at and --known-at ask a past map, which only the log knows")
        # Imported here: the drivers take as long to import as a small map to fold.
        from projections.postgres.queries.live_view import live_view

        with Databases(db=self.db or None).opened() as targets:
            return live_view(targets)

    def _vectors(self, _: MapView) -> ObjectVectors:
        """The mean vectors of the Objects in the databases."""
        from projections.postgres.queries.live_view import live_vectors

        with Databases(db=self.db or None).opened() as targets:
            return live_vectors(targets)


def find_things(
    *,
    asked: AskedMap,
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="WHAT",
            help="A class, such as chair or chairs, what it looks like, such as red mug, by a text"
            " encoder, or an object's id [default: everything].",
        ),
    ] = None,
    in_: Annotated[
        str | None, option("PLACE", "Only what is in this place, such as kitchen.", "--in")
    ] = None,
    near: Annotated[
        str | None, option("X,Y|THING", "Nearest first, to a point in metres or a thing.", "--near")
    ] = None,
    start: Annotated[
        str | None,
        option(
            "X,Y|THING",
            "Nearest first by the way from there, over ground that robots drove on.",
            "--from",
        ),
    ] = None,
    missing: Annotated[
        bool,
        typer.Option(
            "--missing", help="Only missing objects: the robot looked and did not see them."
        ),
    ] = False,
    moved: Annotated[bool, typer.Option("--moved", help="Only what has moved.")] = False,
    seen_since: Annotated[
        str | None, option("TIME", "Only what was seen at TIME or later.", "--seen-since")
    ] = None,
    not_seen_since: Annotated[
        str | None, option("TIME", "Only what was last seen earlier.", "--not-seen-since")
    ] = None,
    top: Annotated[int, option("N", "Most answers.", "--top", min=1)] = 10,
    every: Annotated[bool, typer.Option("--all", help="Also what was seen once.")] = False,
    text_encoder: Annotated[
        Path | None,
        option(
            "MODEL.onnx",
            "Compare WHAT with embeddings by this text tower instead of the log's own.",
        ),
    ] = None,
    crops: Annotated[
        Path | None,
        option(
            "FOLDER",
            "Write the best crop that the log keeps of each answer there, and name its file.",
        ),
    ] = None,
    goal: GoalOption = None,
    clearance: ClearanceOption = CLEARANCE_M,
    sender: GoalSender,
    json_: JsonOption = False,
) -> None:
    """Find things: where they are, how often and when they were seen.

    WHAT forgives letter case, plurals and near spellings; a place is given by its id, name or type.
    """
    (what,) = asked.words(what)
    sender.check(goal)
    if crops is not None and asked.db is not None:
        raise MisuseError("--crops needs the LOG: the databases keep no crops")
    wanted = Wanted(
        what=what,
        room=in_,
        near=near,
        start=start,
        missing=missing,
        moved=moved,
        seen_since=seen_since,
        not_seen_since=not_seen_since,
        top=top,
        every=every,
    )
    view = asked.view(text_encoder)
    found = find(view, wanted, asked.compared(view))
    files = {} if crops is None else asked.write_crops(view, found, crops)
    if goal is not None:
        if not found.answers:
            raise MapfoldError("nothing found, so there is no goal")
        pose = goal_of(view, found.answers[0].object_id, clearance)
        print_goal(pose, goal)
        sender.send(pose)
        return
    if json_:
        document = found.document()
        for each in document["answers"] if crops is not None else ():
            each["crop"] = files.get(each["object_id"])
        emit(document)
        return
    display(_table(found, files) if found.answers else "nothing found\n")
    for line in _remarks(wanted, found):
        say(line)


def show_room(
    *,
    asked: AskedMap,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="A place: p3, a name, a type of room.")
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="List all objects, not only ten.")] = False,
    json_: JsonOption = False,
) -> None:
    """Show a place: what it is, what is in it, its neighbours, and when robots were there."""
    (name,) = asked.words(name)
    if name is None:
        raise MisuseError("give the NAME of a place, such as p3 or kitchen")
    view = asked.view()
    found = room(view, name)
    if json_:
        emit(found.document())
        return
    display(_room_text(found, None if all_ else _MOST_IN_ROOM))
    if found.unconfirmed:
        lists = visible(advised("find", "--in", found.place_id, "--all"))
        say(f"+ {found.unconfirmed:,} seen once; `{lists}` lists them")


def show_path(
    *,
    asked: AskedMap,
    start: Annotated[
        str | None, typer.Argument(metavar="A", help="A point X,Y in metres, a place or a thing.")
    ] = None,
    end: Annotated[str | None, typer.Argument(metavar="B", help="The other end.")] = None,
    goal: GoalOption = None,
    clearance: ClearanceOption = CLEARANCE_M,
    json_: JsonOption = False,
) -> None:
    """Show the way from one place or thing to another, over ground that robots drove on."""
    start, end = asked.words(start, end)
    if start is None or end is None:
        raise MisuseError("give both ends A and B of the way, such as p3 fridge")
    view = asked.view()
    found = path(view, start, end, clearance)
    if goal is not None:
        if found.goal is None:
            raise MisuseError(f"--goal faces a thing, and {visible(end)} is none; give an object")
        print_goal(found.goal, goal)
    elif json_:
        emit(found.document())
    else:
        display(_path_text(found))


_MOST_IN_ROOM: Final = 10


def _room_text(found: Room, most: int | None) -> str:
    sure = "" if found.type_probability is None else f" (probability {found.type_probability:.2f})"
    size = "" if found.area_m2 is None else f", {found.area_m2:.1f} m²"
    at = f"({found.centroid_x:.2f}, {found.centroid_y:.2f})"
    visits = counted(found.keyframe_count, "keyframe")
    lines = [
        f"{_called(found)}{sure}: {visits} around {at}{size}",
        f"visited {_seen(found.first_visited)} to {_seen(found.last_visited)}",
    ]
    if found.neighbours:
        beside = (f"{_called(n)} ({n.shared_transitions:,}×)" for n in found.neighbours)
        lines.append(f"next to {', '.join(beside)}")
    shown = found.objects[:most]
    rows = [
        [o.object_id, visible(o.class_name), _position(o), f"{o.obs_count:,}×", _last(o)]
        for o in shown
    ]
    if rows:
        header = ["object", "class", "position (m)", "seen", "last seen"]
        lines.append(table(header, rows, right=("seen",)).rstrip("\n"))
    if len(shown) < len(found.objects):
        lines.append(f"… and {len(found.objects) - len(shown):,} more (--all lists them)")
    return "".join(f"{line}\n" for line in lines)


def _called(place: NamedPlace) -> str:
    word = place.name or place.type
    return visible(place.place_id if word is None else f"{place.place_id} {word}")


def _path_text(found: DrivenPath) -> str:
    names = [_called(place) for place in found.places]
    doors = counted(len(found.doors), "passage")
    points = counted(len(found.way_points), "way point")
    lines = [f"{found.length_m:.2f} m, {doors}, {points}: {' → '.join(names) or 'in no place'}"]
    lines += [
        f"  from {visible(d.before)} to {visible(d.after)} at ({d.x:.2f}, {d.y:.2f})"
        for d in found.doors
    ]
    if found.goal is not None:
        g = found.goal
        facing = f"facing {math.degrees(g.yaw):.0f}°, {g.distance_m:.2f} m from it"
        lines.append(f"ends at ({g.x:.2f}, {g.y:.2f}), {facing}")
    return "".join(f"{line}\n" for line in lines)


def _table(found: FoundObjects, files: Mapping[str, str]) -> str:
    header = ["object", "class", "place", "position (m)", "seen", "last seen"]
    measures = {"away (m)": "distance_m", "way (m)": "way_m", "score": "score"}
    rated = {n for n in measures.values() if any(getattr(e, n) is not None for e in found.answers)}
    header[4:4] = [title for title, name in measures.items() if name in rated]
    rows = []
    for each in found.answers:
        row = [
            each.object_id,
            visible(each.class_name),
            _place(each),
            _position(each),
            f"{each.obs_count:,}×",
            _last(each),
        ]
        measured = (getattr(each, name) for name in measures.values() if name in rated)
        row[4:4] = ["none" if value is None else f"{value:.2f}" for value in measured]
        rows.append([*row, visible(files.get(each.object_id, "none"))] if files else row)
    header += ["crop"] if files else []
    return table(header, rows, right=("seen", *measures))


def _place(each: FoundObject) -> str:
    if each.place_id is None:
        return "no place"
    word = each.place_name or each.place_type
    place_id = visible(each.place_id)
    return place_id if word is None else f"{place_id} {visible(word)}"


def _position(each: FoundObject) -> str:
    at = f"({each.x:.2f}, {each.y:.2f})"
    return f"seen from {at}" if each.sigma_m is None else f"{at} ± {each.sigma_m:.2f}"


def _seen(at: SeenAt) -> str:
    return f"{at.iso} {visible(at.run_id)}:{at.keyframe_id}"


def _last(each: FoundObject) -> str:
    """When it was last seen, and what became of it."""
    seen = _seen(each.last_seen)
    if each.missing_in is not None:
        return f"{seen}; missing in {visible(each.missing_in)}"
    if each.moved_from is not None:
        return f"{seen}; was at ({each.moved_from[0]:.2f}, {each.moved_from[1]:.2f})"
    return seen


def _remarks(wanted: Wanted, found: FoundObjects) -> list[str]:
    remarks = []
    if wanted.what is not None and found.match in ("words", "spelling"):
        classes = ", ".join(map(visible, found.classes))
        remarks.append(f"no class {wanted.what!r}; found {classes}")
    if found.remark is not None:
        remarks.append(found.remark)
    if found.count > len(found.answers):
        remarks.append(f"{found.count - len(found.answers):,} more; --top {found.count} lists all")
    if found.unconfirmed:
        remarks.append(f"+ {found.unconfirmed:,} seen once; --all lists them")
    return remarks
