"""The scene of a recording with a rig of one's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.camera import FISHEYE
from lab.simulate.scenarios import RIGS
from lab.simulate.scene import compose


def test_a_rigs_clocks_and_lenses_are_those_of_its_recording():
    """A camera that exposes 2 ms late, and each row 1 us later, through a fisheye lens; the other one is ordinary."""
    rig = RIGS["fan"]()
    late, other = rig.cameras.values()
    late = replace(late, time_offset_s=2e-3, row_time_s=1e-6, lens=FISHEYE, distortion=(0.02, -0.01, 0.0, 0.0))
    scene = compose("sharp-turns", seed=1, frames=8, rig=replace(rig, cameras={late.name: late, other.name: other}))
    assert scene.rig.cameras[late.name].lens == FISHEYE
    of_late = scene.model.camera_of == list(scene.rig.cameras).index(late.name)
    middle = (late.image_size_px[1] - 1) / 2
    for j in np.flatnonzero(of_late):
        expected = scene.t_s + 2e-3 + 1e-6 * (scene.uv_px[:, j, 1] - middle)
        seen = np.isfinite(scene.uv_px[:, j, 1])
        np.testing.assert_allclose(scene.exposed_s[seen, j], expected[seen], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(scene.exposed_s[:, ~of_late], scene.t_s[:, None] + np.zeros(np.sum(~of_late)))
    for j in range(len(scene.model)):
        at = scene.motion.pose(scene.exposed_s[:, j])
        np.testing.assert_allclose(scene.uv_px[:, j], scene.model.project(at)[0][:, j], rtol=0, atol=1e-6)
