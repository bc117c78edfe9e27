"""Published predictions of real regressors as walks: a folder of HR-APR's text files (docs/fusion.md).

The files hold a line a frame, `<sequence>/<frame> x y z qw qx qy qz`, the pose of the camera in the scene. They say
neither which way is up nor what odometry saw. Up is the direction that the true cameras' x axes are square to, as people
hold a camera level; odometry is simulated from the true poses with the drift of docs/vio-drift.md.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from artefacts import UserError
from benchmarks.fusion_inputs import Case, Track, _DRIFT, _seed, _vio, as_walk
from geometry.fits import rotation_to_up
from geometry.poses import Array, make_pose, pose_from_tq

REAL = "real predictions"
_RATES_HZ = {"7Scenes": 30.0, "Cambridge": 2.0}
