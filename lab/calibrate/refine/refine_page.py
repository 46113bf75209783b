"""Report of a refinement."""

from __future__ import annotations

import numpy as np

from calibration.rig.recordings import Reduced
from calibration.rig.refinement import MOTIONS, Refinement, further_motions
from calibration.terms.rig_blocks import prior_of
from geometry.arrays import Array
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import CLOCK, POSE, ROW_TIME, split_name
from lab.calibrate.refine.refine_findings import RefinedRig
from lab.number_format import format_number
from lab.report.calibration.calibration_charts import correlation_matrix
from lab.report.calibration.calibration_drawings import residual_field
from lab.report.calibration.calibration_scene import SceneObject, Trail, frustum_length, rig_things, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section

_MUCH_BETTER = 0.7  # of its sigma: what a further motion must at least leave to be named


def page_of(result: RefinedRig) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report."""
    r = result.refined
    return _key_figures(r), [
        changes_of_numbers(result),
        _directions(result),
        _held_out(result),
        _residuals(r),
        _correlations(r),
        _scene(r),
    ]


def pixel_residuals(d: Reduced) -> Array:
    """(K, n, 2), px, measured minus predicted; 0 for spots that are not used."""
    back = np.linalg.inv(np.where(d.lin.used[..., None, None], d.lin.W, np.eye(2)))
    return np.asarray((back @ d.left[..., None])[..., 0])


def _key_figures(r: Refinement) -> list[KeyFigure]:
    out = []
    for name, data in (("residuals, given", r.given_data), ("residuals, refined", r.data)):
        rms = np.sqrt(sum(np.sum(pixel_residuals(d) ** 2) for d in data) / sum(2 * d.lin.used.sum() for d in data))
        out.append((name, f"{format_number(float(rms))} px", "RMS per axis, poses fitted"))
    out.append(("frames", str(sum(len(x.seen) for x in r.recordings)), f"{r.excluded} spots excluded"))
    out.append(("determined", f"{int(np.sum(r.gain > 1))} of {len(r.gain)}", "directions of the rig's parameters"))
    return out


def changes_of_numbers(result: RefinedRig) -> Section:
    """The section with the change of each number."""
    r = result.refined
    prior, after = result.prior, r.covariance
    before = dict(zip(prior.names, np.sqrt(np.diagonal(prior.matrix)), strict=True))
    sigma = dict(zip(after.names, np.sqrt(np.diagonal(after.matrix)), strict=True))
    rows = []
    for name, change in r.named_changes().items():
        if name in before and name in sigma:
            unit, factor = _unit(name)
            removed = np.sqrt(max(before[name] ** 2 - sigma[name] ** 2, 0.0))
            in_sigmas = change / removed if removed > 1e-3 * before[name] else float("nan")
            rows.append((name, unit, factor * before[name], factor * sigma[name], factor * change, float(in_sigmas)))
    heads = ("parameter", "unit", "sigma before", "sigma after", "change", "change / its sigma")
    words = [
        "Sigmas of each number before and after, and its change, also in sigmas of a correct prior: values beyond 3 are"
        " unusual. The sigmas after contain the errors that all parts share, which the recordings do not determine (see"
        " the next section); differences between parts are known better: rig.yaml holds the joint covariance.",
    ]
    return Section("Change of each number", words, (), PageTable(heads, rows))


def _unit(name: str) -> tuple[str, float]:
    """The unit in which a number is shown, and its factor."""
    parameter = split_name(name)[2]
    if parameter in CLOCK:
        return ("us", 1e6) if parameter == ROW_TIME else ("ms", 1e3)
    is_angle = parameter.endswith("_rad") or parameter.startswith("direction")
    return ("mm", 1e3) if parameter.endswith("_m") else ("mrad", 1e3) if is_angle else ("", 1.0)


def _directions(result: RefinedRig) -> Section:
    r = result.refined
    conventions = r.conventions
    free = len(r.gain) - int(np.sum(r.gain > 1))
    words = [
        f"The recordings determine {int(np.sum(r.gain > 1))} of {len(r.gain)} directions of the unknown numbers better"
        f" than what was stated. {conventions} directions are conventions: motions of all cameras and screens together,"
        " and of all beams in the body, change no residual. What is stated of all parts together decides them, and no"
        f" recording can. The other {max(free - conventions, 0)} stay near what was stated.",
        "The last column is the motion, along an axis of world or about one of the body, that would determine a"
        " direction best in as many frames again, and the sigma that it would leave over that before.",
    ]
    motions = further_motions(r, prior_of(r.given, result.prior)[1])
    rows: list[tuple[object, ...]] = []
    for i in np.argsort(r.gain):
        parts: dict[str, float] = {}
        for share, part in zip(r.shares[:, i], r.parts, strict=True):
            parts[part] = parts.get(part, 0.0) + share
        largest = sorted(parts.items(), key=lambda p: -p[1])[:3]
        ratio = 1 / np.sqrt(1 + r.gain[i])
        name = min(motions, key=lambda m: motions[m][1][i], default="")
        would = ""
        if name and motions[name][1][i] < _MUCH_BETTER * ratio:
            size, sigmas = motions[name]
            words_of = f"{format_number(1e3 * size, 2)} mm" if name in MOTIONS[:3] else f"{np.rad2deg(size):.2g} deg"
            would = f"{name} ± {words_of}: {format_number(float(sigmas[i]), 2)}"
        rows.append((len(rows) + 1, float(ratio), ", ".join(f"{n} {100 * s:.0f} %" for n, s in largest), would))
    heads = ("direction", "sigma after / before", "largest shares", "motion that would help")
    return Section("What the recordings determine", words, (), PageTable(heads, rows))


def _held_out(result: RefinedRig) -> Section:
    r = result.refined
    several = len(r.recordings) > 1
    rows = [
        (
            result.runs[i].run.name if several else f"block {i + 1}",
            *(float(np.sqrt(chi2 / max(h.dof, 1))) for chi2 in h.chi2), h.p,
            h.log_density[1] - h.log_density[0],
        )
        for i, h in enumerate(r.held_out)
    ]  # fmt: skip
    heads = ("held out", "residuals, given (sigmas)", "residuals, refined (sigmas)", "p", "gain of ln p")
    words = (
        f"Each {'recording' if several else 'block of time of the recording'} against the rig refined by the others:"
        " its residuals in sigmas, 1 if all sigmas are right; the p-value of its data with the refined rig and its"
        " covariance; and by how much the logarithm of their probability density grows."
    )
    return Section("Held-out recordings", words, (), PageTable(heads, rows))


def _residuals(r: Refinement) -> Section:
    drawings = []
    model_views = r.rig.views()
    for camera, c in r.rig.cameras.items():
        views = np.array([name == camera for name, _ in model_views])
        for words, data in (("given", r.given_data), ("refined", r.data)):
            places, residuals = [], []
            for i, d in enumerate(data):
                used = d.lin.used & views
                places.append(r.of_data(i).uv_px[used])
                residuals.append(pixel_residuals(d)[used])
            at = np.concatenate(places)
            if len(at):
                title = f"Camera {camera}, {words} rig"
                drawings.append(
                    PageDrawing(residual_field(c.image_size_px, at, np.concatenate(residuals), title, things="spots"))
                )
    words_ = "Mean residuals over each picture, after the pose of each frame was fitted; the scales differ."
    return Section("Residuals", words_, drawings)


def _correlations(r: Refinement) -> Section:
    keep = [i for i, n in enumerate(r.covariance.names) if split_name(n)[2] in POSE][:60]
    names = [r.covariance.names[i] for i in keep]
    picture = correlation_matrix(names, r.covariance.matrix[np.ix_(keep, keep)], "Correlations of cameras and screens")
    words = "Common motions of all parts are strongly correlated; the covariance in rig.yaml contains this."
    return Section("Correlations", words, [PageDrawing(picture, wide=True)])


def _scene(r: Refinement) -> Section:
    poses = r.data[0].lin.poses
    things = rig_things(r.rig, poses[len(poses.translation) // 2])
    arrows, times = _arrows(r, 1.5 * frustum_length(things))
    words = f"Arrows are the changes of cameras and screens, {format_number(times, 2)} times as long." if arrows else ""
    return Section("The refined rig", words, [PageDrawing(picture) for picture in scene_views([*things, *arrows])])


def _arrows(r: Refinement, longest_m: float) -> tuple[list[SceneObject], float]:
    """The changes of the places of cameras and screens, the largest of this length, and how much they are stretched."""

    def places(rig: Rig) -> dict[str, Array]:
        out = {f"camera {n}": c.camera_from_world.inverse().translation for n, c in rig.cameras.items()}
        return out | {f"screen {n}": s.world_from_screen.translation for n, s in rig.screens.items()}

    before, after = places(r.given), places(r.rig)
    moved = {name: after[name] - place for name, place in before.items()}
    largest = max(float(np.linalg.norm(m)) for m in moved.values())
    if not largest > 0:
        return [], 1.0
    out: list[SceneObject] = []
    for name, shift in moved.items():
        end = before[name] + shift * (longest_m / largest)
        back, across = -0.2 * (end - before[name]), 0.1 * np.cross(end - before[name], [0.3, 0.5, 0.8])
        head = [end, end + back + across, end, end + back - across]
        text = f"{name}: {format_number(1e3 * float(np.linalg.norm(shift)), 2)} mm"
        out.append(Trail(text, np.array([before[name], *head])))
    return out, longest_m / largest
