"""Renderers of drogues that share no code with those of the training and of the figures."""
