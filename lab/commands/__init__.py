"""The commands of the command line, one module per group; cli.py collects them.

A command reads arguments, calls one function of lab/ and prints its outcome. Everything can also be done from Python.
The modules import click only: each command imports the code that it runs when it is called.
"""

import os

# Before numpy is loaded: threads of the linear algebra wait for each other at the size of these matrices. `refine` of
# three recordings of 150 frames on two processors: 10.3 s of process time with one thread, 17.4 s with two.
for _library in ("OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
