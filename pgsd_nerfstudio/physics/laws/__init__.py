"""Laws of weather: terminal speeds, sizes and numbers of particles, and the wind near the ground."""
