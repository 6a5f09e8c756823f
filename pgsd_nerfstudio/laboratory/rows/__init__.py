"""One module for each room that offers figures, and what they share."""
