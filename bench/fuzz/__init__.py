"""Fuzzing: valid inputs of every kind, damaged at random, must end in a result or in one plain line.

    python -m bench.fuzz --inputs 3000 --seed 1

A case passes if the command ends within 20 s, without a traceback, with an exit status of the contract, with few lines
on stderr, and if no table that it writes holds a number that is not finite.
"""
