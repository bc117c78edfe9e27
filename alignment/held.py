"""Ground truth that walks were added to or taken out of: the map, and its frames' rows, stay as they were."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from groundwalk.alignment.check_models import CheckedMap, refusal
from groundwalk.alignment.ground_truth import AlignResult
from groundwalk.alignment.settings import AlignSettings
from groundwalk.geometry.fits import similarity_of_poses
from groundwalk.store import UserError
from groundwalk.store.choices import GroundTruthChange, QualityClass
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table


def model_numbers(images: pd.DataFrame, before: Path) -> dict[str, int]:
    """The number that each of SfM's models (of its table `images`) has in the map of the artefact `before`, by its id:
    added frames may make another one the largest."""
    component = images["frame_id"].map(_truth(before).set_index("frame_id")["component"])
    numbers = component.dropna().groupby(images["model_id"]).min()
    return {str(model_id): int(number) for model_id, number in numbers.items()}


def in_map_before(checked: CheckedMap, frames: pd.DataFrame, images: pd.DataFrame, before: Path) -> CheckedMap:
    """The models where the artefact `before` has them, with its scale and vertical and their standard errors. `frames`
    is import's table, `images` SfM's in its order."""
    truth, figures = _truth(before), load_manifest(before)["figures"]
    map_T_cam = poses_of(truth.set_index("frame_id").reindex(frames["frame_id"]), "map_cam")
    sfm_T_cam, has_truth = poses_of(images, "sfm_cam"), np.isfinite(map_T_cam[:, 0, 0])
    placed, exclusion = [], checked.frames.exclusion.copy()
    main = set(truth.loc[truth["component"] == truth["component"].min(), "frame_id"])
    for each in checked.placed:
        component = each.component
        known = component.registered_rows[has_truth[component.registered_rows]]
        if len(known) < 2:  # none of them was in the map
            exclusion[component.registered_rows] = "its SfM model isn't in the map that was there"
            continue
        # The same similarity took each of these rows to the map.
        is_main = frames["frame_id"].iloc[known[0]] in main
        scale = figures["metres_per_sfm_unit"] if is_main else None
        map_S_sfm = similarity_of_poses(map_T_cam[known], sfm_T_cam[known], scale)
        sds = (component.scale.sd, component.vertical.sd)
        if is_main:
            scale_sd, tilt_deg = figures["scale_sd"], figures["vertical_sd_deg"]
            sds = (np.nan if scale_sd is None else scale_sd, np.radians(np.nan if tilt_deg is None else tilt_deg))
        of_scale = replace(component.scale, log=float(np.log(map_S_sfm.scale)), sd=sds[0])
        vertical = replace(component.vertical, up_sfm=map_S_sfm.rotation[1], sd=sds[1])
        component = replace(component, scale=of_scale, vertical=vertical)
        placed.append(replace(each, component=component, map_S_sfm=map_S_sfm))
    of_index = {each.component.index: each.component for each in placed}
    components = [of_index.get(component.index, component) for component in checked.components]
    return replace(checked, components=components, placed=placed, frames=replace(checked.frames, exclusion=exclusion))


def refusal_of_added(
    checked: CheckedMap, frames: pd.DataFrame, settings: AlignSettings, before: Path
) -> UserError | None:
    """Why there is no ground truth of the frames that weren't there before, if there isn't."""
    known = set(_truth(before)["session_id"])
    is_new = ~frames["session_id"].isin(known).to_numpy(bool)
    if not is_new.any():
        return None
    checks = [check for check in checked.checks if check.subject.session_id not in known]
    return refusal(replace(checked.where(is_new), checks=checks), frames[is_new].reset_index(drop=True), settings)


def with_rows_before(result: AlignResult, before: Path) -> AlignResult:
    """The result with the rows that ground truth had of frames that are still there."""
    truth, frame_ids = _truth(before), result.ground_truth["frame_id"]
    truth = truth[truth["frame_id"].isin(frame_ids)]
    new = result.ground_truth[~frame_ids.isin(truth["frame_id"])]
    both = result.ground_truth.merge(truth, on="frame_id", suffixes=("_now", ""))
    of_model = both.dropna(subset=["component_now", "component"]).groupby("component_now")
    for name in ("scale_source", "vertical_source", "component"):
        new = new.assign(**{name: new["component"].map(of_model[name].first()).astype(truth[name].dtype)})
    joined = pd.concat([truth, new]).set_index("frame_id").loc[frame_ids].reset_index()
    return replace(result, ground_truth=joined)


def versions_table(ground_truth: pd.DataFrame, before: Path | None) -> pd.DataFrame:
    """The align.versions table: that of the artefact `before`, and what is added or removed since."""
    if before is None:
        return _rows(ground_truth, 1, GroundTruthChange.BUILT)
    versions, truth = read_table(before / "versions.parquet", schema("align", "versions")), _truth(before)
    number = int(versions["version"].max()) + 1
    added = ground_truth[~ground_truth["session_id"].isin(truth["session_id"])]
    removed = truth[~truth["session_id"].isin(ground_truth["session_id"])]
    parts = [_rows(added, number, GroundTruthChange.ADDED), _rows(removed, number, GroundTruthChange.REMOVED)]
    return pd.concat([versions, *(part for part in parts if len(part))], ignore_index=True)


def _rows(ground_truth: pd.DataFrame, version: int, change: GroundTruthChange) -> pd.DataFrame:
    rows = []
    for session_id, of_session in ground_truth.groupby("session_id", sort=True):
        has_truth = of_session["quality"] != QualityClass.NONE
        rows.append(
            {
                "version": version,
                "change": change,
                "session_id": session_id,
                "frames": len(of_session),
                "with_ground_truth": int(has_truth.sum()),
                **{f"quality_{q}": int((of_session["quality"] == q).sum()) for q in "ABC"},
                "position_sd_m": of_session["position_sd_m"].median(),
            }
        )
    return pd.DataFrame(rows, columns=schema("align", "versions").column_names)


def _truth(before: Path) -> pd.DataFrame:
    return read_table(before / "ground_truth.parquet", schema("align", "ground_truth"))
