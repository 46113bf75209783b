"""The files, commands and reports of the program: from a run folder to tables and reports."""
