"""Settings of stages and scenes: strict, typed, resolved from code, profile, scene and command line."""

import json
import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from groundwalk.store.errors import UserError

# Profiles, scenes and published tables: beside the packages, in the repository as in a wheel (groundwalk/shipped).
SHIPPED_DATA = (Path(__file__).resolve().parent.parent / "shipped").resolve()
STAGES = ("import", "sfm", "align", "localise", "train", "fuse", "report")
_SECTIONS = ("simulate", *STAGES)
_NAME = r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}"
# Lists of tables at the top of a scene's file that are a setting of one stage, which alone depends on them.
_TABLES = {"ruler": ("align", "rulers"), "control": ("align", "controls")}


class Settings(BaseModel):
    """Base of every stage's settings: frozen; an unknown key is an error, and so is a number that isn't finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SplitRules(Settings):
    """Which sessions are for training and which for testing."""

    test: list[str] | None = Field(None, description="sessions to test on; the others train")
    train: list[str] | None = Field(None, description="sessions to train on; with `test`, others are left out")
    test_fraction: float = Field(0.25, gt=0, lt=1, description="fraction of a single session's time to test on")
    val_fraction: float = Field(0.1, ge=0, lt=0.5, description="fraction of the training walks held out for validation")
    allow_leak: bool = Field(False, description="allow test frames within 5 s of training frames of a session")

    @model_validator(mode="after")
    def _consistent(self) -> "SplitRules":
        for side, names in (("test", self.test), ("train", self.train)):
            if names == []:
                raise ValueError(f"{side} lists no session; leave it out where it's to list none")
        if both := sorted({*(self.test or [])} & {*(self.train or [])}):
            raise ValueError(f"session {both[0]!r} is listed for training and testing")
        return self


class SceneConfig(Settings):
    """A scene, or a group of scenes that share a model (`members`)."""

    name: str
    description: str = Field("", description="one line that lists of scenes show")
    environment: Literal["outdoor", "indoor", "unknown"] = Field(
        "unknown", description="outdoor or indoor scenes share Table II's averages and MS-T's first loss weights"
    )
    can_simulate: bool = Field(False, description="simulation/ knows this place")
    members: list[str] = Field(default_factory=list, description="a group's scenes, or groups")
    stages: list[str] = Field(default_factory=lambda: list(STAGES), description="what a group itself runs")
    split: SplitRules = SplitRules()

    @property
    def is_group(self) -> bool:
        return bool(self.members)


T = TypeVar("T", bound=Settings)
ConfigKind = Literal["profiles", "scenes"]
# What the files have at the top beside the stages' sections.
_TOP = {"profiles": ("description",), "scenes": (*SceneConfig.model_fields, *_TABLES)}


def is_name(text: str) -> bool:
    """Whether a scene or profile can have this name: it's one folder's name everywhere."""
    return re.fullmatch(_NAME, text) is not None


def checked_name(kind: Literal["scene", "profile"], name: str) -> str:
    """`name`, fit to be one folder's name everywhere; UserError otherwise. Every path with a name in it passes here."""
    if not is_name(name):
        raise UserError(
            f"this can't be the name of a {kind}",
            found=repr(name if len(name) <= 100 else name[:97] + "...") + f" ({len(name)} characters)",
            expected="1 to 100 letters a-z or A-Z, digits, - and _, beginning with a letter or digit",
        )
    return name


