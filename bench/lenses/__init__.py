"""Benches of lens calibration from photographs: real ones, and rendered ones with exact truth."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does
