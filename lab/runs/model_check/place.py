"""Position-dependent errors on the screen, in the model check: over a vehicle at rest they would look like faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.model_check.recording import ModelCheckRecording
from geometry.forward_model import SpotModel
from tracking.smoothing.error_scale import LARGEST_WIDTH_SHARE
from tracking.smoothing.place_errors import correlation, place_errors

_CHUNK = 500  # frames that are compared with each other at once


def with_place_errors(recording: ModelCheckRecording, model: SpotModel) -> ModelCheckRecording:
    """The recording with covariances that include such errors, for tests that sum over its frames.

    Frames in which a spot is at the same place share the same error. Adding to each covariance the place's variance
    times the number of such frames gives the correct uncertainty of a sum over them. Errors that are the same at all
    places of a spot are not included. Where the widths of the spots are unknown (points of another program), the stated
    covariances are used unchanged.
    """
    if recording.width_px is None or not np.isfinite(recording.width_px).any():
        return recording
    uv, _ = model.project(recording.poses)
    usable = recording.usable & np.isfinite(uv).all(axis=-1)
    size2 = 0.5 * np.trace(recording.cov_px2, axis1=-2, axis2=-1)
    residual = np.where(usable[..., None], (recording.uv_px - uv) / np.sqrt(size2)[..., None], np.nan)
    frames, n = usable.shape
    found = place_errors(residual, recording.uv_px, recording.width_px, np.ones(frames), np.zeros(n))
    share = max(found.share - found.elsewhere, 0.0)
    if share == 0.0:
        return recording
    added = np.zeros(usable.shape)
    for view in range(n):
        rows = np.flatnonzero(usable[:, view])
        if not len(rows):
            continue
        width = recording.width_px[view] if np.isfinite(recording.width_px[view]) else np.nanmedian(recording.width_px)
        square = np.mean(np.sum((recording.uv_px[rows, view] - uv[rows, view]) ** 2, axis=-1)) / 2
        # An error larger than texture and speckle can cause is a displacement.
        place = min(share * max(square, size2[rows, view].mean()), (LARGEST_WIDTH_SHARE * width) ** 2)
        for some in np.array_split(rows, len(rows) // _CHUNK + 1):
            at = recording.uv_px[some, view]
            rho = correlation(np.linalg.norm(at[:, None] - at[None], axis=-1), found.reach_px[view])
            # The other chunks are assumed to be like this one.
            added[some, view] = place * rho.sum(axis=1) * len(rows) / len(some)
    return replace(recording, cov_px2=recording.cov_px2 + added[..., None, None] * np.eye(2))
