"""Plots as SVG text: elements, scales, axes, series over time, histograms, maps with contour lines."""
