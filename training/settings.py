"""Settings of the training stage."""

from typing import Literal

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from groundwalk.store import Settings
from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.regressors import REGRESSORS


class TrainSettings(Settings):
    models: tuple[str, ...] = Field(
        default_factory=lambda: tuple(i for i in REGRESSORS.builtin if REGRESSORS[i].in_paper),
        description="the regressors to train, by id",
    )
    predictions: tuple[str, ...] = Field(
        (),
        description="Parquet files with predictions of other regressors, which take part as if they had been trained"
        " here; paths are relative to the data folder (docs/how-to/predictions.md)",
    )
    resize: int = Field(256, ge=32, description="shorter side of the images, pixels")
    crop: int = Field(224, ge=32, description="side of the square that the networks see, pixels")
    undistort: bool = Field(
        True,
        description="turn all images into those of one virtual pinhole, with the median focal length of the training"
        " frames and its principal point in the middle; otherwise images as captured, each with its lens",
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to train")
    threads: int = Field(
        1,
        gt=0,
        description="CPU threads a model; the models train side by side, and another number gives slightly different"
        " results",
    )
    # Not among what the results depend on: a run goes on from its checkpoint with any number.
    processes: int = Field(
        1,
        gt=0,
        exclude=True,
        description="processes of this machine that share each model's batches, on GPUs one each; the results are the"
        " same to rounding (docs/explanation/training.md)",
    )
    precision: Literal["auto", "fp32", "bf16"] = Field(
        "auto", description="of training; auto: bf16 (bfloat16) where the processor has units for it, else fp32"
    )
    regressors: dict[str, SerializeAsAny[RegressorSettings]] = Field(
        default_factory=dict,
        validate_default=True,
        description="settings of each regressor: `regressors.<id>.epochs` and so on",
    )

    @field_validator("predictions", mode="before")
    @classmethod
    def _one_file_is_a_list(cls, files: object) -> object:
        return (files,) if isinstance(files, str) else tuple(files) if isinstance(files, list) else files

    @field_validator("regressors", mode="before")
    @classmethod
    def _known(cls, sections: object, info: ValidationInfo) -> object:
        return REGRESSORS.sections(sections, info.data.get("models", ()), "train.regressors")

    @model_validator(mode="after")
    def _fits(self) -> "TrainSettings":
        if self.crop > self.resize:
            raise ValueError(f"crop {self.crop} is larger than resize {self.resize}")
        if not self.models and not self.predictions:
            raise ValueError("neither models nor predictions name a regressor")
        for name, batch in ((name, self.regressors[name].batch) for name in self.models if name in self.regressors):
            if self.processes > 1 and (batch % self.processes or batch < 2 * self.processes):
                raise ValueError(
                    f"{self.processes} processes can't share batches of {batch} images: set processes to a number that "
                    f"divides regressors.{name}.batch, of which each gets two or more"
                )
        return self
