"""The frozen scene: Gaussians, cameras and the metric frame, from every kind of file that holds them."""
