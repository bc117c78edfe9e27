"""What can be added to groundwalk: records that entry points name, groundwalk's own and other packages' alike.

There is one registry a kind (capture formats, mappers, structure localisers, regressors, fusion methods, exporters). An
entry point of group `groundwalk.<kind>` names a record of the kind's class; its name is the record's id.
Records of groundwalk itself are listed in `builtin.py`, those of other packages in their metadata. A plug-in that can't
be used is named with its package and entry point, and all others go on.
"""

import contextlib
import pkgutil
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import metadata
from typing import Any, ClassVar, Generic, TypeVar, cast

from groundwalk.store import progress
from groundwalk.store.builtin import BUILTIN
from groundwalk.store.errors import UserError
from groundwalk.store.settings import Settings, validated
from groundwalk.store.signals import handlers_kept

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

    def load(self) -> Any:
        """What it stands for, imported."""
        with handlers_kept():
            return pkgutil.resolve_name(self.reference)

    def __call__(self, *arguments: Any, **more: Any) -> Any:
        return self.load()(*arguments, **more)


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
    """Where an entry of another package comes from."""

    package: str
    version: str
    point: metadata.EntryPoint

    def __str__(self) -> str:
        point = f"entry point {self.point.group}: {self.point.name} = {self.point.value}"
        return f"package {self.package} {self.version}, {point}"

    def error(self, what: str, reason: str) -> "PluginError":
        do = f"mend or update {self.package}, or take the entry out of the settings"
        return PluginError(what, where=str(self), found=reason, do=do)


class PluginError(UserError):
    """A plug-in that can't be used or fails; says its package and entry point, and `found`, why."""

    @property
    def reason(self) -> str:
        return str(self.details["found"])


E = TypeVar("E", bound=Entry)


@dataclass(frozen=True)
class _Others(Generic[E]):
    """The entries of other packages by id, where each comes from, and why others can't be used."""

    entries: dict[str, E] = field(default_factory=dict)
    sources: dict[str, Source] = field(default_factory=dict)
    problems: dict[str, list[PluginError]] = field(default_factory=dict)


class Registry(Mapping[str, E], Generic[E]):
    """The usable entries of one kind by id: groundwalk's own in their order, then other packages' by package and id.

    groundwalk's own are each imported when they are asked for; of other packages all, as only then it's known which can
    be used.
    """

    def __init__(self, group: str, record: type[E]) -> None:
        self.group = group
        self.record = record

    @property
    def builtin(self) -> tuple[str, ...]:
        """The ids of groundwalk's own entries."""
        return tuple(BUILTIN[self.group])

    def __getitem__(self, entry_id: str) -> E:
        if entry_id in BUILTIN[self.group]:
            return cast(E, pkgutil.resolve_name(BUILTIN[self.group][entry_id]))
        return self._others.entries[entry_id]

    def __contains__(self, entry_id: object) -> bool:
        return entry_id in BUILTIN[self.group] or entry_id in self._others.entries

    def __iter__(self) -> Iterator[str]:
        yield from BUILTIN[self.group]
        yield from self._others.entries

    def __len__(self) -> int:
        return sum(1 for _ in self)

    @property
    def problems(self) -> Mapping[str, list[PluginError]]:
        """Entry points that can't be used, by their name."""
        return self._others.problems

    def known(self, entry_id: str) -> str:
        """The id itself, for settings; UserError where there is none, PluginError where it can't be used."""
        if entry_id in self:
            return entry_id
        if entry_id in self.problems:
            raise self.problems[entry_id][0]
        raise UserError(
            f"there is no {self.record.noun} {entry_id!r}",
            expected=f"one of {', '.join(self)}",
            do="correct the name, or install the package that brings it",
        )

    def find(self, entry_id: str) -> E:
        """The entry of that id; raises as `known` does."""
        return self[self.known(entry_id)]

    @contextlib.contextmanager
    def guard(self, entry_id: str) -> Iterator[None]:
        """Turns what another package's entry raises into a PluginError. UserErrors, which say what the user's data or
        settings have, stay as they are, and so do all errors of groundwalk's own entries."""
        try:
            yield
        except Exception as error:
            source = self._others.sources.get(entry_id)
            if source is None or isinstance(error, UserError):
                raise
            raise source.error(f"{self.record.noun} {entry_id!r} failed", _in_words(error)) from error

    def unusable(self, entry_ids: Iterable[str]) -> list[PluginError]:
        """Why those of the entries take no part that can't be used."""
        return [error for name in entry_ids if name not in self for error in self.problems.get(name, [])]

    def sections(self, content: object, selected: Iterable[str], table: str) -> object:
        """Sections of settings, by entry, as the entries' settings models; kept are those of `selected`, on which alone
        a run depends. `table` is where they stand: `train.regressors`. For a validator of mode "before": what isn't a
        table is returned as it is; raises as `known` does, and UserError for a setting that doesn't fit."""
        if not isinstance(content, dict):
            return content
        selected = tuple(selected)
        for name in (*selected, *content):
            if name not in self.problems:
                self.known(name)
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

    def versions(self, entry_ids: Iterable[str] | None = None) -> dict[str, str]:
        """Package and version of the entries (None: of all) that other packages bring: what they compute depends on
        these, too."""
        sources = self._others.sources
        ids = sources if entry_ids is None else [i for i in entry_ids if i in sources]
        return {i: f"{sources[i].package} {sources[i].version}" for i in ids}

    @cached_property
    def _others(self) -> _Others[E]:
        """Of groundwalk itself none, whatever an older installation says."""
        points = metadata.entry_points(group=self.group)
        sources = [Source(point.dist.metadata["Name"], point.dist.version, point) for point in points if point.dist]
        others = _Others[E]()
        for source in sorted(sources, key=lambda source: (source.package.lower(), source.point.name)):
            if source.package != GROUNDWALK:
                self._load(source, others)
        return others

    def _load(self, source: Source, others: _Others[E]) -> None:
        name = source.point.name
        reason, record = "", None
        if name in BUILTIN[self.group]:
            reason = f"its id is taken: package {GROUNDWALK}"
        elif name in others.sources:
            reason = f"its id is taken: {others.sources[name]}"
        else:
            try:
                record = source.point.load()
                reason = "; ".join(self._faults(record, name))
            except (Exception, SystemExit) as error:
                reason = f"it can't be imported: {_in_words(error)}"
        if reason:
            problem = source.error(f"{self.record.noun} {name!r} is left out", reason)
            others.problems.setdefault(name, []).append(problem)
            progress.console.print(f"warning: {problem}")
        else:
            others.entries[name], others.sources[name] = cast(E, record), source

    def _faults(self, record: object, name: str) -> Iterator[str]:
        if not isinstance(record, self.record):
            wanted = f"{self.record.__module__}.{self.record.__qualname__}"
            yield f"it is a {type(record).__name__}, not a {wanted}"
            return
        yield from record.faults()
        if record.id != name:
            yield f"its id is {record.id!r}, not the entry point's name"


def _in_words(error: BaseException) -> str:
    text = error.what if isinstance(error, UserError) else str(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
