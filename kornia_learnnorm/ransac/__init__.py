"""Robust estimation: RANSAC, samplers, scoring, constrained fit, soft RANSAC."""
