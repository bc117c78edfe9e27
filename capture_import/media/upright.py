"""Quarter turns of images, and those that put a session's images upright."""

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Session, poses_of
from groundwalk.geometry.gravity import gravity_in_camera


def quarters_to_upright(session: Session) -> int:
    """How many quarter turns clockwise (0 to 3) put gravity down in most of a session's images. One answer a session;
    0 where up is unknown."""
    if not session.recording.is_gravity_aligned or not session.images:
        return 0
    x, y, _ = gravity_in_camera(poses_of(session.images)).sum(axis=0)
    # What was right is down after a turn clockwise, what was down left.
    return int(np.argmax([y, x, -y, -x]))


def turned_pixels(image: NDArray[np.uint8], quarters: int) -> NDArray[np.uint8]:
    """An image (H, W) or (H, W, 3) turned by quarters clockwise."""
    return np.ascontiguousarray(np.rot90(image, -quarters))
