"""Captures from a bucket, and results into one, against a server of moto's that speaks S3 on this machine."""

import os
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import boto3
import pandas as pd
import pytest
from moto.server import ThreadedMotoServer

from groundwalk.bucket import download, upload
from groundwalk.campaign import plan
from groundwalk.store import DataRoot, UserError
from groundwalk.store.files import file_names
from tests.capture_import.capture_writers import WRITERS, make_walk
from tests.groundwalk.test_campaign import run_campaign

WALKS, RESULTS = "s3://bucket/walks/one", "s3://bucket/results"


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The server's, with an empty bucket and credentials for it."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    tell(f"http://{host}:{port}/moto-api/reset")
    boto3.client("s3").create_bucket(Bucket="bucket")
    yield f"http://{host}:{port}"
    tell(f"http://{host}:{port}/moto-api/reset-auth", "Infinity")
    server.stop()


def tell(place: str, value: str = "") -> None:
    """Post a value to moto's own interface."""
    request = urllib.request.Request(place, data=value.encode(), headers={"Content-Type": "text/plain"})
    urllib.request.urlopen(request).close()


def put(name: str, content: bytes) -> None:
    boto3.client("s3").put_object(Bucket="bucket", Key=name, Body=content)


@pytest.mark.usefixtures("address")
def test_a_campaign_takes_captures_from_a_bucket_and_sends_its_results_there(tmp_path: Path) -> None:
    pytest.importorskip("snakemake", reason="campaigns are run by Snakemake: pip install -e '.[campaign]'")
    WRITERS["frames_jsonl"].write(tmp_path / "walk", make_walk(20))
    for name in file_names(tmp_path / "walk"):
        put(f"walks/one/walk/{name}", (tmp_path / "walk" / name).read_bytes())
    table = tmp_path / "scenes.csv"
    table.write_text(f"scene,captures,until\none,{WALKS},import\ngone,s3://bucket/none,import\n")
    ended = run_campaign(table, tmp_path / "data", "--results", RESULTS)
    assert ended.returncode == 1 and "1 refused" in ended.stdout and "2 done" in ended.stdout, ended.stderr
    captures = tmp_path / "data" / "captures" / "one" / "walk"
    assert {name: (captures / name).read_bytes() for name in file_names(captures)} == {
        name: (tmp_path / "walk" / name).read_bytes() for name in file_names(tmp_path / "walk")
    }
    download(RESULTS, tmp_path / "sent")
    outcome = pd.read_parquet(tmp_path / "sent" / "campaigns" / "scenes" / "campaign.parquet").set_index("scene")
    assert "s3://bucket/none" in outcome["message"]["gone"] and "not exist" in outcome["message"]["gone"]
    frames = Path("runs", "tiny", "one", "import", "frames.parquet")
    assert (tmp_path / "sent" / frames).read_bytes() == (tmp_path / "data" / frames).read_bytes()


@pytest.mark.usefixtures("address")
def test_only_what_changed_is_loaded_again_and_what_is_gone_is_removed(tmp_path: Path) -> None:
    for name in ("kept", "changed", "gone"):
        put(f"walks/one/{name}", b"before")
    folder = tmp_path / "one"
    download(WALKS, folder)
    kept = (folder / "kept").stat()
    put("walks/one/changed", b"then")
    put("walks/one/deep/new", b"new")
    boto3.client("s3").delete_object(Bucket="bucket", Key="walks/one/gone")
    download(WALKS, folder)
    assert {name: (folder / name).read_bytes() for name in file_names(folder)} == {
        "kept": b"before",
        "changed": b"then",
        "deep/new": b"new",
    }
    assert (folder / "kept").stat().st_ino == kept.st_ino
    assert upload(folder, file_names(folder), RESULTS) == 3
    assert upload(folder, file_names(folder), RESULTS) == 0
    (folder / "kept").write_bytes(b"longer than before")
    assert upload(folder, file_names(folder), RESULTS) == 1


def test_a_scene_whose_bucket_cannot_be_read_is_named_and_others_are_planned(address: str, tmp_path: Path) -> None:
    put("walks/one/a", b"")
    table = tmp_path / "scenes.csv"
    table.write_text(f"scene,captures\nChurch,\none,{WALKS}\n")
    tell(f"{address}/moto-api/reset-auth", "0")  # from now on it asks who one is
    jobs, problems = plan(table, "tiny", DataRoot(tmp_path / "data"))
    assert {job.scene for job in jobs} == {"Church"}
    assert "INVALID_ACCESS_KEY_ID" in problems["tiny/one"] and "AWS_ACCESS_KEY_ID" in problems["tiny/one"]


@pytest.mark.usefixtures("address")
@pytest.mark.parametrize(
    ("place", "said"),
    [("s3://none/walks", "does not exist"), ("s3:///walks", "Missing bucket"), ("ftp://host/walks", "Unrecognized")],
)
def test_a_place_that_is_none_is_refused(place: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        download(place, tmp_path / "one")
    assert not os.path.lexists(tmp_path / "one")


@pytest.mark.usefixtures("address")
def test_nothing_is_loaded_into_a_link(tmp_path: Path) -> None:
    put("walks/one/a", b"a")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "mine").touch()
    (tmp_path / "one").symlink_to(tmp_path / "own")
    with pytest.raises(UserError, match="is a link"):
        download(WALKS, tmp_path / "one")
    assert file_names(tmp_path / "own") == ["mine"]


@pytest.mark.usefixtures("address")
def test_keys_do_not_leave_the_folder_and_secrets_of_an_address_are_not_shown(tmp_path: Path) -> None:
    put("walks/one/../../../out", b"")
    with pytest.raises(UserError, match="outside"):
        download(WALKS, tmp_path / "one")
    with pytest.raises(UserError) as refused:
        download("s3://someone:secret@none/walks", tmp_path / "one")
    assert "secret" not in str(refused.value)
