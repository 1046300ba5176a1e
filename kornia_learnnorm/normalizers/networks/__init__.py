"""Permutation-invariant networks that predict the parameters of both transforms."""
