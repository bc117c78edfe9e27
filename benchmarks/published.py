"""`python -m benchmarks.published`: do the paper's printed tables agree with themselves, and its text with them?

Every rule is general: it knows nothing of a scene. A printed number stands for the interval of numbers that print like
it, so that rounding alone is never called a fault.
"""

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from groundwalk.reports.details import checks
from groundwalk.reports.grids import PUBLISHED, markdown
from groundwalk.reports.published import PAPER_METHOD, RAW_METHOD, PrintedTables, load_claims, load_published
from groundwalk.reports.run_checks import AGREES, CAUTION, DISAGREES, Finding, as_table
from groundwalk.scoring.errors import ACCURACY_LEVELS
from groundwalk.scoring.scores import SUBSETS

Interval = tuple[float, float]
_QUANTITIES = ("translation_m", "rotation_deg")
_LEVELS = list(ACCURACY_LEVELS)
_EPS = 1e-9
_HEAD = """# The paper's printed tables, held against each other

Written by `python -m benchmarks.published` from `shipped/published/`: {rules} comparisons. A printed number is taken as
the interval that rounding leaves open: 0.27 is anything from 0.265 to 0.275, and 4.0 anything from 3.95 to 4.05, since
a zero may have been dropped. A percentage may have been rounded or cut. Where a share is no whole number of frames, the
number of frames is found from the accuracy levels printed for the same subset.

| rule | what must hold |
|---|---|
| `share_whole` | a share is a whole number of the test frames |
| `share_sum` | the share of both subsets is the sum of theirs |
| `level_whole` | a level is a whole number of its frames |
| `level_order` | high ≤ medium ≤ low |
| `pooled_level`, `pooled_mean` | figures of both subsets are those of the two, weighted by their frames |
| `copied_row` | the row of both subsets isn't that of one alone while pooling gives another |
| `median_between` | a pooled median lies between its parts' medians |
| `raw_repeated` | the raw regressor over all frames is the same each time it is printed |
| `average` | the average is the mean over the scenes |
| `like_for_like` | the raw regressor is there over the fused method's frames |
| `text_claim` | the paper's text says what its tables say |

These don't agree, or can't be compared as they are printed.

| """
# "Halved" as a reader takes it: the ratio is 0.5 to one digit.
_HALF = 0.55


def check_tables(tables: PrintedTables, claims: pd.DataFrame | None = None) -> pd.DataFrame:
    """Every finding of every rule on `tables`, and of `claims` where there are any; `source` names the tables."""
    findings: list[Finding] = []
    for _, dataset in tables.dataset.iterrows():
        for model in tables.levels.loc[tables.levels["scene"] == dataset["scene"], "model"].unique():
            findings += _SceneModel(tables, str(dataset["scene"]), str(model), int(dataset["test_images"])).findings()
    findings += raw_repeated(tables)
    findings += averages(tables)
    findings += like_for_like(tables)
    for _, claim in claims.iterrows() if claims is not None else ():
        findings += _CLAIMS[claim["kind"]](claim, tables)
    return as_table(findings, tables.source)


def page() -> str:
    """docs/results/published.md."""
    findings = check_tables(load_published(), load_claims())
    grid = checks(findings, PUBLISHED)
    return _HEAD.format(rules=len(findings)) + (markdown(grid).partition("\n\n| ")[2] if grid else "")


# --- printed numbers as intervals -------------------------------------------------------------------------------


def decimals(value: float) -> int:
    """How many decimals a printed number shows at least: 0.27 has two; 2.1, 4.0 and 9 have one (a zero may be cut)."""
    return max(1, len(f"{value:.6f}".rstrip("0").partition(".")[2]))


def rounded(value: float) -> Interval:
    """The numbers that round to a printed one."""
    half = 0.5 * 10.0 ** -decimals(value)
    return value - half, value + half


def percent(value: float) -> Interval:
    """The percentages that print as `value` with one decimal, rounded or cut."""
    return value - 0.05, value + 0.1


def meets(a: Interval, b: Interval) -> bool:
    return a[0] <= b[1] + _EPS and b[0] <= a[1] + _EPS


def whole(value: float, frames: int) -> list[int]:
    """The frame counts k for which k of `frames` prints as `value` percent."""
    low, high = percent(value)
    share = 100.0 * np.arange(frames + 1) / frames
    return [int(k) for k in np.flatnonzero((share >= low - _EPS) & (share < high - _EPS))]


