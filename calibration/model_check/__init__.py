"""Tests of a rig against one recording, and identification of the fault that a discrepancy points to."""
