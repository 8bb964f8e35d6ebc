"""Every parameter that changes the fold, in one frozen model.

The fingerprint is part of a checkpoint's identity: no projection mixes settings.
"""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import ErrorDetails, to_json

from eventsrc.base.user_files import FileFault, parse_json, read_file
from eventsrc.envelope.model import ANGLE_RAD, HFOV_DEG, PIXELS, Text, describe_error

from .evidence import EvidenceConstants
from .map_errors import SettingsError
from .presets import OLD_NAMES, PRESETS

_MAX_SHOWN = 80
_MOST_CONSTANTS = 4


class CameraConstants(BaseModel):
    """A level pinhole camera: horizontal field of view, picture size in pixels, and the angle from
    the robot's heading to where it looks, radians to the left."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    hfov_deg: Annotated[float, HFOV_DEG] = 69.4
    width_px: Annotated[float, PIXELS] = 640.0
    height_px: Annotated[float, PIXELS] = 400.0
    yaw_rad: Annotated[float, ANGLE_RAD] = 0.0


class CameraSettings(BaseModel):
    """What the settings say of the camera; None where they do not say it.

    ``hfov_error_deg`` is the standard error of an estimated field of view, None for a given one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    hfov_deg: Annotated[float, HFOV_DEG] | None = None
    hfov_error_deg: Annotated[float, Field(ge=0.0, le=90.0)] | None = None
    width_px: Annotated[float, PIXELS] | None = None
    height_px: Annotated[float, PIXELS] | None = None
    yaw_rad: Annotated[float, ANGLE_RAD] = 0.0

    @property
    def constants(self) -> CameraConstants:
        """The camera of envelopes that do not state theirs: defaults for what is not said."""
        return CameraConstants(**self.model_dump(exclude_none=True, exclude={"hfov_error_deg"}))

    @property
    def is_stated(self) -> bool:
        """Whether a person gave the field of view."""
        return self.hfov_deg is not None and self.hfov_error_deg is None


_MOST_CELLS = 20
"""Most cells' radii in ``drive_m``; what a new link costs grows with the square of it."""
_Length = Annotated[float, Field(ge=0.01, le=100.0)]


class RoomsConstants(BaseModel):
    """Constants of places by rooms (``places = "rooms"``), lengths in metres.

    They were chosen on the developing half of the trial data; the rule is in docs/places.md.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cell_m: _Length = 0.75
    """A pose farther than this from the centres of all cells becomes the centre of a new one."""
    drive_m: Annotated[_Length, Field(validate_default=True)] = 4.0
    """Places join up to this mean driven distance between their cells."""

    @field_validator("drive_m")
    @classmethod
    def _is_few_cells(cls, drive_m: float, info: ValidationInfo) -> float:
        cell_m = info.data.get("cell_m")
        if cell_m is not None and drive_m > _MOST_CELLS * cell_m:
            raise ValueError(f"should be at most {_MOST_CELLS} times cell_m, which is {cell_m:g}")
        return drive_m


_Shift = Annotated[float, Field(ge=-10.0, le=10.0)]
_Scale = Annotated[float, Field(ge=0.1, le=10.0)]
_Count = Annotated[int, Field(ge=0)]


class LocalizerConstants(BaseModel):
    """Constants of re-localisation, calibrated by a map's own questions.

    `projections.localize.relocalize` has two numbers beside a pose: `known`, whether the things
    shown are in the map, and `confidence`, whether the pose is within 1.5 m. Both are logistic
    models with weights for all maps. A logit z becomes scale · z + shift, by how far they are off
    on one map; the defaults change nothing. `mapfold calibrate` asks the map about its own
    keyframes and records the correction with the number of questions that it rests on.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    known_shift: _Shift = 0.0
    known_scale: _Scale = 1.0
    known_count: _Count = 0
    """The number of the map's own questions behind the correction of `known`; 0 for none."""
    confidence_shift: _Shift = 0.0
    confidence_scale: _Scale = 1.0
    confidence_count: _Count = 0
    text_shift: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.45
    """How much lower a text's cosine with a picture is than that of two pictures of different
    things of one class; added to it before it is compared with cosines of pictures."""


