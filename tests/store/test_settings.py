"""Settings come from code, profile, scene and command line, and a mistake in one is said in one line."""

from pathlib import Path

import pytest
from pydantic import Field

from groundwalk.store import DataRoot, Settings, UserError
from groundwalk.store.choices import Split
from groundwalk.store.settings import SHIPPED_DATA, SplitRules, resolve_settings
from tests.known import written


class Inner(Settings):
    depth: int = 1
    exact: bool = True
    sizes: tuple[int, float] = (1, 1.0)
    split: Split = Split.TEST


class Example(Settings):
    features: int = Field(100, gt=0, description="how many")
    ratio: float = 0.5
    inner: Inner = Inner()


@pytest.fixture
def data(tmp_path: Path) -> DataRoot:
    written(tmp_path / "profiles" / "own.toml", "[sfm]\nfeatures = 200\nratio = 0.1\n")
    written(tmp_path / "scenes" / "place.toml", "environment = 'indoor'\n[sfm]\nratio = 0.2\ninner.depth = 2\n")
    return DataRoot(tmp_path)


def test_later_sources_win(data: DataRoot) -> None:
    settings = resolve_settings(Example, "sfm", data, "own", "place", ["inner.depth=3"])
    assert settings == Example(features=200, ratio=0.2, inner=Inner(depth=3))
    assert data.scene("place")[0].environment == "indoor"
    assert data.scene("unheard-of")[0].environment == "unknown"
    with pytest.raises(UserError, match="no profile 'none'"):
        data.profile("none")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("nonsense=1", "nonsense"),
        ("features=0", "greater than 0"),
        ("features", "key=value"),
        ("ratio=x", "ratio"),
        ("ratio=inf", r"(?s)'ratio': .*finite number.*--set ratio=inf"),
        ("inner.exact=no", r"'inner.exact': [^\n]*\n.*\n *expected: true or false"),
        ("features=3\nratio=1", "one --set has one setting"),
        ("features=x\nratio=1", "one --set has one setting"),
        ("features=2026-11-27", "no setting is a date or a time"),
        ("features=\udc80", "isn't text in UTF-8"),
    ],
)
def test_a_wrong_setting_is_named(data: DataRoot, override: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        resolve_settings(Example, "sfm", data, "own", "place", [override])


def test_lists_numbers_and_choices_are_taken_as_toml_has_them(data: DataRoot) -> None:
    overrides = ["ratio=1", "inner.sizes=[2, 3]", "inner.split=val", "inner.exact=false"]
    settings = resolve_settings(Example, "sfm", data, "own", "place", overrides)
    assert (settings.ratio, settings.inner.sizes) == (1.0, (2, 3.0))
    assert settings.inner.split is Split.VAL and settings.inner.exact is False


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[sfmm]", "unknown section 'sfmm'"),
        ("environment = ", r"can't be read\n  where: .*place\.toml"),
        ("import = 3", r"import is a section of settings\n  where: .*place\.toml\n.*\[import\]"),
        ("align = 3\n[[ruler]]\nkind = 'distance'", "align is a section of settings"),
        ("can_simulate = 1", r"'can_simulate': .*boolean\n  where: .*place\.toml"),
        ("[split]\nallow_leak = 'yes'", r"'split\.allow_leak': .*boolean\n  where: .*place\.toml"),
        ("[split]\ntest = []", "test lists no session"),
        ("[split]\ntest = ['a', 'b']\ntrain = ['c', 'a']", "'a' is listed for training and testing"),
    ],
)
def test_a_scene_s_file_is_checked_as_it_is_read(data: DataRoot, text: str, message: str) -> None:
    (data.root / "scenes" / "place.toml").write_text(text)
    with pytest.raises(UserError, match=message):
        data.scene("place")


def test_a_group_that_is_its_own_member_is_refused(data: DataRoot) -> None:
    for name, members in {"a": ["b"], "b": ["c", "a"], "alone": ["alone"], "twice": ["c", "c"]}.items():
        (data.root / "scenes" / f"{name}.toml").write_text(f"members = {members}\n")
    with pytest.raises(UserError, match="a has the member b has the member a"):
        data.leaves(data.scene("a")[0])
    with pytest.raises(UserError, match="alone is a member of itself"):
        data.leaves(data.scene("alone")[0])
    assert data.leaves(data.scene("twice")[0]) == ["c"]


def test_every_shipped_profile_and_scene_is_valid() -> None:
    data = DataRoot(Path("nowhere"))
    assert {"demo", "standard", "paper", "tiny"} <= set(data.names("profiles"))
    for name in data.names("profiles"):
        assert data.profile(name)["description"]
    for name in data.names("scenes"):
        scene = data.scene(name)[0]
        assert (scene.environment == "unknown") == (set(scene.members) == {"indoor", "outdoor"})
    assert data.leaves(data.scene("indoor")[0]) == ["Stairs", "Office", "Atrium"]


def test_a_users_file_adds_to_the_shipped_one_of_its_name_and_wins(tmp_path: Path) -> None:
    church = 'description = "ours"\n[align]\nmax_scale_sd = 0.5\n[split]\ntest_fraction = 0.5\n'
    written(tmp_path / "scenes" / "Church.toml", church)
    written(tmp_path / "scenes" / "Mine.toml", '[sfm]\nmapper = "global"\n')
    written(tmp_path / "profiles" / "demo.toml", "[sfm]\nmax_features = 77\n")
    data, shipped = DataRoot(tmp_path), DataRoot(SHIPPED_DATA)
    config, sections = data.scene("Church")
    assert config == shipped.scene("Church")[0].model_copy(
        update={"description": "ours", "split": SplitRules(test_fraction=0.5)}
    )
    assert sections["align"]["max_scale_sd"] == 0.5 and "Mine" in data.names("scenes")
    assert data.profile("demo") == shipped.profile("demo") | {
        "sfm": {**shipped.profile("demo")["sfm"], "max_features": 77}
    }
    (tmp_path / "scenes" / "Church.toml").write_text("members = 3\n")
    with pytest.raises(UserError, match="members") as caught:
        data.scene("Church")
    assert str(tmp_path / "scenes" / "Church.toml") in str(caught.value)


def test_a_file_of_the_data_folder_stands_before_the_shipped_one(tmp_path: Path) -> None:
    written(tmp_path / "published" / "datasets.csv", "")
    files, shipped = DataRoot(tmp_path).files("published"), DataRoot(SHIPPED_DATA).files("published")
    assert files == shipped | {"datasets.csv": tmp_path / "published" / "datasets.csv"}
    assert "table1_dataset.csv" in shipped and shipped["datasets.csv"].is_file()
