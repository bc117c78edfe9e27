"""What can be added to groundwalk: records that entry points name, groundwalk's own and other packages' alike.

There is one registry a kind (capture formats, mappers, retrieval, structure localisers, regressors, fusion methods,
exporters). An entry point of group `groundwalk.<kind>` names a record of the kind's class; its name is the record's id.
Records of groundwalk itself are listed in `builtin.py`, those of other packages in their metadata. A plug-in that can't
be used is named with its package and entry point, and all others go on.
"""

import contextlib
import pkgutil
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from typing import Any, ClassVar, Generic, TypeVar

from groundwalk.store import progress
from groundwalk.store.builtin import BUILTIN
from groundwalk.store.errors import UserError
from groundwalk.store.settings import Settings, validated

Colour = tuple[int, int, int]
GROUNDWALK = "groundwalk"
AN_ID = "1 to 40 letters a-z or A-Z, digits, - and _, beginning with a letter or digit"


def is_id(name: object) -> bool:
    """Whether a name is fit to be an entry's id: for settings, paths and entity paths of recordings."""
    return isinstance(name, str) and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}", name) is not None


@dataclass(frozen=True)
class Lazy:
    """Calls `module:name`, which is imported at the first call: a record then costs nothing until it is used."""

    reference: str

    def __call__(self, *arguments: Any, **more: Any) -> Any:
        return pkgutil.resolve_name(self.reference)(*arguments, **more)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Base of the records.

    id: as in settings, tables and file names; the entry point's name. label: as tables and pages print it. meaning: the
    entry in a few words.
    """

    id: str
    label: str
    meaning: str

    noun: ClassVar[str]
    """What the kind is called in messages."""

    def faults(self) -> Iterable[str]:
        """What is wrong with the record; a kind with more fields checks these, too."""
        if not is_id(self.id):
            yield f"id is {self.id!r}, not {AN_ID}"
        for name in ("label", "meaning"):
            if not isinstance(getattr(self, name), str):
                yield f"{name} is {getattr(self, name)!r}, not text"


def colour_faults(colour: object) -> Iterable[str]:
    """What is wrong with a record's colour, which should be three whole numbers from 0 to 255."""
    parts = colour if isinstance(colour, tuple) else ()
    if len(parts) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in parts):
        yield f"colour is {colour!r}, not (red, green, blue) from 0 to 255"


def callable_faults(record: object, names: Iterable[str]) -> Iterable[str]:
    """What is wrong with a record's functions."""
    for name in names:
        if not callable(getattr(record, name)):
            yield f"{name} is {getattr(record, name)!r}, not a function"


@dataclass(frozen=True)
class Source:
    """Where an entry comes from."""

    package: str
    version: str
    point: metadata.EntryPoint

    @property
    def is_builtin(self) -> bool:
        return self.package == GROUNDWALK

    def __str__(self) -> str:
        return (
            f"package {self.package} {self.version}, entry point {self.point.group}: "
            f"{self.point.name} = {self.point.value}"
        )


class PluginError(UserError):
    """A plug-in that can't be used or fails; says its package and entry point."""

    def __init__(self, what: str, *, reason: str = "", **details: Any) -> None:
        super().__init__(what, **details)
        self.reason = reason

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (self.what, self.reason, self.details)


def _rebuild(what: str, reason: str, details: dict[str, Any]) -> PluginError:
    return PluginError(what, reason=reason, **details)


E = TypeVar("E", bound=Entry)


