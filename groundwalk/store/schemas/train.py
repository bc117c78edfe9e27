"""What the train stage writes: the regressors' poses, how they learned, and what they are."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "train",
    """
predictions 1.1: One row a model and frame: the pose estimated from the frame's image alone. A regressor that is trained
        here has one for every frame of every split, an imported one those that its file has.
    model (string): the regressor's id
    scene (string): the scene that the frame is of
    frame_id (string): <session>/<six digits>
    session_id (string): capture session
    split (Split): what the frame is for
    t_ns (int64, ns): capture time on the session's clock
    map_cam (pose): estimated map_T_cam, in the map of picked_scene
    covariance (list<float64>?, rad, m in map): 6x6, row-major, of map_cam's error: rotation then translation; null
        where neither the regressor nor held-out frames give one
    picked_scene (string): the scene that the model took the image for; one of several scenes can err
    inference_ms (float64?, ms): one image through the network, crop to pose, batch of 1, float32; null where a file
        doesn't say

history 2.0: Learning curves: one row a model and epoch.
    model (string): the regressor's id
    scenes (list<string>): the scenes that the model was trained on, in the order of its queries
    epoch (int64): passes over the training frames, from 1
    learning_rate (float64): of the epoch's last step
    train_loss (float64): mean over the epoch's steps; comparable within a model only
    val_position_m (float64, m): median position error on held-out frames
    val_rotation_deg (float64, deg): median rotation error on held-out frames
    sx (float64?): learned log-variance of the position loss; null: there is none
    sq (float64?): learned log-variance of the rotation loss; null: there is none
    seconds (float64, s): wall time of the epoch
    selected (bool): the epoch whose weights the model has: smallest held-out score

models 1.4: Model cards: one row a model. What only training knows is null for imported predictions.
    model (string): the regressor's id
    label (string?): the model as tables and pages print it; null: its id
    scenes (list<string>): the scenes that the model was trained on, in the order of its queries
    file (string): the weights, relative to the artefact; empty for imported predictions
    parameters (int64?): numbers that training can change
    bytes (int64?, byte): float32 weights: parameters and the batch norms' running statistics
    layers (string): sizes that the settings choose, in words; empty where there are none
    weights (string): where the first weights came from: ImageNet, a file, scratch, and why; or the file of predictions
    resize_px (int64?, px): shorter side of the images before cropping
    crop_px (int64?, px): height of what the network sees of the image's middle
    width_px (int64?, px): its width; null: as its height
    upright (bool?): images are turned about their middle until gravity points down
    focal_px (float64?, px): of the pinhole, its principal point in the middle, as whose images the network sees all;
        null: images as captured
    train_frames (int64?): frames trained on
    val_frames (int64?): frames held out to choose the epoch
    epochs (int64?): epochs trained
    best_epoch (int64?): the epoch whose weights the model has
    seed (int64): seed of everything random
    config (string): settings of this model, JSON
    reduced (string?): what the profile makes smaller than in the paper; empty: nothing, null: it isn't in the paper
    device (string): where it was trained and timed, and in which precision it was trained
    inference_ms (float64?, ms): median of predictions.inference_ms
    train_seconds (float64?, s): wall time of training
""",
)
