"""Physics of weather particles: it simulates their trajectories, the motion prior."""

from pgsd_nerfstudio import vectors as vectors  # before the first kernel
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.clock import Clock, Domain, domain_of
from pgsd_nerfstudio.physics.metric import MAX_PARTICLES, simulate_metric
from pgsd_nerfstudio.physics.motion_prior import motion_prior, summary
from pgsd_nerfstudio.physics.record.history import ParticleHistory, Window

__all__ = [
    "MAX_PARTICLES",
    "Clock",
    "Domain",
    "ParticleHistory",
    "WindField",
    "Window",
    "domain_of",
    "motion_prior",
    "simulate_metric",
    "summary",
]
