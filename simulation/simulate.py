"""Simulates the captures of a scene: plans, renders in several processes, writes, and puts all in place at the end."""

import functools
import multiprocessing
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import pandas as pd

from groundwalk.simulation.atlas import TexturedMesh, is_saved
from groundwalk.simulation.existing import is_made, key_of
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.render import Renderer
from groundwalk.simulation.scenes import NAMES, scenery
from groundwalk.simulation.session import Shot, SimulatedSession, outline, plan_session, take, write_frames
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store import DataRoot, UserError
from groundwalk.store.files import partial_folder, swap_in, write_json
from groundwalk.store.hints import link_command
from groundwalk.store.locks import locked
from groundwalk.store.parallel import single_threaded_opencv
from groundwalk.store.progress import console, track
from groundwalk.store.resuming import run_resumable
from groundwalk.store.schemas import schema
from groundwalk.store.settings import resolve_settings
from groundwalk.store.signals import signals_held_from_workers
from groundwalk.store.simulated import SIMULATED_MARKER, TRUE_CAMERAS, TRUE_POSES, simulated_files
from groundwalk.store.tables import pose_frame, write_table

_MESH = "mesh"


def simulate(
    scene: str,
    profile: str,
    data: DataRoot,
    overrides: list[str] | None = None,
    seed: int = 0,
    force: bool = False,
    processes: int = 2,
) -> Path:
    """Simulate the captures of `scene` into data/captures/<scene> unless they are there; returns that folder.

    A killed run leaves only the hidden folder .<scene>.partial, from which the same call goes on. UserError for a
    scene that can't be simulated, or a folder that holds anything which this function didn't write.
    """
    if scene not in NAMES:
        do = f"{link_command(data.captures(scene), profile)}, for captures of your own"
        raise UserError(f"scene {scene} can't be simulated", expected=f"one of {', '.join(NAMES)}", do=do)
    settings = resolve_settings(SimulateSettings, "simulate", data, profile, scene, overrides or [])
    config = data.scene(scene)[0]
    final = data.captures(scene)
    key, parts = key_of(scene, settings, seed)
    title = f"simulate · {scene} · {profile}"
    work = partial_folder(final)
    with locked(final):
        if is_made(final, key) and not force:
            console.print(f"{title}: up to date")
            return final
        sessions: list[SimulatedSession] = []

        def attempt() -> None:
            sessions[:] = plan_sessions(scene, settings, config.environment == "indoor", work, seed)
            render_images([shot for s in sessions for shot in s.shots], settings, work, processes)

        run_resumable(work, key, title, force, attempt)
        for session in track(sessions, "writing poses"):
            write_frames(work / session.frames.name, session.frames)
        write_truth(work, sessions)
        content = {
            **parts,
            "key": key,
            "what": "Simulated capture: a procedural place rendered by simulation/, not a recording of a real one.",
            "profile": profile,
            "sessions": {s.frames.name: {"poses": len(s.frames.time_s), "images": len(s.shots)} for s in sessions},
        }
        shutil.rmtree(work / _MESH)
        write_json(work / SIMULATED_MARKER, content)
        swap_in(work, final, simulated_files)
    images = sum(len(s.shots) for s in sessions)
    console.print(f"{title}: {len(sessions)} sessions, {images} images → {final}")
    return final


def plan_sessions(
    scene: str, settings: SimulateSettings, indoor: bool, work: Path, seed: int
) -> list[SimulatedSession]:
    """Every session of the scene; the place is left painted in `work` for the renderers."""
    plan, mesh = scenery(scene, seed), work / _MESH
    if not is_saved(mesh):
        build_mesh(plan.place, settings.texel_m, seed, track).save(mesh)
    renderer = Renderer(TexturedMesh.load(mesh))
    with single_threaded_opencv():
        return [
            plan_session(item, plan, settings, indoor, renderer, work / item.name, seed)
            for item in track(outline(settings, scene, seed), "walking and measuring light")
        ]


def render_images(shots: list[Shot], settings: SimulateSettings, work: Path, processes: int) -> None:
    """Render all images that aren't there yet, by the mesh in `work`; each depends on its shot alone, not on the number
    of processes."""
    for folder in {shot.path.parent for shot in shots}:
        folder.mkdir(exist_ok=True)
    missing = [shot for shot in shots if not shot.path.is_file()]
    if not missing:
        return
    if processes == 1:
        _start_worker(work, settings, cv2.getNumThreads())
        for shot in track(missing, "rendering images"):
            _work(shot)
        return
    context = multiprocessing.get_context("spawn")
    with signals_held_from_workers():
        workers = context.Pool(min(processes, len(missing)), _start_worker, (work, settings))
    with workers as pool:
        for _ in track(pool.imap_unordered(_work, missing), "rendering images", len(missing)):
            pass


_take: Callable[[Shot], None]


def _start_worker(work: Path, settings: SimulateSettings, threads: int = 1) -> None:
    global _take
    cv2.setNumThreads(threads)
    _take = functools.partial(take, renderer=Renderer(TexturedMesh.load(work / _MESH)), settings=settings)


def _work(shot: Shot) -> None:
    _take(shot)


def write_truth(folder: Path, sessions: Iterable[SimulatedSession]) -> None:
    """TRUE_POSES and TRUE_CAMERAS of all sessions, for checks and benchmarks."""
    poses, cameras = [], []
    for session in sessions:
        truth, phone = session.truth, session.truth.phone
        rows = pd.DataFrame({"session_id": session.frames.name, "t_ns": session.t_ns})
        poses.append(rows.join(pose_frame("map_cam", truth.world_T_cam)))
        rows[["fx", "fy", "cx", "cy"]] = truth.intrinsics_N4
        rows[["k1", "k2", "k3"]] = phone.lens.k1, phone.lens.k2, phone.lens.k3
        rows[["readout_s", "time_offset_s"]] = phone.readout_s, phone.time_offset_s
        cameras.append(rows)
    write_table(folder / TRUE_POSES, pd.concat(poses, ignore_index=True), schema("simulate", "true_poses"))
    write_table(folder / TRUE_CAMERAS, pd.concat(cameras, ignore_index=True), schema("simulate", "true_cameras"))