def reduction(raw: float, fused: float) -> Interval:
    """By how many percent `fused` lies below `raw`, both printed numbers."""
    (raw_low, raw_high), (low, high) = rounded(raw), rounded(fused)
    return 100 * (1 - high / raw_low), 100 * (1 - low / raw_high)


# --- one scene and model ----------------------------------------------------------------------------------------


class _SceneModel:
    """The rules that tie one scene's and model's rows to its number of test frames."""

    def __init__(self, tables: PrintedTables, scene: str, model: str, frames: int) -> None:
        self.scene, self.model, self.frames = scene, model, frames
        levels, errors = tables.levels, tables.errors
        self.levels = levels[(levels["scene"] == scene) & (levels["model"] == model)]
        self.errors = errors[(errors["scene"] == scene) & (errors["model"] == model)]
        self.counts = self._counts()

    def findings(self) -> Iterator[Finding]:
        yield from self._shares()
        yield from self._levels()
        yield from self._pooled_errors()

    def _fused(self, subset: str) -> pd.Series | None:
        rows = self.levels[(self.levels["method"] == PAPER_METHOD) & (self.levels["subset"] == subset)]
        return None if rows.empty or rows["share"].isna().any() else rows.iloc[0]

    def _error(self, subset: str, statistic: str) -> pd.Series | None:
        e = self.errors
        rows = e[(e["method"] == PAPER_METHOD) & (e["subset"] == subset) & (e["statistic"] == statistic)]
        return None if rows.empty else rows.iloc[0]

    def _parts(self, rows: dict[str, pd.Series | None]) -> list[tuple[int, pd.Series]]:
        """Frames and row of each subset that has frames."""
        parts = [(self.counts[subset], rows[subset]) for subset in ("rp", "opt")]
        return [(count, row) for count, row in parts if count and row is not None]

    def _counts(self) -> dict[str, int]:
        """How many frames each subset has: what its share says or, where no whole number of frames gives the share,
        what the accuracy levels printed for it say."""
        counts: dict[str, int] = {}
        for subset in ("rp", "opt"):
            row = self._fused(subset)
            if row is None:
                return {}
            near = round(row["share"] * self.frames / 100)
            fits = whole(row["share"], self.frames) or self._counts_by_levels(subset, self.frames - counts.get("rp", 0))
            counts[subset] = min(fits, key=lambda k: abs(k - near), default=near)
        counts["rp+opt"] = counts["rp"] + counts["opt"]
        return counts

    def _counts_by_levels(self, subset: str, most: int) -> list[int]:
        rows = self.levels[(self.levels["subset"] == subset) & (self.levels["over"] == "subset")]
        printed = rows[_LEVELS].to_numpy(float).ravel()
        return [k for k in range(1, most + 1) if all(whole(value, k) for value in printed)]

    def _finding(self, check: str, table: str, subset: str, column: str, ok: bool, *text: str) -> Finding:
        expected, printed, because = text
        status = AGREES if ok else DISAGREES
        return Finding(check, table, self.scene, subset, f"{self.model} {column}", expected, printed, status, because)

    def _shares(self) -> Iterator[Finding]:
        for subset, count in self.counts.items():
            row = self._fused(subset)
            if row is None:
                continue
            share = row["share"]
            # The share of both may be printed as the sum of two printed shares.
            parts = [self._fused(s) for s in ("rp", "opt")] if subset == "rp+opt" else []
            summed = abs(sum(p["share"] for p in parts if p is not None) - share) < 0.05 if parts else False
            ok = summed or bool(whole(share, self.frames))
            expected = f"{100 * count / self.frames:.1f} %"
            because = f"a share is a whole number of the {self.frames} test frames; {count} is the nearest that fits"
            yield self._finding("share_whole", "III", subset, "share", ok, expected, f"{share:g} %", because)
            if parts:
                shares = [p["share"] for p in parts if p is not None]
                possible = product(*(whole(s, self.frames) for s in shares))
                ok = summed or any(sum(counts) in whole(share, self.frames) for counts in possible)
                because = (
                    f"reliable and optimised are {self.counts['rp']} + {self.counts['opt']} of {self.frames} frames"
                )
                yield self._finding("share_sum", "III", subset, "share", ok, expected, f"{share:g} %", because)

    def _levels(self) -> Iterator[Finding]:
        for _, row in self.levels.iterrows():
            count = self._level_frames(row)
            values = row[_LEVELS].astype(float)
            if not count or values.isna().any():
                continue
            column = "raw" if row["method"] == RAW_METHOD else "fused"
            ordered = bool(values["high"] <= values["medium"] <= values["low"])
            printed = "/".join(f"{v:g}" for v in values)
            because = "a stricter tolerance holds for no more frames"
            yield self._finding(
                "level_order", "III", row["subset"], column, ordered, "high <= medium <= low", printed, because
            )
            for level, value in values.items():
                nearest = 100 * round(value * count / 100) / count
                because = f"a level is a whole number of the {count} frames"
                ok = bool(whole(value, count))
                yield self._finding(
                    *("level_whole", "III", row["subset"], f"{column} {level}", ok),
                    *(f"{nearest:.1f} %", f"{value:g} %", because),
                )
        yield from self._pooled_levels()

    def _level_frames(self, row: pd.Series) -> int:
        """How many frames a row's levels are shares of."""
        return self.frames if row["over"] == "all" else self.counts.get(row["subset"], 0)

    def _pooled_levels(self) -> Iterator[Finding]:
        rows = {subset: self._fused(subset) for subset in SUBSETS}
        both = rows["rp+opt"]
        if both is None or not self.counts.get("rp+opt"):
            return
        parts = [(self._level_frames(row), row) for _, row in self._parts(rows)]
        parts = [(count, row) for count, row in parts if count]
        for level in _LEVELS if parts else ():
            ok = meets(_pooled_interval(parts, level, percent), percent(both[level]))
            expected, printed = f"{_pooled(parts, level):.1f} %", f"{both[level]:g} %"
            pooled = f"{self._pool()} pooled"
            yield self._finding("pooled_level", "III", "rp+opt", f"fused {level}", ok, expected, printed, pooled)

    def _pool(self) -> str:
        return f"{self.counts['rp']} reliable and {self.counts['opt']} optimised frames"

    def _pooled_errors(self) -> Iterator[Finding]:
        if self.counts.get("rp+opt"):
            yield from self._pooled_means()
            yield from self._medians_between()

    def _pooled_means(self) -> Iterator[Finding]:
        rows = {subset: self._error(subset, "mean") for subset in SUBSETS}
        both, rp, parts = rows["rp+opt"], rows["rp"], self._parts(rows)
        if both is None or rp is None:
            return
        because = f"mean of {self._pool()} pooled"
        fits = {q: meets(_pooled_interval(parts, q, rounded), rounded(both[q])) for q in _QUANTITIES}
        for q, ok in fits.items():
            text = (f"{_pooled(parts, q):.2f}", f"{both[q]:g}", because)
            yield self._finding("pooled_mean", "II", "rp+opt", f"mean {q}", ok, *text)
        copied = all(both[q] == rp[q] for q in _QUANTITIES) and not all(fits.values())
        expected = " / ".join(f"{_pooled(parts, q):.2f}" for q in _QUANTITIES)
        printed = " / ".join(f"{both[q]:g}" for q in _QUANTITIES)
        why = f"{because}, against {' / '.join(f'{rp[q]:g}' for q in _QUANTITIES)} of the reliable ones alone"
        yield self._finding("copied_row", "II", "rp+opt", "mean m / deg", not copied, expected, printed, why)

    def _medians_between(self) -> Iterator[Finding]:
        rows = {subset: self._error(subset, "median") for subset in SUBSETS}
        both, parts = rows["rp+opt"], self._parts(rows)
        if both is None:
            return
        for q in _QUANTITIES:
            medians = [row[q] for _, row in parts]
            low, high = min(medians), max(medians)
            ok = meets((rounded(low)[0], rounded(high)[1]), rounded(both[q]))
            text = (f"{low:g} to {high:g}", f"{both[q]:g}", "a pooled median lies between its parts' medians")
            yield self._finding("median_between", "II", "rp+opt", f"median {q}", ok, *text)


