"""The recording: each source at its own path, frame by frame, whatever the names."""

from pathlib import Path

import cv2
import numpy as np
from rerun.chunk import RrdReader

from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import evaluate
from groundwalk.fusion.files.walks import Inputs
from groundwalk.fusion.recording import blueprint, record
from groundwalk.store.recording import open_recording
from tests.fusion.tables import tables


def rows_of(path: Path) -> dict[str, int]:
    """Timed rows by entity path."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        counted = 0 if chunk.is_static else chunk.to_record_batch().num_rows
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + counted
    return rows


def test_every_source_has_its_own_path_and_moves_with_the_walk(tmp_path: Path) -> None:
    frames, truth, predictions = tables([1, 2])
    for table in (frames, truth, predictions):
        table["session_id"] = table["session_id"].map({"s1": "first walk/a", "s2": "s2"})
    methods = ["raw", "paper_rule", "drift_aware", "vio_oracle"]
    frames["image"] = [f"{session}.png" for session in frames["session_id"].str[:2]]
    cv2.imwrite(str(tmp_path / "s2.png"), np.zeros((6, 8, 3), np.uint8))  # those of the other walk are gone
    inputs = Inputs("Place", frames, truth, predictions.assign(model="PN: ü 2/3"))
    results = evaluate([inputs], FuseSettings(methods=methods))
    with open_recording(tmp_path / "r.rrd", "fuse", "Place", blueprint(results.fused, results.gates)) as stream:
        frames = frames.assign(gravity_x=0.0, gravity_y=1.0, file=[tmp_path / image for image in frames["image"]])
        record(stream, results.fused, results.gates, {"Place": frames})
    rows, at = rows_of(tmp_path / "r.rrd"), "/Place/PN\\:\\ ü\\ 2\\/3"
    fused = [m for m in methods if m != "raw"]
    moving = [
        "/Place/ground_truth/now",
        f"{at}/raw/now",
        *(f"{at}/{k}/{m}/now" for k in ("fused", "vio_aligned") for m in fused),
    ]
    series = [f"{at}/{q}/{m}" for q in ("position_error_m", "rotation_error_deg") for m in methods]
    decisions = [*(f"{at}/{k}/{m}" for k in ("status", "residual") for m in fused), f"{at}/covariance/drift_aware"]
    gated = [f"{at}/signals/paper_rule/{s}/{k}" for s in ("similarity", "rpe_m", "roe_deg") for k in ("value", "gate")]
    for path in (*moving, *series, *decisions, *gated):
        assert rows[path] == 80, path
    assert rows["/Place/image"] == (frames["session_id"] == "s2").sum()
    for kind in ("ground_truth", "PN\\:\\ ü\\ 2\\/3/raw", "PN\\:\\ ü\\ 2\\/3/fused/drift_aware"):
        for session in ("first\\ walk\\/a", "s2"):
            assert f"/Place/{kind}/path/{session}/test" in rows


def test_stretches_of_a_split_follow_one_another(tmp_path: Path) -> None:
    parts = tables([1])
    for table in parts:  # held-out frames lie between training frames
        table["split"] = ["train"] * 15 + ["val"] * 10 + ["train"] * 15
    results = evaluate([Inputs("Place", *parts)], FuseSettings(methods=["raw"], splits=["train", "val"]))
    with open_recording(tmp_path / "r.rrd", "fuse", "Place", blueprint(results.fused, results.gates)) as stream:
        record(stream, results.fused, results.gates, {})
    rows = rows_of(tmp_path / "r.rrd")
    assert rows["/Place/ground_truth/now"] == rows["/Place/PN/raw/now"] == 40
    assert {f"/Place/PN/raw/path/s1/{name}" for name in ("train", "val", "train_2")} <= set(rows)
