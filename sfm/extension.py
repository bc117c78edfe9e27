"""A finished artefact of the stage to which walks are added, or of which some are taken out: what it says of the other
frames stays as it is.

New frames are matched with old ones and with each other, and registered into the models that there are
(`mapping.build`). The map's points count as exact there; what they may be off by is added to the covariances.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import csr_array

from groundwalk.geometry.poses import Array, skew
from groundwalk.geometry.shutter import sensor_axes
from groundwalk.sfm.cameras.model_adjustment import CameraLog, known_lens
from groundwalk.sfm.database import Workspace
from groundwalk.sfm.mapping.attempts import MIN_CONSISTENT, MIN_REGISTERED, Attempt
from groundwalk.sfm.model import BuiltModel, Model, selected_models
from groundwalk.sfm.pairs.matched import are_verified, rows_of
from groundwalk.sfm.pairs.odometry import Odometry
from groundwalk.sfm.scene_input import logged_cameras, with_focal_lengths, with_start_lenses
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import CameraOrigin
from groundwalk.store.schemas import stage_tables
from groundwalk.store.tables import read_table

_COEFFICIENTS = 8
_SIZES = ["images", "points", "observations", "mean_track_length", "mean_reprojection_px"]


@dataclass(frozen=True)
class HeldArtefact:
    """The tables of the artefact, of frames that are still there; which of the N frames of this run are new (N,), and
    the row of table `images` that each of the others has, by its row; and its selected models."""

    folder: Path
    tables: dict[str, pd.DataFrame]
    is_new: NDArray[np.bool_]
    images: pd.DataFrame
    models: list[BuiltModel]

    @staticmethod
    def of(folder: Path, frames: pd.DataFrame) -> "HeldArtefact":
        """From the artefact's folder and import's frames as they are now."""
        tables = {of.name: read_table(folder / f"{of.name}.parquet", of) for of in stage_tables("sfm")}
        there = frames["frame_id"]
        for table, column, ids in (
            ("images", "frame_id", there),
            ("pairs", "frame_id_a", there),
            ("pairs", "frame_id_b", there),
            ("intrinsics", "session_id", frames["session_id"]),
        ):
            tables[table] = tables[table][tables[table][column].isin(ids)]
        images = tables["images"]
        is_new = ~there.isin(images["frame_id"]).to_numpy(bool)
        images = images.set_index("frame_id").loc[there[~is_new]].reset_index().set_index(np.flatnonzero(~is_new))
        selected = tables["models"][tables["models"]["selected"]]
        models = [
            BuiltModel(one["mapping"], int(one["model_id"].rpartition("/")[2]), 0, 0, 0, 0.0, 0.0, folder=one["folder"])
            for one in selected.to_dict("records")
        ]
        return HeldArtefact(folder, tables, is_new, images, selected_models(models))

    def with_rows(self, now: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
        """The artefact's tables with those rows of the tables as they would be `now` that are new."""
        new = dict(now)
        new["images"] = now["images"][self.is_new]
        for table, column in (("lenses", "lens_id"), ("intrinsics", "session_id")):
            new[table] = now[table][~now[table][column].isin(self.tables[table][column])]
        models, sizes = (t["models"].set_index("model_id") for t in (self.tables, now))
        models.loc[sizes.index, _SIZES] = sizes[_SIZES]
        tables = {name: pd.concat([self.tables[name], new[name]], ignore_index=True) for name in now}
        images = tables["images"].set_index("frame_id").loc[now["images"]["frame_id"]].reset_index()
        return tables | {"images": images, "models": models.reset_index(), "points": now["points"]}

    def cameras(
        self, r: StageRun[SfmSettings], frames: pd.DataFrame, sessions: pd.DataFrame, vio: Odometry, work: Workspace
    ) -> tuple[pd.DataFrame, CameraLog]:
        """The frames table with the intrinsics that the artefact has, and all cameras.

        A lens that the artefact knows is a prior for new frames.
        """
        new, old = np.flatnonzero(self.is_new), np.flatnonzero(~self.is_new)
        if len(new):
            names = [work.names[row] for row in new.tolist()]
            of_new = with_focal_lengths(r, frames.iloc[new].reset_index(drop=True), replace(work, names=names))
            frames = frames.copy()
            for name in ("fx", "fy", "focal_sd"):
                frames.loc[new, name] = of_new[name].to_numpy()
        log = logged_cameras(r, frames, sessions)
        if np.setdiff1d(log.lenses.lens[new], log.lenses.lens[old]).size:
            log = with_start_lenses(r, frames, vio, work, log)
        lenses, lens = list(log.lenses.priors), log.lenses.lens.copy()
        adjusted, off_px = np.zeros((len(frames), _COEFFICIENTS + 1)), np.zeros((len(frames), 2))
        for row, coefficients, readout_s in zip(old, self.images["distortion"], self.images["readout_s"], strict=True):
            adjusted[row, : len(coefficients)], adjusted[row, -1] = coefficients, readout_s
        off_px[old] = self.images[["cx", "cy"]].to_numpy() - log.intrinsics[old, 2:]
        off_px = np.einsum("nkx,nx->nk", sensor_axes(log.readout_line), off_px)
        for number in np.unique(lens[new]).tolist():
            of_lens = old[log.lenses.lens[old] == number]
            if len(of_lens):
                values, count = np.unique(adjusted[of_lens], axis=0, return_counts=True)
                commonest = values[count.argmax()]
                centre_px = np.median(off_px[of_lens], axis=0)
                known = known_lens(lenses[number], commonest[:-1], float(commonest[-1]), centre_px)
                if self.images.loc[of_lens[0], "camera_origin"] == CameraOrigin.ESTIMATED:
                    known = replace(known, origin=CameraOrigin.ESTIMATED, stated_readout_s=None)
                lenses[number] = known
            added = ", ".join(sorted(set(frames["session_id"].iloc[new[lens[new] == number]])))
            lenses[number] = replace(lenses[number], lens_id=f"{lenses[number].lens_id}, added: {added}")
        for values in np.unique(adjusted[old], axis=0):
            members = old[(adjusted[old] == values).all(axis=1)]
            # Their intrinsics are those of the artefact.
            known = known_lens(log.lenses.priors[lens[members[0]]], values[:-1], float(values[-1]), np.zeros(2))
            lens[members] = len(lenses)
            lenses.append(known)
        log.motion.angular[old] = self.images[[f"angular_{axis}" for axis in "xyz"]]
        intrinsics = log.intrinsics.copy()
        intrinsics[old] = self.images[["fx", "fy", "cx", "cy"]]
        frames = frames.copy()
        frames[["fx", "fy", "cx", "cy"]] = intrinsics
        held_velocity = np.full((len(frames), 3), np.nan)
        held_velocity[old] = self.images[[f"velocity_{axis}" for axis in "xyz"]]
        all_lenses = replace(log.lenses, priors=lenses, lens=lens)
        log = replace(log, intrinsics=intrinsics, lenses=all_lenses, held_velocity=held_velocity)
        return frames, log

    def covariance_by_map(self, model: Model) -> Array:
        """What the map's own errors do to new frames, (N, 6, 6); NaN for others.

        The points that a new frame sees are off as the frames of the map are that see them, too: those turn and shift
        the place about them, and with it the new frame. So this is the mean of their covariances, each taken along to
        the new frame and weighted by how many points it has in common with that. A new frame without any gets the mean
        of all.
        """
        result = np.full((len(self.is_new), 6, 6), np.nan)
        known = self.images.loc[self.images["covariance"].notna(), "covariance"]
        covariance = np.array([np.asarray(c, float) for c in known]).reshape(-1, 6, 6)
        seen = csr_array((np.ones(len(model.frame)), (model.frame, model.point)), shape=(len(result), len(model.xyz)))
        centre = model.sfm_T_cam[:, :3, 3]
        for number in np.unique(model.model[self.is_new & model.registered]):
            new, of_model = np.flatnonzero(self.is_new & (model.model == number)), model.model[known.index] == number
            old, of_old = known.index[of_model].to_numpy(), covariance[of_model]
            common = (seen[new] @ seen[old].T).toarray()
            if not common.any():  # no frame of the map whose error is known has a point in common
                continue
            common[~common.any(axis=1)] = common.sum(axis=0)
            for row, weight in zip(new, common, strict=True):
                moved = np.tile(np.eye(6), (len(old), 1, 1))
                moved[:, 3:, :3] = -skew(centre[row] - centre[old])
                result[row] = np.average(moved @ of_old @ np.swapaxes(moved, 1, 2), axis=0, weights=weight)
        return result


