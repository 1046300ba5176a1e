"""The models: all that a layer, the optimiser or RANSAC must know of a matrix between two views, one file each."""
