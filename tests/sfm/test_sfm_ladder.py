"""The ladder of attempts."""

from sfm.ladder import ladder
from sfm.settings import SfmSettings


def test_each_attempt_keeps_what_the_one_before_it_gained_and_vio_comes_last() -> None:
    steps = dict(ladder(SfmSettings()))
    assert list(steps) == ["as set", "more pairs", "more features", "other mapper", "from VIO"]
    assert steps["as set"] == SfmSettings()
    tried = list(steps.values())
    for name in ("sequence_pairs", "vio_pairs", "retrieval_pairs", "transitive_pairs", "max_features"):
        values = [getattr(settings, name) for settings in tried]
        assert values == sorted(values)
        assert values[-1] > values[0]
    assert [settings.mapper for settings in tried] == ["incremental"] * 3 + ["global", "vio"]
    # What isn't a matter of trying stays as it was set.
    assert {settings.min_registered for settings in tried} == {SfmSettings().min_registered}


def test_no_attempt_comes_twice() -> None:
    for mapper in ("incremental", "global", "hierarchical", "vio"):
        tried = [settings for _, settings in ladder(SfmSettings(mapper=mapper))]
        assert len({settings.model_dump_json() for settings in tried}) == len(tried)


def test_without_retries_there_is_one_attempt() -> None:
    assert [name for name, _ in ladder(SfmSettings(retries=False))] == ["as set"]
