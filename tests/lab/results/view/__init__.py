"""Tests of the views in three dimensions."""
