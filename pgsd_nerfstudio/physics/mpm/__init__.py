"""The dense regime: water, elastic bodies, snow and sand that touch themselves and obstacles."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # read when Taichi is imported

from pgsd_nerfstudio.physics.mpm.config import MpmConfig, Sleep
from pgsd_nerfstudio.physics.mpm.layout import ACTIVE, REMOVED, RESTING
from pgsd_nerfstudio.physics.mpm.materials import Elastic, Matter, Sand, Snow, Water
from pgsd_nerfstudio.physics.mpm.obstacle import Obstacle
from pgsd_nerfstudio.physics.mpm.report import Report
from pgsd_nerfstudio.physics.mpm.solver import Mpm
from pgsd_nerfstudio.physics.mpm.stability import Unstable

__all__ = [
    "ACTIVE",
    "REMOVED",
    "RESTING",
    "Elastic",
    "Matter",
    "Mpm",
    "MpmConfig",
    "Obstacle",
    "Report",
    "Sand",
    "Sleep",
    "Snow",
    "Unstable",
    "Water",
]
