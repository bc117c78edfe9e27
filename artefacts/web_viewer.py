"""Rerun's viewer in a browser, as a page that asks this machine alone.

Rerun's own page loads a font and a script of statistics from elsewhere. Here it comes through a server that forbids
that (Content-Security-Policy), listens on the loopback address, and refuses requests for other hosts.
"""

import os
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
from urllib.parse import quote

from groundwalk.artefacts.errors import UserError

_LOOPBACK = "127.0.0.1"
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data: http://127.0.0.1:* http://localhost:*"
)
_FORWARDED = ("Content-Type", "Content-Encoding", "Cache-Control")
_STARTED_WITHIN_S = 30.0


def rerun_command(files: Sequence[str]) -> list[str]:
    """The viewer's command line for recordings."""
    return [str(Path(sys.executable).with_name("rerun")), *files]


def rerun_environment() -> dict[str, str]:
    """The viewer sends no telemetry where CI is set; a user's own rerun keeps the user's own choice."""
    return {**os.environ, "CI": "1"}


def view_in_browser(files: Sequence[str]) -> int:
    """Serve the recordings until the viewer's server ends; its exit status. Opens the page in the browser."""
    web, data = _free_port(), _free_port()
    ports = ["--serve-web", "--bind", _LOOPBACK, "--web-viewer-port", str(web), "--port", str(data)]
    with subprocess.Popen([*rerun_command(files), *ports], env=rerun_environment()) as rerun:
        try:
            _wait_for(f"http://{_LOOPBACK}:{web}/", rerun)
            with page_server(f"http://{_LOOPBACK}:{web}") as server:
                Thread(target=server.serve_forever, daemon=True).start()
                source = quote(f"rerun+http://localhost:{data}/proxy", safe="")
                page = f"http://{_LOOPBACK}:{server.server_port}/?url={source}"
                print(f"Look at {page} (Ctrl-C ends it)", flush=True)
                webbrowser.open(page)
                return rerun.wait()
        finally:
            rerun.terminate()


def page_server(upstream: str) -> ThreadingHTTPServer:
    """A server on a free port of the loopback address that gives what `upstream` does, with the policy."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            _, port = self.connection.getsockname()
            if self.headers.get("Host") not in (f"{_LOOPBACK}:{port}", f"localhost:{port}"):
                self.send_error(403, "another host's name")
                return
            try:
                with urllib.request.urlopen(upstream + self.path) as answer:
                    status, headers, body = answer.status, answer.headers, answer.read()
            except urllib.error.HTTPError as error:
                status, headers, body = error.code, error.headers, error.read()
            self.send_response(status)
            for name in _FORWARDED:
                if name in headers:
                    self.send_header(name, headers[name])
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", _POLICY)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    return ThreadingHTTPServer((_LOOPBACK, 0), Page)


def _free_port() -> int:
    with socket.socket() as held:
        held.bind((_LOOPBACK, 0))
        return int(held.getsockname()[1])


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
