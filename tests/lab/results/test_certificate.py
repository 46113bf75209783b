"""The certificate's budget is the covariance of the run, and the page states what a laboratory needs."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest

from geometry.uncertainty.rig_uncertainty import RigCovariance, rig_names
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig_file, save_rig
from lab.files.run.results import read_poses, read_result_table
from lab.files.text import columns
from lab.results.certificate import CLOCKS, NOISE, PLACES, TURNS, certificate, write_certificate
from lab.runs.process import process_run
from lab.simulate.write import simulate
from tests.lab.command import typed


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A run with turns within its exposures, with a rig whose parameters are all correlated."""
    folder = simulate(
        "sharp-turns",
        tmp_path_factory.mktemp("run") / "run",
        seed=11,
        frames=30,
        points=True,
        exposure_s=0.006,
    )
    rig_file = load_rig_file(folder / "rig.yaml")
    names = rig_names(rig_file.rig)
    sigma = np.array([0.3 if n.endswith((".cx", ".cy", ".fx", ".fy")) else 1e-4 for n in names])
    A = np.random.default_rng(3).normal(size=(len(names), 2 * len(names)))
    C = A @ A.T
    scale = sigma / np.sqrt(np.diagonal(C))
    save_rig(
        dataclasses.replace(rig_file, covariances={"target": RigCovariance(names, C * np.outer(scale, scale))}),
        folder / "rig.yaml",
    )
    return folder


@pytest.fixture(scope="module")
def results(run_folder):
    process_run(run_folder, run_folder.parent / "results")
    return run_folder.parent / "results"


def test_the_budget_of_every_frame_adds_up_to_the_covariance_of_the_run(results):
    poses = read_poses(results)
    measured = poses.frames[poses.has("measured")].tolist()
    for frame in certificate(results, at=measured, draws=0).frames:
        k = int(np.flatnonzero(poses.frames == frame.frame)[0])
        stated = np.concatenate([np.sqrt(np.diagonal(poses.covariance[k])[:3]), poses.sigma_ypr_deg[k]])
        np.testing.assert_allclose(np.sqrt(frame.variances.sum(axis=0)), stated, rtol=1e-6)
        np.testing.assert_allclose(frame.result.combined, stated, rtol=1e-6)
        assert frame.variances.min() > -1e-9 * frame.variances.max()
        # The weights of the reported spots are nearly those of the run.
        assert frame.share is not None
        assert np.abs(np.linalg.eigvals(frame.share.adjusted) - 1).max() < 0.15


def test_the_range_has_the_uncertainty_of_each_measured_frame(results):
    found = certificate(results, draws=0)
    frames = certificate(results, at=found.measured.tolist(), draws=0).frames
    np.testing.assert_allclose(found.over_recording.expanded, [f.result.expanded for f in frames], rtol=1e-6)


def test_turns_within_the_exposure_and_errors_of_places_have_lines_of_their_own(results):
    table = read_result_table(results / "budget.csv", columns.BUDGET)
    poses = read_poses(results)
    turns = table.stack(*columns.BUDGET[2:8])
    assert (turns > 0).any()
    rest = poses.covariance - poses.systematic
    assert np.linalg.eigvalsh(rest - turns[..., None] ** 2 * np.eye(6)).min() > 0
    assert np.all((table.numbers["place_share"] >= 0) & (table.numbers["place_share"] < 1))
    row = int(np.argmax(turns[:, 3]))
    (frame,) = certificate(results, at=[int(table.numbers["frame"][row])], draws=0).frames
    assert frame.lines[:3] == (NOISE, PLACES, TURNS)
    np.testing.assert_allclose(np.sqrt(frame.variances[2, :3]), turns[row, :3], rtol=1e-9)
    both = frame.variances[:2].sum(axis=0)
    np.testing.assert_allclose(frame.variances[1], table.numbers["place_share"][row] * both, rtol=1e-9)


def test_a_monte_carlo_of_the_command_agrees_with_the_budget(results):
    (frame,) = certificate(results, draws=500).frames
    assert frame.simulated is not None
    np.testing.assert_allclose(frame.simulated[1], frame.result.expanded, rtol=0.13)  # 4.5 % by chance, three sigmas


@pytest.mark.slow
def test_ten_thousand_draws_agree_within_two_per_cent(results):
    (frame,) = certificate(results).frames
    np.testing.assert_allclose(frame.simulated[1], frame.result.expanded, rtol=0.02)


def test_the_page_states_measurand_budget_and_traceability(results, run_folder):
    write_certificate(results, None, (5,), 50)
    page = (results / "certificate.html").read_text()
    for text in (
        "Measurand and model",
        "Budget of frame 5",
        "Range over the recording",
        "Traceability",
        "JCGM 100:2008",
    ):
        assert text in page
    for file in (run_folder / "rig.yaml", results / "covariance.csv"):
        assert hashlib.sha256(file.read_bytes()).hexdigest() in page
    assert "states no covariance" not in page


def test_a_rig_without_covariance_makes_an_incomplete_budget_that_says_so(tmp_path):
    run = simulate("smooth", tmp_path / "run", seed=5, frames=10, points=True)
    process_run(run, tmp_path / "out")
    (tmp_path / "out/budget.csv").unlink()  # as results of earlier versions
    (frame,) = certificate(tmp_path / "out", draws=0).frames
    assert frame.lines == (NOISE, PLACES, TURNS, CLOCKS)
    assert frame.variances[1:].max() == 0
    write_certificate(tmp_path / "out", None, (), 50)
    assert (
        "the uncertainty of the calibration is not part of this budget"
        in (tmp_path / "out/certificate.html").read_text()
    )


def test_a_frame_that_is_not_measured_and_a_lost_run_folder_are_errors(results, tmp_path):
    with pytest.raises(InputError, match="--at 999: expected a frame with a measured pose"):
        certificate(results, at=[999], draws=0)
    with pytest.raises(InputError, match=r"run\.yaml"):
        certificate(results, tmp_path, draws=0)
    done = typed("report", results, "--at", "3")
    assert done.exit_code == 2
    assert "--at is of the certificate" in done.output
