"""Recordings of a lab that does not exist, with truth: for tests, studies and the sample runs."""
