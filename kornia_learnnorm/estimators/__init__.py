"""From correspondences to fundamental matrices: linear, refined, minimal."""
