"""The offset of a spot's centre from the image of the beam's axis, against pictures that are integrated ray by ray."""

import cv2
import numpy as np
import pytest

from geometry.camera import Camera
from geometry.light_centroid import CentroidOffsets
from geometry.planes import intersect_plane
from geometry.pose import Pose
from geometry.rig import Screen

CAMERA = Camera(
    "c", "s", (1280, 1024), np.array([[1000.0, 0, 640], [0, 1000, 512], [0, 0, 1]]), (-0.2, 0.05, 0, 0), Pose.identity()
)


def turned(axis, degrees):
    return cv2.Rodrigues(np.asarray(axis, float) * np.radians(degrees))[0]


def fitted_centre(image, u, v, start, covariance, brightness, clip):
    """Weighted least squares for centre, shape, flux and plane, by Gauss-Newton with numerical derivatives."""
    L = np.linalg.cholesky(covariance)
    x = np.array([*start, L[0, 0], L[1, 0], L[1, 1], image.max(), 0.0, 0.0, 0.0])

    def model(p):
        chol = np.array([[p[2], 0], [p[3], p[4]]])
        w = np.linalg.solve(chol, np.stack([u - p[0], v - p[1]]))
        return p[5] * np.exp(-0.5 * (w**2).sum(axis=0)) + p[6] + p[7] * (u - start[0]) + p[8] * (v - start[1])

    for _ in range(8):
        f = model(x)
        root = (image <= clip) / np.sqrt(1 + brightness * np.maximum(f, 0) / image.max())
        J = np.stack([(model(x + h) - f) / 1e-5 for h in 1e-5 * np.eye(len(x))], axis=-1)
        x = x + np.linalg.lstsq(J * root[:, None], (image - f) * root, rcond=None)[0]
    return x[:2]


@pytest.mark.parametrize("clip", [1.0, 0.7, 0.25])
@pytest.mark.parametrize("brightness", [0.0, 20.0])
@pytest.mark.parametrize("tilt", [0, 30, 50])
def test_the_offset_is_that_of_a_fitted_gaussian(tilt, brightness, clip):
    """clip: height at which the sensor clips, relative to the Gaussian's."""
    screen = Screen("s", Pose(turned([0, 1, 0.3], tilt), np.array([0.1, 0.05, 2.0])))
    place, spread = np.array([0.2, -0.1]), np.array([[1.0, 0.3], [0.3, 1.5]]) * 0.012**2
    axis = CAMERA.project(screen.world_from_screen.apply(np.array([*place, 0.0])))
    u, v = (x.ravel().astype(float) for x in np.meshgrid(*(np.rint(c) + np.arange(-26, 27) for c in axis)))
    origin, direction = CAMERA.rays(np.stack([u, v], axis=-1))
    s = intersect_plane(origin, direction, screen.world_from_screen) - place
    image = np.exp(-0.5 * np.einsum("ni,ij,nj->n", s, np.linalg.inv(spread), s))
    d = np.stack([u, v], axis=-1) - axis
    covariance = (d * image[:, None]).T @ d / image.sum()
    measured = fitted_centre(image, u, v, axis, covariance, brightness, clip)
    shape = covariance[[0, 0, 1], [0, 1, 1]][None]
    predicted = CentroidOffsets(CAMERA, screen).at(measured[None], shape, np.array([brightness]), np.array([clip]))[0]
    size = np.linalg.norm(measured - axis)
    assert size > 0.005
    assert np.linalg.norm(measured - axis - predicted) < 0.2 * size + 5e-4


def test_the_offset_grows_with_the_square_of_the_width():
    screen = Screen("s", Pose(turned([0, 1, 0], 40), np.array([0.0, 0.0, 2.0])))
    at, faint, whole = np.array([[700.0, 500.0]]), np.zeros(1), np.ones(1)
    offsets = CentroidOffsets(CAMERA, screen)
    narrow, wide = (offsets.at(at, w**2 * np.array([[1.0, 0, 1]]), faint, whole) for w in (2.0, 4.0))
    assert wide == pytest.approx(4 * narrow, rel=0.01)


def test_without_a_screen_there_is_no_offset():
    behind = Screen("s", Pose(np.eye(3), np.array([0.0, 0.0, -2.0])))
    offsets = CentroidOffsets(CAMERA, behind)
    assert not offsets.at(np.array([[700.0, 500.0]]), np.array([[9.0, 0, 9]]), np.zeros(1), np.ones(1)).any()
    assert offsets.at(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.ones(0)).shape == (0, 2)
