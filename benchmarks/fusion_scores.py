"""The figures of the fusion benchmark: scores of a case, comparisons over scenes, and the targets."""

# pandas' stubs know no labels of several levels, nor what is in a table.
# mypy: disable-error-code="operator,index,arg-type,return-value,list-item,misc,has-type,attr-defined"

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.fusion_inputs import SIMULATED, Case
from groundwalk.fusion.evaluation.evaluate import stacked
from groundwalk.fusion.evaluation.fuse import Fused, Run, error_rows, fuse, options_json
from groundwalk.fusion.evaluation.leaderboard import within_bounds
from groundwalk.fusion.evaluation.summary import session_figures, summarise
from groundwalk.fusion.methods import METHODS, method
from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.scoring.bootstrap import draws
from groundwalk.store.settings import SHIPPED_DATA

RAW, RULE, OURS = "apr", "mobilearloc", "drift_aware"
ERRORS = ["position_mean_m", "rotation_mean_deg"]


@dataclass(frozen=True)
class Variant:
    """A method with options: a row of the tables, under its label."""

    label: str
    method: str
    options: MethodOptions


# ---------------------------------------------------------------- one case


def score(case: Case, methods: Sequence[Variant]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """A case's rows of fuse.summary and fuse.sessions, `method` being the variant's label, with the kind of walks.

    Added to the summary: shares of errors within the 95 % bounds of the method's covariance; to the sessions: sums of
    errors and their count.
    """
    fused: list[Fused] = []
    for variant in methods:
        run = Run(variant.label, options_json(variant.options.model_dump(mode="json")), case.model)
        make = partial(method(variant.method).localiser, variant.options)
        fused += [fuse(run, w, make(m)) for w, m in zip(case.walks, case.error_maps, strict=True)]
    summary = summarise(stacked(error_rows(f) for f in fused))
    for i, name in enumerate(("position", "rotation")):
        inside = {v.label: [within_bounds(f)[:, i] for f in fused if f.run.method == v.label] for v in methods}
        share = {label: 100 * np.concatenate(part).mean() for label, part in inside.items() if sum(map(len, part))}
        summary[f"{name}_within_pct"] = summary["method"].map(share).astype(float)
    sessions = pd.DataFrame([session_figures(f) | _sums(f) for f in fused])
    return summary.assign(kind=case.kind, scene=case.scene), sessions.assign(kind=case.kind, scene=case.scene)


def _sums(fused: Fused) -> dict[str, float]:
    """The sums of a walk's errors over answered frames, and their count: what a mean over walks is made of."""
    rows = error_rows(fused)[["live_position_m", "live_rotation_deg"]]
    return dict(zip(_SUMS, [*rows.sum(), rows.iloc[:, 0].count()], strict=True))


_SUMS = ["position_sum_m", "rotation_sum_deg", "scored"]


# ---------------------------------------------------------------- over scenes


def per_scene(summary: pd.DataFrame, kind: str, subset: str = "all") -> pd.DataFrame:
    """The methods' rows of one kind of walks over one subset, indexed by method, scene and model."""
    rows = summary[(summary["kind"] == kind) & (summary["subset"] == subset) & (summary["scored"] == "method")]
    return rows.set_index(["method", "scene", "model"])


def against(summary: pd.DataFrame, kind: str, other: str, subset: str = "all") -> pd.DataFrame:
    """Each method's mean errors over those of `other` in the same scene with the same model, as ratios."""
    rows = per_scene(summary, kind, subset)[ERRORS]
    return rows / rows.loc[other].reindex(rows.index.droplevel("method")).to_numpy()


def overview(summary: pd.DataFrame, kind: str) -> pd.DataFrame:
    """A row a method, averaged over scenes and regressors: figures over all frames, and ratios to the paper's rule.
    Methods that see the whole walk come last and say so."""
    rows = per_scene(summary, kind)
    by_method = rows.groupby("method", sort=False)
    means = by_method[[*ERRORS, "high_pct", "medium_pct", "low_pct", "coverage_pct"]].mean()
    ratio = against(summary, kind, RULE).groupby("method", sort=False).mean()
    common = against(summary, kind, RULE, "common").groupby("method", sort=False).mean()
    table = pd.DataFrame(
        {
            "position m": means["position_mean_m"],
            "rotation deg": means["rotation_mean_deg"],
            "high %": means["high_pct"],
            "medium %": means["medium_pct"],
            "low %": means["low_pct"],
            "coverage %": means["coverage_pct"],
            "position /rule": ratio["position_mean_m"],
            "rotation /rule": ratio["rotation_mean_deg"],
            # A level may be empty in one scene: ratios are of the averages.
            "high /rule": means["high_pct"] / means.loc[RULE, "high_pct"],
            "medium /rule": means["medium_pct"] / means.loc[RULE, "medium_pct"],
            "position /rule, common": common["position_mean_m"],
            "rotation /rule, common": common["rotation_mean_deg"],
            "position within 95 %": by_method["position_within_pct"].mean(),
            "rotation within 95 %": by_method["rotation_within_pct"].mean(),
        }
    )
    offline = [name for name in table.index if name in METHODS and not METHODS[name].causal]
    return pd.concat([table.drop(index=offline), table.loc[offline].rename(index="{} (offline)".format)])


def ratio_intervals(sessions: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Each method's mean errors over the rule's, averaged over scenes and regressors, with 95 % intervals by bootstrap
    over the walks of each scene: the same walks are drawn for both. One walk in a scene can't be drawn otherwise."""
    rows = sessions[sessions["kind"] == kind]
    methods = list(dict.fromkeys(rows["method"]))
    rng = np.random.default_rng(0)
    ratios = []
    for _, group in rows.groupby(["scene", "model"], sort=False):
        sums = np.array([group[group["method"] == m].sort_values("session_id")[_SUMS].to_numpy(float) for m in methods])
        walks = sums.shape[1]
        total = np.einsum("dw,mws->mds", draws(walks, rng), sums)  # first the walks as they are
        with np.errstate(invalid="ignore", divide="ignore"):
            means = total[..., :2] / total[..., 2:]
            ratios.append(means / means[methods.index(RULE)])
    mean = np.nanmean(np.where(np.isfinite(ratios), ratios, np.nan), axis=0)  # (methods, draws, 2)
    low, high = np.nanpercentile(mean[:, 1:], [2.5, 97.5], axis=1)
    table = {"method": methods}
    for i, name in enumerate(("position", "rotation")):
        table |= {f"{name} /rule": mean[:, 0, i], f"{name} from": low[:, i], f"{name} to": high[:, i]}
    return pd.DataFrame(table).set_index("method")


def worst(summary: pd.DataFrame, kinds: Iterable[str]) -> pd.DataFrame:
    """Each method's worst ratios to the raw regressor over scenes and models: a row a kind of walks and method."""
    rows = []
    for kind in kinds:
        coverage = per_scene(summary, kind)["coverage_pct"].groupby("method").mean()
        for name, group in against(summary, kind, RAW).groupby("method", sort=False):
            if name == RAW:
                continue
            row: dict[str, Any] = {"walks": kind, "method": name}
            for column, label in zip(ERRORS, ("position /raw", "rotation /raw"), strict=True):
                _, scene, model = group[column].idxmax()
                row |= {label: group[column].max(), f"where, {label.split()[0]}": f"{scene} {model}"}
            rows.append(row | {"coverage %": coverage[name]})
    return pd.DataFrame(rows)


# ---------------------------------------------------------------- published


def beside_published(summary: pd.DataFrame) -> pd.DataFrame:
    """Tables II and III beside the same cells of the simulated walks, raw and by the paper's rule."""
    folder = SHIPPED_DATA / "published"
    sizes = pd.read_csv(folder / "table2_pose_errors.csv").set_index(["scene", "subset", "method", "statistic"])
    levels = pd.read_csv(folder / "table3_accuracy_levels.csv").set_index(["scene", "subset", "method"])
    names = dict(zip(["high", "medium", "low"], [c for c in levels.columns if "_pct_" in c], strict=True))
    ours = summary[(summary["kind"] == SIMULATED) & (summary["method"] == RULE)]
    by_scene = ours.set_index(["scene", "model", "subset", "scored"])
    rows = []
    for scene, model in by_scene.index.droplevel(["subset", "scored"]).unique():
        for subset, scored in ((s, w) for s in ("rp", "opt", "rp+opt") for w in ("apr", "method")):
            # The paper prints its raw columns over all frames, but for the block of optimised frames.
            over = "all" if scored == "apr" and subset != "opt" else subset
            here = by_scene.loc[(scene, model, over, scored)]
            printed = f"{model}+VIO" if scored == "method" else model

            def row(figure: str, published: float, value: float, *key: str) -> dict[str, Any]:
                return dict(zip(_KEY, key, strict=True)) | {"figure": figure, "published": published, "ours": value}

            key = (scene, model, subset, "the rule" if scored == "method" else "raw")
            for statistic in ("mean", "median"):
                size = sizes.loc[(scene, subset, printed, statistic)]
                position, rotation = f"position_{statistic}_m", f"rotation_{statistic}_deg"
                rows.append(row(f"{statistic} m", size["translation_m"], here[position], *key))
                rows.append(row(f"{statistic} deg", size["rotation_deg"], here[rotation], *key))
            level = levels.loc[(scene, subset, printed)]
            rows += [row(f"{name} %", level[column], here[f"{name}_pct"], *key) for name, column in names.items()]
            if scored == "method":
                rows.append(row("frames %", level["frames_pct"], here["frames_pct"], *key))
    table = pd.DataFrame(rows)
    shares = table["figure"].str.endswith("%")
    off, ratio = table["ours"] - table["published"], table["ours"] / table["published"]
    table["off by"] = np.where(shares, off.map("{:+.1f} points".format), ratio.map("x {:.2f}".format))
    return table


_KEY = ["scene", "model", "subset", "poses"]


def differences(published: pd.DataFrame) -> pd.DataFrame:
    """By how much they differ over scenes and regressors: errors as ratios ours / published, shares in points."""
    rows = []
    for (poses, subset, figure), group in published.groupby(["poses", "subset", "figure"], sort=False):
        row: dict[str, Any] = {"poses": poses, "subset": subset, "figure": figure}
        if figure.endswith("%"):
            off = group["ours"] - group["published"]
            row |= {
                "typically off by": f"{off.median():+.1f} points",
                "from to": f"{off.min():+.1f} to {off.max():+.1f}",
            }
        else:
            ratio = group["ours"] / group["published"]
            row |= {"typically off by": f"x {ratio.median():.2f}", "from to": f"{ratio.min():.2f} to {ratio.max():.2f}"}
        rows.append(row)
    return pd.DataFrame(rows)


# ---------------------------------------------------------------- targets


@dataclass(frozen=True)
class Target:
    """A figure to reach, between `low` and `high`, and its value."""

    what: str
    walks: str
    value: float
    low: float = -np.inf
    high: float = np.inf

    @property
    def reached(self) -> bool:
        return bool(self.low <= self.value <= self.high)

    @property
    def wanted(self) -> str:
        if np.isinf(self.low):
            return f"at most {self.high:g}"
        return f"at least {self.low:g}" if np.isinf(self.high) else f"{self.low:g} to {self.high:g}"


def accuracy_targets(summary: pd.DataFrame, kinds: Sequence[str]) -> list[Target]:
    """Ours against the paper's rule, and its covariance, on each kind of walks."""
    targets = []
    for kind in kinds:
        row = overview(summary, kind).loc[OURS]
        targets += [
            Target("mean position error / the rule's", kind, row["position /rule"], high=0.45),
            Target("mean rotation error / the rule's", kind, row["rotation /rule"], high=0.33),
            Target("frames at high level / the rule's", kind, row["high /rule"], low=2.0),
            Target("frames at medium level / the rule's", kind, row["medium /rule"], low=2.0),
            Target("coverage %", kind, row["coverage %"], low=100.0),
            Target("position errors within 95 % bounds, %", kind, row["position within 95 %"], 90.0, 98.0),
            Target("rotation errors within 95 % bounds, %", kind, row["rotation within 95 %"], 90.0, 98.0),
        ]
    return targets


def guard_targets(summary: pd.DataFrame, kinds: Sequence[str]) -> list[Target]:
    """Never worse than the raw regressor by more than 5 % in any scene."""
    rows = worst(summary, kinds)
    ours = rows[rows["method"] == OURS]
    return [
        Target(f"mean {q} error / the raw one's, worst scene", row["walks"], row[f"{q} /raw"], high=1.05)
        for row in ours.to_dict("records")
        for q in ("position", "rotation")
    ]


def target_table(targets: Sequence[Target]) -> pd.DataFrame:
    """Each target beside its figure."""
    return pd.DataFrame(
        {
            "target": [t.what for t in targets],
            "walks": [t.walks for t in targets],
            "value": [t.value for t in targets],
            "wanted": [t.wanted for t in targets],
            "": ["ok" if t.reached else "short" for t in targets],
        }
    )


# ---------------------------------------------------------------- what a user sees


def recovery_table(sessions: pd.DataFrame) -> pd.DataFrame:
    """How long each method takes to be right again, over the sessions with a long time without a frame."""
    rows = []
    for name, group in sessions.groupby("method", sort=False):
        seconds = np.sort(group["recovery_s"].dropna().to_numpy(float))
        at = {"median s": 0.5, "90 % within s": 0.9}
        row = {column: seconds[min(len(seconds) - 1, int(share * len(seconds)))] for column, share in at.items()}
        rows.append({"method": name} | row | {"never %": 100 * float(np.isinf(seconds).mean()), "walks": len(seconds)})
    return pd.DataFrame(rows)


def user_table(sessions: pd.DataFrame) -> pd.DataFrame:
    """Times without a pose and jitter of each method, averaged over sessions."""
    grouped = sessions.groupby("method", sort=False)
    return pd.DataFrame(
        {
            "first pose after s": grouped["first_fix_s"].mean(),
            "longest outage s": grouped["longest_outage_s"].mean(),
            "jitter m a frame": grouped["jitter_m"].mean(),
            "jitter deg a frame": grouped["jitter_deg"].mean(),
        }
    )