class Registry(Mapping[str, E], Generic[E]):
    """The usable entries of one kind by id: groundwalk's own in their order, then other packages' by package and id."""

    def __init__(self, group: str, record: type[E]) -> None:
        self.group = group
        self.record = record

    def __getitem__(self, entry_id: str) -> E:
        return self._loaded.entries[entry_id]

    def __iter__(self) -> Iterator[str]:
        return iter(self._loaded.entries)

    def __len__(self) -> int:
        return len(self._loaded.entries)

    @property
    def builtin(self) -> tuple[str, ...]:
        """The ids of groundwalk's own entries."""
        return tuple(BUILTIN[self.group])

    @property
    def problems(self) -> Mapping[str, list[PluginError]]:
        """Entry points that can't be used, by their name."""
        return self._loaded.problems

    def source(self, entry_id: str) -> Source:
        """Where a usable entry comes from."""
        return self._loaded.sources[entry_id]

    def find(self, entry_id: str) -> E:
        """The entry of that id; UserError where there is none, PluginError where it can't be used."""
        if entry_id in self:
            return self[entry_id]
        if entry_id in self.problems:
            raise self.problems[entry_id][0]
        raise UserError(
            f"there is no {self.record.noun} {entry_id!r}",
            expected=f"one of {', '.join(self)}",
            do="correct the name, or install the package that brings it",
        )

    def known(self, entry_id: str) -> str:
        """The id itself, for settings; raises as `find` does."""
        self.find(entry_id)
        return entry_id

    @contextlib.contextmanager
    def guard(self, entry_id: str) -> Iterator[None]:
        """Turns what another package's entry raises into a PluginError. UserErrors, which say what the user's data or
        settings have, stay as they are, and so do all errors of groundwalk's own entries."""
        try:
            yield
        except Exception as error:
            if self.source(entry_id).is_builtin or isinstance(error, UserError):
                raise
            raise self.failure(entry_id, _in_words(error)) from error

    def failure(self, entry_id: str, reason: str) -> PluginError:
        """The error for an entry that does something wrong."""
        return _error(f"{self.record.noun} {entry_id!r} failed", self.source(entry_id), reason)

    def unusable(self, entry_ids: Iterable[str]) -> list[PluginError]:
        """Why those of the entries take no part that can't be used."""
        return [error for name in entry_ids if name not in self for error in self.problems.get(name, [])]

    def sections(self, content: object, selected: Iterable[str], table: str) -> object:
        """Sections of settings, by entry, as the entries' settings models; kept are those of `selected`, on which alone
        a run depends. `table` is where they stand: `train.regressors`. For a validator of mode "before": what isn't a
        table is returned as it is; raises as `find` does, and UserError for a setting that doesn't fit."""
        if not isinstance(content, dict):
            return content
        selected = tuple(selected)
        for name in (*selected, *content):
            if name not in self.problems:
                self.find(name)
        usable = [name for name in self if name in selected or name in content]
        checked = {name: self._section(name, content.get(name, {}), table) for name in usable}
        return {name: settings for name, settings in checked.items() if name in selected}

    def _section(self, name: str, content: object, table: str) -> Settings:
        if isinstance(content, Settings):
            return content
        if not isinstance(content, dict):
            raise ValueError(f"{name} is {content!r}, not a section of settings")
        entry: Any = self[name]  # of a kind whose records have `settings`
        section: Settings = validated(entry.settings, content, f"[{table}.{name}]")
        return section

    def versions(self, entry_ids: Iterable[str]) -> dict[str, str]:
        """Package and version of the entries that other packages bring: what they compute depends on these, too."""
        sources = {i: self._loaded.sources[i] for i in entry_ids if i in self._loaded.sources}
        return {i: f"{s.package} {s.version}" for i, s in sources.items() if not s.is_builtin}

    @cached_property
    def _loaded(self) -> "_Loaded[E]":
        loaded = _Loaded[E]({}, {}, {})
        for source in [*_builtin(self.group), *_installed(self.group)]:
            self._load(source, loaded)
        for errors in loaded.problems.values():
            for error in errors:
                progress.console.print(f"warning: {error}")
        return loaded

    def _load(self, source: Source, loaded: "_Loaded[E]") -> None:
        try:
            reason = self._id_clash(source, loaded)
            record = None if reason else source.point.load()
            reason = reason or "; ".join(self._faults(record, source))
        except (Exception, SystemExit) as error:
            if source.is_builtin:
                raise
            record, reason = None, f"it can't be imported: {_in_words(error)}"
        if reason:
            what = f"{self.record.noun} {source.point.name!r} is left out"
            loaded.problems.setdefault(source.point.name, []).append(_error(what, source, reason))
        elif isinstance(record, self.record):
            loaded.entries[record.id] = record
            loaded.sources[record.id] = source

    def _id_clash(self, source: Source, loaded: "_Loaded[E]") -> str:
        name = source.point.name
        return f"its id is taken: {loaded.sources[name]}" if name in loaded.entries else ""

    def _faults(self, record: object, source: Source) -> Iterator[str]:
        if not isinstance(record, self.record):
            wanted = f"{self.record.__module__}.{self.record.__qualname__}"
            yield f"it is a {type(record).__name__}, not a {wanted}"
            return
        yield from record.faults()
        if record.id != source.point.name:
            yield f"its id is {record.id!r}, not the entry point's name"


@dataclass(frozen=True)
class _Loaded(Generic[E]):
    entries: dict[str, E]
    sources: dict[str, Source]
    problems: dict[str, list[PluginError]]


def _builtin(group: str) -> list[Source]:
    points = [metadata.EntryPoint(name, value, group) for name, value in BUILTIN[group].items()]
    return [Source(GROUNDWALK, "", point) for point in points]


def _installed(group: str) -> list[Source]:
    """Entry points of installed packages by package and name; of groundwalk itself none, whatever an older one says."""
    sources = [
        Source(point.dist.metadata["Name"], point.dist.version, point)
        for point in metadata.entry_points(group=group)
        if point.dist is not None
    ]
    others = [source for source in sources if not source.is_builtin]
    return sorted(others, key=lambda source: (source.package.lower(), source.point.name))


def _error(what: str, source: Source, reason: str) -> PluginError:
    do = f"mend or update {source.package}, or take the entry out of the settings"
    return PluginError(what, where=str(source), found=reason, do=do, reason=reason)


def _in_words(error: BaseException) -> str:
    text = error.what if isinstance(error, UserError) else str(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