def _pooled(parts: list[tuple[int, pd.Series]], column: str) -> float:
    """The mean of a column over parts, weighted by their frames."""
    return float(np.average([row[column] for _, row in parts], weights=[count for count, _ in parts]))


def _pooled_interval(
    parts: list[tuple[int, pd.Series]], column: str, interval: Callable[[float], Interval]
) -> Interval:
    """The same for printed numbers, each known as an interval."""
    bounds = [interval(row[column]) for _, row in parts]
    low, high = np.average(bounds, axis=0, weights=[count for count, _ in parts])
    return float(low), float(high)


# --- across rows ------------------------------------------------------------------------------------------------


def raw_repeated(tables: PrintedTables) -> Iterator[Finding]:
    """A raw column over all frames is printed with "reliable" and again with "both": the same number twice."""
    for table, frame, keys, values in (
        ("II", tables.errors, ["scene", "environment", "model", "statistic"], list(_QUANTITIES)),
        ("III", tables.levels, ["scene", "environment", "model"], _LEVELS),
    ):
        raw = frame[(frame["method"] == RAW_METHOD) & (frame["over"] == "all")]
        for key, rows in raw.groupby(keys, sort=False):
            for column in values:
                printed = rows.set_index("subset")[column].dropna()
                if printed.empty:
                    continue
                ok = bool((printed == printed.iloc[0]).all())
                name = " ".join([str(key[2]), "raw", *map(str, key[3:]), column])
                yield Finding(
                    *("raw_repeated", table, str(key[0]), " and ".join(printed.index), name),
                    *("the same value each time", " / ".join(f"{v:g}" for v in printed), AGREES if ok else DISAGREES),
                    "the raw regressor over all test frames doesn't depend on the subset",
                )


