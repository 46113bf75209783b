"""The usual mistakes of setting up: changes of the rig or of its pictures that a recording can be tested with."""
