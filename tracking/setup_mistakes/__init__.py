"""The usual mistakes of setting up, each as a change of the rig or of the pictures that a recording can be tested with."""
