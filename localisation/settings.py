"""Settings of the localise stage."""

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator

from groundwalk.artefacts.choices import Split
from groundwalk.artefacts.settings import validated
from groundwalk.localisation.localiser_settings import LocaliserSettings, StructureSettings
from groundwalk.localisation.localisers import LOCALISERS


class LocaliseSettings(StructureSettings):
    """Settings of the localise stage."""

    models: tuple[str, ...] = Field(
        default_factory=lambda: LOCALISERS.builtin,
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
        """The sections as settings of their localisers; kept are those of `models`, on which alone a run depends."""
        if not isinstance(sections, dict):
            return sections
        models = info.data.get("models", ())
        for name in (*models, *sections):
            if name not in LOCALISERS.problems:
                LOCALISERS.find(name)
        usable = [name for name in LOCALISERS if name in models or name in sections]
        checked = {name: _section(name, sections.get(name, {})) for name in usable}
        return {name: settings for name, settings in checked.items() if name in models}


def _section(name: str, content: object) -> LocaliserSettings:
    if isinstance(content, LocaliserSettings):
        return content
    if not isinstance(content, dict):
        raise ValueError(f"{name} is {content!r}, not a section of settings")
    return validated(LOCALISERS[name].settings, content, f"[localise.localisers.{name}]")
