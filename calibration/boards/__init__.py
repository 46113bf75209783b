"""Types of calibration boards, their printed patterns and their detection."""
