"""From correspondences to matrices: linear and learned layers, their stages, refinement."""
