"""`beampose compare`: a result against another result or a reference; tables and a report."""
