"""Settings of the localise stage."""

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator

from groundwalk.localisation.localisers import LOCALISERS, LocaliserSettings, StructureSettings
from groundwalk.store.choices import Split


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