def averages(tables: PrintedTables) -> Iterator[Finding]:
    """The average row is the mean over its scenes' rows."""
    keys = ["environment", "subset", "model", "method", "over", "statistic"]
    for key, rows in tables.errors.groupby(keys, sort=False):
        average = rows[rows["scene"] == "average"]
        scenes = rows[rows["scene"] != "average"]
        if average.empty or average[list(_QUANTITIES)].isna().to_numpy().any():
            continue
        for q in _QUANTITIES:
            values = scenes[q].dropna()
            bounds = np.array([rounded(v) for v in values]).mean(axis=0)
            printed = float(average[q].iloc[0])
            ok = meets((bounds[0], bounds[1]), rounded(printed))
            column = f"{key[2]} {'raw' if key[3] == RAW_METHOD else 'fused'} {key[5]} {q}"
            yield Finding(
                *("average", "II", f"average {key[0]}", str(key[1]), column, f"{values.mean():.3f}", f"{printed:g}"),
                *(AGREES if ok else DISAGREES, f"the mean of {len(values)} scenes"),
            )


def like_for_like(tables: PrintedTables) -> Iterator[Finding]:
    """Where the method answers for some frames only, the raw regressor must be there over the same frames too."""
    fused = tables.levels[(tables.levels["method"] == PAPER_METHOD) & tables.levels["share"].between(_EPS, 100 - _EPS)]
    for table, frame in (("II", tables.errors), ("III", tables.levels)):
        for subset, rows in fused.groupby("subset", sort=False):
            raw = frame[(frame["method"] == RAW_METHOD) & (frame["subset"] == subset)]
            pairs = set(zip(rows["scene"], rows["model"], strict=True))
            comparable = raw[raw["over"] == "subset"]
            ok = pairs <= set(zip(comparable["scene"], comparable["model"], strict=True))
            shares = f"{rows['share'].min():g} to {rows['share'].max():g} %"
            yield Finding(
                *("like_for_like", table, "all scenes", str(subset), "raw beside fused"),
                *("raw over the fused method's frames", f"{'those' if ok else 'all'} frames; fused over {shares}"),
                *(AGREES if ok else CAUTION, "raw over all frames and fused over some of them aren't comparable"),
            )


# --- the text ---------------------------------------------------------------------------------------------------


def _pairs(claim: pd.Series, tables: PrintedTables) -> pd.DataFrame:
    """Raw and fused errors side by side (columns raw, fused, scene, environment, quantity) that a claim is about."""
    errors = tables.errors
    chosen = errors[(errors["subset"] == claim["subset"]) & (errors["model"] == claim["model"])]
    chosen = chosen[chosen["statistic"] == claim["statistic"]]
    chosen = chosen[(chosen["scene"] == "average") == (claim["scenes"] == "average")]
    if claim["environment"] != "both":
        chosen = chosen[chosen["environment"] == claim["environment"]]
    quantities = list(_QUANTITIES) if claim["quantity"] == "both" else [claim["quantity"]]
    keys = ["environment", "scene"]
    long = chosen.melt(id_vars=[*keys, "method"], value_vars=quantities, var_name="quantity")
    wide = long.pivot_table(index=[*keys, "quantity"], columns="method", values="value", sort=False).reset_index()
    return wide.rename(columns={RAW_METHOD: "raw", PAPER_METHOD: "fused"})


