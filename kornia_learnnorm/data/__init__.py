"""Correspondences: from image sequences, from synthetic scenes and from rendered pairs with exact ground truth."""
