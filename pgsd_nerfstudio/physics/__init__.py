"""What moves: reference trajectories of weather particles, the motion prior."""

from pgsd_nerfstudio.physics.clock import Clock, Domain, domain_of
from pgsd_nerfstudio.physics.history import ParticleHistory, Window
from pgsd_nerfstudio.physics.prior import motion_prior, summary
from pgsd_nerfstudio.physics.simulate import MAX_PARTICLES, simulate
from pgsd_nerfstudio.physics.wind import WindField

__all__ = [
    "MAX_PARTICLES",
    "Clock",
    "Domain",
    "ParticleHistory",
    "WindField",
    "Window",
    "domain_of",
    "motion_prior",
    "simulate",
    "summary",
]
