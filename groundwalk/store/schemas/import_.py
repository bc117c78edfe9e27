"""Frames of a capture with the phone's poses, and everything that was rejected."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "import",
    """
frames 2.5: Images that are used, each with its intrinsics and the phone's pose: frames of the dataset, and between them
        support frames, which only SfM and the checks of its model use: no table of a later stage has them.
    frame_id (string): <session>/<six digits>, the row's number in the capture's log
    session_id (string): recording; a part of one where VIO jumped or a video was cut (`walk`, `walk.part2`), or of one
        camera of several (`walk.camera2`)
    t_ns (int64, ns): time on the session's clock; where that is name_order, the place in the order of names times 1e9
    clock (Clock): what t_ns counts from; name_order: images have no times
    image (string): path in the capture folder; `import:` in front: in this artefact
    image_sha256 (string): sha256 of the image file
    width (int64, px): image width
    height (int64, px): image height
    f{xy} (float64, px): focal length, {}
    c{xy} (float64, px): principal point, {}; the first pixel's outer corner is 0
    distortion (list<float64>): OpenCV's k1, k2, p1, p2, k3, ...; empty: not stated; zeros: stated to be none
    focal_sd (float64): standard error of fx and fy, as a fraction, where they are EXIF's or a guess; 0: as logged
    first_row (ImageSide): side of the image that the sensor reads out first (rolling shutter); sfm estimates a readout
        time below 0 where it is the opposite one
    stated_readout_s (float64?, s): rolling shutter: time from the first to the last row that the capture states; null:
        none
    vio_cam (pose?): vio_T_cam by the phone's odometry
    gravity_{xyz} (float64?, in cam): unit vector of gravity, {}
    tracking (Tracking): the odometry's state
    sharpness (float64): 1 - blur after Crete et al. 2007, 0 to 1; higher is sharper
    exposure_s (float64?, s): exposure time
    split (Split): what the frame is for; a support frame's is that of the frame of the dataset nearest in time
    support (bool): support frame: used by SfM and the checks of its model, not in the dataset
    blurred_faces (int64?): regions blurred as faces; null: nothing looked for any
    blurred_plates (int64?): regions blurred as plates, which `blur_boxes` lists; null as for faces
    depth (string?): depth image that shows what the image shows: path as in `image`; PNG of 16 bits, mm along the
        camera's z axis, 0: none. Null where there is none
    depth_sha256 (string?): sha256 of the depth image file; null where there is none
    depth_confidence (string?): the sensor's confidence in the depth: path as in `image`; PNG of 8 bits, 0, 1, 2 or 0,
        127, 255 for low, medium, high. Null where there is none

sessions 3.4: The recordings of a capture.
    = session_id
    recording (string): the recording that the session is, or is a part of
    format (string): capture format, as `groundwalk formats` lists it
    device (string): phone, as far as the capture says
    clock (Clock): what t_ns counts from; name_order: images have no times
    duration_s (float64?, s): time from the first to the last pose; null: no times
    path_m (float64?, m): length of the path of the poses; null where their unit is unknown, or without times their
        order
    poses (int64): poses in the log
    images (int64): sound images with a pose, before sampling
    frames (int64): images selected by sampling: frames of the dataset
    support_frames (int64): images added for SfM alone
    split (SessionSplit): what it is for; val blocks lie in train sessions
    pose_source (PoseSource?): whose poses they are; those of a reference are in table `reference`; none: photos or a
        video alone
    reference_unit (LengthUnit?): unit of the reference poses, unknown where their file states none; null where there
        are none
    reference_origin_{xyz} (float64?): where the origin of the reference poses is in the data set's own coordinates, {},
        in reference_unit: 0 where they are as stated, else what was taken off positions far from their origin; null for
        VIO
    up (UpAxis?): up in the world of the poses
    up_source (UpSource?): what says whether +y is up: the format, untested; the capture itself; or import's test, by
        the accelerometer, lines in the images or the start pose

rejects 1.2: Rows, files and recordings that were rejected; images that sampling didn't select aren't here.
    = session_id
    source (string): file or row in the capture
    t_ns (int64?, ns): time on the session's clock, where it could be read
    reason (string): why
    rejected (Rejected?): what is left out by it: an image with its pose, a pose without an image, the depth image of a
        frame that stays, or a recording as a whole, which then has no other row; null for a row that can't be read

jumps 1.0: Motion between two poses that no hand can do: relocalisations of the odometry; and steps over poses that the
        phone calls limited or lost, where these stood still or went elsewhere.
    = session_id
    t_ns (int64, ns): time of the first pose after the jump
    dt_s (float64, s): time between the two poses
    jump_m (float64, m): displacement beyond the motion around it
    jump_deg (float64, deg): rotation beyond the motion around it
    splits (bool): larger than 0.5 m or 15 degrees, and not over such poses: the session was split here

reference 1.0: Poses that a public data set has instead of VIO; no rows for phone captures. Its world is the data set's.
    frame_id (string): frame, as in `frames`
    = session_id
    t_ns (int64, ns): time on the session's clock; where that is name_order, the place in the order of names times 1e9
    map_cam (pose): map_T_cam by the data set

gps 1.0: Positions on earth (WGS84) that photos and logs state; there only where the setting gps asks for them.
    recording (string): the recording that states it
    t_ns (int64, ns): time on the clock of its sessions; of a photo that of its frame
    latitude_deg (float64, deg): latitude
    longitude_deg (float64, deg): longitude
    altitude_m (float64?, m): altitude as stated, by phones above sea level
    accuracy_m (float64?, m): as stated: radius of a circle with 68 % of positions
    altitude_sd_m (float64?, m): standard error of the altitude, as stated

vio 1.0: All sound poses of the odometry at its full rate, also those without an image.
    = session_id
    t_ns (int64, ns): time on the session's clock; where that is name_order, the place in the order of names times 1e9
    vio_cam (pose): vio_T_cam by the phone's odometry
    tracking (Tracking): the odometry's state
""",
)
