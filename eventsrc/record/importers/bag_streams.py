"""Choose topics and their uses, by option, else by types, names and frames.

Of several candidates the one whose name shares the most leading parts with the detections' topic is
used (``/robot1/tf`` for ``/robot1/camera/detections``). If two share as many, neither is used, and
a note names the option that chooses.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final, TypeVar

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.ros import messages as ros
from eventsrc.ros.library import BagTopic, MessageTypes, Undecodable
from eventsrc.ros.measured import LASER_SCAN
from eventsrc.ros.messages import BadMessage
from eventsrc.ros.named_classes import CLASS_TYPES, ClassNames, nearest
from eventsrc.ros.pictures import IMAGES, CutCrops
from eventsrc.ros.stream import DEFAULT_MAX_GAP_NS, Stream
from eventsrc.ros.transforms import TransformBuffer

from .bag_files import BagContents

TF_POSE: Final = "tf"
NONE: Final = "none"
"""Values of options: transforms instead of a topic of poses, and no topic of this kind."""
_BASES: Final = ("base_link", "base_footprint")
_MAP: Final = "map"
_POSE_TYPES: Final = (ros.POSE, ros.ODOMETRY)
_MOST_NAME: Final = 100
_NS: Final = 1_000_000_000

_Read = TypeVar("_Read")


@dataclass(frozen=True)
class BagOptions:
    """The user's choices for a bag; what is None or empty follows from the bag's topics."""

    detections: tuple[str, ...] = ()
    pose: str | None = None
    covariance: str | None = None
    embeddings: str | None = None
    camera: str | None = None
    classes: tuple[str, ...] = ()
    grid: str | None = None
    map_frame: str | None = None
    base_frame: str | None = None
    run_id: str | None = None
    embedding_model: str | None = None
    labels: Mapping[str, str] = field(default_factory=dict)
    heights: bool = False
    max_gap_ns: int = DEFAULT_MAX_GAP_NS
    images: str | None = None
    scan: str | None = None
    cut: CutCrops | None = None
    """Cuts crops of detections, to keep them; None to keep none."""


@dataclass
class Choice:
    """Streams, topics of occupancy grids, the uses of each topic, and notes for the user."""

    streams: list[Stream] = field(default_factory=list)
    grids: list[str] = field(default_factory=list)
    uses: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def use(self, topic: str | None, what: str) -> None:
        """Add a use to those of a topic."""
        if topic is not None:
            uses = self.uses.get(topic)
            if uses is None:
                self.uses[topic] = what
            elif what not in uses.split(", "):
                self.uses[topic] = f"{uses}, {what}"


class Chooser:
    """Chooses the topics of a bag, or of another ``source``, and their uses."""

    def __init__(
        self,
        name: str,
        contents: BagContents,
        types: MessageTypes,
        options: BagOptions,
        source: str = "the bag",
    ) -> None:
        self._name = name
        self._source = source
        self._contents = contents
        self._types = types
        self._options = options
        self._made = Choice()
        self._frames = {
            topic.name: frame
            for topic in contents.topics.values()
            if topic.type_name != ros.TF and (frame := self._frame_of(topic)) is not None
        }

    def choose(self) -> Choice:
        """Choose. Raises MisuseError for an option that names a missing or unfit topic."""
        detections = self._detections()
        for topic in detections:
            self._add_stream(topic, several=len(detections) > 1)
        self._choose_grids(detections)
        return self._made

    def _detections(self) -> Sequence[str]:
        given = self._options.detections
        for topic in given:
            self._check("--detections", topic, *ros.DETECTION_TYPES)
        return given or self._contents.detections()

    def _add_stream(self, topic: str, *, several: bool) -> None:
        made, options = self._made, self._options
        run_id = options.run_id or self._run_id()
        if several:
            run_id = f"{run_id}:{topic.strip('/').removesuffix('/detections')}"
        tf = self._nearest(topic, self._transforms(static=False), "transforms")
        tf_static = self._nearest(topic, self._transforms(static=True), "static transforms")
        tree = self._tree(tf, tf_static)
        camera_frame = self._frames.get(topic, "")
        map_frame, base_frame = self._map_and_base(tree, camera_frame)
        found = any(tree.is_connected(map_frame, each) for each in (base_frame, camera_frame))
        pose = self._pose(topic, has_transforms=found)
        if pose == TF_POSE and not self._of_type(ros.TF):
            raise MisuseError(f"--pose {TF_POSE}: {self._source} has no topic of {ros.TF}")
        if pose is None:  # without a topic of poses a stream takes those of its transforms
            tf = tf_static = None
        by_transforms = pose == TF_POSE
        covariance = self._covariance(topic, map_frame) if by_transforms else None
        embeddings = self._embeddings(topic)
        camera = self._camera(topic, camera_frame)
        images = None if options.cut is None else self._images(topic, camera_frame)
        told, scan = self._class_names(topic), self._scan(topic)
        topics = tf, tf_static, None if by_transforms else pose, covariance, embeddings, camera
        made.streams.append(
            Stream(
                *(topic, run_id, *topics, map_frame, base_frame),
                {**told, **options.labels},
                *(options.embedding_model, options.heights),
                max_gap_ns=options.max_gap_ns,
                images=images,
                scan=scan,
            )
        )
        made.use(topic, f"keyframes of run {run_id}")
        if by_transforms:
            made.use(tf, f"poses of {base_frame} in {map_frame}")
            made.use(tf_static, "where the camera is")
            if found and _last(map_frame) != _MAP and options.map_frame is None:
                made.notes.append(
                    f"poses are in the frame {map_frame!r}: no transform leads to a frame "
                    f"{_MAP!r}; odometry alone drifts, so give --map-frame or --pose "
                    "if there is something better"
                )
            elif not found:
                made.notes.append(
                    f"no transforms lead from {map_frame!r} to {base_frame!r} or to the camera's "
                    f"{camera_frame!r}; there are {_some(sorted(tree.frames()))}; "
                    "--map-frame and --base-frame name others"
                )
        else:
            made.use(pose, "poses")
            for each in (tf, tf_static):
                made.use(each, "where the camera is")
            if pose is None and options.pose != NONE:
                made.notes.append(f"{topic}: no topic has poses; its keyframes are kept without")
        uses = "errors of poses", "embeddings", "camera", "crops", "walls"
        for used, what in zip((covariance, embeddings, camera, images, scan), uses, strict=True):
            made.use(used, what)
        if embeddings is None and options.embeddings != NONE:
            made.notes.append(
                f"{topic}: no topic has embeddings, so Objects go by class and box alone; "
                "docs/ros.md says how to publish them"
            )

    def _choose_grids(self, detections: Sequence[str]) -> None:
        there = self._of_type(ros.GRID)
        if (given := self._given("--grid", ros.GRID)) is not None:
            self._made.grids += [given] if given != NONE else []
        else:
            maps = [topic for topic in there if _last(topic) == _MAP]
            if not maps and there:
                self._made.notes.append(
                    f"no occupancy grid is on a topic called map; {_some(there)} may be costmaps; "
                    "give --grid TOPIC to take one"
                )
            near = [self._nearest(topic, maps, "maps", "--grid") for topic in detections]
            chosen = {topic for topic in near if topic is not None} if detections else {*maps}
            self._made.grids += sorted(chosen)
        for topic in self._made.grids:
            self._made.use(topic, "map")

    def _given(self, option: str, *type_names: str) -> str | None:
        given: str | None = getattr(self._options, option.removeprefix("--"))
        if given not in (None, NONE):
            self._check(option, given, *type_names)
        return given

    def _pose(self, topic: str, *, has_transforms: bool) -> str | None:
        if self._options.pose == TF_POSE:
            return TF_POSE
        if (given := self._given("--pose", *_POSE_TYPES)) is not None:
            return _unless_none(given)
        if has_transforms:
            return TF_POSE
        poses = [each for each in self._of_type(ros.POSE) if _last(each) != "initialpose"]
        for candidates in (poses, self._of_type(ros.ODOMETRY)):
            found = self._nearest(topic, candidates, "poses", "--pose")
            if found is not None:
                return found
        return TF_POSE if self._transforms(static=False) else None

    def _covariance(self, topic: str, map_frame: str) -> str | None:
        if (given := self._given("--covariance", *_POSE_TYPES)) is not None:
            return _unless_none(given)
        for kind in _POSE_TYPES:
            there = [
                each
                for each in self._of_type(kind)
                if self._frames.get(each) == map_frame and _last(each) != "initialpose"
            ]
            found = self._nearest(topic, there, "errors of poses", "--covariance")
            if found is not None:
                return found
        return None

    def _embeddings(self, topic: str) -> str | None:
        if (given := self._given("--embeddings", ros.TEXT, ros.FLOATS)) is not None:
            return _unless_none(given)
        there = [each for each in self._of_type(ros.TEXT, ros.FLOATS) if "embedding" in _last(each)]
        return self._nearest(topic, there, "embeddings", "--embeddings")

    def _camera(self, topic: str, frame: str) -> str | None:
        if (given := self._given("--camera", ros.CAMERA_INFO)) is not None:
            return _unless_none(given)
        there = self._of_type(ros.CAMERA_INFO)
        same = [each for each in there if frame and self._frames.get(each) == frame]
        return self._nearest(topic, same or there, "cameras", "--camera")

    def _images(self, topic: str, frame: str) -> str | None:
        if (given := self._given("--images", *IMAGES)) is not None:
            return _unless_none(given)
        there = [each for each in self._of_type(*IMAGES) if "depth" not in each.lower()]
        same = [each for each in there if frame and self._frames.get(each) == frame]
        found = self._nearest(topic, same or there, "pictures", "--images")
        if not there:
            note = f"{topic}: no topic has pictures, so there are no crops to keep"
            self._made.notes.append(note)
        return found

    def _scan(self, topic: str) -> str | None:
        if (given := self._given("--scan", LASER_SCAN)) is not None:
            return _unless_none(given)
        grid, grids = self._options.grid, self._of_type(ros.GRID)
        has_map = grid != NONE if grid is not None else any(_last(g) == _MAP for g in grids)
        there = [] if has_map else self._of_type(LASER_SCAN)
        return self._nearest(topic, there, "range scans", "--scan")

    def _class_names(self, topic: str) -> Mapping[str, str]:
        """The names of classes that messages tell, by id."""
        given = self._options.classes
        for each in sorted({*given} - {NONE}):
            self._check("--classes", each, *CLASS_TYPES)
        names = ClassNames()
        by_type: dict[str, str] = {}
        for kind in CLASS_TYPES:
            there = [each for each in self._of_type(kind) if not given or each in given]
            chosen = self._nearest(topic, there, "names of classes", "--classes")
            if chosen is None:
                continue
            by_type[kind] = chosen
            for message in self._samples(chosen, lambda message: message):
                try:
                    names.add(kind, message)
                except BadMessage as error:
                    self._made.notes.append(f"{chosen}: {error}")
        named = names.of(topic)
        if named.labels and named.by:
            self._made.use(by_type[ros.PARAMETERS], f"names of classes by {named.by}")
        elif named.labels:
            self._made.use(by_type[ros.LABELS], "names of classes")
        elif named.doubt:
            self._made.notes.append(f"{topic}: {named.doubt}; --labels FILE names its classes")
        return named.labels

    def _map_and_base(self, tree: TransformBuffer, camera: str) -> tuple[str, str]:
        """The frames of the map and of the robot's base."""
        frames = sorted(tree.frames())
        chain = tree.above(camera) if camera in frames else []
        base = self._options.base_frame or _first(chain, _BASES) or _first(frames, _BASES)
        if not chain and base in frames:
            chain = tree.above(base)
        root = chain[-1] if len(chain) > 1 else None
        map_ = self._options.map_frame or _first(chain, (_MAP,)) or root
        return map_ or _first(frames, (_MAP,)) or _MAP, base or _BASES[0]

    def _tree(self, *topics: str | None) -> TransformBuffer:
        """The tree of frames of the sampled transforms, all of them taken as static."""
        tree = TransformBuffer(0)
        for topic in topics:
            for each in self._samples(topic, lambda message: [*message.transforms]):
                for stamped in each:
                    try:
                        link = ros.read(ros.transform_of, stamped)
                    except BadMessage:
                        continue  # the assembler counts it
                    tree.add_static(link.parent, link.child, link.pose)
        return tree

    def _frame_of(self, topic: BagTopic) -> str | None:
        frames = self._samples(topic.name, lambda m: ros.frame_name(m.header.frame_id))
        return next(iter(frames), None)

    def _samples(self, topic: str | None, reader: Callable[[Any], _Read]) -> Iterable[_Read]:
        known = None if topic is None else self._contents.topics.get(topic)
        for payload in () if known is None else known.samples:
            try:
                yield ros.read(reader, self._types.decode(payload, known.type_name))  # type: ignore[union-attr]
            except (Undecodable, BadMessage):
                continue  # counted or kept as rejected when the bag is imported

    def _transforms(self, *, static: bool) -> list[str]:
        return [t for t in self._of_type(ros.TF) if (_last(t) == "tf_static") is static]

    def _of_type(self, *type_names: str) -> list[str]:
        topics = self._contents.topics.values()
        return sorted(topic.name for topic in topics if topic.type_name in type_names)

    def _nearest(
        self, topic: str, candidates: Sequence[str], what: str, option: str | None = None
    ) -> str | None:
        """The candidate that is `nearest` to ``topic``; None, with a note, if several are."""
        if not candidates:
            return None
        near = nearest(topic, candidates)
        if len(near) > 1:
            how = "none is used" if option is None else f"{option} chooses one; none is used"
            self._made.notes.append(f"{topic}: several topics have {what}: {_some(near)}; {how}")
            return None
        return near[0]

    def _check(self, option: str, topic: str, *type_names: str) -> None:
        known = self._contents.topics.get(topic)
        there = self._of_type(*type_names)
        others = f"of that type it has {_some(there)}" if there else "it has none of that type"
        wanted = " or ".join(type_names)
        if known is None:
            raise MisuseError(
                f"{option} {visible(topic)}: {self._source} has no messages of that topic; it "
                f"should be of type {wanted}, and {others}"
            )
        if known.type_name not in type_names:
            raise MisuseError(
                f"{option} {visible(topic)}: it is of type {visible(known.type_name)}, not "
                f"{wanted}; {others}"
            )

    def _run_id(self) -> str:
        """The bag's name and time, so that importing it again gives the same id."""
        name = "".join(char if char.isprintable() else "_" for char in self._name)[:_MOST_NAME]
        first_ns = self._contents.first_ns or 0
        try:
            began = datetime.fromtimestamp(first_ns // _NS, UTC)
        except (OverflowError, ValueError, OSError):
            return f"{name}-{first_ns}"
        return f"{name}-{began:%Y%m%dT%H%M%S}"


def _unless_none(given: str) -> str | None:
    return None if given == NONE else given


def _last(name: str) -> str:
    return name.rstrip("/").rpartition("/")[2]


def _first(frames: Iterable[str], names: Sequence[str]) -> str | None:
    """The first frame that has the first of these names that any frame has, prefixes ignored."""
    known = [*frames]
    for name in names:
        for frame in known:
            if _last(frame) == name:
                return frame
    return None


_MOST_NAMED: Final = 8


def _some(names: Sequence[str]) -> str:
    """The first few names, and the number of the others."""
    shown = ", ".join(visible(name)[:_MOST_NAME] for name in names[:_MOST_NAMED]) or "none"
    more = len(names) - _MOST_NAMED
    return shown if more <= 0 else f"{shown} and {more} more"
