"""What the localise stage writes: the structure localisers' poses and refusals, and what they keep and cost."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "localise",
    """
predictions 1.0: One row a structure localiser and frame of the splits in the settings: the pose estimated from the
        frame's image and its gravity, or why there is none. Frames of split train are in the map, and so aren't asked
        unless the settings say so.
    model (string): the structure localiser's id
    scene (string): the scene that the frame is of
    frame_id (string): <session>/<six digits>
    session_id (string): capture session
    split (Split): what the frame is for; neither val nor test is in the map
    t_ns (int64, ns): capture time on the session's clock
    map_cam (pose?): estimated map_T_cam; null where refused
    covariance (list<float64>?, rad, m in map): 6x6, row-major, of map_cam's error: rotation then translation; null
        where there is none
    picked_scene (string): the scene of the map
    inference_ms (float64, ms): one decoded image to its pose, on the clock
    cpu_ms (float64, ms): the same as time of all cores, which other work on the machine changes less
    inliers (int64): keypoints that the pose explains
    candidates (int64): keypoints that were matched with a point
    refusal (Refusal?): why there is no pose (docs/explanation/localisation.md); null: there is one
    reason (string?): the figures behind the refusal; null: there is a pose

models 1.0: One row a structure localiser: what it is, what it was built from, and what a query costs.
    model (string): the structure localiser's id
    label (string): the localiser as tables and pages print it
    meaning (string): the localiser in a few words
    file (string): its file, relative to the artefact; empty where it has none
    bytes (int64, byte): all that a query needs: the sum of localise.storage
    points (int64): points that it keeps
    train_frames (int64): frames that it was built from
    seed (int64): seed of everything random
    config (string): settings of the features and of this localiser, JSON
    device (string): where it was built and timed
    inference_ms (float64?, ms): median of predictions.inference_ms; null: no frame was asked
    cpu_ms (float64?, ms): median of predictions.cpu_ms; null: no frame was asked
    build_cpu_seconds (float64, s): time of all cores that it took beyond features and matches, which all localisers
        share

storage 1.0: What a query needs of a structure localiser, part by part.
    model (string): the structure localiser's id
    part (string): descriptors, points, ... (docs/explanation/localisation.md)
    bytes (int64, byte): its size
""",
)
