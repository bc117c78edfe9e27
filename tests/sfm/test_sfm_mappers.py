from pathlib import Path

import numpy as np
import pycolmap
import pytest

from groundwalk.sfm.mapping.mappers import MappingInput, pipeline_options


@pytest.mark.parametrize(("size", "expected_px"), [((320, 240), 1.0), ((1440, 1920), 1.92)])
def test_the_first_pair_is_held_to_a_pixel_or_a_thousandth_of_the_image(
    tmp_path: Path, size: tuple[int, int], expected_px: float
) -> None:
    given = MappingInput(tmp_path / "database.db", tmp_path, np.empty((0, 4, 4)), np.empty(0, object), 0)
    with pycolmap.Database.open(given.database) as database:
        database.write_camera(pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=[300, 300, 1, 1]))
    assert pipeline_options(given).mapper.init_max_error == pytest.approx(expected_px)
