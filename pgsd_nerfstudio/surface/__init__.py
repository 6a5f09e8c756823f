"""The surface of a scene, on which particles land: a triangle mesh in metres, and the signed distance to it."""

from pgsd_nerfstudio import vectors as vectors  # before the first kernel
