"""What happens on surfaces: landing, sliding, cover, wetness, matter so thick that it moves as a whole."""
