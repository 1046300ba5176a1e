"""Metrics of estimates: better rate, pairs, poses, and their torchmetrics modules."""
