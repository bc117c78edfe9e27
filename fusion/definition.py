"""The stage fuse: its version, settings and inputs; what runs it is imported when it is to run."""

from typing import Any, Literal

from pydantic import Field, model_validator

from groundwalk.fusion.methods import METHODS, resolve_options
from groundwalk.store import Settings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy


class FuseSettings(Settings):
    methods: list[str] = Field(
        default_factory=lambda: list(METHODS.builtin), min_length=1, description="fusion methods to run, by id"
    )
    options: dict[str, dict[str, Any]] = Field(
        {}, description="a method's options that differ from its defaults: options.window30.pairs=20"
    )
    splits: list[Literal["train", "val", "test"]] = Field(["test"], min_length=1, description="frames to evaluate")

    @model_validator(mode="after")
    def _known(self) -> "FuseSettings":
        for name in (*self.methods, *self.options):
            if name not in METHODS.problems:
                METHODS.known(name)
        for name, stated in self.options.items():
            if name not in METHODS.problems:
                resolve_options(name, stated)
        return self


STAGE = Stage(
    name="fuse",
    version=36,
    settings=FuseSettings,
    needs=("import", "align", "localise", "train"),
    run=Lazy("groundwalk.fusion.stage:run"),
    help="Fuse regressors' and structure localisers' predictions with odometry, and measure every method against the "
    "ground truth.",
    plugins=lambda settings: METHODS.versions(settings.methods),
)