def _claim_finding(claim: pd.Series, column: str, expected: str, printed: str, ok: bool, scene: str = "") -> Finding:
    where = scene or ("each scene" if claim["scenes"] == "each" else str(claim["scenes"]))
    status = AGREES if ok else DISAGREES
    table = "III" if claim["kind"] in ("share", "level") else "II"
    because = f"the text, section {claim['section']}: {claim['says']}"
    return Finding("text_claim", table, where, str(claim["subset"]), column, expected, printed, status, because)


def _says(computed: Interval, printed: float) -> bool:
    """Whether a computed percentage, known as an interval, prints as a whole number, rounded or cut."""
    return meets(computed, (printed - 0.5, printed + 1.0))


def _reduction(claim: pd.Series, tables: PrintedTables) -> Iterator[Finding]:
    pairs = _pairs(claim, tables)
    bounds = np.array([reduction(raw, fused) for raw, fused in zip(pairs["raw"], pairs["fused"], strict=True)])
    values = 100 * (1 - pairs["fused"] / pairs["raw"])
    ok = _says((bounds[:, 0].max(), bounds[:, 1].max()), claim["high"])
    said = f"up to {claim['high']:g} %"
    if not np.isnan(claim["low"]):
        ok = ok and _says((bounds[:, 0].min(), bounds[:, 1].min()), claim["low"])
        said = f"{claim['low']:g} to {claim['high']:g} %"
    printed = f"{values.min():.1f} to {values.max():.1f} %"
    column = f"{claim['model']} {claim['statistic']} {claim['quantity']}"
    yield _claim_finding(claim, column, f"{printed} by the table", f"{said} in the text", ok)


def _halves(claim: pd.Series, tables: PrintedTables) -> Iterator[Finding]:
    pairs = _pairs(claim, tables)
    # One figure for both environments: the mean over them, as the paper's averages are means over scenes.
    means = pairs.groupby("quantity", sort=False)[["raw", "fused"]].mean()
    ratios = means["fused"] / means["raw"]
    printed = ", ".join(f"{q} {r:.2f}" for q, r in ratios.items())
    ok = bool((ratios <= _HALF).all())
    column = f"{claim['model']} {claim['statistic']} fused / raw"
    yield _claim_finding(claim, column, f"at most {_HALF:g}", printed, ok)


def _falls(claim: pd.Series, tables: PrintedTables) -> Iterator[Finding]:
    for _, row in _pairs(claim, tables).iterrows():
        column = f"{claim['model']} {claim['statistic']} {row['quantity']}"
        change = 100 * (row["fused"] / row["raw"] - 1)
        printed = f"{row['raw']:g} to {row['fused']:g} ({change:+.1f} %)"
        yield _claim_finding(claim, column, "no increase", printed, bool(row["fused"] <= row["raw"]), row["scene"])


def _share(claim: pd.Series, tables: PrintedTables) -> Iterator[Finding]:
    levels = tables.levels
    rows = levels[(levels["subset"] == claim["subset"]) & (levels["model"] == claim["model"])]
    rows = rows[(rows["method"] == PAPER_METHOD) & (rows["environment"] == claim["environment"])]
    low, high = rows["share"].min(), rows["share"].max()
    ok = abs(low - claim["low"]) < 0.05 and abs(high - claim["high"]) < 0.05
    said = f"{claim['low']:g} to {claim['high']:g} %"
    column = f"{claim['model']} share"
    yield _claim_finding(claim, column, f"{low:g} to {high:g} % by the table", f"{said} in the text", ok)


def _level(claim: pd.Series, tables: PrintedTables) -> Iterator[Finding]:
    levels = tables.levels
    rows = levels[(levels["subset"] == claim["subset"]) & (levels["model"] == claim["model"])]
    rows = rows[(rows["method"] == PAPER_METHOD) & (rows["scene"] == claim["scenes"])]
    level = str(claim["quantity"]).removesuffix("_pct")
    value = float(rows[level].iloc[0])
    ok = abs(value - claim["low"]) < 0.05
    column = f"{claim['model']} fused {level}"
    yield _claim_finding(claim, column, f"{value:g} % by the table", f"{claim['low']:g} % in the text", ok)


_CLAIMS: dict[str, Callable[[pd.Series, PrintedTables], Iterator[Finding]]] = {
    "reduction": _reduction,
    "halves": _halves,
    "falls": _falls,
    "share": _share,
    "level": _level,
}


if __name__ == "__main__":
    Path("docs/results/published.md").write_text(page(), encoding="utf-8")
