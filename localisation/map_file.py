"""One file of named arrays: versioned, checksummed, memory-mappable.

docs/reference/map-format.md describes every byte.
"""

import hashlib
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.store.errors import UserError
from groundwalk.store.files import written_aside

MAGIC = b"GWMAP\r\n\x1a"
MAJOR, MINOR = 1, 1
_HEADER = struct.Struct("<8sHHIQ32s8x")
_SECTION = struct.Struct("<16s8s3IIQQ")
_ALIGNED = 64
_METADATA = "metadata"
_TYPES = {"<u1", "<u2", "<u4", "<i1", "<f2", "<f4", "<f8"}


def write_sections(path: Path, arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]) -> None:
    """Write a map file. A killed write leaves no file of that name."""
    with written_aside(path) as partial:
        partial.write_bytes(packed(arrays, metadata))


def packed(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]) -> bytes:
    """The bytes of a map file; the same for the same content."""
    text = json.dumps(metadata, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    everything = {**arrays, _METADATA: np.frombuffer(text, np.uint8)}
    table, body = [], bytearray()
    start = _HEADER.size + _SECTION.size * len(everything)
    for name, array in sorted(everything.items()):
        code = array.dtype.newbyteorder("<").str.replace("|", "<")
        if code not in _TYPES or array.ndim > 3:
            raise ValueError(f"map section {name}: {array.dtype} with {array.ndim} dimensions")
        content = np.ascontiguousarray(array.astype(code, copy=False)).tobytes()
        body += b"\0" * (-(start + len(body)) % _ALIGNED)
        shape = [*array.shape, *[1] * (3 - array.ndim)]
        table.append(_SECTION.pack(name.encode(), code.encode(), *shape, array.ndim, start + len(body), len(content)))
        body += content
    rest = b"".join(table) + bytes(body)
    digest = hashlib.sha256(rest).digest()
    return _HEADER.pack(MAGIC, MAJOR, MINOR, len(everything), _HEADER.size + len(rest), digest) + rest


def read_sections(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays of a map file by name, mapped into memory and read-only, and its metadata; UserError where it isn't
    one, is cut short, damaged or newer."""
    try:
        content = np.memmap(path, np.uint8, "r")
    except (OSError, ValueError) as error:
        raise UserError("a map can't be read", where=path, found=error, do="build it again") from error
    if len(content) < _HEADER.size or bytes(content[:8]) != MAGIC:
        raise UserError("this isn't a map file", where=path, expected=f"a file that starts with {MAGIC!r}")
    _, major, minor, count, length, digest = _HEADER.unpack(bytes(content[: _HEADER.size]))
    if major != MAJOR:
        raise UserError(
            "a map has another version",
            where=path,
            expected=f"{MAJOR}.x",
            found=f"{major}.{minor}",
            do="update groundwalk, or build the map again",
        )
    if length != len(content):
        raise UserError("a map is cut short", where=path, expected=f"{length} bytes", found=f"{len(content)} bytes")
    if hashlib.sha256(content[_HEADER.size :].data).digest() != digest:
        raise UserError("a map is damaged: its content doesn't have its checksum", where=path, do="build it again")
    arrays: dict[str, NDArray[Any]] = {}
    for number in range(count):
        at = _HEADER.size + _SECTION.size * number
        name, code, *shape, dimensions, offset, size = _SECTION.unpack(bytes(content[at : at + _SECTION.size]))
        array = content[offset : offset + size].view(np.dtype(code.rstrip(b"\0").decode()))
        arrays[name.rstrip(b"\0").decode()] = array.reshape(shape[:dimensions])
    return arrays, json.loads(bytes(arrays.pop(_METADATA)))
