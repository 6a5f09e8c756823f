"""What happens in the air: wind, what comes in, flight, what cameras can see of it."""
