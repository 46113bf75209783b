"""The commands of the command line, one module per group; cli.py collects them.

A command reads arguments, calls one function of lab/ and prints its outcome. Everything can also be done from Python.
The modules import click only: each command imports the code that it runs when it is called.
"""
