"""The columns of every table that a run reads or writes, in order."""

from __future__ import annotations

DETECTIONS = (
    "frame", "camera", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "flux", "peak", "major_px", "minor_px",
    "angle_deg", "cov_uv_px2",
)  # fmt: skip
PICTURE_TIME = "t_s"  # after the others, where a camera has a clock of its own: mid-exposure of its middle row
PICTURES = "pictures"  # after the others, of a row of a watched run whose cameras have clocks: `camera:number ...`
LIKENESS = "likeness"  # after the others, of single pictures only: see lab.runs.detect.picture_series.laser_likeness
SPOTS = (
    "frame", "t_s", "camera", "spot", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "status", "predicted_u_px",
    "predicted_v_px", "gain", "cov_uv_px2", "label_probability",
)  # fmt: skip
BEAMS = ("frame", "t_s", "beam", "dx", "dy", "dz", "px_m", "py_m", "pz_m", "status")
ATTITUDE = (
    "frame", "t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "yaw_deg", "pitch_deg", "roll_deg",
    "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg",
    "spots_used", "rms_px", "status",
    "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s", "rate_x_rad_s", "rate_y_rad_s", "rate_z_rad_s",
    "sigma_velocity_x_m_s", "sigma_velocity_y_m_s", "sigma_velocity_z_m_s",
    "sigma_rate_x_rad_s", "sigma_rate_y_rad_s", "sigma_rate_z_rad_s",
)  # fmt: skip
WHOLE = ("frame", "spots_used")  # columns of whole numbers
POSE = ATTITUDE[2:18]  # the pose: position, quaternion, angles and their sigmas
MOTION = ATTITUDE[21:]  # velocity of the body origin, in world; rate about the body's axes; their sigmas
ADDED = frozenset({"label_probability", *MOTION})  # to the contract's columns: nan in a table that does not have them
COVARIANCE = ("frame", *(f"c{i}{j}" for i in range(6) for j in range(i, 6)))
BUDGET = (
    "frame", "place_share", *(f"turn_{name}" for name in ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")),
    *(f"clock_{name}" for name in COVARIANCE[1:]),
)  # fmt: skip
TRUTH_POSE = ("frame", "t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
TRUTH_SPOTS = ("frame", "camera", "spot", "u_px", "v_px", "in_view")
TIMES = ("frame", "t_s")
CAUSAL = "_causal"  # suffix of the tables of the causal filter; the tables without it are smoothed
