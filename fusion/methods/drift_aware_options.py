"""What `drift_aware` assumes of odometry and of the regressor before it has seen them."""

from pydantic import Field

from groundwalk.fusion.methods.odometry import OdometryOptions


class DriftAwareOptions(OdometryOptions):
    vio_speed_m_s: float = Field(1.5, gt=0, description="fastest motion that odometry is believed without question")
    vio_jump_m: float = Field(0.5, gt=0, description="motion beyond that speed that may be an odometry jump")
    vio_turn_deg_s: float = Field(360.0, gt=0, description="fastest turn that odometry is believed without question")
    vio_turn_jump_deg: float = Field(15.0, gt=0, description="turn beyond that speed that counts as an odometry jump")
    jump_s: float = Field(2.0, ge=0, description="longest jump over which the phone is taken to have gone on")
    jump_m_s: float = Field(
        0.5, gt=0, description="how far a jump's second takes the phone from where it was going, one sigma"
    )
    jump_deg: float = Field(3.0, gt=0, description="heading error of odometry across a jump, one sigma")
    jump_deg_s: float = Field(60.0, gt=0, description="how far the phone turns in a second of a jump that turns")
    jump_loss: float = Field(
        0.05, gt=0, le=0.5, description="probability that odometry lost its frame in a jump of at most jump_s"
    )
    vio_gap_s: float = Field(10.0, gt=0, description="time without a frame after which odometry may have begun anew")
    position_sd_m: float = Field(0.3, gt=0, description="a prediction's first assumed position error an axis")
    rotation_sd_deg: float = Field(8.0, gt=0, description="a prediction's first assumed rotation error an axis")
    size_count: float = Field(0.3, gt=0, description="predictions that the first assumed sizes count as")
    size_count_known: float = Field(20.0, gt=0, description="the same where held-out frames say how large errors are")
    size_count_stated: float = Field(
        10.0, gt=0, description="the same where predictions bring covariances, whose common factor is learnt"
    )
    size_count_seen: float = Field(
        2.0, gt=0, description="predictions that the sizes count as which show beside odometry's quality"
    )
    side_turn: float = Field(
        0.7,
        ge=0,
        lt=1,
        description="assumed correlation of errors to the side with yaw errors, and of height with pitch",
    )
    side_turn_count: float = Field(20.0, gt=0, description="predictions that this correlation counts as")
    axis_count: float = Field(
        10.0, ge=0, description="weight, in predictions, of the prior that errors are as large along each axis"
    )
    axis_count_stated: float = Field(
        100.0,
        ge=0,
        description="weight, in predictions, of the prior that good stated covariances have one common factor",
    )
    degrees_of_freedom: float = Field(
        3.0, gt=0, description="d of the fit's robust kernel, Barron's of shape 2 - d: larger ignores outliers sooner"
    )
    position_degrees_of_freedom: float = Field(
        6.0,
        gt=0,
        description="d of a position's kernel where many predictions agree on the pose; it falls to "
        "degrees_of_freedom, its least value, where one prediction tells the pose about as well",
    )
    rotation_marginal: float = Field(
        0.3,
        ge=0,
        le=1,
        description="0: a rotation's robust weight is by the joint error with the position; 1: by its own error; "
        "between: the geometric mean, with this exponent",
    )
    position_marginal: float = Field(0.6, ge=0, le=1, description="the same, of a position's robust weight")
    rival_degrees_of_freedom: float = Field(
        0.3, gt=0, description="of Student's t by which rival alignments are compared: smaller has heavier tails"
    )
    shared: float = Field(
        0.9, ge=0, lt=1, description="share of their errors' variance that predictions of one place have in common"
    )
    shared_sizes: float = Field(
        10.0,
        gt=0,
        description="distance over which that fades to 1/e, in standard deviations of a prediction's position an axis",
    )
    shared_turn_deg: float = Field(45.0, gt=0, description="turn of the camera over which it fades to 1/sqrt(e)")
    yaw_covariance_factor: float = Field(
        0.8, gt=0, description="what the yaw's variance is multiplied with before answers could be judged"
    )
    hindsight_s: float = Field(15.0, gt=0, description="age at which an answer is judged by what is then known")
    hindsight_count: float = Field(3.0, gt=0, description="answers that the first factors, 1 and yaw's, count as")
    position_hindsight_factor: float = Field(
        5.0, gt=0, description="what squared position errors are multiplied with that hindsight shows"
    )
    yaw_hindsight_factor: float = Field(1.6, gt=0, description="the same, of yaw")
    apart_m: float = Field(0.05, gt=0, description="motion after which two predictions are half independent")
    turn_length_m: float = Field(1.0, ge=0, description="motion that a turn by one radian counts as")
    keyframes: int = Field(64, ge=8, description="predictions kept as evidence")
    iterations: int = Field(2, ge=1, description="iterations with each prediction while few are kept, later one")
    error_map: bool = Field(True, description="use what held-out frames tell of the regressor's errors")
    covariances: bool = Field(True, description="use the covariances that predictions bring")
    drift_m: float = Field(0.03, gt=0, description="odometry's drift over one metre, one sigma, as a random walk")
    drift_height_m: float = Field(0.008, gt=0, description="the same, of height")
    drift_deg_m: float = Field(0.35, gt=0, description="odometry's yaw drift over one metre, one sigma")
    drift_deg_s: float = Field(0.05, gt=0, description="odometry's yaw drift over one second, one sigma")
    distrust: bool = Field(True, description="learn how much more than usual odometry drifts")
    rivals: bool = Field(True, description="try other alignments: odometry may have lost its frame")
    recent: int = Field(10, ge=2, description="newest predictions that judge other alignments")
    evidence: float = Field(0.7, gt=0, le=1, description="how much a prediction counts in judging other alignments")
    loss: float = Field(1e-6, gt=0, lt=0.5, description="probability that odometry loses its frame unnoticed, a frame")
    tilt_sd_deg: float = Field(0.05, gt=0, description="odometry's gravity error an axis, one sigma")
    tilt_covariance_factor: float = Field(36.0, gt=0, description="what its covariance is multiplied with")
