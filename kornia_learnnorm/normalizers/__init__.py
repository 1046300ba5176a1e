"""Normalisers ``(points1, points2, weights=None) -> (T1, T2)``: closed forms and learned."""
