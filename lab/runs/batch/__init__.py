"""Many runs in one command: list of runs, result folders, worker processes, resumption, batch.csv."""
