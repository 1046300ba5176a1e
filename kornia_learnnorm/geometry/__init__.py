"""Pure functions on tensors: input checks, linear algebra of the DLT, epipolar distances, transforms, rank 2."""
