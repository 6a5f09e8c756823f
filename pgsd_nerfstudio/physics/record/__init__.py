"""What is kept of a simulation: chunks while it runs, then the history of every particle."""
