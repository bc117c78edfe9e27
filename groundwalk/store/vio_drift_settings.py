"""How far VIO may drift: settings that pairs and models (sfm) and ground truth (align) have in common."""

from pydantic import Field

from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.store.settings import Settings


class VioDriftSettings(Settings):
    """Base of the settings of stages that compare motion with VIO."""

    vio_drift_m: float = Field(
        0.1, ge=0, description="constant part of VIO's position drift, metres; a larger difference is inconsistent"
    )
    vio_drift_m_per_m: float = Field(0.03, ge=0, description="VIO's position drift, metres a metre of path")
    vio_drift_deg: float = Field(
        3.0, ge=0, description="constant part of VIO's rotation drift, degrees; a larger difference is inconsistent"
    )
    vio_drift_deg_per_sqrt_m: float = Field(
        2.5, ge=0, description="VIO's rotation drift, degrees a square root of a metre of path"
    )

    @property
    def vio_drift(self) -> VioDrift:
        """The drift model of these settings."""
        return VioDrift.in_degrees(
            self.vio_drift_m, self.vio_drift_m_per_m, self.vio_drift_deg, self.vio_drift_deg_per_sqrt_m
        )
