"""Rerun's viewer gets recordings in a way that offers them to nobody on the network."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
import rerun as rr

from groundwalk.store.viewer import view_run

_VIEW = "from pathlib import Path; from groundwalk.store.viewer import view_run; view_run(Path({!r}), web=True)"


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
def run(tmp_path: Path) -> Path:
    """The folder of a run with two recordings."""
    for stage in ("import", "sfm"):
        (tmp_path / "run" / stage).mkdir(parents=True)
        stream = rr.RecordingStream(f"groundwalk_{stage}")
        stream.save(tmp_path / "run" / stage / "recording.rrd")
        stream.disconnect()
    return tmp_path / "run"


@pytest.mark.skipif(sys.platform != "linux", reason="which addresses are listened on is read from /proc")
def test_a_browser_s_page_is_for_this_machine_alone(run: Path) -> None:
    command, environment = [sys.executable, "-c", _VIEW.format(str(run))], os.environ | {"BROWSER": "true"}
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env=environment, start_new_session=True
    ) as process:
        try:
            assert process.stderr is not None
            said = process.stderr.readline().decode()
            found = re.search(r"http://127\.0\.0\.1:\d+", said)
            assert found, said
            assert "<html" in urllib.request.urlopen(found[0]).read().decode()
            assert listening(process.pid) == {"0100007F"}
        finally:
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize(("web", "more"), [(False, ""), (True, "--web-viewer --web-viewer-port 0 ")])
def test_recordings_come_through_a_pipe(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, web: bool, more: str
) -> None:
    """Rerun offers files that it opens itself to every user of the machine."""
    rerun = tmp_path / "rerun"
    rerun.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/arguments\ncat > {tmp_path}/read\n')
    rerun.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
    assert view_run(run, web=web) == 0
    assert (tmp_path / "arguments").read_text() == f"--bind 127.0.0.1 --port auto {more}-\n"
    recordings = [(run / stage / "recording.rrd").read_bytes() for stage in ("import", "sfm")]
    assert (tmp_path / "read").read_bytes() == b"".join(recordings)
