"""Read cameras and photographs of a capture, from the files that nerfstudio, COLMAP and Inria's trainer write."""
