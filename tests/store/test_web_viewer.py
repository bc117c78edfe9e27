"""The viewer's page comes from this machine, asks this machine, and answers to no other name."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from threading import Thread
from urllib.parse import parse_qs, urlsplit

import pytest
import rerun as rr

from groundwalk.store import web_viewer
from groundwalk.store.web_viewer import PageServer, view_in_window
from tests.known import written

_VIEW = """
import sys, webbrowser
from pathlib import Path
from groundwalk.store.web_viewer import view_in_browser
webbrowser.open = lambda page: True
view_in_browser([Path(sys.argv[1])])
"""


def answer(page: str, host: str = "") -> tuple[int, str, str]:
    """Status, policy and text."""
    request = urllib.request.Request(page, headers={"Host": host} if host else {})
    try:
        with urllib.request.urlopen(request) as got:
            policy = got.headers["Content-Security-Policy"]
            return got.status, policy, got.read().decode(errors="replace")
    except urllib.error.HTTPError as error:
        return error.code, "", ""


def listening(group: int) -> set[str]:
    """The addresses, in hexadecimal digits, that processes of a group listen on."""
    own = set()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if os.getpgid(int(process.name)) == group:
                own |= {str(file.readlink()) for file in (process / "fd").iterdir()}
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    file = tmp_path / "a.rrd"
    stream = rr.RecordingStream("groundwalk_import")
    stream.save(file)
    stream.disconnect()
    return file


def test_reruns_page_may_ask_this_machine_alone(recording: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _VIEW, str(recording)], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline()
            found = re.search(r"(http://(127\.0\.0\.1:\d+)/)\S+", said)
            assert found, said
            with urllib.request.urlopen(found[0]) as page:
                (data,) = parse_qs(urlsplit(page.url).query)["url"]
                text, policy = page.read().decode(), page.headers["Content-Security-Policy"]
            # What the page itself names elsewhere is forbidden.
            assert "<html" in text and "https:" in text
            assert "http" not in policy and policy.startswith("default-src 'self'")
            assert answer(found[1] + "re_viewer_bg.wasm")[0] == 200
            # Recordings are for who knows the secret path, and nothing else has them.
            assert answer(data)[0] == 200 and urllib.request.urlopen(data).read() == recording.read_bytes()
            assert answer(data, "evil.example")[0] == 403
            assert answer(f"{found[1]}0.rrd")[0] == 404
            if sys.platform == "linux":
                assert listening(process.pid) == {"0100007F"}
        finally:
            os.killpg(process.pid, signal.SIGKILL)


def test_a_window_gets_recordings_through_a_pipe(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rerun offers files that it opens itself to every user of the machine."""
    rerun = tmp_path / "rerun"
    rerun.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/arguments\ncat > {tmp_path}/read\n')
    rerun.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
    assert view_in_window([recording, recording]) == 0
    assert (tmp_path / "arguments").read_text() == "--bind 127.0.0.1 - --port auto\n"
    assert (tmp_path / "read").read_bytes() == 2 * recording.read_bytes()


def test_recordings_of_outdated_stages_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for stage, inputs in {"sfm": {}, "align": {"place/sfm": {"t": "old"}}, "import": {}}.items():
        made = {"outputs": {"t": "now"}, "simulated": False, "scene": {"name": "place"}, "inputs": inputs}
        written(tmp_path / stage / "manifest.json", json.dumps(made))
        written(tmp_path / stage / "recording.rrd", "")
    monkeypatch.setattr(web_viewer, "view_in_window", len)
    assert web_viewer.view_run(tmp_path, web=False) == 3
    assert capfd.readouterr().err == "warning: align is outdated: sfm of scene place was run again since\n"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1:1", "192.168.0.1:{port}"])
def test_requests_for_other_hosts_are_refused(host: str) -> None:
    """As a page elsewhere would send them, whose name was made to point here (DNS rebinding)."""
    with PageServer("http://127.0.0.1:1", []) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        page = f"http://127.0.0.1:{server.server_port}/"
        assert answer(page, host.format(port=server.server_port))[0] == 403
        server.shutdown()
