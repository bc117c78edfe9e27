"""The files of a bundle: which there are, and whether they are as they were written."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from groundwalk.store.errors import UserError
from groundwalk.store.files import hash_files, leads_outside, write_json

FORMAT = "groundwalk-bundle"
MAJOR, MINOR = 1, 0
MANIFEST = "bundle.json"
PREPROCESSING = "preprocessing.json"
FRAME = "frame.json"
ERRORS = "errors.json"
GOLDEN = "golden/golden.json"
_AGAIN = "copy the bundle again, or export it again"


def write_manifest(folder: Path, content: Mapping[str, Any]) -> None:
    """Write bundle.json over all files that the folder has, with the sha256 of each and of itself."""
    files = hash_files(folder, (path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST))
    manifest = {"format": FORMAT, "version": [MAJOR, MINOR], **content, "files": files}
    write_json(folder / MANIFEST, {**manifest, "sha256": _digest(manifest)})


def read_manifest(folder: Path) -> dict[str, Any]:
    """The content of bundle.json after a look at every file; UserError where the folder isn't a bundle, is one of a
    newer version, lacks a file, or has one that was changed."""
    path = folder / MANIFEST
    if not path.is_file():
        actual = "no such folder" if not folder.is_dir() else f"no {MANIFEST} in it"
        raise UserError("this isn't a bundle", where=folder, found=actual, expected="what `groundwalk export` wrote")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError("a bundle's manifest can't be read", where=path, found=error, do=_AGAIN) from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise UserError("this isn't a bundle", where=path, expected=f"an object with format {FORMAT!r}")
    version = manifest.get("version")
    if not (isinstance(version, list) and len(version) == 2 and version[0] == MAJOR):
        newer = isinstance(version, list) and version[:1] > [MAJOR]
        raise UserError(
            "a bundle has another version of its format",
            where=path,
            expected=f"{MAJOR}.x",
            found=".".join(map(str, version)) if isinstance(version, list) else version,
            do="update groundwalk" if newer else "export it again",
        )
    if manifest.pop("sha256", None) != _digest(manifest):
        raise UserError("a bundle's manifest was changed: it doesn't have its sha256", where=path, do=_AGAIN)
    _check_files(folder, manifest["files"])
    return manifest


def read_part(folder: Path, name: str) -> dict[str, Any]:
    """A JSON file of a bundle that `read_manifest` has looked at."""
    return dict(json.loads((folder / name).read_text(encoding="utf-8")))


def _check_files(folder: Path, listed: Mapping[str, str]) -> None:
    outside = [name for name in listed if leads_outside(name)]
    missing = [*outside, *(name for name in listed if name not in outside and not (folder / name).is_file())]
    if missing:
        raise UserError("a bundle lacks a file", where=folder / missing[0], do=_AGAIN)
    digests = hash_files(folder, [folder / name for name in listed])
    changed = [name for name, digest in listed.items() if digests[name] != digest]
    if changed:
        raise UserError(
            "a file of a bundle was changed: it doesn't have its sha256", where=folder / changed[0], do=_AGAIN
        )


def _digest(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
