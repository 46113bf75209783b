"""The scores of scenes in pictures as a table and as a summary, and all figures of one scene."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from bench.random_pictures.judge import CLASSES, PictureJudgement
from bench.random_pictures.render import Renderer

WORST = 12


def crashed(renderer: Renderer, pairs: int, trace: str) -> PictureJudgement:
    """The scores of a scene on which the program raised an exception."""
    nan, ps = float("nan"), renderer.ps
    return PictureJudgement(
        seed=ps.seed, family=ps.family or "mixed", counts=True, why_not="", classes=("crash",), pairs=pairs, right=0.0,
        recall=0.0, false_per_picture=nan, wrong=0, measured=0.0, wrong_poses=0, nees=nan, nees_max=nan, scatter=nan,
        error_px=nan, noise=(), exit_status=1, verdict=trace, wrong_diagnoses=(), render_s=nan, run_s=nan, text=ps.text,
    )  # fmt: skip


def write_rows(rows: Sequence[PictureJudgement], path: Path) -> None:
    """Write one row per scene; the ratios of the noise models of its cameras share a field."""
    names = [f.name for f in fields(PictureJudgement) if f.name not in ("noise", "classes", "wrong_diagnoses")]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*names, "classes", "wrong_diagnoses", "noise_background", "noise_half"])
        for row in rows:
            values = [getattr(row, n) for n in names]
            writer.writerow(
                [
                    *(f"{v:.6g}" if isinstance(v, float) else v for v in values),
                    "|".join(row.classes),
                    "|".join(row.wrong_diagnoses),
                    "|".join(f"{n.background:.4g}" for n in row.noise),
                    "|".join(f"{n.half:.4g}" for n in row.noise),
                ]
            )


def line(row: PictureJudgement) -> str:
    """One line for a scene."""
    noise = ", ".join(f"{n.background:.2g}/{n.half:.2g}" for n in row.noise)
    return (
        f"{row.family} {row.seed}: {', '.join(row.classes) or 'clean'}; right {row.right:.4f} of {row.pairs}, recall"
        f" {row.recall:.4f}, false {row.false_per_picture:.2f}, wrong {row.wrong}, NEES/6 {row.nees:.2f}, err/sigma"
        f" {row.scatter:.2f}, noise {noise}, status {row.exit_status}"
    )


def details(row: PictureJudgement) -> str:
    """All figures of one scene."""
    out = [line(row) + ("" if row.counts else f" (left out: {row.why_not})"), f"  {row.text}"]
    out.append(
        f"  measured {row.measured:.1%}, confidently wrong {row.wrong_poses}, NEES/6 at most {row.nees_max:.3g}, rms"
        f" {row.error_px:.3g} px; render {row.render_s:.1f} s, run {row.run_s:.1f} s"
    )
    out.append(f"  verdict: {row.verdict}")
    out += [f"  wrong: {w}" for w in row.wrong_diagnoses]
    return "\n".join(out)


def summary(rows: Sequence[PictureJudgement]) -> str:
    """Distributions, classes, a row per family and the worst scenes, in plain text."""
    counted = [r for r in rows if r.counts]
    out = [f"{len(rows)} scenes; with the true labels {len(counted)} can be solved"]
    out += [f"  left out: {n} x {why}" for why, n in Counter(r.why_not for r in rows if not r.counts).items()]
    if not counted:
        return "\n".join(out)
    out += _figures(counted)
    families = list(dict.fromkeys(r.family for r in counted))
    if len(families) > 1:
        out.append(
            "family               scenes clean  right least/median  recall  NEES/6  err/sig  noise bg / half (median)"
        )
        out += [_family_row(name, [r for r in counted if r.family == name]) for name in families]
    failed = [r for r in counted if r.classes]
    if failed:
        out.append("classes (leading | anywhere):")
        leading, anywhere = Counter(r.failure for r in counted), Counter(c for r in counted for c in r.classes)
        out += [f"  {c}: {leading[c]} | {anywhere[c]}" for c in CLASSES if anywhere[c]]
        out.append("worst:")
        for r in sorted(failed, key=lambda r: (CLASSES.index(r.failure), r.right))[:WORST]:
            out += [f"  {line(r)}", f"    {r.text}"]
    return "\n".join(out)


def _figures(rows: Sequence[PictureJudgement]) -> list[str]:
    n = len(rows)
    right = np.array([r.right for r in rows])
    pairs = np.array([r.pairs for r in rows])
    wrong = sum(bool(r.wrong_diagnoses) for r in rows)
    background = np.array([f.background for r in rows for f in r.noise])
    half = np.array([f.half for r in rows for f in r.noise])
    return [
        f"clean: {sum(not r.classes for r in rows)} of {n}",
        f"measured and right, share of {pairs.sum()} pairs: {_quantiles(right)}, least {right.min():.4f}, pooled"
        f" {np.sum(right * pairs) / max(pairs.sum(), 1):.4f}",
        f"recall: {_quantiles(np.array([r.recall for r in rows]))}, pooled"
        f" {np.sum([r.recall * r.pairs for r in rows]) / max(pairs.sum(), 1):.4f};"
        f" false points per picture: {_quantiles(np.array([r.false_per_picture for r in rows]))}",
        f"wrong labels {sum(r.wrong for r in rows)} in {sum(r.wrong > 0 for r in rows)} scenes; confidently wrong poses"
        f" {sum(r.wrong_poses for r in rows)} in {sum(r.wrong_poses > 0 for r in rows)} scenes; scenes with a wrong"
        f" diagnosis {wrong}; exit status not 0: {sum(r.exit_status != 0 for r in rows)}",
        f"smoothed NEES/6: {_quantiles(np.array([r.nees for r in rows]))}",
        f"rms(error / sigma) of right pairs: {_quantiles(np.array([r.scatter for r in rows]))}",
        f"noise, estimated / true variance at the background: {_quantiles(background)}, within 1.3 x"
        f" {within(background, 1.3):.1%}; at half of full scale: {_quantiles(half)}, within 2 x {within(half, 2):.1%}",
        f"process time: render {_quantiles(np.array([r.render_s for r in rows]))} s,"
        f" run {_quantiles(np.array([r.run_s for r in rows]))} s",
    ]


def _family_row(name: str, rows: Sequence[PictureJudgement]) -> str:
    right = np.array([r.right for r in rows])
    background = [f.background for r in rows for f in r.noise]
    half = [f.half for r in rows for f in r.noise]
    return (
        f"{name:20} {len(rows):6} {sum(not r.classes for r in rows):5}  {right.min():.4f} {np.median(right):.4f}"
        f"       {_median([r.recall for r in rows]):6.4f}  {_median([r.nees for r in rows]):6.2f}"
        f"  {_median([r.scatter for r in rows]):7.2f}  {_median(background):.3g} / {_median(half):.3g}"
    )


def within(ratios: np.ndarray, factor: float) -> float:
    """The share of ratios between 1 / factor and factor."""
    return float(np.mean((ratios <= factor) & (ratios >= 1 / factor))) if ratios.size else float("nan")


def _median(values: Sequence[float]) -> float:
    known = np.array([v for v in values if np.isfinite(v)])
    return float(np.median(known)) if known.size else float("nan")


def _quantiles(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]
    if not values.size:
        return "none"
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"median {middle:.4g} (5 % {low:.4g}, 95 % {high:.4g})"
