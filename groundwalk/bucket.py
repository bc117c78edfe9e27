"""Captures from a bucket, and results into one: Amazon's S3 and servers like it, Google Cloud Storage and Azure's, as
PyArrow's file systems reach them. Credentials are those that their own tools take, as AWS_ACCESS_KEY_ID."""

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pyarrow import fs

from groundwalk.store.errors import UserError
from groundwalk.store.files import file_names, leads_outside, written_aside
from groundwalk.store.progress import track

_TRANSFERS = 8  # at once
_CHUNK_BYTES = 8 << 20


def is_address(text: str) -> bool:
    """Whether it names a place in a bucket, as s3://bucket/folder, and no folder of this machine."""
    return "://" in text


def download(address: str, folder: Path) -> None:
    """Make a folder hold the files below an address: what has another size or time there is loaded, and what is gone
    there is removed here. UserError where it can't be read, or there are no files, and for a link, whose files are
    somebody's own."""
    if folder.is_symlink():
        raise UserError("the folder for a bucket's captures is a link", where=folder, expected="a folder, or nothing")
    bucket, base = _opened(address)
    with _explained(address):
        found = bucket.get_file_info(fs.FileSelector(base, recursive=True))
    files = {one.path.removeprefix(base).lstrip("/"): one for one in found if one.type == fs.FileType.File}
    if not files:
        raise UserError(
            "there are no files at this address of a bucket", where=_shown(address), expected="a folder of captures"
        )
    if outside := [name for name in files if leads_outside(name)]:
        raise UserError("a file's name in a bucket leads outside its folder", where=_shown(address), found=outside[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name in set(file_names(folder)) - set(files):
        (folder / name).unlink()

    def load(name: str) -> None:
        one, path = files[name], folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_aside(path) as partial:
            with partial.open("wb") as written:
                for chunk in _chunks(bucket, one.path, address):
                    written.write(chunk)
            os.utime(partial, ns=(one.mtime_ns, one.mtime_ns))
            if (size := partial.stat().st_size) != one.size:
                where, expected = f"{_shown(address)}/{name}", f"{one.size} bytes"
                raise UserError("a download from a bucket ended early", where=where, expected=expected, found=size)

    changed = [name for name, one in files.items() if _size_and_time(folder / name) != (one.size, one.mtime_ns)]
    _at_once(load, changed, f"loading {folder.name} from {_shown(address)}")


def upload(root: Path, names: Iterable[str], address: str) -> int:
    """Send files of `root`, by their paths in it, to the same paths below an address, but for those that are there with
    this size and aren't older; how many were sent. UserError where it can't be written."""
    bucket, base = _opened(address)
    everything = fs.FileSelector(base, recursive=True, allow_not_found=True)
    with _explained(address):
        there = {one.path: one for one in bucket.get_file_info(everything)}

    def is_newer(name: str) -> bool:
        size, time = _size_and_time(root / name)
        sent = there.get(f"{base}/{name}")
        return sent is None or sent.size != size or sent.mtime_ns < time

    def send(name: str) -> None:
        with (
            (root / name).open("rb") as read,
            _explained(address),
            bucket.open_output_stream(f"{base}/{name}") as stream,
        ):
            shutil.copyfileobj(read, stream, _CHUNK_BYTES)

    newer = [name for name in names if is_newer(name)]
    _at_once(send, newer, f"sending results to {_shown(address)}")
    return len(newer)


def _opened(address: str) -> tuple[fs.FileSystem, str]:
    with _explained(address):
        bucket, base = fs.FileSystem.from_uri(address)
    return bucket, base.rstrip("/")


def _shown(address: str) -> str:
    """Without a key that stands in it."""
    return re.sub("//[^/]*:[^/]*@", "//", address)


def _chunks(bucket: fs.FileSystem, path: str, address: str) -> Iterator[bytes]:
    with _explained(address), bucket.open_input_stream(path) as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            yield chunk


@contextlib.contextmanager
def _explained(address: str) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, NotImplementedError) as error:
        raise UserError(
            "a bucket can't be reached",
            where=_shown(address),
            expected="s3://bucket/folder, gs://bucket/folder or abfss://container@account/folder",
            found=" ".join(str(error).split()),
            do="check the address, the network and the credentials (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY,"
            " AWS_REGION; AWS_ENDPOINT_URL for a server that isn't Amazon's)",
        ) from None


def _size_and_time(path: Path) -> tuple[int, int]:
    return (path.stat().st_size, path.stat().st_mtime_ns) if path.is_file() else (-1, 0)


def _at_once(transfer: Callable[[str], None], names: list[str], text: str) -> None:
    with ThreadPoolExecutor(_TRANSFERS) as pool:
        for _ in track(pool.map(transfer, names), text, len(names)):
            pass
