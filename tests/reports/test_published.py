"""The table checker finds what is wrong in the paper's printed tables, and nothing in tables that are right."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.published import check_tables, decimals, meets, page, percent, rounded, whole
from groundwalk.reports.published import PrintedTables, load_claims, load_published
from groundwalk.reports.run_checks import AGREES, CAUTION, DISAGREES
from groundwalk.scoring.scores import SUBSETS
from tests.known import rows

# Everything that the published tables get wrong, as (rule, scene, subset, column) -> (by the rule, printed).
TABLE_FAULTS = {
    ("pooled_mean", "Stairs", "rp+opt", "PN mean translation_m"): ("0.25", "0.27"),
    ("pooled_mean", "Stairs", "rp+opt", "PN mean rotation_deg"): ("5.12", "5.25"),
    ("pooled_mean", "Stairs", "rp+opt", "MS-T mean rotation_deg"): ("4.24", "4.56"),
    ("copied_row", "Stairs", "rp+opt", "PN mean m / deg"): ("0.25 / 5.12", "0.27 / 5.25"),
    ("copied_row", "Stairs", "rp+opt", "MS-T mean m / deg"): ("0.21 / 4.24", "0.22 / 4.56"),
    ("share_whole", "Stairs", "opt", "PN share"): ("34.7 %", "36.7 %"),
    ("share_whole", "Stairs", "rp+opt", "PN share"): ("98.6 %", "90.7 %"),
    ("share_sum", "Stairs", "rp+opt", "PN share"): ("98.6 %", "90.7 %"),
    ("share_sum", "Church", "rp+opt", "MS-T share"): ("99.1 %", "97 %"),
    ("share_sum", "Bar", "rp+opt", "MS-T share"): ("95.6 %", "92 %"),
    ("raw_repeated", "Square", "rp and rp+opt", "MS-T raw mean translation_m"): (
        "the same value each time",
        "2.5 / 2.49",
    ),
    ("raw_repeated", "Church", "rp and rp+opt", "MS-T raw mean translation_m"): (
        "the same value each time",
        "1.91 / 1.9",
    ),
    ("raw_repeated", "Atrium", "rp and rp+opt", "MS-T raw high"): ("the same value each time", "0.4 / 0"),
    # 116 and 117 of 428 frames are 27.1 and 27.3 %; 273 and 274 of 500 are 54.6 and 54.8 %.
    ("level_whole", "Square", "rp", "PN fused medium"): ("27.1 %", "27.2 %"),
    ("level_whole", "Office", "rp", "MS-T fused medium"): ("54.8 %", "54.7 %"),
}
CLAIMS_FAULTS = {
    ("rp", "PN median translation_m"): "19.2 to 31.5 % by the table",
    ("rp", "PN median rotation_deg"): "15.6 to 24.4 % by the table",
    ("rp", "MS-T median translation_m"): "24.6 to 46.0 % by the table",
}
RISES = {
    ("Church", "PN median translation_m"): 1.4,
    ("Church", "MS-T median translation_m"): 2.8,
    ("Bar", "PN median translation_m"): 4.5,
    ("Bar", "MS-T median translation_m"): 1.4,
    ("Stairs", "PN median rotation_deg"): 0.2,
}
NOT_HALVED = {"PN mean fused / raw", "PN median fused / raw", "MS-T median fused / raw"}


@pytest.fixture(scope="module")
def published() -> pd.DataFrame:
    return check_tables(load_published(), load_claims())


def test_every_known_fault_of_the_published_tables_is_found_and_no_other(published: pd.DataFrame) -> None:
    faults = published[(published["status"] == DISAGREES) & (published["check"] != "text_claim")]
    found = {(f.check, f.scene, f.subset, f.column): (f.expected, f.printed) for f in faults.itertuples()}
    assert found == TABLE_FAULTS


def test_text_that_says_other_than_its_tables_is_found(published: pd.DataFrame) -> None:
    wrong = published[(published["check"] == "text_claim") & (published["status"] == DISAGREES)]
    ranges = wrong[wrong["scene"] == "each scene"]
    assert {(f.subset, f.column): f.expected for f in ranges.itertuples()} == CLAIMS_FAULTS
    assert set(wrong.loc[wrong["scene"] == "average", "column"]) == NOT_HALVED
    rises = wrong[~wrong["scene"].isin(["each scene", "average"])]
    assert set(zip(rises["scene"], rises["column"], strict=True)) == set(RISES)
    for row in rows(rises):
        assert f"({RISES[row.scene, row.column]:+.1f} %)" in row.printed


def test_raw_columns_over_other_frames_are_not_like_for_like(published: pd.DataFrame) -> None:
    caution = published[published["status"] == CAUTION]
    assert set(caution["check"]) == {"like_for_like"}
    # The paper compares like with like in its "only optimised" blocks alone.
    assert set(zip(caution["table"], caution["subset"], strict=True)) == {
        (t, s) for t in ("II", "III") for s in ("rp", "rp+opt")
    }


def printed_from_frames(frames: int, shares: tuple[float, float], seed: int) -> PrintedTables:
    """Tables of one scene printed, rounded as a person would, from made-up errors of single frames."""
    rng = np.random.default_rng(seed)
    status = rng.choice(["rp", "opt", "none"], frames, p=[*shares, max(0.0, 1 - sum(shares))])
    raw, fused = rng.gamma(0.8, 1.5, (2, frames, 2)) * [1.0, 4.0]
    members = {"rp": status == "rp", "opt": status == "opt", "rp+opt": status != "none"}
    errors, levels = [], []
    for subset in SUBSETS:
        inside = members[subset]
        everything = np.ones(frames, bool)
        for method, over, values, mask in (
            ("raw", "all", raw, everything), ("raw", "subset", raw, inside), ("paper_rule", "subset", fused, inside)
        ):  # fmt: skip
            keys = {
                "environment": "indoor",
                "scene": "Hall",
                "subset": subset,
                "model": "PN",
                "method": method,
                "over": over,
            }
            e = values[mask]
            if not len(e):
                levels.append(keys | dict.fromkeys(("high", "medium", "low"), np.nan) | {"share": 0.0})
                continue
            for statistic in (np.mean, np.median):
                t, r = np.round(np.asarray(statistic(e, axis=0)), 2)
                errors.append(keys | {"statistic": statistic.__name__, "translation_m": t, "rotation_deg": r})
            within = [((e[:, 0] <= m) & (e[:, 1] <= d)).mean() for m, d in ((0.25, 2), (0.5, 5), (5, 10))]
            row = dict(zip(("high", "medium", "low"), np.round(100 * np.array(within), 1), strict=True))
            share = np.nan if over == "all" else round(100 * mask.mean(), 1)
            levels.append(keys | row | {"share": share})
    dataset = pd.DataFrame([{"environment": "indoor", "scene": "Hall", "test_images": frames}])
    return PrintedTables("ours", dataset, pd.DataFrame(errors), pd.DataFrame(levels))


@settings(max_examples=25)
@given(st.integers(1, 600), st.floats(0, 0.6), st.floats(0, 0.4), st.integers(0, 10_000))
def test_tables_printed_from_frames_always_agree(frames: int, rp: float, opt: float, seed: int) -> None:
    findings = check_tables(printed_from_frames(frames, (rp, opt), seed))
    assert len(findings) > 10
    assert findings.loc[findings["status"] != AGREES].empty, findings[findings["status"] != AGREES].to_string()


@pytest.mark.parametrize(
    ("table", "subset", "method", "column", "change", "rule"),
    [
        ("errors", "rp+opt", "paper_rule", "rotation_deg", 1.0, "pooled_mean"),
        ("errors", "rp", "raw", "translation_m", 0.02, "raw_repeated"),
        ("levels", "opt", "paper_rule", "medium", 1.3, "level_whole"),
        ("levels", "rp+opt", "paper_rule", "share", -7.0, "share_sum"),
        ("levels", "rp", "paper_rule", "high", 90.0, "level_order"),
    ],
)
def test_a_number_changed_by_hand_is_found(
    table: str, subset: str, method: str, column: str, change: float, rule: str
) -> None:
    tables = printed_from_frames(222, (0.5, 0.35), 3)
    frame = getattr(tables, table).copy()
    row = frame.index[(frame["subset"] == subset) & (frame["method"] == method)][0]
    frame.loc[row, column] = round(frame.loc[row, column] + change, 2)
    findings = check_tables(dataclasses.replace(tables, **{table: frame}))
    assert rule in set(findings.loc[findings["status"] == DISAGREES, "check"])


@given(st.integers(1, 1000), st.data())
def test_a_printed_share_gives_back_its_count(frames: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(0, frames))
    assert count in whole(round(100 * count / frames, 1), frames)


def test_printed_numbers_stand_for_intervals() -> None:
    assert [decimals(v) for v in (0.27, 2.1, 9.0, 11.76)] == [2, 1, 1, 2]
    assert rounded(0.25) == pytest.approx((0.245, 0.255))
    assert percent(0.4) == pytest.approx((0.35, 0.5))
    assert meets((0, 1), (1, 2)) and not meets((0, 1), (1.1, 2))


def test_shares_of_many_frames_add_up_where_some_of_the_counts_that_they_stand_for_do() -> None:
    # 667 + 667 of 2000: each 33.4 % is 667, 668 or 669 of them, and 66.7 % not twice the middle one.
    keys = {"environment": "indoor", "scene": "Hall", "model": "PN", "method": "paper_rule", "over": "subset"}
    row = keys | dict.fromkeys(("high", "medium", "low"), 0.0)
    levels = pd.DataFrame(
        [row | {"subset": s, "share": share} for s, share in (("rp", 33.4), ("opt", 33.4), ("rp+opt", 66.7))]
    )
    dataset = pd.DataFrame([{"environment": "indoor", "scene": "Hall", "test_images": 2000}])
    errors = pd.DataFrame(columns=[*keys, "subset", "statistic", "translation_m", "rotation_deg"])
    findings = check_tables(PrintedTables("ours", dataset, errors, levels))
    assert set(findings.loc[findings["check"] == "share_sum", "status"]) == {AGREES}


def test_the_results_page_is_up_to_date() -> None:
    assert Path("docs/results/published.md").read_text(encoding="utf-8") == page()
