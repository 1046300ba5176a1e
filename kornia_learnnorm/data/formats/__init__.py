"""Stores of correspondences to and from file formats of other packages."""
