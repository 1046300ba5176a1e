"""Robust estimation: RANSAC, samplers, scoring, local optimisation, last fit, soft RANSAC."""
