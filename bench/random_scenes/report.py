"""The scores of many scenes as a table and as a summary, and all figures of one scene."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from bench.random_scenes.judge import CLASSES, CLEAN, Judgement, PassFigures
from bench.random_scenes.oracle import Oracle
from bench.random_scenes.scene import Scene
from geometry.arrays import Array

WORST = 10


def nothing() -> PassFigures:
    """The figures of a run that ended in an exception."""
    nan = float("nan")
    return PassFigures(
        identity=0.0, countable=0, wrong=0, near=0, measured=0, predicted=0, lost=0, nees=nan, nees_median=nan,
        nees_measured=nan, nees_predicted=nan, nees_max=nan, poses=0, independent=0.0, coverage=nan, wrong_measured=0,
        wrong_predicted=0, beyond_6=0, not_definite=0,
        first_labels=-1, first_wrong=0, locked_in=-1, worst_deg=nan, worst_m=nan,
    )  # fmt: skip


def crashed(scene: Scene, oracle: Oracle, trace: str) -> Judgement:
    """The scores of a scene on which the program raised an exception."""
    return Judgement(
        scene.seed, oracle.counts, oracle.why_not, ("crash",), nothing(), None, float("nan"),
        float(oracle.solvable.mean()), int(oracle.solvable.sum()), 1, trace.strip().splitlines()[-1], 0, trace,
        float("nan"), float("nan"), float("nan"), 0, scene.text,
    )  # fmt: skip


def write_rows(rows: Sequence[Judgement], path: Path) -> None:
    """Write one row per scene with all fields; those of the two passes have a prefix."""
    flat = [_flat(row) for row in rows]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(flat[0]) if flat else ["seed"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(flat)


def _flat(row: Judgement) -> dict[str, object]:
    out: dict[str, object] = {"seed": row.seed, "counts": int(row.counts), "class": row.failure}
    out["classes"] = "|".join(row.classes)
    for name in ("smoothed", "causal"):
        figures = getattr(row, name)
        values = asdict(figures) if figures is not None else {f.name: "" for f in fields(PassFigures)}
        out |= {f"{name}_{key}": _short(value) for key, value in values.items()}
    for field in fields(Judgement):
        if field.name not in ("seed", "counts", "classes", "smoothed", "causal"):
            out[field.name] = _short(getattr(row, field.name))
    return out


def _short(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def summary(rows: Sequence[Judgement]) -> str:
    """The share of clean scenes, distributions, classes and the worst seeds, in plain text."""
    counted = [r for r in rows if r.counts]
    out = [f"{len(rows)} scenes; the oracle with the true labels can solve {len(counted)}"]
    out += [f"  left out: {n} x {why}" for why, n in Counter(r.why_not for r in rows if not r.counts).items()]
    if not counted:
        return "\n".join(out)
    n = len(counted)
    clean = sum(r.clean for r in counted)
    out.append(f"clean: {clean} of {n} = {clean / n:.1%}")
    out.append(f"identity < .995: {_count(counted, lambda r: not r.smoothed.identity >= 0.995)}")
    out.append(f"any wrong label as measured: {_count(counted, lambda r: r.smoothed.wrong > 0)}")
    out.append(
        "any confidently wrong pose (Mahalanobis > 10):"
        f" measured {_count(counted, lambda r: r.smoothed.wrong_measured > 0)},"
        f" predicted {_count(counted, lambda r: r.smoothed.wrong_predicted > 0)};"
        f" covariance not positive definite {_count(counted, lambda r: r.smoothed.not_definite > 0)}"
    )
    out.append(
        f"NEES mean > 12: {_count(counted, lambda r: not r.smoothed.nees <= 12)};"
        f" exit status not 0: {_count(counted, lambda r: r.exit_status != 0)};"
        f" numeric warnings: {_count(counted, lambda r: r.warnings > 0)}"
    )
    for name in ("smoothed", "causal"):
        figures = [f for r in counted if (f := getattr(r, name)) is not None]
        if figures:
            out += [f"{name}:", *(f"  {line}" for line in _distributions(figures))]
    ratio = np.array([r.smoothed.nees / 6 for r in counted])
    outside = int(np.sum(~((ratio >= 0.6) & (ratio <= 1.6))))
    independent = np.array([r.smoothed.independent for r in counted])
    p = chi2.cdf(6 * independent * ratio, 6 * np.maximum(independent, 1e-9))
    beyond = int(np.sum(~((p >= 0.005) & (p <= 0.995))))
    out.append(
        f"smoothed NEES/6 outside .6 to 1.6: {outside} = {outside / n:.1%};"
        f" beyond the 99 % of chance, given how many independent poses a scene holds: {beyond} = {beyond / n:.1%}"
        f" (independent poses: {_quantiles(independent)})"
    )
    out.append(f"oracle NEES/6: {_quantiles(np.array([r.oracle_nees for r in counted]))}")
    for what, field in (("both passes", "ms_per_frame"), ("causal", "ms_causal"), ("slowest frame", "ms_slowest")):
        out.append(f"process time, {what}: {_quantiles(np.array([getattr(r, field) for r in counted]))} ms")
    out.append(f"rounds of smoothing: {dict(sorted(Counter(r.rounds for r in counted).items()))}")
    out.append("classes (leading | anywhere):")
    leading = Counter(r.failure for r in counted)
    anywhere = Counter(c for r in counted for c in r.classes)
    out += [f"  {c}: {leading[c]} | {anywhere[c]}" for c in CLASSES if anywhere[c]]
    failed = [r for r in counted if not r.clean]
    if failed:
        out.append("seeds by leading class:")
        out += [f"  {c}: {' '.join(str(r.seed) for r in failed if r.failure == c)}" for c in CLASSES if leading[c]]
        out.append("worst:")
        out += [f"  {line(r)}" for r in sorted(failed, key=_badness)[:WORST]]
    return "\n".join(out)


def line(row: Judgement) -> str:
    """One line for a scene."""
    s = row.smoothed
    what = ", ".join(row.classes) or CLEAN
    return (
        f"seed {row.seed}: {what}; identity {s.identity:.4f}, wrong {s.wrong},"
        f" NEES {s.nees:.3g} (max {s.nees_max:.3g}), status {row.exit_status} | {row.text}"
    )


def details(row: Judgement) -> str:
    """All figures of one scene."""
    left_out = "" if row.counts else f" (left out: {row.why_not})"
    out = [f"seed {row.seed}: {', '.join(row.classes) or CLEAN}{left_out}", f"  {row.text}"]
    for name in ("smoothed", "causal"):
        figures = getattr(row, name)
        if figures is not None:
            out.append(f"  {name}: " + ", ".join(f"{k} {_short(v)}" for k, v in asdict(figures).items()))
    out.append(
        f"  oracle: NEES/6 {row.oracle_nees:.2f}, solvable {row.solvable:.1%}, not measured though solvable"
        f" {row.lost_though_solvable}; {row.ms_per_frame:.1f} ms/frame, {row.rounds} rounds"
    )
    out.append(f"  exit status {row.exit_status}: {row.reasons}")
    if row.warnings or row.first_warning:
        out.append(f"  {row.warnings} warnings: {row.first_warning}")
    return "\n".join(out)


def _badness(row: Judgement) -> tuple[int, float]:
    return CLASSES.index(row.failure), row.smoothed.identity - np.nan_to_num(row.smoothed.nees_max) * 1e-9


def _count(rows: Sequence[Judgement], bad: Callable[[Judgement], object]) -> str:
    n = sum(bool(bad(r)) for r in rows)
    return f"{n} = {n / len(rows):.1%}"


def _distributions(figures: Sequence[PassFigures]) -> list[str]:
    def of(name: str) -> Array:
        return np.array([getattr(f, name) for f in figures], dtype=float)

    return [
        f"identity: least {of('identity').min():.4f}, {_quantiles(of('identity'))};"
        f" pooled {np.sum(of('identity') * of('countable')) / max(of('countable').sum(), 1):.5f};"
        f" wrong labels {of('wrong').sum():.0f}, near ones {of('near').sum():.0f}",
        f"NEES/6 over scenes: {_quantiles(of('nees') / 6)}; of measured poses {_quantiles(of('nees_measured') / 6)};"
        f" of predicted ones {_quantiles(of('nees_predicted') / 6)}",
        f"95 % coverage: {_quantiles(of('coverage'))}",
        f"all poses together: NEES/6 {_pooled(of('nees'), of('poses')) / 6:.3f}, 95 % coverage"
        f" {_pooled(of('coverage'), of('poses')):.4f},"
        f" beyond 6 sigma {of('beyond_6').sum():.0f} of {of('poses').sum():.0f}",
        f"frames measured {of('measured').sum():.0f}, predicted {of('predicted').sum():.0f},"
        f" lost {of('lost').sum():.0f}",
        f"locked in frame: {_quantiles(np.where(of('locked_in') < 0, np.nan, of('locked_in')))};"
        f" within 3 frames {int(np.sum((of('locked_in') >= 0) & (of('locked_in') <= 3)))} of {len(figures)},"
        f" never {int(np.sum(of('locked_in') < 0))}",
        f"first labels: right in {int(np.sum((of('first_labels') >= 0) & (of('first_wrong') == 0)))},"
        f" with wrong ones in {int(np.sum(of('first_wrong') > 0))}, none in {int(np.sum(of('first_labels') < 0))};"
        f" in frame 0: {int(np.sum(of('first_labels') == 0))}",
    ]


def _pooled(means: Array, counts: Array) -> float:
    """The mean over all poses, from the means of scenes."""
    some = counts > 0
    return float(np.sum(means[some] * counts[some]) / max(counts[some].sum(), 1))


def _quantiles(values: Array) -> str:
    values = values[~np.isnan(values)]
    if not values.size:
        return "none"
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"median {middle:.4g} (5 % {low:.4g}, 95 % {high:.4g})"