class DataRoot:
    """The data folder, all of which is the user's: captures/, runs/, and files of profiles/ and scenes/, each of which
    adds to the shipped one of its name, and goes before it; a file of published/ replaces the shipped one.

    `before`, in the data folder of a change: the run whose recordings are added to or taken out. `holds`: what it says
    of frames that are still there stays as it is."""

    def __init__(self, root: Path, before: Path | None = None, *, holds: bool = False) -> None:
        self.root, self.before, self.holds = root.absolute(), before, holds

    def captures(self, scene: str) -> Path:
        """data/captures/<scene>; UserError for a name that isn't one."""
        return self.root / "captures" / checked_name("scene", scene)

    def run(self, profile: str, scene: str, stage: str = "") -> Path:
        """data/runs/<profile>/<scene>/<stage>; UserError for a name that isn't one."""
        return self.root / "runs" / checked_name("profile", profile) / checked_name("scene", scene) / stage

    def config_files(self, kind: ConfigKind, name: str) -> list[Path]:
        """The files <kind>/<name>.toml that there are: the shipped one, then the user's, whose settings win."""
        bases = dict.fromkeys((SHIPPED_DATA, self.root))
        return [path for base in bases if (path := base / kind / f"{name}.toml").is_file()]

    def files(self, folder: str) -> dict[str, Path]:
        """The files of a folder by name: profiles, scenes or published, each the user's or else as shipped."""
        bases = (SHIPPED_DATA, self.root)
        return {p.name: p for base in bases for p in sorted((base / folder).glob("*")) if p.is_file()}

    def names(self, kind: ConfigKind) -> list[str]:
        """The names of all scene or profile files."""
        return sorted(path.stem for path in self.files(kind).values() if path.suffix == ".toml")

    def scenes(self) -> list[str]:
        """The names of all scenes and groups of scenes: those with a file, captures or a run, and those whose captures
        are a link to what isn't there now, as on a disk that isn't mounted."""
        places = (path for folder in ("captures", "runs/*") for path in self.root.glob(f"{folder}/*"))
        folders = {path.name for path in places if path.is_dir() or path.is_symlink()}
        return sorted({*self.names("scenes"), *filter(is_name, folders)})

    def profile(self, name: str) -> dict[str, Any]:
        """A profile's sections; UserError where there is no such profile."""
        paths = self.config_files("profiles", checked_name("profile", name))
        if not paths:
            names = ", ".join(self.names("profiles"))
            raise UserError(f"there is no profile {name!r}", where=self.root / "profiles", expected=f"one of {names}")
        return _merged(_read_file(path, "profiles") for path in paths)

    def scene(self, name: str) -> tuple[SceneConfig, dict[str, Any]]:
        """A scene's config and its stage sections; a scene without a file has the defaults."""
        paths = self.config_files("scenes", checked_name("scene", name))
        content = _merged(_read_file(path, "scenes") for path in paths)
        sections = {key: content.pop(key) for key in _SECTIONS if key in content}
        where = ", ".join(map(str, paths)) or f"scene {name!r}"
        return validated(SceneConfig, {**content, "name": name}, where), sections

    def leaves(self, scene: SceneConfig, groups: tuple[str, ...] = ()) -> list[str]:
        """The scenes under a group, in order, each once; a plain scene is its own only leaf. UserError where a group is
        a member of itself, `groups` being those around the scene."""
        if not scene.is_group:
            return [scene.name]
        above = (*groups, scene.name)
        if scene.name in groups:
            raise UserError(
                f"the group of scenes {scene.name} is a member of itself",
                where=self.config_files("scenes", scene.name)[-1],
                found=" has the member ".join(above),
                do="take one of these members out",
            )
        return list(dict.fromkeys(leaf for m in scene.members for leaf in self.leaves(self.scene(m)[0], above)))


def resolve_settings(
    model: type[T], section: str, data: DataRoot, profile: str, scene: str, overrides: Sequence[str] = ()
) -> T:
    """A stage's settings: code defaults, then the profile, the scene and `key=value` overrides, later ones winning.

    UserError for an unknown key, a wrong type or a value out of range.
    """
    data.profile(profile), data.scene(scene)  # each as a whole, before a section of it
    stated = [
        *_sections_of(data, section, "profiles", profile),
        *_sections_of(data, section, "scenes", scene),
        *((f"--set {override}", _nested(override)) for override in overrides),
    ]
    merged = _merged(content for _, content in stated)

    def where(key: Sequence[Any]) -> str:
        """The last source that states a key, or each one that states any where none does."""
        sources = [source for source, content in stated if content]
        return next((s for s, content in reversed(stated) if key and key[0] in content), ", ".join(sources))

    return validated(model, merged, where)