_YOUNGER = {
    "fusion": ("fusion", "camera", "evidence"),
    "places": ("places", "rooms"),
    **{name: (name,) for name in ("localizer", "floor_height_m")},
    "text_encoder": ("text_encoder", "text_encoder_sha256"),
}
"""Settings that older versions did not have, by the setting that activates them."""


class Settings(BaseModel):
    """Parameters of the fold. Lengths in metres; similarities are cosines."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    eps_m: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.5
    """DBSCAN's ε: two poses are neighbours within this distance, inclusive."""
    min_samples: Annotated[int, Field(ge=1, le=1_000_000)] = 3
    """Neighbours, self included, that make a pose a core point."""
    fusion_radius_m: Annotated[float, Field(gt=0.0, le=1000.0)] = 3.0
    """An observation may fuse with an Object whose mean position is within this distance."""
    fusion_similarity: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.7
    """An observation may fuse with an Object whose mean embedding has this cosine with its own."""
    embedding_model: Text | None = None
    """The map's embedding model; None takes that of the first embedded detection."""
    embedding_dim: Annotated[int, Field(ge=1, le=16_000)] | None = None
    """The map's embedding dimension; None takes that of the first embedded detection."""
    fusion: Literal["page", "evidence"] = "page"
    """The rule that fuses observations into Objects: by ``fusion_radius_m`` and
    ``fusion_similarity``, or by the evidence of bearings and looks."""
    camera: CameraSettings = CameraSettings()
    """The camera of envelopes that do not state theirs; for fusion by evidence."""
    evidence: EvidenceConstants = EvidenceConstants()
    """The constants of fusion by evidence."""
    localizer: LocalizerConstants = LocalizerConstants()
    """The corrections of re-localisation's numbers; the fold does not use them."""
    places: Literal["page", "rooms"] = "page"
    """The rule that groups poses into places: DBSCAN by ``eps_m`` and ``min_samples``, or rooms."""
    rooms: RoomsConstants = RoomsConstants()
    """The constants of places by rooms."""
    floor_height_m: Annotated[float, Field(ge=0.5, le=1000.0)] = 3.0
    """The height of a storey. An envelope with a height ``map_z`` but no ``floor`` is on the floor
    whose number times this is nearest to ``map_z``."""
    text_encoder: Annotated[str, Field(min_length=1, max_length=4096)] | None = None
    """The file of the text encoder by which words find things; the fold does not use it."""
    text_encoder_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_a_removed_setting(cls, values: Any) -> Any:
        """Documents of older versions may have ``"neighbourhood": null``, which meant nothing."""
        if isinstance(values, dict) and values.get("neighbourhood", 0) is None:
            return {name: value for name, value in values.items() if name != "neighbourhood"}
        return values

    @model_serializer(mode="wrap")
    def _without_younger_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out younger settings that have their default, so that older fingerprints hold;
        those of a rule in force are all named, so that the fingerprint changes with a default."""
        values: dict[str, Any] = handler(self)
        defaults = {name: Settings.model_fields[name].default for name in values}
        for rule, names in _YOUNGER.items():
            if getattr(self, rule) == defaults[rule]:
                for name in names:
                    if name in values and getattr(self, name) == defaults[name]:
                        del values[name]
        return values

    def __hash__(self) -> int:
        return hash(self.fingerprint())

    def fingerprint(self) -> str:
        """16 hex digits, equal exactly when every setting is; a camera not said is the default."""
        values, camera = self.model_dump(), self.camera.constants
        if "camera" in values:
            values["camera"] = camera.model_dump()
            if self.fusion == "page" and camera == CameraConstants():
                del values["camera"]
        return hashlib.sha256(to_json(values)).hexdigest()[:16]

    @property
    def wants_camera(self) -> bool:
        """Whether positions depend on the camera and none is said."""
        return self.fusion == "evidence" and self.camera.hfov_deg is None

    def places_text(self) -> str:
        """The rule of places as a short text: ``ε 1.5 m, min_samples 3``."""
        if self.places == "rooms":
            return f"rooms: cells of {self.rooms.cell_m:g} m, {self.rooms.drive_m:g} m of driving"
        return f"ε {self.eps_m:g} m, min_samples {self.min_samples}"

    def by_name(self) -> dict[str, Any]:
        """All settings, those with their default too, by the names that ``--set`` takes:
        ``eps_m``, ``camera.hfov_deg``, ``evidence.sizes_m.chair``."""
        return settings_by_name(_tree(self))

    def changed_from(self, base: "Settings") -> dict[str, Any]:
        """The values here that differ from ``base``; None for a size that only ``base`` has."""
        before, here = base.by_name(), self.by_name()
        names = [*here, *(name for name in before if name not in here)]
        changed = {name: here.get(name) for name in names if here.get(name) != before.get(name)}
        taken = [of for name, of in _OF_A_VALUE.items() if name in changed and here[of] is not None]
        return changed | {of: here[of] for of in taken}  # which a new value takes away

    def with_assignments(self, assignments: Iterable[str], option: str = "--set") -> "Settings":
        """These settings changed by ``name=value`` texts, as ``option`` takes them. ``preset=NAME``
        stands for the assignments of a preset; others come on top of it wherever it stands.

        Raises SettingsError that names the option, the setting and the rule it breaks, or the two
        values of a setting that is given twice.
        """
        values, given = _tree(self), dict[str, str]()
        texts = sorted(assignments, key=lambda text: not text.lstrip().startswith("preset="))
        for text in texts:
            try:
                name, value = _split(text)
                _check_once(name, value, given)
                _assign(values, name, value)
            except SettingsError as error:
                raise SettingsError(f"{option} {_plain(text)}: {error}") from None
        try:
            return Settings.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            fault = f"{_dotted(first)}={_plain(str(first['input']))}: {_rule(first)}"
            raise SettingsError(f"{option} {fault}") from None

    @classmethod
    def from_document(cls, document: object) -> "Settings":
        """Settings from parsed JSON. Raises SettingsError; its message does not name the file."""
        if not isinstance(document, dict):
            raise SettingsError('no JSON object; write one such as {"eps_m": 1.0}')
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            first = error.errors()[0]
            name = _dotted(first)
            if first["type"] == "extra_forbidden":
                raise SettingsError(_no_setting(name)) from None
            raise SettingsError(f"{name} is {_shown(first['input'])}: {_rule(first)}") from None


MAX_SETTINGS_BYTES: Final = 64 * 1024


def read_settings(file: Path) -> Settings:
    """The settings in a file of JSON. Raises FileFault if it cannot be read, SettingsError for what
    is in it; the messages do not name the file."""
    content = read_file(file, MAX_SETTINGS_BYTES)
    try:
        document = parse_json(content)
    except FileFault as fault:
        raise SettingsError(f"not JSON: {fault}") from None
    return Settings.from_document(document)


def _rule(error: ErrorDetails) -> str:
    """The rule that a value breaks, as the end of a sentence."""
    text = describe_error(error)
    return text[:1].lower() + text[1:]


def _shown(value: object) -> str:
    return text if len(text := repr(value)) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN - 3]}..."


def _plain(text: str) -> str:
    """A text as typed; escaped and cut if it is not printable or is too long for a line."""
    return text if text.isprintable() and len(text) <= _MAX_SHOWN else _shown(text)


def _dotted(error: ErrorDetails) -> str:
    return ".".join(str(part) for part in error["loc"] if part != "[key]")


def _no_setting(name: str) -> str:
    """``no setting 'eps'; there are …``: those of its group, else the plain ones and groups."""
    every = list(Settings().by_name())
    group = name.partition(".")[0] + "."
    names = sorted(each for each in every if each.startswith(group))
    if names:
        names += [f"{_SIZES}CLASS"] if _SIZES.startswith(group) else []
    else:
        groups = sorted({each.partition(".")[0] for each in every if "." in each})
        names = [*sorted(each for each in every if "." not in each), *(f"{g}.NAME" for g in groups)]
    return f"no setting {_shown(name)}; there are {', '.join(names)}"


def settings_by_name(document: Mapping[str, Any]) -> dict[str, Any]:
    """The values that a document of settings has, by the names that ``--set`` takes."""
    found: dict[str, Any] = {}
    for name, value in document.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{key}": each for key, each in settings_by_name(value).items()}
        else:
            found[name] = value
    return found


def assignment_texts(changed: Mapping[str, Any]) -> list[str]:
    """``name=value`` for settings by name; of many constants, as a calibration gives, only the
    number: ``28 constants of evidence``."""
    many = {}
    for group in ("evidence", "localizer"):
        constants = [name for name in changed if name.startswith(f"{group}.")]
        if len(constants) > _MOST_CONSTANTS:
            many[group] = constants
    hidden = {name for constants in many.values() for name in constants}
    texts = [f"{name}={value}" for name, value in changed.items() if name not in hidden]
    return texts + [f"{len(constants)} constants of {group}" for group, constants in many.items()]


def _tree(settings: Settings) -> dict[str, Any]:
    """All settings as a document, those with their default too."""
    return {n: v.model_dump() if isinstance(v, BaseModel) else v for n, v in settings}


_OF_A_VALUE = {"camera.hfov_deg": "camera.hfov_error_deg", "text_encoder": "text_encoder_sha256"}
"""Settings that are of the value of another, and go with it."""
_SIZES = "evidence.sizes_m."
_EXAMPLES = {
    "camera": "camera.hfov_deg=90",
    "rooms": "rooms.cell_m=0.5",
    "evidence": "evidence.range_m=1.3",
    "evidence.sizes_m": f"{_SIZES}chair=0.9",
}


def preset_assignments(name: str) -> tuple[str, ...]:
    """The assignments of a preset, also by its old name. Raises SettingsError."""
    found = PRESETS.get(OLD_NAMES.get(name, name))
    if found is None:
        raise SettingsError(f"no preset {name[:_MAX_SHOWN]!r}; there are {', '.join(PRESETS)}")
    return found


def _split(text: str) -> tuple[str, str]:
    """Name and value of ``name=value``. Raises SettingsError."""
    # A class's name may hold dots and equals signs; its size is a number.
    split = text.rpartition("=") if text.lstrip().startswith(_SIZES) else text.partition("=")
    if not split[1]:
        raise SettingsError("write it as name=value, such as eps_m=1.0")
    return split[0].strip(), split[2].strip()


def _check_once(name: str, value: str, given: dict[str, str]) -> None:
    """Add a setting to those that were ``given``. Raises SettingsError if it was, otherwise."""
    before = given.setdefault(name, value)
    if before != value:
        raise SettingsError(f"{_plain(name)} is given as {_plain(before)} too; give one of them")


def _assign(values: dict[str, Any], name: str, value: str) -> None:
    """Change one setting in the document of settings. Raises SettingsError."""
    if name == "preset":
        for each in preset_assignments(value):
            _assign(values, *_split(each))
        return
    given = None if value in ("", "none") else value
    if name.startswith(_SIZES):
        values["evidence"]["sizes_m"].pop(name[len(_SIZES) :], None)
        if given is not None:
            values["evidence"]["sizes_m"][name[len(_SIZES) :]] = given
        return
    group, dot, last = name.partition(".")
    inner = values.get(group) if dot else values
    key = last if dot else name
    if not isinstance(inner, dict) or key not in inner:
        raise SettingsError(_no_setting(name))
    if isinstance(inner[key], dict):
        raise SettingsError(f"it has several values; give one of them, such as {_EXAMPLES[name]}")
    inner[key] = given
    if name in _OF_A_VALUE:
        inner[_OF_A_VALUE[name].rpartition(".")[2]] = None