def refuse_misfit(best: Attempt, is_new: NDArray[np.bool_], frames: pd.DataFrame) -> None:
    """UserError where too few of the new frames are in a model, or too few of these where their VIO says."""
    model, count = best.model, int(is_new.sum())
    assert model is not None
    registered, right = (int((is_new & which).sum()) for which in (model.registered, best.consistent))
    if registered >= MIN_REGISTERED * count and right >= MIN_CONSISTENT * registered:
        return
    names = frames["frame_id"].to_numpy(str)
    pairs = rows_of(best.matched)[are_verified(best.matched)]
    across = pairs[is_new[pairs].sum(axis=1) == 1]
    misplaced = [row for one in best.built for row in one.misplaced]
    what, do = "the new recordings don't fit the map", "see that they are of this place, and of this scale and light"
    found = (
        f"{registered} of {count} new frames registered; {len(np.unique(across[is_new[across]]))} have verified pairs "
        f"with {len(np.unique(across[~is_new[across]]))} frames of the map"
    )
    if len(misplaced) + registered - right > registered / 2:
        partners = {row: across[(across == row).any(axis=1)] for row in misplaced}
        row = max(partners, key=lambda row: len(partners[row]), default=-1)
        others = np.setdiff1d(partners.get(row, np.empty(0, np.int64)), [row])
        if len(others) > 1:
            what = "the new recordings fit the map at two places"
            centre = model.sfm_T_cam[others, :3, 3]
            a, b = np.unravel_index(np.linalg.norm(centre[:, None] - centre, axis=2).argmax(), (len(others),) * 2)
            found += (
                f"; matches of {len(misplaced)} contradict where most put them: {names[row]} matches "
                f"{names[others[a]]} and {names[others[b]]}"
            )
            do = "places that look alike can't be told apart by images: begin the recording where the map is distinct"
    elif right < MIN_CONSISTENT * registered:
        found += f"; the motion of {right} of them is consistent with VIO, {MIN_CONSISTENT:.0%} expected"
    raise UserError(what, expected=f"{MIN_REGISTERED:.0%} of their frames in it", found=found, do=do)
