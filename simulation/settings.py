"""Settings of the simulator, section [simulate]."""

from pydantic import Field

from artefacts import Settings


class SimulateSettings(Settings):
    """How much is simulated and how finely."""

    width: int = Field(640, ge=64, description="image width, pixels")
    height: int = Field(480, ge=48, description="image height, pixels")
    rate_hz: float = Field(10.0, gt=0, le=60, description="poses a second")
    image_hz: float = Field(1.0, gt=0, description="images a second; every k-th pose has one")
    train_frames: int = Field(1500, gt=0, description="training images, before frame_share")
    test_frames: int = Field(600, gt=0, description="test images, before frame_share")
    frame_share: float = Field(0.18, gt=0, le=1, description="share of these images that is made")
    train_sessions: int = Field(3, ge=1, description="training walks, at least")
    test_sessions: int = Field(2, ge=1, description="test walks, at least")
    max_session_s: float = Field(400.0, gt=0, description="longer walks are split into more sessions")
    texel_m: float = Field(0.012, gt=0, description="texel of surfaces that are seen from near, metres")
    supersampling: int = Field(2, ge=1, le=4, description="n x n rays a pixel where surfaces meet")
    jpeg_quality: int = Field(90, ge=50, le=100, description="JPEG quality")
