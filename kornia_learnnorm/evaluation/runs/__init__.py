"""Predictions of methods on stores, computed once and kept in a folder."""
