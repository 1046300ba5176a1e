"""Features, matchers, and matching of all pairs of a dataset into a store."""
