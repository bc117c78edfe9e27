"""The stage localise: its version, settings and inputs; what runs it is imported when it is to run."""

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator

from groundwalk.localisation.localisers import LOCALISERS, LocaliserSettings, StructureSettings
from groundwalk.store.choices import Split
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy


class LocaliseSettings(StructureSettings):
    models: tuple[str, ...] = Field(
        default_factory=lambda: tuple(i for i in LOCALISERS.builtin if LOCALISERS[i].by_default),
        description="the structure localisers to build, by id; none where the list is empty",
    )
    splits: tuple[Split, ...] = Field(
        (Split.VAL, Split.TEST),
        min_length=1,
        description="frames to localise: val, test, train; maps are built from those of train alone",
    )
    localisers: dict[str, SerializeAsAny[LocaliserSettings]] = Field(
        default_factory=dict,
        validate_default=True,
        description="settings of each structure localiser: `localisers.<id>.max_points` and so on",
    )

    @field_validator("localisers", mode="before")
    @classmethod
    def _known(cls, sections: object, info: ValidationInfo) -> object:
        return LOCALISERS.sections(sections, info.data.get("models", ()), "localise.localisers")


STAGE = Stage(
    name="localise",
    version=9,
    settings=LocaliseSettings,
    needs=("import", "sfm", "align"),
    run=Lazy("groundwalk.localisation.stage:run"),
    help="Build maps of points from the training frames, and localise the other frames in them. A group of scenes has "
    "its scenes' maps.",
    plugins=lambda settings: LOCALISERS.versions(settings.models),
    reads_images=lambda settings: True,
    space_bytes=lambda settings, frames: (32 << 20) + frames * 100_000,
)
