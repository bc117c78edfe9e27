"""The viewer's page comes from this machine, asks this machine, and answers to no other name."""

import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from threading import Thread

import pytest
import rerun as rr

from groundwalk.artefacts.web_viewer import page_server

_VIEW = """
import sys, webbrowser
from groundwalk.artefacts.web_viewer import view_in_browser
webbrowser.open = lambda page: True
view_in_browser(sys.argv[1:])
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


def test_reruns_page_may_ask_this_machine_alone(tmp_path: Path) -> None:
    file = tmp_path / "a.rrd"
    stream = rr.RecordingStream("groundwalk_import")
    stream.save(file)
    stream.disconnect()
    with subprocess.Popen(
        [sys.executable, "-c", _VIEW, str(file)], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline()
            found = re.search(r"http://127\.0\.0\.1:\d+/", said)
            assert found, said
            status, policy, text = answer(found[0])
            assert status == 200 and "<html" in text
            # What the page itself names elsewhere is forbidden.
            assert "https:" in text and "https:" not in policy and policy.startswith("default-src 'self'")
            assert answer(found[0] + "re_viewer_bg.wasm")[0] == 200
        finally:
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1:1", "192.168.0.1:{port}"])
def test_requests_for_other_hosts_are_refused(host: str) -> None:
    """As a page elsewhere would send them, whose name was made to point here (DNS rebinding)."""
    with page_server("http://127.0.0.1:1") as server:
        Thread(target=server.serve_forever, daemon=True).start()
        page = f"http://127.0.0.1:{server.server_port}/"
        assert answer(page, host.format(port=server.server_port))[0] == 403
        server.shutdown()
