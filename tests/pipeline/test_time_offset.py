"""A simulated phone whose images are taken some time before their time stamps."""

from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk.capture_import.definition import STAGE as IMPORT
from groundwalk.sfm.definition import STAGE as SFM
from groundwalk.simulation.__main__ import app as simulation_app
from groundwalk.store import DataRoot, execute

pytestmark = pytest.mark.slow
SCENE = "Church"


@pytest.mark.parametrize("offset_s", [0.0, 0.03])
def test_the_offset_of_time_stamps_is_estimated(tmp_path: Path, offset_s: float) -> None:
    arguments = ["--scene", SCENE, "--profile", "tiny", "--data", str(tmp_path)]
    for setting in (f"time_offset_s={offset_s}", "readout_s=0.02", "frame_fraction=0.03"):
        arguments += ["--set", setting]
    CliRunner().invoke(simulation_app, arguments, catch_exceptions=False)
    execute(IMPORT, SCENE, "tiny", DataRoot(tmp_path))
    lenses = pd.read_parquet(execute(SFM, SCENE, "tiny", DataRoot(tmp_path)) / "lenses.parquet")
    lens = lenses.sort_values("frames").iloc[-1]
    print(
        f"{1000 * lens['time_offset_s']:.2f} ± {1000 * lens['time_offset_sd_s']:.2f} ms for {1000 * offset_s:g}, "
        f"readout {1000 * lens['readout_s']:.1f} ± {1000 * lens['readout_sd_s']:.1f} ms"
    )
    assert abs(lens["time_offset_s"] - offset_s) < max(3 * lens["time_offset_sd_s"], 0.002)
    assert lens["time_offset_used"] or not offset_s
