"""Turning a session's images upright: pixels, intrinsics and poses together."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, Intrinsics, Session, poses_of
from groundwalk.geometry.gravity import gravity_in_camera
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.geometry.shutter import usual_first_row
from groundwalk.store.choices import ImageSide

# A quarter turn clockwise: what was right is down, what was down is left.
_CLOCKWISE: Array = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0])


def quarters_to_upright(session: Session) -> int:
    """How many quarter turns clockwise (0 to 3) put gravity down in most of a session's images.

    One answer a session, so that its images and all its poses have the same axes. 0 where up is unknown.
    """
    if not session.recording.is_gravity_aligned or not session.images:
        return 0
    gravity = gravity_in_camera(poses_of(session.images)).sum(axis=0)
    downs = [(np.linalg.matrix_power(_CLOCKWISE, k)[:3, :3] @ gravity)[1] for k in range(4)]
    return int(np.argmax(downs))


def turned(session: Session, quarters: int) -> Session:
    """The session with camera axes, poses and intrinsics turned by quarters clockwise."""
    if quarters == 0:
        return session
    turn = inverse(np.linalg.matrix_power(_CLOCKWISE, quarters))
    frames = []
    for frame in session.frames:
        assert frame.vio_T_cam is not None  # up is known of sessions with poses alone
        frame = replace(frame, vio_T_cam=frame.vio_T_cam @ turn)
        if isinstance(frame, Image):
            for _ in range(quarters):
                camera, check = frame.camera, frame.check
                k1, k2, p1, p2, *rest = (*camera.distortion, *[0.0] * (4 - len(camera.distortion)))
                # x becomes y, and y becomes the height less y.
                turned_camera = Intrinsics(
                    fx=camera.fy,
                    fy=camera.fx,
                    cx=check.height - camera.cy,
                    cy=camera.cx,
                    width=camera.height,
                    height=camera.width,
                    distortion=(k1, k2, p2, -p1, *rest) if camera.distortion else (),
                    focal_sd=camera.focal_sd,
                )
                turned_check = replace(check, width=check.height, height=check.width)
                frame = replace(frame, intrinsics=turned_camera, check=turned_check)
        frames.append(frame)
    return replace(session, frames=frames)


def first_row(width: int, height: int, stated: str | None, quarters: int) -> ImageSide:
    """The side of an image that is read out first, after quarter turns clockwise; of `width` and `height` then.

    `stated` is the side before turning, None where the capture doesn't say.
    """
    clockwise = list(ImageSide)
    if stated is None:
        stated = usual_first_row(*((height, width) if quarters % 2 else (width, height)))
    return clockwise[(clockwise.index(ImageSide(stated)) + quarters) % 4]


def turned_pixels(image: NDArray[np.uint8], quarters: int) -> NDArray[np.uint8]:
    """An image (H, W) or (H, W, 3) turned by quarters clockwise."""
    return np.ascontiguousarray(np.rot90(image, -quarters))
