"""Records of a simulation: its chunks while it runs, then the history of every particle."""
