"""Published errors with ours beside: what is run is compared, what isn't stays empty."""

import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import datasets
from groundwalk.artefacts import DataRoot
from groundwalk.artefacts.settings import SHIPPED_DATA


def test_a_published_figure_has_a_source_and_a_scene_a_recipe() -> None:
    rows = pd.read_csv(SHIPPED_DATA / "published" / "datasets.csv")
    assert (rows["median_position_m"].notna() == rows["source"].notna()).all()
    assert (rows["median_position_m"].notna() == rows["median_rotation_deg"].notna()).all()
    for dataset, scene in rows[["dataset", "scene"]].drop_duplicates().itertuples(index=False):
        if scene != "average":
            config, sections = DataRoot(SHIPPED_DATA).scene(f"{datasets.PREFIXES[dataset]}-{scene}")
            assert config.environment != "unknown" and "MS-T" in sections["train"]["regressors"]


@pytest.mark.slow
def test_our_errors_stand_beside_the_published_ones(trained_wall: Path, tmp_path: Path) -> None:
    data = Path(shutil.copytree(trained_wall, tmp_path / "data"))
    (data / "runs/tiny/Wall").rename(data / "runs/tiny/7scenes-chess")
    datasets.main(data, "tiny", tmp_path)
    text = (tmp_path / "datasets.md").read_text()
    ours = datasets.errors_of(DataRoot(data), "tiny", "7scenes-chess")["PN"]
    figures = pd.read_json(data / "runs/tiny/7scenes-chess/train/manifest.json", typ="series")["figures"]
    assert ours[0] == pytest.approx(figures["PN Wall test median position_m"], abs=1e-6)
    assert f"| PN, ours | {ours[0]:.2f} m, {ours[1]:.1f}° |  |" in text
    assert re.search(r"MS-T, published \| 0\.11 m, 4\.7°", text) and "| MS-T, ours |  |  |" in text
