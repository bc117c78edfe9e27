"""Rerun's viewer, in a window or in a browser, for this user alone as far as it can be.

Of itself Rerun listens on all addresses, and offers the files that it opens to whoever asks. Here it listens on the
loopback address, reads recordings from a pipe, and its page for browsers comes through a server of our own: that
forbids the page to load anything from elsewhere (Content-Security-Policy), refuses requests for other hosts, and has
the recordings under a path that nobody else knows.
"""

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import quote

from groundwalk.store.errors import UserError
from groundwalk.store.files import RECORDING, read_json
from groundwalk.store.hints import run_command
from groundwalk.store.manifests import MANIFEST, outdated_stages
from groundwalk.store.progress import console
from groundwalk.store.settings import STAGES

_LOOPBACK = "127.0.0.1"
_POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:"
_FORWARDED = ("Content-Type", "Content-Encoding", "Cache-Control")
_STARTED_WITHIN_S = 30.0


def view_run(folder: Path, *, web: bool) -> int:
    """Show the recordings of a run's finished stages until the viewer is closed; its exit status. UserError where there
    is none."""
    files = [path for stage in STAGES if (path := folder / stage / RECORDING).is_file()]
    if not files:
        raise UserError("there is no recording to view", where=folder, do=run_command(folder / STAGES[-1]))
    manifests = {stage: read_json(folder / stage / MANIFEST) for stage in STAGES}
    known = {stage: manifest for stage, manifest in manifests.items() if isinstance(manifest.get("scene"), dict)}
    for stage, of in outdated_stages(folder, known).items():
        console.print(f"warning: {stage} is outdated: {of} was run again since")
    return view_in_browser(files) if web else view_in_window(files)


def view_in_window(files: Sequence[Path]) -> int:
    """Show the recordings until the viewer is closed; its exit status."""
    with _rerun("-", "--port", "auto", stdin=subprocess.PIPE) as rerun:
        assert rerun.stdin is not None
        with contextlib.suppress(BrokenPipeError), rerun.stdin:  # closed before all was read
            for path in files:
                with path.open("rb") as file:
                    shutil.copyfileobj(file, rerun.stdin)
        return rerun.wait()


def view_in_browser(files: Sequence[Path]) -> int:
    """Serve the recordings until the viewer's server ends; its exit status. Opens the page in the browser."""
    with socket.socket() as held:
        held.bind((_LOOPBACK, 0))
        port = held.getsockname()[1]  # a free one
    upstream = f"http://{_LOOPBACK}:{port}"
    # Given an address instead of files, it serves its page and no data.
    with _rerun(f"{upstream}/none.rrd", "--serve-web", "--web-viewer-port", str(port)) as rerun:
        try:
            _wait_for(upstream, rerun)
            with PageServer(upstream, files) as server:
                Thread(target=server.serve_forever, daemon=True).start()
                print(f"Look at {server.address}/{server.secret} (Ctrl-C ends it)", flush=True)
                webbrowser.open(server.page_once())
                return rerun.wait()
        finally:
            rerun.terminate()


def _rerun(*arguments: str, **options: Any) -> "subprocess.Popen[bytes]":
    """Rerun without telemetry, which it doesn't send where CI is set; a user's own rerun keeps the user's choice."""
    command = [str(Path(sys.executable).with_name("rerun")), "--bind", _LOOPBACK, *arguments]
    return subprocess.Popen(command, env={**os.environ, "CI": "1", "RUST_LOG": "warn"}, **options)


class PageServer(ThreadingHTTPServer):
    """A server on a free port of the loopback address: Rerun's page, as `upstream` has it, with the policy, and files
    for whoever knows their path."""

    def __init__(self, upstream: str, files: Sequence[Path]) -> None:
        super().__init__((_LOOPBACK, 0), _Page)
        self.address, self.upstream = f"http://{_LOOPBACK}:{self.server_port}", upstream
        self.secret = secrets.token_urlsafe()
        self.files = {f"/{self.secret}/{number}.rrd": path for number, path in enumerate(files)}
        self.starts = {f"/{self.secret}"}

    def page_once(self) -> str:
        """An address of the page that works once: others see what a browser is started with."""
        once = f"/{secrets.token_urlsafe()}"
        self.starts.add(once)
        return self.address + once


class _Page(BaseHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        with contextlib.suppress(ConnectionError):  # the browser left
            self._answer()

    def _answer(self) -> None:
        host = self.headers.get("Host")
        if host not in (f"{_LOOPBACK}:{self.server.server_port}", f"localhost:{self.server.server_port}"):
            self.send_error(403, "another host's name")
        elif self.path in self.server.starts:
            self.server.starts -= {self.path} - {f"/{self.server.secret}"}
            files = "&".join(f"url={quote(f'http://{host}{path}', safe='')}" for path in self.server.files)
            self._begin(302, {"Location": f"/?{files}", "Content-Length": "0"})
        elif self.path in self.server.files:
            with self.server.files[self.path].open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                self._begin(200, {"Content-Type": "application/octet-stream", "Content-Length": str(size)})
                shutil.copyfileobj(file, self.wfile)
        else:
            try:
                with urllib.request.urlopen(self.server.upstream + self.path) as answer:
                    status, headers, body = answer.status, answer.headers, answer.read()
            except urllib.error.HTTPError as error:
                status, headers, body = error.code, error.headers, error.read()
            except OSError as error:
                return self.send_error(502, str(error))
            forwarded = {name: headers[name] for name in _FORWARDED if name in headers}
            self._begin(status, {**forwarded, "Content-Length": str(len(body))})
            self.wfile.write(body)

    def _begin(self, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Security-Policy": _POLICY, "Referrer-Policy": "no-referrer"}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        pass


def _wait_for(page: str, rerun: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + _STARTED_WITHIN_S
    while rerun.poll() is None and time.monotonic() < end:
        try:
            urllib.request.urlopen(page).close()
        except OSError:
            time.sleep(0.1)
        else:
            return
    raise UserError("the viewer doesn't start", where=page, do="look at what it printed above")