def _sections_of(data: DataRoot, section: str, kind: ConfigKind, name: str) -> list[tuple[str, dict[str, Any]]]:
    """A section in each of the files of a profile or scene, and where it stands."""
    return [(f"[{section}] of {p}", _read_file(p, kind).get(section, {})) for p in data.config_files(kind, name)]


def validated(model: type[T], content: dict[str, Any], where: str | Callable[[Sequence[Any]], str]) -> T:
    """`content` as a settings model; UserError naming a key that doesn't fit, and where it stands, which may be a
    function of the key's path."""
    place = where if callable(where) else lambda key: where
    try:
        # As JSON, whose strict mode takes a list for a tuple and text for an enumeration, as TOML has them, but neither
        # text nor true for a number.
        return model.model_validate_json(json.dumps(content, default=_refuse_time), strict=True)
    except UserError as error:  # a value that names no entry of a registry
        error.details["where"] = ", ".join(filter(None, [str(error.details["where"] or ""), place(())])) or None
        raise
    except ValidationError as error:
        # A key that there isn't says most: its right name may be what is missing.
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        key = ".".join(str(part) for part in first["loc"])
        listed = {"extra_forbidden": "one of " + ", ".join(model.model_fields), "bool_type": "true or false"}
        raise UserError(
            f"setting {key!r}: {first['msg']}",
            where=place(first["loc"]),
            found=None if first["type"] == "missing" else repr(first.get("input")),
            expected=listed.get(first["type"]),
            do="correct it; `groundwalk <stage> --help` lists the settings",
        ) from None


def _refuse_time(value: object) -> object:
    raise UserError("no setting is a date or a time", found=value, do="put it in quotes where it's text")


def _nested(override: str) -> dict[str, Any]:
    """`a.b=value` as the tables that it stands for."""
    key, eq, value = override.partition("=")
    if not eq:
        raise UserError("a setting needs a value", found=override, expected="key=value", where="--set")
    try:
        override.encode()
    except UnicodeEncodeError:
        raise UserError("a setting isn't text in UTF-8", found=override, where="--set") from None
    text = value.strip()
    try:
        content = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        content = {} if "\n" in text else {"value": text}  # a bare word is a string
    if content.keys() != {"value"}:
        raise UserError("one --set has one setting", where="--set", found=repr(text), do="give --set several times")
    nested = content["value"]
    for part in reversed(key.strip().split(".")):
        nested = {part: nested}
    return nested


def _merged(contents: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Tables in one, later ones winning key by key."""
    merged: dict[str, Any] = {}
    for content in contents:
        for key, value in content.items():
            both = isinstance(value, dict) and isinstance(merged.get(key), dict)
            merged[key] = _merged([merged[key], value]) if both else value
    return merged


def _read_file(path: Path, kind: ConfigKind) -> dict[str, Any]:
    """The content of a profile's or scene's file, lists of tables in the sections of their stages."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UserError("a settings file can't be read", where=path, found=error, expected="TOML in UTF-8") from None
    known = (*_SECTIONS, *_TOP[kind])
    for key, value in content.items():
        if key not in known:
            raise UserError(f"unknown section {key!r}", where=path, expected="one of " + ", ".join(known))
        if key in _SECTIONS and not isinstance(value, dict):
            raise UserError(f"{key} is a section of settings", where=path, found=value, expected=f"[{key}]")
        if key in _TABLES and not isinstance(value, list):
            raise UserError(f"{key} is a list of tables", where=path, found=f"[{key}]", expected=f"[[{key}]]")
    for table, (section, setting) in _TABLES.items():
        if table in content:
            content.setdefault(section, {})[setting] = content.pop(table)
    return content
