"""Plots in SVG text: axes, lines, bands, shading."""
