"""EuRoC: `mav0/cam0` with images, times and camera, and `mav0/state_groundtruth_estimate0`, a folder a session.

Format: https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets (times in nanoseconds, body to
world, quaternion w first). The body is the camera; the world has +z up. A session has one camera, so its images are
those of one pinhole. There is no IMU, and of the ground truth no velocity or bias.
"""

from pathlib import Path
from urllib.parse import quote

import numpy as np

from groundwalk.export.dataset import WORLD_T_MAP, Dataset, Images, number
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import tq_from_pose
from groundwalk.store import UserError

_POSES = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []"


def write_euroc(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths. UserError where a session has several cameras."""
    placed, cameras = [""] * len(dataset.frames), dataset.cameras
    position, quaternion = tq_from_pose(WORLD_T_MAP @ dataset.map_T_cam)
    for session_id, of_session in dataset.frames.groupby("session_id", sort=True):
        rows, own = of_session.sort_values("t_ns").index.to_numpy(), {cameras[row] for row in of_session.index}
        if len(own) > 1:
            raise UserError(
                "EuRoC has one camera a session",
                where=session_id,
                found=f"{len(own)}: other lenses, or focal lengths from {min(c.fx for c in own):.0f} to "
                f"{max(c.fx for c in own):.0f} px",
                do="export as splat or tum, or record the session with one lens, without zoom",
            )
        session = folder / quote(str(session_id), safe="") / "mav0"
        (session / "cam0" / "data").mkdir(parents=True)
        (session / "state_groundtruth_estimate0").mkdir()
        listed, poses = ["#timestamp [ns],filename"], [_POSES]
        for row in rows:
            t_ns = dataset.frames["t_ns"].iloc[row]
            x, y, z, w = quaternion[row]
            listed.append(f"{t_ns},{t_ns}.png")
            poses.append(",".join([str(t_ns), *map(number, (*position[row], w, x, y, z))]))
            image = session / "cam0" / "data" / f"{t_ns}.png"
            placed[row] = image.relative_to(folder).as_posix()
            dataset.images[row].place(image, images)
        (session / "cam0" / "data.csv").write_text("\n".join(listed) + "\n", encoding="ascii")
        (session / "cam0" / "sensor.yaml").write_text(_sensor(cameras[rows[0]]), encoding="ascii")
        (session / "state_groundtruth_estimate0" / "data.csv").write_text("\n".join(poses) + "\n", encoding="ascii")
    return placed


def _sensor(camera: Camera) -> str:
    focal_and_centre = ", ".join(map(number, (camera.fx, camera.fy, camera.cx, camera.cy)))
    return (
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: [{', '.join(map(number, np.eye(4).ravel()))}]\n"
        f"resolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\nintrinsics: [{focal_and_centre}]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )
