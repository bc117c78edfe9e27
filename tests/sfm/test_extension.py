"""Maps that recordings are added to or taken out of, on models that are made up."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from groundwalk.geometry.poses import make_pose
from groundwalk.sfm.extension import HeldArtefact, refuse_misfit
from groundwalk.sfm.mapping.attempts import Attempt
from groundwalk.sfm.model import BuiltModel, Model
from groundwalk.sfm.pairs.matched import matched_pairs
from groundwalk.sfm.recording import side_by_side
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import UserError
from groundwalk.store.choices import AttemptName


def line_of(model: list[int]) -> Model:
    """Frames a metre apart in these models, without points."""
    nothing, x = np.zeros(0, np.int64), np.arange(float(len(model)))
    return Model(
        sfm_T_cam=make_pose(np.tile(np.eye(3), (len(x), 1, 1)), np.stack([x, 0 * x, 0 * x], axis=1)),
        model=np.array(model),
        point_model=nothing,
        point_ids=nothing,
        xyz=np.zeros((0, 3)),
        rgb=np.zeros((0, 3), np.uint8),
        frame=nothing,
        point=nothing,
        observed_px=np.zeros((0, 2)),
        residual_px=np.zeros((0, 2)),
    )


def refused(misplaced: list[int]) -> str:
    """The message about a walk of six, two of them registered; each of the others matches both ends of a corridor."""
    names = [f"corridor/{k}" for k in range(4)] + [f"walk/{k}" for k in range(6)]
    x = np.array([0.0, 1, 9, 10, 0, 1, *[np.nan] * 4])
    pairs = np.array([(old, new) for new in range(6, 10) for old in (0, 3)])
    count = np.full(len(pairs), 50)
    model = line_of(np.where(np.isfinite(x), 0, -1).tolist())
    model = replace(model, sfm_T_cam=make_pose(np.tile(np.eye(3), (10, 1, 1)), np.stack([x, 0 * x, 0 * x], axis=1)))
    built = [BuiltModel("mapping", 0, 6, 9, 9, 3.0, 0.5, misplaced=misplaced, folder="model_0")]
    matched = matched_pairs(pairs, np.full(len(pairs), "vio"), count, count)
    attempt = Attempt(
        name=AttemptName.ADDED,
        settings=SfmSettings(),
        matched=matched,
        built=built,
        folder=Path(),
        model=model,
        consistent=model.registered,
        has_vio=True,
    )
    with pytest.raises(UserError) as error:
        refuse_misfit(attempt, np.arange(10) >= 4, pd.DataFrame({"frame_id": names}))
    return str(error.value)


def test_a_walk_that_fits_two_places_is_refused_with_the_names_of_the_frames_of_both() -> None:
    said = refused(misplaced=[6, 7, 8, 9])
    assert "the new recordings fit the map at two places" in said
    assert "2 of 6 new frames registered" in said and "walk/2 matches corridor/0 and corridor/3" in said


def test_a_walk_that_matches_without_fitting_is_no_ambiguity() -> None:
    assert "the new recordings don't fit the map" in refused(misplaced=[])


def test_models_of_which_all_or_all_but_one_frame_were_taken_out_are_drawn() -> None:
    for model in ([1, 1, 1], [0, 1, 1]):
        assert np.isfinite(side_by_side(line_of(model), np.full((3, 4, 4), np.nan)).sfm_T_cam).all()


def test_new_frames_are_as_unknown_as_the_map_that_they_are_placed_in() -> None:
    images = pd.DataFrame({"covariance": [None, None]})
    held = HeldArtefact(Path(), {}, np.array([False, False, True]), images, [])
    assert np.isnan(held.covariance_by_map(line_of([0, 0, 0]))).all()
