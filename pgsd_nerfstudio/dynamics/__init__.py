"""LEARNED: the neural dynamics field, rolled out over time from the simulated motion."""

from pgsd_nerfstudio.dynamics.field import DeltaBounds, DynamicsField
from pgsd_nerfstudio.dynamics.look import LearnedLook
from pgsd_nerfstudio.dynamics.regularizers import RegularizationWeights, drift, regularization
from pgsd_nerfstudio.dynamics.rollout import RolledFrame, Rollout

__all__ = [
    "DeltaBounds",
    "DynamicsField",
    "LearnedLook",
    "RegularizationWeights",
    "RolledFrame",
    "Rollout",
    "drift",
    "regularization",
]
