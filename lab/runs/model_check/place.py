"""Errors that belong to places on the screen, in the model check: over a vehicle at rest they look like faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.forward_model import SpotModel
from lab.runs.model_check.recording import ModelCheckRecording
from tracking.smoothing.error_scale import LARGEST_WIDTH_SHARE
from tracking.smoothing.place_errors import correlation, place_errors

_CHUNK = 500  # frames that are compared with each other


def with_place_errors(recording: ModelCheckRecording, model: SpotModel) -> ModelCheckRecording:
    """The recording with covariances that allow for such errors in tests that sum over its frames.

    Frames in which a spot is in the same place hold the same error: a covariance of noise plus so many times that of
    the place makes a sum over them as uncertain as it is. What is the same in all places of a spot is none of it. Where
    the widths of the spots are not known (points of another program) the claims are believed.
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
        # What is farther off than texture and speckle explain has moved.
        place = min(found.few * share * max(square, size2[rows, view].mean()), (LARGEST_WIDTH_SHARE * width) ** 2)
        for some in np.array_split(rows, len(rows) // _CHUNK + 1):
            at = recording.uv_px[some, view]
            rho = correlation(np.linalg.norm(at[:, None] - at[None], axis=-1), found.reach_px[view])
            # The other chunks are taken to be like this one.
            added[some, view] = place * rho.sum(axis=1) * len(rows) / len(some)
    return replace(recording, cov_px2=recording.cov_px2 + added[..., None, None] * np.eye(2))
