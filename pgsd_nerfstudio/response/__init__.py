"""ANSWERS: how the frozen scene looks under the weather, as a function of Gaussians and time."""
