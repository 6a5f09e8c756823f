"""Physics of the air: wind, particles that enter, flight, splashes, and the air that cameras can see."""
