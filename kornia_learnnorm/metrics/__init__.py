"""Metrics of estimates: better rate, pairs and poses."""
