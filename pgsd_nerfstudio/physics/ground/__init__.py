"""Physics on surfaces: landing, sliding, cover, wetness and dense matter."""
