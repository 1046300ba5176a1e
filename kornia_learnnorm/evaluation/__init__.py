"""Measuring estimates: predictions, tables and figures."""
