"""The model check of a run: frames sampled from the run, the test (calibration/model_check), findings and summary."""
